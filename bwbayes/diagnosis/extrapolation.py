"""For which drives bands were tested, and where a prediction leaves those.

In voltage, speed, reversals, slowness or duration. There the bands know how sure the parameters
are, and of what else the actuator does only the creep after slower drives, by its prior
(:mod:`bwbayes.inference.prior_creep`): it saturates at higher voltages, lags behind faster ones,
and drifts.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Self

import numpy as np
import scipy

from bwbayes.arrays import FloatArray
from bwbayes.diagnosis.finding import TELLING_DRIVE, Finding
from bwbayes.inference.posterior import Posterior
from bwbayes.model.inputs import Inputs
from bwbayes.model.reversals import RETURN, fastest, time_between_turns, turning_points

# Part of the time between turning points over which a speed is taken: a sine's peak speed is then
# 0.4% too low, and noise of 1% of its range adds a tenth.
PART = 0.1

# Times that are longer than the fitted ones by more than this factor leave creep that the record
# does not show. Creep goes with the logarithm of the time, by one or two percent of a change each
# decade: half a decade is half of the one or two percent that a model misses anyway.
LONGER = 3.0

# Mean distance of a drive's voltages and last reversals from those of training, in parts of the
# range: of drives alike it is at most 0.02, of others at least 0.03.
ALIKE = 0.025


@dataclass(frozen=True)
class Drive:
    """What training drove the actuator with: all that a validation on its readings speaks for.

    Attributes
    ----------
    low, high
        Lowest and highest voltage, V.
    frequency
        Frequency of the fastest swing, Hz; 0 without any.
    depths
        Smallest and largest swing between two reversals, V; none without any.
    """

    low: float
    high: float
    frequency: float = 0.0
    depths: tuple[float, float] | None = None

    @classmethod
    def of(cls, posterior: Posterior) -> Self:
        """Return the drive of the windows that were fitted."""
        low, high = _fitted_range(posterior)
        frequencies, depths = [], []
        for dataset in posterior.datasets:
            for window in dataset.training:
                voltage = dataset.voltage[window]
                turns = turning_points(voltage, RETURN * (high - low))
                if turns.size > 1:
                    fastest_swing = float(np.min(np.diff(turns))) * dataset.actuator.interval
                    frequencies.append(0.5 / fastest_swing)
                    depths += np.abs(np.diff(voltage[turns])).tolist()
        if not depths:
            return cls(low, high)
        return cls(low, high, max(frequencies), (min(depths), max(depths)))

    def __str__(self) -> str:
        text = f"{self.low:.4g} to {self.high:.4g} V"
        if self.depths is None:
            return text
        smallest, largest = self.depths
        return (
            f"{text}, up to {self.frequency:.2g} Hz, reversals of {smallest:.2g} to {largest:.3g} V"
        )


def beyond_training(
    posterior: Posterior,
    inputs: Inputs,
    window: slice = slice(None),
) -> list[Finding]:
    """Return in what a drive leaves those that the model was fitted to.

    Findings of kind "range" and "speed" leave what any model knows, as does "covariate",
    and "reversals" the loops on which this one was tested; "slow" and "duration" leave room for
    creep and drift, which may be as small as the bands allow.

    Parameters
    ----------
    posterior
        The posterior of the records that were fitted.
    inputs
        The drive from its first sample on.
    window
        The samples that are predicted; those before are what the actuator went through.
    """
    voltage, interval = inputs.voltage, inputs.interval
    low, high = _fitted_range(posterior)
    turn_times = [
        time_between_turns(data.voltage, data.actuator.interval, data.training)
        for data in posterior.datasets
    ]
    planned, findings = voltage[window], [*_covariates(posterior, inputs, window)]
    slack = 0.02 * (high - low)  # a sensor's noise
    if np.min(planned) < low - slack or np.max(planned) > high + slack:
        text = (
            f"voltage {np.min(planned):.4g} to {np.max(planned):.4g} V exceeds the training range "
            f"{low:.4g} to {high:.4g} V; the bands extrapolate, their level untested"
        )
        findings.append(Finding("range", text, "train on a record that spans this range"))
    turn_time, speeds = time_between_turns(planned, interval), []
    for dataset, fitted_turn_time in zip(posterior.datasets, turn_times, strict=True):
        over = PART * min(fitted_turn_time, turn_time)
        fitted = fastest(dataset.voltage, dataset.actuator.interval, over, dataset.training)
        speeds.append((fastest(planned, interval, over), fitted))
    # Of several records the one that comes nearest to the drive.
    speed, slower = min(speeds, key=lambda pair: pair[0] / max(pair[1], 1e-300))
    # Noise and the sampling change a speed by a tenth or so.
    if speed > 1.5 * slower:
        text = (
            f"voltage speed of up to {speed:.3g} V/s exceeds the {slower:.3g} V/s of training; the "
            "bands extrapolate, their level untested, because the lag is not known that well"
        )
        findings.append(Finding("speed", text, "train on a record that is as fast"))
    distance = _distance(posterior, (low, high), voltage, window)
    if distance > ALIKE:
        text = (
            f"voltage and last reversal are {100 * distance:.2g}% of the range away from those of "
            "training on average; the bands' level is untested on these loops"
        )
        findings.append(Finding("reversals", text, TELLING_DRIVE))
    findings += _slow(posterior, (low, high), min(turn_times), voltage, interval, window)
    duration = voltage[: window.stop].size * interval
    before = max(
        dataset.training[-1].stop * dataset.actuator.interval for dataset in posterior.datasets
    )
    if duration > LONGER * before:
        text = (
            f"duration of {duration:.4g} s exceeds the {before:.4g} s of training; the bands "
            "extrapolate, their level untested, with slow creep at its prior and no drift"
        )
        findings.append(Finding("duration", text, "train on a record that is as long"))
    return findings


# What a drive excites in an actuator that its training record did not, by a finding's kind.
UNEXCITED = {"speed": "fast edges", "slow": "slow holds"}


def unexcited(findings: Iterable[Finding]) -> str:
    """Say what a drive excites that the training record did not; nothing if that is not known."""
    kinds = [UNEXCITED[finding.kind] for finding in findings if finding.kind in UNEXCITED]
    return f"this drive excites what the record did not ({', '.join(kinds)})" if kinds else ""


def _covariates(posterior: Posterior, inputs: Inputs, window: slice) -> Iterator[Finding]:
    """Hold what parts of the model see beside the voltage against what they saw in training."""
    seen_names = {stage.sees for stage in posterior.datasets[0].actuator.stages}
    for name in sorted(seen_names & {*inputs.covariates}):
        ranges = [data.inputs.range_of(name, data.training) for data in posterior.datasets]
        low, high = min(low for low, _ in ranges), max(high for _, high in ranges)
        smallest, largest = inputs.range_of(name, [window])
        slack = 0.02 * (high - low)
        if smallest < low - slack or largest > high + slack:
            text = (
                f"{name} of {smallest:.4g} to {largest:.4g} exceeds the training range "
                f"{low:.4g} to {high:.4g}; the bands extrapolate, their level untested"
            )
            yield Finding("covariate", text, "train on a record that spans this range")


def _fitted_range(posterior: Posterior) -> tuple[float, float]:
    """Lowest and highest voltage that was fitted, V."""
    windows = [
        data.voltage[training_window]
        for data in posterior.datasets
        for training_window in data.training
    ]
    return min(float(np.min(w)) for w in windows), max(float(np.max(w)) for w in windows)


def _distance(
    posterior: Posterior, span: tuple[float, float], voltage: FloatArray, window: slice
) -> float:
    """Mean distance of a drive's loops from the nearest ones of training, in parts of the range.

    Rate-independent memory goes along a branch that begins at the last reversal.
    """
    extent = span[1] - span[0]
    fitted = np.concatenate(
        [
            _branches(data.voltage, training_window, RETURN * extent)
            for data in posterior.datasets
            for training_window in data.training
        ]
    )
    # What is beyond the range is said by itself; a drive without a reversal has no loop.
    planned = _branches(np.clip(voltage, *span), window, RETURN * extent)
    if not (fitted.size and planned.size):
        return 0.0
    distances, _ = scipy.spatial.KDTree(fitted / extent).query(planned / extent)
    return float(np.mean(distances))


def _branches(voltage: FloatArray, window: slice, threshold: float) -> FloatArray:
    """Voltage and last reversal (samples, 2), V, of some thousand samples after a reversal."""
    turns = turning_points(voltage[: window.stop], threshold)
    rows = np.arange(voltage.size)[window]
    rows = rows[:: max(rows.size // 5_000, 1)]
    number = np.searchsorted(turns, rows, side="right")
    rows, number = rows[number > 0], number[number > 0]
    return np.stack([voltage[rows], voltage[turns[number - 1]]], axis=1)


def _slow(
    posterior: Posterior,
    span: tuple[float, float],
    turn_time: float,
    voltage: FloatArray,
    interval: float,
    window: slice,
) -> Iterator[Finding]:
    """Hold the voltage's means over some times T against those of training.

    Creep with the time T follows the mean over T. The creep that training does not show is as large
    as ∫ (mean now − mean then) d log T, where means go beyond those of training.
    """
    low, high = span
    a_decade, sides = 8, np.array([[-1.0], [1.0]])  # times, and where a mean may go
    # What is beyond the range is said by itself.
    inside = np.clip(voltage[: window.stop], low, high)
    longest = inside.size * interval
    decades = max(math.log10(longest / (PART * turn_time)), 0.0)
    times = longest / 10 ** (np.arange(1 + math.ceil(a_decade * decades)) / a_decade)
    planned = _slow_means(inside, interval, times, [window])
    fitted = []
    for dataset in posterior.datasets:
        interval = dataset.actuator.interval
        means = sides * _slow_means(dataset.voltage, interval, times, dataset.training)
        # What is longer than the record is taken for the longest time that is not.
        finite = np.flatnonzero(np.isfinite(means[0]))
        fitted.append(means[:, finite[np.searchsorted(finite, np.arange(times.size))]])
    # A mean over a longer time is that over a shorter one somewhere.
    before = np.maximum.accumulate(np.max(fitted, axis=0), axis=1)
    excess = np.maximum(np.nan_to_num(sides * planned - before), 0.0)
    # In volts times decades of time; a sine over the whole range has half the range to either side.
    unknown = np.sum(excess, axis=1) / a_decade
    if unknown.max() > math.log10(LONGER) * (high - low) / 2:
        side = int(np.argmax(unknown))
        at = int(np.argmax(excess[side] >= excess[side].max() / 2))
        reached = f"at {('least', 'most')[side]} {(sides * before)[side, at]:.3g} V"
        text = (
            f"voltage averages {planned[side, at]:.3g} V over {times[at]:.3g} s, in training "
            f"{reached}; the bands extrapolate, their level untested, with slow creep at its prior"
        )
        yield Finding("slow", text, "train on a record that is as slow, or is held as long")


def _slow_means(
    voltage: FloatArray, interval: float, times: FloatArray, windows: Sequence[slice]
) -> FloatArray:
    """Return the lowest and the highest mean voltage over some times, (2, times), V.

    The mean over the time T before a sample is what creep with that time follows, of all samples in
    the windows that have so much before them; nan, if none has.
    """
    spans = [window.indices(voltage.size)[:2] for window in windows]
    total = np.concatenate([[0.0], np.cumsum(voltage[: spans[-1][1]])])
    extremes = np.full((2, times.size), np.nan)
    for i, length in enumerate(np.maximum(np.rint(times / interval), 1).astype(np.int64).tolist()):
        for start, stop in spans:
            # Means over many samples change slowly: the last one, and one in a fiftieth of them.
            ends = np.arange(stop, max(start, length - 1), -max(length // 50, 1))
            if ends.size:
                means = (total[ends] - total[ends - length]) / length
                extremes[0, i] = np.fmin(extremes[0, i], means.min())
                extremes[1, i] = np.fmax(extremes[1, i], means.max())
    return extremes
