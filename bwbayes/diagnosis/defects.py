"""Catalog of the possible defects of a record, its readings or its bands.

A :class:`Defect` has one name. It holds the kind of finding of the record check, the stage of the
model that describes it, the starting points of that stage's fit, and its text and fix: for a fit
with the defect, and for failing bands with it (:mod:`bwbayes.diagnosis.departures`). Each stage of
the registry has a defect, so that new stages are tried without further code.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from bwbayes.arrays import FloatArray
from bwbayes.diagnosis.innovations import innovations
from bwbayes.diagnosis.loopfit import find_delay
from bwbayes.diagnosis.residual_analysis import Explanation, ResidualAnalysis, Sighting
from bwbayes.diagnosis.series_patterns import strongest_line
from bwbayes.inference.posterior import FARTHEST_FOLLOWED
from bwbayes.inference.study import Stated
from bwbayes.model.declaration import Distribution, normal
from bwbayes.model.registry import STAGES
from bwbayes.model.stages.additions import Oscillation
from bwbayes.model.stages.lags import Delay
from bwbayes.model.stages.sensor import ReversedSign
from bwbayes.record.io.grid import clock
from bwbayes.record.record import Record


@dataclass(frozen=True)
class Defect:
    """A defect, with the stage of the model that it is, if it is one.

    Attributes
    ----------
    kind
        Its name.
    stage
        Name of the stage.
    foreign, removes, noise
        As in :class:`~bwbayes.diagnosis.residual_analysis.Explanation` and
        :class:`~bwbayes.diagnosis.finding.Finding`.
    finding
        Kind of the finding that a record check has of it.
    in_bands
        Text and fix for failing bands with the defect, with fields to fill in.
    """

    kind: str
    stage: str = ""
    foreign: bool = False
    removes: bool = False
    noise: bool = False
    finding: str = ""
    in_bands: tuple[str, str] = ("", "")

    def explanations(self, analysis: ResidualAnalysis) -> Iterator[Explanation]:
        """Fit the model with the stage to a record that does not have it yet."""
        stage, inputs = STAGES[self.stage](), analysis.posterior.single_record.inputs
        if self.stage in analysis.study.spec.chain or not all(map(inputs.has, stage.sees)):
            return
        if not (stage.rate_independent or inputs.quantities.has_clock):
            return
        flags = {"foreign": self.foreign, "removes": self.removes, "noise": self.noise}
        words = partial(self.words, analysis)
        for sighting in self.sightings(analysis):
            for explanation in analysis.changed(self.kind, words, (self.stage,), sighting, flags):
                named_only = stage.named_only or sighting.named_only
                yield replace(explanation, spec=None) if named_only else explanation

    def sightings(self, analysis: ResidualAnalysis) -> Iterator[Sighting]:  # noqa: ARG002
        """Yield the starting points for a fit of the stage."""
        yield Sighting(starts=STAGES[self.stage]().starts)

    def words(self, analysis: ResidualAnalysis, values: Mapping[str, float]) -> tuple[str, str]:  # noqa: ARG002
        """Return the text and the fix for the parameters' values by name."""
        stage = STAGES[self.stage]()
        return stage.describe(values), stage.advice


class _Transient(Defect):
    def words(self, analysis: ResidualAnalysis, values: Mapping[str, float]) -> tuple[str, str]:
        """Leave the start out, until a five-hundredth of the range is left of the transient."""
        threshold = 0.002 * analysis.extent
        until = values["transient_time"] * np.log(max(abs(values["transient"]) / threshold, 1.0))
        window = f"set exclude = [[{analysis.clock(0.0)}, {analysis.clock(until)}]] in [record]"
        settled = int(np.searchsorted(analysis.time[: analysis.voltage.size], until))
        return super().words(analysis, values)[0], settle_fix(analysis.voltage, settled, window)


