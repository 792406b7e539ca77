"""Validation of bands on a record: the first result on the screen and in the report.

Bands are compared with the readings in three ways: coverage, size of the residuals, and bias
(:mod:`bwbayes.diagnosis.departures`). Validation fails on a departure that chance causes in one of
5,000 good records, and is inconclusive on one in a hundred, or if the record has too small an
effective sample size. A fit is validated on its own readings, too. There the noise model grows
until it covers any residual, so that a fit fails if the residual exceeds a part of the
displacement's range.

A failed validation names the likely cause: on fitted readings the explanation with the best
evidence (:mod:`bwbayes.diagnosis.explanations`), on others the shape that explains the residuals
(:mod:`bwbayes.diagnosis.departures`). A fit has not passed, whatever its bands cover, if the best
explanation is an effect that does not come from the actuator, such as a transient, a drift or
outliers: the parameters may have followed it. It has not passed either if a better model is known:
held-out readings have the drive of the fitted ones, and there a discrepancy takes up the model's
error; along another drive the error has another size. For the same reason it has not passed if a
search for stages added some and left a model error all the same.

Every product of a run carries the run's :class:`ValidationSummary`: it goes first
on every page, into every file of numbers, and decides the exit status of every command.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Self

import numpy as np

from bwbayes.arrays import FloatArray
from bwbayes.diagnosis.defects import DEFECTS
from bwbayes.diagnosis.departures import LEAD_IN_ALARM, UNEXPLAINED, StandardizedResiduals, cause
from bwbayes.diagnosis.explanations import better_models, followed_causes, likely_causes
from bwbayes.diagnosis.finding import TELLING_DRIVE, Finding, join_findings
from bwbayes.diagnosis.residual_analysis import Explanation
from bwbayes.errors import ExitStatus, InputError
from bwbayes.inference.posterior import Posterior
from bwbayes.prediction.bands import Bands
from bwbayes.record.io.grid import clock
from bwbayes.shown import brief, rounded


@dataclass(frozen=True)
class ValidationContext:
    """Facts about the fit that a validation needs besides the bands.

    Parameters
    ----------
    memory
        Correlation time of the discrepancy, s; to be on the safe side, a high quantile of its
        posterior. Zero without a discrepancy.
    noise_log_sd
        Sd of the logarithm of the noise's sd over the draws: the uncertainty of its size.
    fitted
        Lowest and highest voltage that was fitted, V.
    extent
        Range of all readings of a record that were fitted, um, whatever their windows.
    """

    __repr__ = brief

    memory: float = 0.0
    noise_log_sd: float = 0.0
    fitted: tuple[float, float] = (-np.inf, np.inf)
    extent: float = 0.0

    @classmethod
    def of(cls, posterior: Posterior, draws: FloatArray) -> ValidationContext:
        """Return the context of a posterior and its draws (draws, free)."""
        memory, noise_log_sd = [], []
        for _, single, record_draws in posterior.each(draws):
            dataset = single.single_record
            noise = dataset.table.noise(single.prior.theta(record_draws))
            # Prefer a time that is too long to one that is too short.
            memory.append(float(np.quantile(dataset.noise.correlation_time(noise), 0.9)))
            variance = np.sum(np.square(dataset.noise.marginal_sd(noise)), axis=0)
            noise_log_sd.append(float(np.std(np.log(variance)) / 2))
        voltage = np.concatenate(
            [data.voltage[window] for data in posterior.datasets for window in data.training]
        )
        return cls(
            max(memory),
            max(noise_log_sd),
            (float(voltage.min()), float(voltage.max())),
            max(dataset.extent for dataset in posterior.datasets),
        )


# Outcome of a validation in a word.
STATUSES = {True: "passed", False: "failed", None: "inconclusive"}


@dataclass(frozen=True)
class BandValidation:
    """Validation of bands on one record or window.

    Attributes
    ----------
    where, training
        Title of the bands, and whether they are those of fitted readings.
    passed
        False if the bands fail one of the tests; None if the outcome may be chance, or the record
        is too short.
    reasons
        Departures and their sizes, one line each, the most important first; if ``passed`` is None,
        the reasons for that.
    cause
        The likely cause with its fix, if the bands fail, the fit has followed a foreign effect, or
        a better model is known.
    notes
        Further notes on the record, which decide nothing.
    """

    __repr__ = brief

    where: str
    training: bool
    passed: bool | None
    reasons: tuple[str, ...] = ()
    cause: Finding | None = None
    notes: tuple[str, ...] = ()

    @property
    def status(self) -> str:
        """The outcome in a word."""
        return STATUSES[self.passed]

    @property
    def line(self) -> str:
        """The result in one line, without its status."""
        why = "".join(f": {reason}" for reason in self.reasons[:1])
        return f"{self.where}{why}" + ("" if self.cause is None else f". {self.cause.line}")

    @property
    def summary(self) -> dict[str, object]:
        """The result for ``validation.NAME`` in summary.json."""
        return {
            "passed": self.passed,
            "message": self.line,
            "reasons": list(self.reasons),
            "cause": None if self.cause is None else self.cause.kind,
            "fix": None if self.cause is None else self.cause.fix,
            "notes": list(self.notes),
        }


@dataclass(frozen=True)
class ValidationSummary:
    """Validation of the bands of a run on all records and windows together.

    Attributes
    ----------
    passed
        False if they fail anywhere; else None if validation is inconclusive anywhere.
    lines
        A line for each record or window that fails, or that is inconclusive.
    """

    passed: bool | None = True
    lines: tuple[str, ...] = ()

    @classmethod
    def of(cls, validation: Iterable[BandValidation]) -> Self:
        """Summarize the validations of a run."""
        return cls._of((outcome.passed, outcome.line) for outcome in validation)

    @classmethod
    def read(cls, summary: Mapping[str, Any]) -> Self:
        """Read the validation from a converged run's ``summary.json``."""
        entries = (summary.get("validation") or {}).items()
        if any("passed" not in entry for _, entry in entries):
            raise InputError(
                "summary.json: is an earlier version's; remove it and write it by `bwbayes resume`"
            )
        return cls._of((entry["passed"], entry.get("message", name)) for name, entry in entries)

    @classmethod
    def _of(cls, answers: Iterable[tuple[bool | None, str]]) -> Self:
        entries = list(answers)
        for passed in (False, None):
            lines = tuple(line for answer, line in entries if answer is passed)
            if lines:
                return cls(passed, lines)
        return cls()

    @property
    def status(self) -> str:
        """The outcome in a word."""
        return STATUSES[self.passed]

    @property
    def exit_status(self) -> ExitStatus:
        """Exit status of a command that uses the run."""
        statuses = {False: ExitStatus.VALIDATION_FAILED, None: ExitStatus.VALIDATION_INCONCLUSIVE}
        return statuses.get(self.passed, ExitStatus.SUCCESS)

    @property
    def headline(self) -> str:
        """Title above the lines; empty if validation passed."""
        titles = {True: "", False: "VALIDATION FAILED", None: "Validation inconclusive"}
        return titles[self.passed]

    @property
    def messages(self) -> tuple[str, ...]:
        """Messages about the validation, a line each; none if it passed."""
        return tuple(f"{self.headline}: {line}" for line in self.lines)

    @property
    def numbers(self) -> dict[str, object]:
        """Status and messages for files of numbers."""
        return {"status": self.status, "messages": list(self.lines)}


