"""Why bands fail on readings that were not fitted: shapes in the residuals, by evidence.

Given the bands, residuals are jointly normal: the parameters' error, the discrepancy, the sensor's
noise. Each cause adds shapes of unknown size (a constant, a trend, a decay at the start, the mean
itself, ...) with a normal prior, so that its evidence is exact and costs one pass of the noise's
filter. What was fitted has :mod:`bwbayes.diagnosis.explanations` instead.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import logsumexp

from bwbayes.arrays import BoolArray, FloatArray, IntArray
from bwbayes.data.io.grid import clock
from bwbayes.diagnosis.explanations import likely_causes
from bwbayes.diagnosis.finding import Finding, joined
from bwbayes.diagnosis.noise import tail_nats
from bwbayes.inference.rough import DiscrepancyNoise
from bwbayes.model.drive import rate
from bwbayes.results.bands import KINDS, Bands

__all__ = ["LEAD_IN_ALARM", "cause", "goes_against"]

# Prior sds: of what is added, as a fraction of the mean's range; of a gain; and of a delay, as a
# fraction of the time in which the mean changes by its sd.
SIZE, GAIN, DELAY = 0.1, 0.3, 0.3

# Time constants of a bad start, as fractions of the record, evenly probable.
DECAYS = (1 / 3, 1 / 10, 1 / 30, 1 / 100)

# A lead-in whose test says less than this does not fit.
LEAD_IN_ALARM = 0.002

# Innovations beyond this many sds are named by their times.
FAR = 5.0

# Voltage and displacement that correlate less than this go against each other.
REVERSED = -0.5


def goes_against(bands: Bands, judged: BoolArray, fitted: tuple[float, float]) -> list[str]:
    """Say that the readings go against the voltage, where it goes up and down by enough.

    A lag of many seconds and a gain beyond all reason can follow even these. ``fitted`` are the
    lowest and the highest voltage of training.
    """
    assert bands.measured is not None
    change = rate(bands.voltage, bands.interval)[judged] * bands.interval
    travel = min(float(np.sum(np.maximum(sign * change, 0))) for sign in (1, -1))
    together = _correlation(bands.voltage[judged], bands.measured[judged])
    if travel < (fitted[1] - fitted[0]) / 2 or together >= REVERSED:
        return []
    return [f"the readings fall where the voltage rises (correlation {together:.2f})"]


def cause(
    bands: Bands,
    judged: BoolArray,
    memory: float,
    fitted: tuple[float, float],
    beyond: Sequence[Finding] = (),
) -> Finding:
    """Return the likely cause of bands that fail, or that there is none among those that are known.

    Parameters
    ----------
    bands, judged
        Bands with readings, and which of these (samples,) count.
    memory
        Correlation time of the discrepancy, s.
    fitted
        Lowest and highest voltage of training, V.
    beyond
        In what the drive leaves training.
    """
    if goes_against(bands, judged, fitted):
        return Finding("sign", *WORDS["sign"])
    residuals = Residuals.of(bands, judged, memory)
    ranked = sorted(residuals.explanations(fitted), key=lambda finding: -finding.nats)
    likely = joined(likely_causes(ranked)) or Finding(
        "unknown",
        "unknown (no pattern in the residuals)",
        "look at the residuals in the figure; train on a record like this one",
    )
    lead = bands.lead_in
    hidden = likely.kind in ("start", "offset", "noise", "unknown")
    if lead is not None and lead.p_value < LEAD_IN_ALARM and hidden:
        told = clock(lead.stop, bands.interval)
        return Finding(
            "lead-in",
            "a start that the lead-in does not show (a transient, a drift, or another actuator)",
            f"set lead_in_from = {told} in [validation.{bands.name}], or predict with "
            f"--lead-in-from {told}; a longer --lead-in or a --window may help too",
            nats=likely.nats,
        )
    # Creep widens loops, and is too small for another gain or a delay.
    creeps = likely.kind in ("loop", "noise", "unknown")
    far = [way for way in beyond if creeps or way.kind in ("range", "speed")]
    if far and (creeps or likely.kind in ("gain", "delay")):
        return Finding("extrapolation", f"extrapolation: {far[0].text}", far[0].fix)
    return likely


def _correlation(left: FloatArray, right: FloatArray) -> float:
    left, right = left - np.mean(left), right - np.mean(right)
    size = float(np.sqrt(np.sum(left**2) * np.sum(right**2)))
    return float(left @ right) / size if size > 0 else 0.0


@dataclass(frozen=True)
class Residuals:
    """Residuals (readings,), um, at ``rows`` (readings,) of the bands, and what these say of them.

    ``expected`` (readings, columns) are the parameters' errors, um, each of an independent standard
    normal size; ``noise`` (1, 3) are the parameters of the discrepancy.
    """

    bands: Bands
    rows: IntArray
    residual: FloatArray
    expected: FloatArray
    noise: FloatArray

    @classmethod
    def of(cls, bands: Bands, judged: BoolArray, memory: float) -> Residuals:
        """Take the judged readings (samples,) out of bands; ``memory`` of the discrepancy, s."""
        assert bands.measured is not None
        rows, mean = np.flatnonzero(judged), bands.mean[judged]
        # Half a 90 % band is 1.645 sds wide.
        variances = [
            float(np.mean((bands.upper[kind, 90] - bands.lower[kind, 90])[rows] ** 2)) / 3.29**2
            for kind in KINDS
        ]
        floor = 1e-12 * max(variances[2], 1e-300)
        discrepancy, sensor = np.sqrt(np.maximum(np.diff(variances), floor))
        if memory <= 0:
            discrepancy = np.sqrt(floor)
        shape = (mean - np.mean(mean)) / (np.std(mean) or 1.0)
        varying = np.sqrt(max(variances[0] - bands.common_sd**2, 0.0))
        expected = np.stack([np.full(rows.size, bands.common_sd), varying * shape], axis=1)
        noise = np.array([[sensor, discrepancy, max(memory, bands.interval)]])
        return cls(bands, rows, bands.measured[rows] - mean, expected, noise)

    def fitted(self, columns: FloatArray, residual: FloatArray) -> tuple[float, FloatArray]:
        """Explain a residual (readings,) by columns (readings, columns) of standard normal sizes.

        Returns its log density, up to what is the same for all columns, and the innovations
        (readings,) less what the columns explain, in sds.
        """
        series = np.column_stack([residual, self.expected, columns]).T
        skipped = np.concatenate([[0.0], np.diff(self.rows) - 1.0])
        noise = DiscrepancyNoise(self.bands.interval)
        white = noise.whiten(self.noise, series[np.newaxis], skipped)[0][0]
        precision = np.eye(len(series) - 1) + white[1:] @ white[1:].T
        pull = white[1:] @ white[0]
        sizes = np.linalg.solve(precision, pull)
        squares = float(white[0] @ white[0] - pull @ sizes)
        log_volume = float(np.linalg.slogdet(precision)[1])
        return -0.5 * (squares + log_volume), white[0] - sizes @ white[1:]

    def evidence(self, columns: FloatArray) -> float:
        """Return the log density with columns (readings, columns) of standard normal sizes."""
        return self.fitted(columns, self.residual)[0]

    def shapes(self, fitted: tuple[float, float]) -> dict[str, FloatArray]:
        """Columns (readings, columns) of what may be added to the mean, by kind, um."""
        mean, voltage = self.bands.mean[self.rows], self.bands.voltage[self.rows]
        slope = np.gradient(self.bands.mean, self.bands.interval)[self.rows]
        size = SIZE * (float(np.ptp(mean)) or 1.0)
        along = self.along
        level = (voltage - np.mean(voltage)) / (float(np.max(np.abs(voltage))) or 1.0)
        speed = rate(self.bands.voltage, self.bands.interval)[self.rows]
        way = np.tanh(3 * speed / (float(np.sqrt(np.mean(speed**2))) or 1.0))
        loops = level, level**2, level**3, way, way * level, way * level**2
        outside = np.maximum(voltage - fitted[1], 0) - np.maximum(fitted[0] - voltage, 0)
        outside /= float(np.max(np.abs(outside))) or 1.0
        columns = {
            "drift": size * np.stack([along, along**2]),
            "offset": np.full((1, along.size), size),
            "gain": GAIN * (mean - np.mean(mean))[np.newaxis],
            "delay": DELAY * np.std(mean) / (np.std(slope) or 1.0) * slope[np.newaxis],
            "loop": size * np.stack(loops),
        }
        if outside.any():
            powers = np.abs(outside), outside, outside**2, outside * np.abs(outside)
            columns["extrapolation"] = 3 * size * np.stack(powers)
        return {kind: rows.T for kind, rows in columns.items()}

    @property
    def along(self) -> FloatArray:
        """Time (readings,) from the first reading to the last, as a fraction."""
        time = self.bands.time[self.rows] - self.bands.time[self.rows[0]]
        fraction: FloatArray = time / max(float(time[-1]), self.bands.interval)
        return fraction

    def explanations(self, fitted: tuple[float, float]) -> list[Finding]:
        """Weigh all causes, with nats against none."""
        plain, white = self.fitted(np.empty((self.rows.size, 0)), self.residual)
        shapes = self.shapes(fitted)
        nats = {kind: self.evidence(columns) - plain for kind, columns in shapes.items()}
        # Twice the mean to the readings: then they are its opposite.
        opposite = self.residual + 2 * self.bands.mean[self.rows]
        nats["sign"] = self.fitted(shapes["offset"], opposite)[0] - plain
        starts = [
            self.evidence(3 * shapes["offset"] * np.exp(-self.along / decay)[:, np.newaxis])
            for decay in DECAYS
        ]
        nats["start"] = float(logsumexp(starts)) - np.log(len(DECAYS)) - plain
        nats["outliers"] = tail_nats(white)
        square = float(np.mean(white**2))
        nats["noise"] = 0.5 * (white.size * (square - 1 - np.log(square)) - np.log(white.size))
        duration = float(np.ptp(self.bands.time[self.rows]))
        until = self.bands.time[self.rows[0]] + 3 * DECAYS[int(np.argmax(starts))] * duration
        words = {
            "name": self.bands.name,
            "settled": clock(until, self.bands.interval),
            "size": f"{np.mean(self.residual):+.3g}",
            "span": f"{fitted[0]:.4g} to {fitted[1]:.4g} V",
            "spikes": self._windows(np.abs(white) > FAR),
        }
        return [
            Finding(kind, text.format(**words), fix.format(**words), nats=nats[kind])
            for kind, (text, fix) in WORDS.items()
            if kind in nats
        ]

    def _windows(self, far: BoolArray) -> str:
        """Write the windows of the first readings that are far off."""
        interval = self.bands.interval
        times = self.bands.time[self.rows[far]][:3].tolist()
        return ", ".join(f"[{clock(t, interval)}, {clock(t + interval, interval)}]" for t in times)


REFIT = "fit this record itself: bwbayes run CONFIG --record FILE"

# What a cause is called, and what to do about it.
WORDS: Mapping[str, tuple[str, str]] = {
    "sign": (
        "reversed sign of the displacement",
        "change the sign of the displacement in the file",
    ),
    "outliers": (
        "outliers",
        "empty their cells in the file, at {spikes} s: they are missing readings then",
    ),
    "start": (
        "the start of the record (large residuals until {settled} s)",
        "set lead_in_from = {settled} in [validation.{name}], or predict with "
        "--lead-in-from {settled}",
    ),
    "drift": (
        "a drift of the readings",
        "validate a shorter part: set window in [validation.{name}], or predict with --window",
    ),
    "offset": (
        "an offset of {size} um",
        "set own_offset = true and a longer lead_in in [validation.{name}], or predict with "
        "--lead-in and without --same-offset",
    ),
    "gain": ("another gain (another actuator, load or sensor range)", REFIT),
    "delay": (
        "a delay (another hold of the voltage, or dynamics that the model lacks)",
        'set voltage_is to "command" or "output", whichever it is, in [validation.{name}]',
    ),
    "loop": ("loop-shaped residuals (model too simple, or a different actuator)", REFIT),
    "noise": (
        "noise of another size than in training",
        "train on a record of this sensor with this sampling",
    ),
    "extrapolation": (
        "extrapolation beyond the {span} of the training",
        "train on a record that spans this range, or predict a --window within {span}",
    ),
}
