"""Why bands do not hold: what the residuals of a record look like, and what helps.

Each cause leaves its mark on the residuals: a constant, a trend, a beginning that differs, spikes,
a part that follows the loop. Least squares says how much of the residuals' energy each mark
explains; the simplest one that explains most of it is the likeliest cause. It comes with its
remedy, a line of config or an option of the command line.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np
from scipy import ndimage

from bwbayes.arrays import BoolArray, FloatArray
from bwbayes.data.inspection import MOST_LEFT_OUT, SETTLE_FIRST
from bwbayes.model.drive import rate
from bwbayes.results.bands import Bands

__all__ = ["Cause", "Kind", "Residuals", "cause", "drifts", "likeliest"]

Kind = Literal[
    "sign",
    "outliers",
    "lead-in",
    "start",
    "offset",
    "drift",
    "extrapolation",
    "gain",
    "delay",
    "loop",
    "noise",
    "unknown",
]

# A mark that explains this part of the energy is taken for the cause; a later one in the list
# below must explain more, because it has more to fit with.
EXPLAINS = 0.6

# A mark that explains less than this, be it the best of all, explains nothing.
LEAST = 0.3

# Voltage and displacement that correlate less than this go against each other.
REVERSED = -0.5

# Spikes: in sds of what changes from sample to sample, and the part of that variance they add.
SPIKE = 8.0
SPIKE_PART = 0.1

# Part of the fitted voltages' range that counts as inside; a sensor's noise.
SLACK = 0.02

# Spikes that are named by their time.
NAMED = 3


@dataclass(frozen=True)
class Cause:
    """A likely cause: its kind, what it looks like, and what helps."""

    kind: Kind
    text: str
    remedy: str

    @property
    def line(self) -> str:
        """Cause and fix, as a part of a line."""
        return f"Likely cause: {self.text}. Fix: {self.remedy}."


@dataclass(frozen=True)
class Residuals:
    """Readings that were judged, and all that may explain their residuals.

    All arrays are (readings,): ``time`` in s, ``residual``, ``mean`` and ``measured`` in um,
    ``voltage`` in V, ``rate`` its change in V/s, ``follow`` the mean's in um/s.
    """

    name: str
    training: bool
    interval: float
    time: FloatArray
    residual: FloatArray
    mean: FloatArray
    measured: FloatArray
    voltage: FloatArray
    rate: FloatArray
    follow: FloatArray
    spikes: BoolArray
    fitted: tuple[float, float]
    told_until: float

    @classmethod
    def of(cls, bands: Bands, judged: BoolArray, fitted: tuple[float, float]) -> Residuals:
        """Take the judged readings (samples,) out of bands."""
        assert bands.measured is not None
        mean = bands.mean
        steps = (np.gradient(mean) if mean.size > 1 else np.zeros_like(mean))[judged]
        residual = (bands.measured - bands.mean)[judged]
        covered = bands.covers("sensor", 95, bands.measured)[judged]
        return cls(
            bands.name,
            bands.training,
            bands.interval,
            bands.time[judged],
            residual,
            bands.mean[judged],
            bands.measured[judged],
            bands.voltage[judged],
            rate(bands.voltage, bands.interval)[judged],
            steps / bands.interval,
            # What a band covers is no outlier of it.
            _spikes(residual, steps) & ~covered,
            fitted,
            bands.time[0] if bands.lead_in is None else bands.lead_in.stop,
        )

    @property
    def isolated(self) -> list[str]:
        """Say how many readings stand alone and far off, if they matter."""
        count = int(np.sum(self.spikes))
        if not count:
            return []
        largest = float(np.max(np.abs(self.residual[self.spikes])))
        lie = "reading lies" if count == 1 else "readings lie up to"
        return [f"{count} isolated {lie} {largest:.3g} um off"]

    @property
    def reversed(self) -> list[str]:
        """Say that the readings go against the voltage, where it goes up and down by enough.

        A lag of many seconds and a gain beyond all reason can follow even these.
        """
        up, down = (np.sum(np.maximum(way * self.rate, 0)) * self.interval for way in (1, -1))
        low, high = self.fitted
        together = _correlation(self.voltage, self.measured)
        if min(up, down) < (high - low) / 2 or together >= REVERSED:
            return []
        return [f"the readings fall where the voltage rises (correlation {together:.2f})"]


def likeliest(r: Residuals) -> Cause:
    """Return the likeliest cause of residuals that are too large."""
    if _correlation(r.voltage, r.measured) < REVERSED:
        return cause("sign", r)
    if r.spikes.any() and _energy(r.residual[r.spikes]) > LEAST * _energy(r.residual):
        return cause("outliers", r)
    shares = {kind: share(r) for kind, share in _MARKS}
    for kind, share in shares.items():
        if share > EXPLAINS:
            return cause(kind, r)
    best = max(shares, key=lambda kind: shares[kind])
    if shares[best] > LEAST:
        return cause(best, r)
    if r.spikes.any():
        return cause("outliers", r)
    forgets = _correlation(r.residual[1:], r.residual[:-1]) < 0.5 if r.residual.size > 2 else False
    return cause("noise" if forgets else "unknown", r)


def drifts(r: Residuals, after: float) -> bool:
    """Tell whether the residuals after a time, s, still drift: a bad start alone does not."""
    late = r.time >= after
    if np.sum(late) < 3:
        return False
    at = r.time[late] - after
    residual = r.residual[late] - np.mean(r.residual[late])
    return _explained(residual, at, at**2) > EXPLAINS


def _energy(values: FloatArray) -> float:
    return float(np.sum(values**2))


def _correlation(one: FloatArray, other: FloatArray) -> float:
    one, other = one - np.mean(one), other - np.mean(other)
    size = np.sqrt(_energy(one) * _energy(other))
    return float(np.sum(one * other) / size) if size > 0 else 0.0


def _explained(residual: FloatArray, *features: FloatArray) -> float:
    """Part of the residual's energy that least squares on a constant and features explains."""
    columns = [np.ones_like(residual)]
    for feature in features:
        spread = np.std(feature)
        if spread > 0:
            columns.append((feature - np.mean(feature)) / spread)
    matrix = np.stack(columns, axis=1)
    weights, *_ = np.linalg.lstsq(matrix, residual, rcond=None)
    total = _energy(residual)
    return 1 - _energy(residual - matrix @ weights) / total if total > 0 else 0.0


