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
from scipy.special import logsumexp, ndtri

from bwbayes.arrays import BoolArray, FloatArray, IntArray
from bwbayes.diagnosis.explanations import likely_causes
from bwbayes.diagnosis.finding import Finding, joined
from bwbayes.diagnosis.noise import tail_nats
from bwbayes.inference.noise import DiscrepancyNoise
from bwbayes.model.reversals import rate
from bwbayes.prediction.bands import KINDS, Bands
from bwbayes.record.io.grid import clock

__all__ = ["LEAD_IN_ALARM", "REVERSED_SIGN", "cause"]

# A lead-in whose test says less than this does not fit.
LEAD_IN_ALARM = 0.002

# Time constants of a bad start, as fractions of the record, evenly probable.
DECAYS = (1 / 3, 1 / 10, 1 / 30, 1 / 100)

REVERSED_SIGN = Finding(
    "sign", "reversed sign of the displacement", "change the sign of the displacement in the file"
)
REFIT = "fit this record itself: bwbayes run CONFIG --record FILE"

# What a cause is called, and what to do about it.
WORDS: Mapping[str, tuple[str, str]] = {
    "sign": (REVERSED_SIGN.text, REVERSED_SIGN.fix),
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
}


def cause(
    bands: Bands, judged: BoolArray, memory: float, beyond: Sequence[Finding] = ()
) -> Finding:
    """Return the likely cause of bands that fail, or that there is none among those that are known.

    Parameters
    ----------
    bands, judged
        Bands with readings, and which of these (samples,) count.
    memory
        Correlation time of the discrepancy, s.
    beyond
        In what the drive leaves training.
    """
    residuals = Residuals.of(bands, judged, memory)
    ranked = sorted(residuals.explanations(), key=lambda finding: -finding.nats)
    likely = joined(likely_causes(ranked)) or Finding(
        "unknown",
        "unknown (no pattern in the residuals)",
        "look at the residuals in the figure; train on a record like this one",
    )
    lead = bands.lead_in
    hidden = likely.kind in ("start", "offset", "noise", "unknown")
    if lead is not None and lead.p_value < LEAD_IN_ALARM and hidden:
        stop = clock(lead.stop, bands.interval)
        return Finding(
            "lead-in",
            "a start that the lead-in does not show (a transient, a drift, or another actuator)",
            f"set lead_in_from = {stop} in [validation.{bands.name}], or predict with "
            f"--lead-in-from {stop}; a longer --lead-in or a --window may help too",
            nats=likely.nats,
        )
    kinds = set(likely.kind.split(" or "))
    # Creep widens loops, and is too small for another gain, a delay or what looks like outliers.
    shapeless = kinds <= {"loop", "noise", "unknown"}
    possible = [way for way in beyond if shapeless or way.kind in ("range", "speed")]
    if possible and kinds <= {"loop", "noise", "unknown", "gain", "delay", "outliers"}:
        return Finding("extrapolation", f"extrapolation: {possible[0].text}", possible[0].fix)
    return likely


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
        variances = [
            float(np.mean((bands.upper[kind, 90] - bands.lower[kind, 90])[rows] ** 2))
            / (2 * ndtri(0.95)) ** 2
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

    def explanations(self) -> list[Finding]:
        """Weigh all causes, with nats against none."""
        plain, white = self._fit(np.empty((0, self.rows.size)), self.residual)
        shapes = self._shapes()
        nats = {kind: self._fit(added, self.residual)[0] - plain for kind, added in shapes.items()}
        # Twice the mean to the readings: then they are its opposite.
        opposite = self.residual + 2 * self.bands.mean[self.rows]
        nats["sign"] = self._fit(shapes["offset"], opposite)[0] - plain
        starts = [
            self._fit(3 * shapes["offset"] * np.exp(-self._time_share / decay), self.residual)[0]
            for decay in DECAYS
        ]
        nats["start"] = float(logsumexp(starts)) - np.log(len(DECAYS)) - plain
        nats["outliers"] = tail_nats(white)
        square = float(np.mean(white**2))
        nats["noise"] = 0.5 * (white.size * (square - 1 - np.log(square)) - np.log(white.size))
        interval, time = self.bands.interval, self.bands.time[self.rows]
        settled = time[0] + 3 * DECAYS[int(np.argmax(starts))] * float(np.ptp(time))
        words = {
            "name": self.bands.name,
            "settled": clock(settled, interval),
            "size": f"{np.mean(self.residual):+.3g}",
            "spikes": ", ".join(
                f"[{clock(t, interval)}, {clock(t + interval, interval)}]"
                for t in time[np.abs(white) > 5][:3].tolist()
            ),
        }
        return [
            Finding(kind, text.format(**words), fix.format(**words), nats=nats[kind])
            for kind, (text, fix) in WORDS.items()
        ]

    def _fit(self, added: FloatArray, residual: FloatArray) -> tuple[float, FloatArray]:
        """Explain a residual (readings,) by shapes (shapes, readings) of standard normal sizes.

        Returns its log density, up to what is the same for all shapes, and the innovations
        (readings,) less what the shapes explain, in sds.
        """
        series = np.concatenate([[residual], self.expected.T, added])
        skipped = np.concatenate([[0.0], np.diff(self.rows) - 1.0])
        noise = DiscrepancyNoise(self.bands.interval)
        white = noise.whiten(self.noise, series[np.newaxis], skipped)[0][0]
        precision = np.eye(len(series) - 1) + white[1:] @ white[1:].T
        pull = white[1:] @ white[0]
        sizes = np.linalg.solve(precision, pull)
        squares = float(white[0] @ white[0] - pull @ sizes)
        log_volume = float(np.linalg.slogdet(precision)[1])
        return -0.5 * (squares + log_volume), white[0] - sizes @ white[1:]

    @property
    def _time_share(self) -> FloatArray:
        """Time (readings,) from the first reading to the last, as a fraction."""
        time = self.bands.time[self.rows] - self.bands.time[self.rows[0]]
        share: FloatArray = time / max(float(time[-1]), self.bands.interval)
        return share

    def _shapes(self) -> dict[str, FloatArray]:
        """Shapes (shapes, readings) that may be added to the mean, by kind, um.

        Prior sds: a tenth of the mean's range; of a gain 0.3; of a delay 0.3 of the time in which
        the mean changes by its sd.
        """
        mean, voltage = self.bands.mean[self.rows], self.bands.voltage[self.rows]
        slope = np.gradient(self.bands.mean, self.bands.interval)[self.rows]
        size, share = 0.1 * (float(np.ptp(mean)) or 1.0), self._time_share
        level = (voltage - np.mean(voltage)) / (float(np.max(np.abs(voltage))) or 1.0)
        speed = rate(self.bands.voltage, self.bands.interval)[self.rows]
        way = np.tanh(3 * speed / (float(np.sqrt(np.mean(speed**2))) or 1.0))
        return {
            "drift": size * np.stack([share, share**2]),
            "offset": np.full((1, share.size), size),
            "gain": 0.3 * (mean - np.mean(mean))[np.newaxis],
            "delay": 0.3 * np.std(mean) / (np.std(slope) or 1.0) * slope[np.newaxis],
            "loop": size * np.stack([level, level**2, level**3, way, way * level, way * level**2]),
        }