class _Step(Defect):
    def sightings(self, analysis: ResidualAnalysis) -> Iterator[Sighting]:
        """Yield the time of the largest innovation; its choice among the readings has a cost.

        If readings just before it were not fitted, the largest innovation among these gives the
        time.
        """
        rows = analysis.posterior.single_record.readings.rows
        white = np.abs(analysis.innovations)
        white[: max(white.size // 50, 1)] = 0.0
        number = int(np.argmax(white))
        between = analysis.posterior.altered(training=(slice(rows[number - 1], rows[number] + 1),))
        white_between = np.abs(innovations(between, analysis.fit.free).white)[1:]
        row = between.single_record.readings.rows[1 + int(np.argmax(white_between))]
        stated = {"step_time": Stated(fixed=analysis.interval * row)}
        yield Sighting(stated, cost=float(np.log(rows.size)))

    def words(self, analysis: ResidualAnalysis, values: Mapping[str, float]) -> tuple[str, str]:
        """Name its time on the record's clock."""
        time = analysis.begin + values["step_time"]
        text, _ = super().words(analysis, {**values, "step_time": time})
        written = clock(time, analysis.interval)
        return text, f"fit one side: set train to end or begin at {written}"


class _Oscillation(Defect):
    def sightings(self, analysis: ResidualAnalysis) -> Iterator[Sighting]:
        """Yield the innovations' strongest frequency that the drive lacks, to its resolution.

        An oscillation that grows with the drive may be the actuator's own: it is only named.
        """
        rows = analysis.posterior.single_record.readings.rows
        line = strongest_line(analysis.innovations, analysis.voltage[rows], rows, analysis.interval)
        if line is not None:
            resolution = normal(line.frequency, 1 / (np.sqrt(12) * analysis.duration))
            yield Sighting(
                {"oscillation_frequency": Stated(resolution)},
                cost=float(np.log(rows.size / 2)),
                note=line.source,
                named_only=not line.is_steady,
            )


class _Sign(Defect):
    def sightings(self, analysis: ResidualAnalysis) -> Iterator[Sighting]:
        """Yield the fit of the readings with their sign changed, if they fall with the voltage.

        A delay that the model has counts: of a sine, half a period is another sign.
        """
        record = analysis.posterior.single_record
        theta = analysis.posterior.prior.theta(analysis.fit.free[np.newaxis])[0].tolist()
        values = dict(zip(analysis.posterior.table.names, theta, strict=True))
        readings, samples = record.readings, np.arange(record.voltage.size)
        late = values.get("delay", 0.0) / analysis.interval
        drive = np.interp(readings.rows - late, samples, record.voltage)
        if float((drive - drive.mean()) @ (readings.values - readings.values.mean())) < 0:
            turned = analysis.posterior.altered(displacement=-record.displacement)
            yield Sighting(places=analysis.local_minima(turned))


class _Delay(Defect):
    def words(self, analysis: ResidualAnalysis, values: Mapping[str, float]) -> tuple[str, str]:
        """Return the text, and the column to move as the fix."""
        fix = late_fix(values["delay"], analysis.interval / analysis.stride)
        return super().words(analysis, values)[0], fix


class _LongDelay(_Delay):
    def sightings(self, analysis: ResidualAnalysis) -> Iterator[Sighting]:
        """Yield a delay up to a quarter of a period, estimated by a fit of loops.

        The fits start from the modes for readings that are moved back by it.
        """
        record = analysis.posterior.single_record
        prior = Delay.parameters[0].default(analysis.study.contexts[""])
        assert isinstance(prior, Distribution)
        sd = prior.arguments["sd"]
        limit = FARTHEST_FOLLOWED * sd
        kept = np.full(record.displacement.size, np.nan)
        for window in record.training:
            kept[window] = record.displacement[window]
        late, _ = find_delay(Record(record.voltage, kept, interval=analysis.interval), limit)
        rows = round(late / analysis.interval)
        if (
            abs(late) < max(analysis.turn_time / 50, analysis.interval / analysis.stride)
            or not rows
        ):
            return
        kept[: max(rows, 0)] = kept[kept.size + min(rows, 0) :] = np.nan
        windows = (slice(0, kept.size),)
        moved = analysis.posterior.altered(displacement=np.roll(kept, -rows), training=windows)
        places = analysis.local_minima(moved)
        yield Sighting(starts=[{"delay": late / sd}], places=places)


def settle_fix(voltage: FloatArray, settled: int, leave_out: str) -> str:
    """Return the fix that leaves out a start of ``settled`` samples, unless it is too long.

    A start that holds more than a twentieth of the drive's path is not left out.
    """
    steps = np.abs(np.diff(voltage, prepend=voltage[0]))
    if steps[:settled].sum() > 0.05 * steps.sum():
        return "measure again once the displacement has settled"
    return leave_out


def late_fix(delay: float, interval: float) -> str:
    """Return the fix for a displacement that follows the voltage ``delay`` s late."""
    rows = max(round(abs(delay) / interval), 1)
    name = "displacement" if delay > 0 else "voltage"
    return f"move the {name}'s column up by {rows} row{'s' * (rows > 1)} in the file"


REFIT = "fit this record itself, with the same config"

# Defects that a good fit rules out at once, in the order in which they are tried.
QUICK = (
    _Transient("transient", "transient", foreign=True, removes=True, finding="switch-on transient"),
    Defect(
        "drift",
        "drift",
        foreign=True,
        finding="drift",
        in_bands=(
            "a drift of the readings",
            "validate a shorter part: set window in [validation.{name}], or predict with --window",
        ),
    ),
    _Step(
        "step",
        "step",
        foreign=True,
        finding="jump",
        in_bands=(
            "a jump of the offset by {jump} um at {jumped} s",
            "validate one side: set window in [validation.{name}] to end or begin at {jumped}, or "
            "predict with --window",
        ),
    ),
    _Oscillation(
        "oscillation",
        "oscillation",
        noise=True,
        in_bands=("an oscillation of {swing} um at {line}", Oscillation.advice),
    ),
    Defect("moving gain", "moving-gain"),
    _Sign(
        "sign",
        "reversed-sign",
        finding="reversed sign",
        in_bands=(ReversedSign().describe({}), ReversedSign.advice),
    ),
    _Delay(
        "delay",
        "delay",
        finding="late",
        in_bands=(
            "a delay (another hold of the voltage, or dynamics that the model lacks)",
            'set voltage_is to "command" or "output", whichever it is, in [validation.{name}]',
        ),
    ),
)
LONG_DELAY = _LongDelay("delay", "delay", finding="late")
SLOW = tuple(
    Defect(name.replace("-", " "), name)
    for name in STAGES
    if name not in [defect.stage for defect in QUICK]
)
# Defects of bands that no stage describes.
OF_BANDS = (
    Defect(
        "outliers",
        in_bands=(
            "outliers",
            "empty their cells in the file, at {spikes} s: they are missing readings then",
        ),
    ),
    Defect(
        "start",
        in_bands=(
            "the start of the record (large residuals until {settled} s)",
            "set lead_in_start = {settled} in [validation.{name}], or predict with "
            "--lead-in-start {settled}",
        ),
    ),
    Defect(
        "offset",
        in_bands=(
            "an offset of {size} um",
            "set estimate_offset = true and a longer lead_in in [validation.{name}], or predict "
            "with --lead-in and without --same-offset",
        ),
    ),
    Defect("gain", in_bands=("another gain (another actuator, load or sensor range)", REFIT)),
    Defect(
        "loop",
        in_bands=("loop-shaped residuals (model too simple, or a different actuator)", REFIT),
    ),
    Defect(
        "noise",
        in_bands=(
            "noise of another size than in training",
            "train on a record of this sensor with this sampling",
        ),
    ),
)
DEFECTS = {defect.kind: defect for defect in (*QUICK, *SLOW, *OF_BANDS)}