def _beside(residual: FloatArray, where: BoolArray) -> float:
    """Part of the energy that is in excess of what the other samples have, at ``where``."""
    total, other = _energy(residual), ~where
    if not where.any() or not other.any() or total == 0:
        return 0.0
    return 1 - _energy(residual[other]) / np.sum(other) * residual.size / total


def _start(r: Residuals) -> float:
    """Part of the energy that the first third has in excess of the last half."""
    late = r.time >= (r.time[0] + r.time[-1]) / 2
    early = r.time < r.time[0] + (r.time[-1] - r.time[0]) / 3
    if not early.any() or not late.any():
        return 0.0
    tail = _energy(r.residual[late]) / np.sum(late)
    # An offset of the remaining readings does not count as a start.
    total = _energy(r.residual)
    return max(0.0, (_energy(r.residual[early]) - tail * np.sum(early)) / total) if total else 0.0


def _offset(r: Residuals) -> float:
    return _explained(r.residual)


def _drift(r: Residuals) -> float:
    """Trend, bent or not, that a drive which goes back and forth does not make."""
    at = (r.time - r.time[0]) / max(r.time[-1] - r.time[0], r.interval)
    share = _explained(r.residual, at, at**2)
    # A trend beside an offset that is far larger does not count.
    return share if _offset(r) < 0.85 * share else 0.0


def _extrapolation(r: Residuals) -> float:
    low, high = r.fitted
    if not np.isfinite(high - low):
        return 0.0
    slack = SLACK * (high - low)
    return _beside(r.residual, (r.voltage < low - slack) | (r.voltage > high + slack))


def _gain(r: Residuals) -> float:
    return _explained(r.residual, r.mean)


def _delay(r: Residuals) -> float:
    return _explained(r.residual, r.follow)


def _loop(r: Residuals) -> float:
    """Share of a smooth function of the voltage, one for each direction."""
    size = np.max(np.abs(r.voltage)) or 1.0
    v = (r.voltage - np.mean(r.voltage)) / size
    typical = np.sqrt(np.mean(r.rate**2)) or 1.0
    way = np.tanh(3 * r.rate / typical)
    return _explained(
        r.residual, v, v**2, v**3, way, way * v, way * v**2, r.follow, r.mean
    )  # fmt: skip


# In the order in which they are believed: a mark comes after those that it may imitate.
_MARKS: tuple[tuple[Kind, Callable[[Residuals], float]], ...] = (
    ("extrapolation", _extrapolation),
    ("start", _start),
    ("drift", _drift),
    ("offset", _offset),
    ("gain", _gain),
    ("delay", _delay),
    ("loop", _loop),
)


def _spikes(residual: FloatArray, steps: FloatArray) -> BoolArray:
    """Tell readings that stand alone: far from their neighbours, where the drive does not jump.

    None, if they add little to the variance of what changes from sample to sample.
    """
    if residual.size < 20:
        return np.zeros(residual.size, dtype=bool)
    # Against the line between the readings two before and two after: spikes are short.
    padded = np.pad(residual, 2, mode="reflect")
    beside = residual - (padded[:-4] + padded[4:]) / 2
    fast = 1.4826 * float(np.median(np.abs(beside)))
    fast = max(fast, 1e-6 * float(np.ptp(residual)))
    jumps = ndimage.maximum_filter1d(np.abs(steps), 5)
    # As long as they are few; many are not outliers.
    far = (np.abs(beside) > SPIKE * fast) & (np.abs(beside) > jumps)
    # The top of something broader does not count.
    level = np.maximum(np.abs(padded[:-4]), np.abs(padded[4:]))
    far &= np.abs(beside) > 0.5 * level
    # A spike throws its neighbours off too, by half.
    far &= np.abs(beside) > 0.75 * ndimage.maximum_filter1d(np.abs(beside), 5)
    matters = _energy(beside[far]) > SPIKE_PART * residual.size * fast**2
    few = np.sum(far) <= 0.05 * residual.size
    return far & (matters and bool(few))


