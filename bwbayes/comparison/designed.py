"""A design: candidates for the next record, ranked by what each would leave, and what is shown.

The numbers are those of :func:`~bwbayes.comparison.design.promises`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from typing import ClassVar, overload

import numpy as np

from bwbayes.arrays import FloatArray
from bwbayes.diagnosis.validation import ValidationSummary
from bwbayes.model.limits import Limits
from bwbayes.record.record import Record
from bwbayes.report.report import (
    Banner,
    Facts,
    Picture,
    Product,
    Report,
    Section,
    Table,
    TableColumn,
    kind_of,
    remarks_banner,
    standing_banner,
)
from bwbayes.shown import brief


@dataclass(frozen=True)
class DesignScore:
    """Expected remaining standard deviation of a candidate signal.

    Attributes
    ----------
    name
        The candidate's name.
    sd_ratio
        The part of the standard deviation that would be left: of the parameter, or of the
        parameter band's mean width along the chosen drive; nan if it is refused.
    error
        Its Monte Carlo error.
    refused
        Why the amplifier cannot make it; empty if it can.
    """

    __repr__ = brief

    name: str
    sd_ratio: float
    error: float
    refused: str = ""


@dataclass(frozen=True)
class RivalScore(DesignScore):
    """The score of a candidate signal for telling a model from its rivals, by their difference.

    Attributes
    ----------
    difference_um
        Root mean square difference of the rivals from the model along it, um.
    sd_um
        Sd of a reading along it, as the model's bands have it without the rivals, um.
    told_apart
        Part of the pairs of models whose evidence would differ by odds of more than twenty to one,
        if it was fitted as well.
    """

    difference_um: float = np.nan
    sd_um: float = np.nan
    told_apart: float = np.nan


@dataclass(frozen=True)
class Design(Product, Sequence[DesignScore]):
    """Candidates for the next measurement, from a run: a sequence of their scores.

    Attributes
    ----------
    run
        The name of the run that is started from.
    parameter, drive
        Target: a parameter, or the band along a drive of that name.
    amplifier
        Limits of the amplifier.
    signals
        The candidates' voltages (samples,) by name, V.
    interval
        Their sampling interval, s.
    standing
        How the validation of the run came out.
    scores
        The score of each candidate, the best first; the first is not refused.
    """

    NAME: ClassVar[str] = "design"
    __repr__ = brief

    run: str
    parameter: str | None
    drive: str | None
    amplifier: Limits
    signals: Mapping[str, FloatArray]
    interval: float
    standing: ValidationSummary
    scores: Sequence[DesignScore]

    @overload
    def __getitem__(self, index: int) -> DesignScore: ...
    @overload
    def __getitem__(self, index: slice) -> Sequence[DesignScore]: ...
    def __getitem__(self, index: int | slice) -> DesignScore | Sequence[DesignScore]:
        return self.scores[index]

    def __len__(self) -> int:
        return len(self.scores)

    @property
    def best(self) -> DesignScore:
        """The best candidate."""
        return self.scores[0]

    @property
    def quantity(self) -> str:
        """The quantity whose remaining SD the scores are, in words."""
        if self.parameter is not None:
            return f"sd left of {self.parameter}"
        return f"width left of the band along {self.drive}"

    @property
    def tied(self) -> list[str]:
        """The candidates that cannot be told apart from the best."""
        best = self.best
        return [
            score.name
            for score in self.scores[1:]
            if score.sd_ratio - best.sd_ratio < 2 * float(np.hypot(score.error, best.error))
        ]

    def records(self) -> dict[str, Record]:
        """Return the best signal as a record that a signal generator can play."""
        best = self.signals[self.best.name]
        return {"best": Record(best, None, interval=self.interval, voltage_is="command")}

    def numbers(self) -> dict[str, object]:
        """Return what ``design.json`` holds."""
        return {
            "validation": self.standing.numbers,
            "target": self.parameter or self.drive or "",
            "best": self.best.name,
            "amplifier": asdict(self.amplifier),
            "candidates": [asdict(score) for score in self.scores],
        }

    def report(self) -> Report:
        """Return which signal teaches most, by how much, and what it looks like, to be shown."""
        from bwbayes.report.figures.products import draw_promises  # noqa: PLC0415
        from bwbayes.report.figures.series import record_pictures  # noqa: PLC0415

        best, amplifier = self.best, self.amplifier
        feasible = [score for score in self.scores if not score.refused]
        names = [score.name for score in feasible]
        remaining, error = np.array([(p.sd_ratio, p.error) for p in feasible]).T
        lines = [
            f"{self.quantity} after one more record of it: {best.sd_ratio:.1%} ± {best.error:.1%}"
        ]
        if self.tied:
            lines.append(f"indistinguishable from it: {', '.join(self.tied)}")
        limits = amplifier.low, amplifier.high
        rate = f", at most {amplifier.rate:.4g} V/s" if np.isfinite(amplifier.rate) else ""
        facts = [
            ("Run", self.run),
            ("Target", self.quantity.replace(" left", "")),
            ("Amplifier", "{:.4g} to {:.4g} V".format(*limits) + rate),
            ("Sampling interval", f"{self.interval:g} s"),
        ]
        signal = record_pictures(self.records()["best"], (), ())["time"]
        shown = "Its voltage, as best.csv has it for the signal generator."
        return Report(
            title="What to measure next",
            banners=[
                *standing_banner(self.standing),
                Banner(kind_of(self.standing), f"Best: {best.name}", lines),
                *remarks_banner(
                    [f"{p.name} {p.refused}" for p in self.scores if p.refused],
                    "What the amplifier cannot make",
                ),
            ],
            blocks=[
                self._table(),
                Picture(
                    "promises",
                    "What each candidate would leave",
                    "The part that is expected to be left after one more record, with two Monte "
                    "Carlo errors to either side; at 100% a signal teaches nothing new.",
                    partial(draw_promises, names, remaining, error, self.quantity),
                ),
                replace(signal, name="best", title=f"The best signal: {best.name}", caption=shown),
                Section("Request", [Facts(facts)], folded=False),
            ],
            numbers=self.numbers(),
        )

    def _table(self) -> Table:
        rows = []
        for score in self.scores:
            voltage = self.signals[score.name]
            fastest = float(np.max(np.abs(np.diff(voltage)))) / self.interval
            numbers = (score.sd_ratio, score.error)
            rows.append(
                (
                    score.name,
                    *("–" if score.refused else f"{number:.1%}" for number in numbers),
                    f"{voltage.min():.4g} V",
                    f"{voltage.max():.4g} V",
                    f"{fastest:,.0f} V/s",
                    f"{self.interval * voltage.size:.4g} s",
                )
            )
        signal = (
            TableColumn(title, on="page") for title in ("Lowest", "Highest", "Fastest", "Length")
        )
        return Table(
            "candidates",
            self.quantity.capitalize()
            if self.parameter is None
            else f"SD left of {self.parameter}",
            ("Candidate", "Left", "Error", *signal),
            rows,
            records=[asdict(score) for score in self.scores],
            note="The error is that of Monte Carlo. Expected from the posterior's draws, with the "
            "model made linear in its parameters at each: what a fit would gain from a new record "
            "with an offset and an initial state of its own (none where the record that was fitted "
            "starts from rest). The noise model is trusted: what the model is wrong about returns "
            "each time that a signal repeats itself.",
            on="both",
        )


@dataclass(frozen=True)
class RivalDesign(Design):
    """Candidates that tell a model from its rivals: a record to validate on, one to train on."""

    __repr__ = brief

    scores: Sequence[RivalScore]

    @property
    def validation(self) -> RivalScore:
        """The candidate along which rivals differ most."""
        return max(
            (score for score in self.scores if not score.refused),
            key=lambda score: score.difference_um,
        )

    @property
    def training(self) -> RivalScore:
        """The candidate that would leave least of the rivals' differences, if it was fitted."""
        return self.scores[0]

    @property
    def quantity(self) -> str:
        """The quantity whose remaining part the scores are, in words."""
        return "difference of rivals left"

    def records(self) -> dict[str, Record]:
        """Return both signals as records that a signal generator can play."""
        return {
            name: Record(
                self.signals[score.name], None, interval=self.interval, voltage_is="command"
            )
            for name, score in (("validate", self.validation), ("train", self.training))
        }

    def numbers(self) -> dict[str, object]:
        """Return what ``design.json`` holds."""
        return {
            **super().numbers(),
            "validate": self.validation.name,
            "train": self.training.name,
        }

    def report(self) -> Report:
        """Return which signals tell the model from its rivals, and by how much, to be shown."""
        from bwbayes.report.figures.series import record_pictures  # noqa: PLC0415

        validation, training = self.validation, self.training
        seconds = self.interval * self.signals[validation.name].size
        differ = (
            f"along it rivals differ from the model by {validation.difference_um:.2g} um, "
            f"{validation.difference_um / validation.sd_um:.2g} times the SD of a reading"
        )
        training_text = (
            f"fitted, too, it would leave {training.sd_ratio:.0%} of the rivals' differences, and "
            f"tell {training.told_apart:.0%} of all pairs of models apart"
        )
        files = {
            "validate": f"Validation record: {validation.name}",
            "train": f"Training record: {training.name}",
        }
        pictures = [
            replace(
                record_pictures(record, (), ())["time"],
                name=name,
                title=files[name],
                caption=f"Its voltage, as {name}.csv has it for the signal generator.",
            )
            for name, record in self.records().items()
        ]
        facts = [
            ("Run", self.run),
            ("Voltages", f"{self.amplifier.low:.4g} to {self.amplifier.high:.4g} V"),
            ("Fastest", f"{self.amplifier.rate:.4g} V/s"),
            ("Sampling interval", f"{self.interval:g} s"),
        ]
        return Report(
            title="What to measure next",
            banners=[
                *standing_banner(self.standing),
                Banner(
                    kind_of(self.standing),
                    f"Validate on: {validation.name}, {seconds:.3g} s",
                    [differ],
                ),
                Banner("note", f"Train on: {training.name}", [training_text]),
                *remarks_banner(
                    [f"{p.name} {p.refused}" for p in self.scores if p.refused],
                    "What the amplifier cannot make",
                ),
            ],
            blocks=[
                self._rivals_table(),
                *pictures,
                Section("Request", [Facts(facts)], folded=False),
            ],
            numbers=self.numbers(),
        )

    def _rivals_table(self) -> Table:
        rows = []
        for score in self.scores:
            cells = (
                f"{score.difference_um:.2g} um",
                f"{score.difference_um / score.sd_um:.2g}",
                f"{score.sd_ratio:.0%}",
                f"{score.told_apart:.0%}",
            )
            rows.append((score.name, *("–" if score.refused else cell for cell in cells)))
        columns = ("Candidate", "Rivals differ by", "Over SD", "Left if fitted", "Told apart")
        return Table(
            "candidates",
            "Rivals along the candidates",
            columns,
            rows,
            records=[asdict(score) for score in self.scores],
            note="Rivals are models of other families that fit the training record about as well. "
            "Over SD: their difference from the model, over the SD of a reading without them. Left "
            "if fitted: the part of all differences between models that would be left if the "
            "candidate was fitted as well; told apart: the part of the pairs of models whose "
            "evidence would differ by odds of more than twenty to one.",
            on="both",
        )