def validate_bands(
    bands: Bands,
    background: ValidationContext,
    *,
    explanations: Sequence[Explanation] = (),
    beyond: Sequence[Finding] = (),
    unexplained: float | None = None,
) -> BandValidation | None:
    """Validate bands on the readings after ``scored_from``; return None without any.

    A good record, one that the fitted model describes, fails with a probability below 1%.

    Parameters
    ----------
    bands
        Bands with readings.
    background
        Facts about the fit.
    explanations
        Explanations that may describe a fitted record better, the best first.
    beyond
        Respects in which the record's drive goes beyond the fitted one.
    unexplained
        The model error, in sds of the sensor's noise, that a search for stages left without finding
        the mechanism: nobody knows how large it is on another drive.
    """
    if not bands.scored(bands.measured).any():
        return None
    standard = StandardizedResiduals.of(bands, background.memory, background.noise_log_sd)
    reasons = standard.reasons(background.fitted, background.extent)
    width = (standard.excess_width,) if bands.training and standard.excess_width else ()
    validation = BandValidation(bands.title, bands.training, True, notes=width)
    # A lead-in that does not fit is noted only if the readings after it show a departure.
    lead, doubted = bands.lead_in, validation
    off = bool(reasons or standard.chances())
    if lead is not None and lead.p_value < LEAD_IN_ALARM and off:
        span = f"{clock(lead.start, bands.interval)} to {clock(lead.stop, bands.interval)}"
        p_value = f"p = {lead.p_value:.2g}" if lead.p_value >= 0.001 else "p < 0.001"
        note = f"the lead-in of {span} s does not fit the model ({p_value})"
        doubted = replace(validation, notes=(note, *width))
    if reasons:
        missed = any(reason.startswith("NRMSE") for reason in reasons)
        mending = [explanation for explanation in explanations if explanation.mends or not missed]
        why = join_findings(likely_causes(mending))
        if why is None and reasons[0].startswith("the readings fall"):
            why = Finding("sign", *DEFECTS["sign"].in_bands)
        elif why is None:
            why = cause(bands, background.memory, beyond)
            # A fit cannot have another gain, offset or noise than its own.
            why = UNEXPLAINED if bands.training and why.kind != "outliers" else why
        return replace(doubted, passed=False, reasons=tuple(reasons), cause=why)
    doubts = [
        f"{text}, which may be luck (p = {chance:.1g}){standard.offset_advice}"
        for text, chance in standard.chances()
    ]
    better, followed = (
        join_findings(find(explanations)) for find in (better_models, followed_causes)
    )
    if followed is not None:
        doubts.append(
            "the fit may have followed what the actuator did not do "
            f"({rounded(followed.nats)} nats)"
        )
    elif better is not None:
        parts = any(explanation.spec is not None for explanation in better_models(explanations))
        remedy = '; stages = "auto" looks for it' if parts else ""
        doubts.insert(
            0, f"a better model is known ({better.kind}, {rounded(better.nats)} nats){remedy}"
        )
    elif unexplained is not None and bands.training:
        doubts.insert(
            0,
            "the search for stages did not find the mechanism: the model error is still "
            f"{unexplained:g} times the sensor's noise; {TELLING_DRIVE}",
        )
    if standard.idle and not bands.training:
        doubts.append(standard.idle)
    minimum = 5.0  # smallest effective sample size that can validate bands
    if standard.effective_size < minimum:
        doubts.append(
            f"effective sample size {standard.effective_size:.1f} is too small to validate the "
            f"bands; use a record {minimum / standard.effective_size:.2g} times as long"
        )
    return (
        replace(doubted, passed=None, reasons=tuple(doubts), cause=followed or better)
        if doubts
        else validation
    )