def cause(kind: Kind, r: Residuals, settled: float | None = None) -> Cause:
    """Put a cause and its fix into words; ``settled`` is when an odd start ends, if known."""
    text, for_fit, for_other = _WORDS[kind]
    until = _settled(r) if settled is None else settled
    if kind == "start" and r.training:  # more than a few percent of the drive are not left out
        steps = np.abs(np.diff(r.voltage, prepend=r.voltage[0]))
        if steps[r.time < until].sum() > MOST_LEFT_OUT * steps.sum():
            for_fit = SETTLE_FIRST
    words = {
        "name": r.name,
        "begin": f"{r.time[0]:.4g}",
        "settled": f"{until:.4g}",
        "size": f"{np.mean(r.residual):+.3g}",
        "low": f"{r.fitted[0]:.4g}",
        "high": f"{r.fitted[1]:.4g}",
        "spikes": _windows(r),
        "told": f"{r.told_until:.4g}",
    }
    return Cause(kind, text.format(**words), (for_fit if r.training else for_other).format(**words))


def _settled(r: Residuals) -> float:
    """Time from which on the residuals are as large as in the record's second half, s."""
    late = r.time >= (r.time[0] + r.time[-1]) / 2
    level = np.sqrt(np.mean(r.residual[late] ** 2))
    above = np.flatnonzero((np.abs(r.residual) > 3 * level) & ~late)
    # To a tenth of a second, or a hundredth of the record if that is less.
    step = 10 ** np.floor(np.log10(max(r.time[-1] - r.time[0], r.interval) / 10))
    last = float(r.time[above[-1]]) if above.size else float(r.time[0])
    return float(np.ceil(last / min(step, 0.1)) * min(step, 0.1))


def _windows(r: Residuals) -> str:
    """Return the windows of the first spikes, as ``exclude`` takes them."""
    windows = [f"[{t:.6g}, {t + r.interval:.6g}]" for t in r.time[r.spikes][:NAMED]]
    return ", ".join(windows) + (", ..." if np.sum(r.spikes) > NAMED else "")


# What a cause is called, and its fix: where the record was fitted, and where it was not.
_WORDS: dict[Kind, tuple[str, str, str]] = {
    "sign": (
        "reversed sign of the displacement",
        "change the sign of the displacement in the file",
        "change the sign of the displacement in the file",
    ),
    "outliers": (
        "outliers",
        "set exclude = [{spikes}] in [record]",
        "empty their cells in the file, at {spikes} s: they are missing readings then",
    ),
    "lead-in": (
        "a start that the lead-in does not show (a transient, a drift, or another actuator)",
        "set lead_in_from = {told} in [validation.{name}]",
        "set lead_in_from = {told} in [validation.{name}], or predict with --lead-in-from {told}; "
        "a longer --lead-in or a --window may help too",
    ),
    "start": (
        "the start of the record (large residuals until {settled} s)",
        "set exclude = [[{begin}, {settled}]] in [record]",
        "set lead_in_from = {settled} in [validation.{name}], or predict with "
        "--lead-in-from {settled}",
    ),
    "offset": (
        "an offset of {size} um",
        "free the offset: remove [parameters.offset]",
        "set own_offset = true and a longer lead_in in [validation.{name}], or predict with "
        "--lead-in and without --same-offset",
    ),
    "drift": (
        "a drift of the readings",
        "measure again after a longer warm-up",
        "validate a shorter part: set window in [validation.{name}], or predict with --window",
    ),
    "extrapolation": (
        "extrapolation beyond the {low} to {high} V of the training",
        "train on a record that spans this range",
        "train on a record that spans this range, or predict a --window within these voltages",
    ),
    "gain": (
        "another gain (another actuator, load or sensor range)",
        "give d a wider prior in [parameters.d]",
        "fit this record itself: bwbayes run CONFIG --record FILE",
    ),
    "delay": (
        "a delay (another hold of the voltage, or dynamics that the model lacks)",
        'set hold in [model], or dynamics = "second-order" there',
        'set voltage_is to "command" or "output", whichever it is, in [validation.{name}]',
    ),
    "loop": (
        "loop-shaped residuals (model too simple, or a different actuator)",
        'free the exponent by a prior in [parameters.exponent], or set dynamics = "second-order" '
        "in [model]",
        "fit this record itself: bwbayes run CONFIG --record FILE",
    ),
    "noise": (
        "noise of another size than in training",
        'set noise = "discrepancy" in [model]',
        "train on a record of this sensor with this sampling",
    ),
    "unknown": (
        "unknown (no pattern in the residuals)",
        "look at the residuals in the report",
        "look at the residuals in the figure; train on a record like this one",
    ),
}
