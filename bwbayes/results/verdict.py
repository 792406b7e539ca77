"""Whether bands hold on a record: the verdict that stands first on screen and report.

Bands are held against the readings in three ways: how many readings they cover, how large the
residuals are, and whether the residuals lean to one side. What luck alone may do to these three
depends on how many independent readings a record is worth, and that is far fewer than it has: its
discrepancy forgets slowly, and the parameters' error is one and the same all along. The bands
themselves say how large each part is, so that the number follows from the model
(:mod:`bwbayes.results.standard`). Validation fails where luck would do it in one of 5,000 good
records, and is inconclusive where it would in one of a hundred, or where the record is worth too
few readings. A fit is judged on its own readings too. There the noise model grows until it covers
whatever the model misses, so that a fit fails when it misses more than a part of the displacement's
range.

A verdict that fails names the likeliest cause (:mod:`bwbayes.results.causes`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from bwbayes.arrays import BoolArray, FloatArray
from bwbayes.inference.posterior import Posterior
from bwbayes.results.bands import Bands, titled
from bwbayes.results.causes import Cause, Residuals, cause, drifts, likeliest
from bwbayes.results.departures import (
    ALARM,
    coverage,
    leaning,
    locally,
    missed,
    percent,
    size,
    too_wide,
)
from bwbayes.results.drift import Drift
from bwbayes.results.extrapolation import Extrapolation
from bwbayes.results.innovations import OddStart
from bwbayes.results.standard import Z_90, Standard, standardised
from bwbayes.results.transient import DOUBTED, Transient
from bwbayes.shown import brief

__all__ = ["STATUSES", "Background", "Verdict", "assess"]

# Worth fewer independent readings than this a record cannot show that bands hold.
FEWEST = 5.0

# The quantile of the discrepancy's time that the judgement goes by: rather too long than too short.
LONG = 0.9

# A lead-in whose test says less than this does not fit.
LEAD_IN_ALARM = 0.002

# A transient is so many times as large as the sensor band's sd, since smaller ones hardly move a
# parameter by more than the band allows; one in a lead-in is no larger than so many of the largest
# residuals after it.
LEAST_SDS, MOST_RESIDUALS = 3.0, 3.0

# Part of the readings' range that is left of a transient when it has ended.
FADED = 0.002

# Part of the bands' variance that an offset from a lead-in of sufficient length has.
SETTLED = 0.15


@dataclass(frozen=True)
class Background:
    """What a verdict needs to know of the fit, besides the bands.

    Parameters
    ----------
    memory
        Correlation time of the discrepancy, s; to be on the safe side, a high quantile of its
        posterior. Zero without a discrepancy.
    unsure
        Sd of the logarithm of the noise's sd over the draws: how well its size is known.
    fitted
        Lowest and highest voltage that was fitted, V.
    extent
        Range of all readings of a record that were fitted, um, whatever their windows.
    """

    __repr__ = brief

    memory: float = 0.0
    unsure: float = 0.0
    fitted: tuple[float, float] = (-np.inf, np.inf)
    extent: float = 0.0

    @classmethod
    def of(cls, posterior: Posterior, draws: FloatArray) -> Background:
        """Return what a posterior and its draws (draws, free) say."""
        memory, unsure = [], []
        for _, alone, its in posterior.each(draws):
            one = alone.only
            noise = one.table.noise(alone.prior.theta(its))
            memory.append(float(np.quantile(one.noise.memory(noise), LONG)))
            sds = one.noise.marginal_sd(noise)
            unsure.append(float(np.std(np.log(np.sqrt(sum(sd**2 for sd in sds))))))
        every = posterior.datasets
        voltage = np.concatenate([one.voltage[window] for one in every for window in one.training])
        return cls(
            max(memory),
            max(unsure),
            (float(voltage.min()), float(voltage.max())),
            max(one.extent for one in every),
        )


# How a validation came out, in a word.
STATUSES = {True: "passed", False: "failed", None: "inconclusive"}


@dataclass(frozen=True)
class Verdict:
    """Whether bands hold on one record or window.

    Attributes
    ----------
    name, training, separate
        Those of the bands.
    holds
        False if the bands fail one of the tests; None if luck may have passed or failed them, or
        the record is too short to tell.
    reasons
        What is off and by how much, one line each, the most telling first; of None, why nothing can
        be told.
    cause
        The likeliest cause with its fix, if the bands do not hold.
    notes
        What else is to be known of the record, and decides nothing.
    """

    __repr__ = brief

    name: str
    training: bool
    holds: bool | None
    reasons: tuple[str, ...] = ()
    cause: Cause | None = None
    notes: tuple[str, ...] = ()
    separate: bool = False

    @property
    def status(self) -> str:
        """The outcome in a word."""
        return STATUSES[self.holds]

    @property
    def where(self) -> str:
        """Name and kind of the record."""
        return titled(self.name, training=self.training, separate=self.separate)

    @property
    def line(self) -> str:
        """The verdict in one line, without its status."""
        why = "".join(f": {reason}" for reason in self.reasons[:1])
        return f"{self.where}{why}" + ("" if self.cause is None else f". {self.cause.line}")

    @property
    def summary(self) -> dict[str, object]:
        """The verdict as ``validation.NAME`` in summary.json has it."""
        return {
            "holds": self.holds,
            "verdict": self.line,
            "reasons": list(self.reasons),
            "cause": None if self.cause is None else self.cause.kind,
            "remedy": None if self.cause is None else self.cause.remedy,
            "notes": list(self.notes),
        }


def assess(
    bands: Bands,
    background: Background,
    *,
    start: OddStart | None = None,
    transient: Transient | None = None,
    drift: Drift | None = None,
    beyond: Sequence[Extrapolation] = (),
) -> Verdict | None:
    """Judge bands by the readings after ``scored_from``; None if there are none.

    A good record, one that the fitted model describes, fails with a probability below 1 %.

    Parameters
    ----------
    bands
        Bands with readings.
    background
        What is known of the fit.
    start
        Of a fitted record, a start that does not go with the rest.
    transient
        Of a fitted record, a transient at its start that the fit has swallowed.
    drift
        Of a fitted record, a drift that the fit has swallowed.
    beyond
        In what the record's drive leaves the one that was fitted.
    """
    if bands.measured is None:
        return None
    judged = np.isfinite(bands.measured)
    judged[: bands.scored_from] = False
    if not judged.any():
        return None
    standard = standardised(bands, judged, background.memory, background.unsure)
    residuals = Residuals.of(bands, judged, background.fitted)
    chances = [
        *coverage(bands, judged, standard),
        *size(standard),
        *leaning(bands, judged, standard),
    ]
    reasons = [
        *residuals.reversed,
        *_odd(start),
        *([transient.line] if transient and transient.sure else []),
        *([drift.line] if drift else []),
        *(text for text, chance in chances if chance < ALARM),
        *locally(bands, judged, standard),
        *(missed(bands, judged, background.extent) if bands.training else []),
        *residuals.isolated,
        *too_wide(standard),
    ]
    verdict = Verdict(bands.name, bands.training, True, separate=bands.separate)
    verdict = replace(verdict, notes=_lead_in(bands, judged))
    if reasons:
        sure = transient if transient and transient.sure else None
        why = _why(bands, residuals, reasons, start, sure, drift, beyond)
        return replace(verdict, holds=False, reasons=tuple(reasons), cause=why)
    advice = _offset_advice(bands, judged, standard)
    doubts = [f"{text}, which may be luck (p = {chance:.1g}){advice}" for text, chance in chances]
    if transient and _in_sds(bands, transient.size) > LEAST_SDS:
        doubts.append(transient.line)
    if standard.worth < FEWEST:
        doubts.append(
            f"effective sample size {standard.worth:.1f} is too small to validate the bands; "
            f"use a record {FEWEST / standard.worth:.2g} times as long"
        )
    if doubts:
        return replace(verdict, holds=None, reasons=tuple(doubts))
    return verdict


def _why(
    bands: Bands,
    residuals: Residuals,
    reasons: Sequence[str],
    start: OddStart | None,
    transient: Transient | None,
    drift: Drift | None,
    beyond: Sequence[Extrapolation],
) -> Cause:
    """Return the likeliest cause of bands that do not hold."""
    if "times too wide" in reasons[0]:
        return cause("noise", residuals)
    why = likeliest(residuals)
    lead = bands.lead_in
    unfit = lead is not None and lead.p_value < LEAD_IN_ALARM
    if unfit and why.kind in ("start", "offset", "noise", "unknown"):
        why = cause("lead-in", residuals)
    if (start or transient) and why.kind not in ("sign", "outliers"):
        until = -np.inf if start is None else start.until
        if transient is not None:
            assert bands.measured is not None
            smallest = FADED * float(np.nanmax(bands.measured) - np.nanmin(bands.measured))
            times = np.log(max(abs(transient.size) / smallest, 1.0))
            until = max(until, float(bands.time[0]) + transient.decay * times)
        # A start that is off bends the fit, and looks like a drift that ends soon.
        if why.kind != "drift" or not drifts(residuals, until):
            why = cause("start", residuals, until)
    if drift and why.kind not in ("sign", "outliers", "start"):
        why = cause("drift", residuals)
    # Creep widens loops, and is too small for another gain or a delay.
    creeps = why.kind in ("loop", "noise", "unknown")
    far = [one for one in beyond if creeps or one.kind in ("range", "speed")]
    if far and (creeps or why.kind in ("gain", "delay")):
        return Cause("extrapolation", f"extrapolation: {far[0].line}", far[0].fix)
    return why


def _odd(start: OddStart | None) -> list[str]:
    """Say that the start of a fitted record does not go with the rest."""
    if start is None:
        return []
    return [
        f"the first readings, until {start.until:.4g} s, do not go with the rest "
        f"({start.size:.2g} SDs)"
    ]


def _lead_in(bands: Bands, judged: BoolArray) -> tuple[str, ...]:
    """Note that the lead-in does not fit, or may hold a transient."""
    lead = bands.lead_in
    if lead is None:
        return ()
    notes = []
    if lead.p_value < LEAD_IN_ALARM:
        notes.append(
            f"the lead-in of {lead.start:.4g} to {lead.stop:.4g} s does not fit the model "
            f"({p_value(lead.p_value)})"
        )
    transient = lead.transient
    if transient and transient.nats > DOUBTED and _in_sds(bands, transient.size) > LEAST_SDS:
        assert bands.measured is not None
        largest = float(np.max(np.abs(bands.measured - bands.mean)[judged]))
        if abs(transient.size) <= MOST_RESIDUALS * largest:
            notes.append(transient.line(lead.start))
    return tuple(notes)


def _in_sds(bands: Bands, size: float) -> float:
    """Return how many of the sensor band's sds a transient is large."""
    width = bands.upper["sensor", 90] - bands.lower["sensor", 90]
    return abs(size) * 2 * Z_90 / float(np.mean(width))


def _offset_advice(bands: Bands, judged: BoolArray, standard: Standard) -> str:
    """Name a large share of the offset in the variance, and the lead-in that makes it small."""
    lead = bands.lead_in
    if lead is None or standard.common <= SETTLED:
        return ""
    # The variance of a mean of correlated readings falls with their time.
    length = (lead.stop - lead.start) * standard.common / SETTLED
    left = float(np.ptp(bands.time[judged])) / 2
    longer = f"lead_in = {length:.2g}" if length < left else f"a record of {3 * length:.2g} s"
    return (
        f"; the offset, estimated from a lead-in of {lead.stop - lead.start:.3g} s, makes "
        f"{percent(standard.common)} of the band's variance; use {longer} for {percent(SETTLED)}"
    )


def p_value(p: float) -> str:
    """Return a p-value as it is printed."""
    return f"p = {p:.2g}" if p >= 0.001 else "p < 0.001"
