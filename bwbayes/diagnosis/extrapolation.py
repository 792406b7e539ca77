"""Range of the drives for which bands were tested, and the predictions that leave it.

A prediction leaves it in voltage, speed, reversals, slowness or duration. There the bands include
the uncertainty of the parameters, and of the actuator's other effects only the creep after slower
drives, by its prior (:mod:`bwbayes.inference.prior_creep`): an actuator saturates at higher
voltages, lags behind faster ones, and drifts.
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
from bwbayes.model.inputs import RETURN, Inputs, Span, fastest, time_between_turns, turning_points
from bwbayes.shown import rounded

# Part of the time between turning points over which a speed is averaged: a sine's peak speed is
# then 0.4% too low, and noise of 1% of its range adds a tenth.
PART = 0.1

# Times that exceed the fitted ones by more than this factor add creep that the record does not
# show. Creep grows with the logarithm of the time, by one or two percent of a change each decade:
# half a decade is half of the usual model error of one or two percent.
LONGER = 3.0


@dataclass(frozen=True)
class Drive:
    """Range of the training drive: a validation on its readings is valid for this range alone.

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
        smallest, largest = rounded(self.depths[0], 2), rounded(self.depths[1])
        return (
            f"{text}, up to {rounded(self.frequency, 2)} Hz, reversals of {smallest} to {largest} V"
        )


def beyond_training(
    posterior: Posterior,
    inputs: Inputs,
    window: slice = slice(None),
) -> list[Finding]:
    """Return the respects in which a drive leaves those that the model was fitted to.

    Findings of kind "range", "speed" and "covariate" are beyond the knowledge of any model, and
    "reversals" beyond the loops on which this one was tested; with "slow" and "duration" there may
    be creep and drift, which may be as small as the bands allow.

    Parameters
    ----------
    posterior
        The posterior of the records that were fitted.
    inputs
        The drive from its first sample on.
    window
        The samples that are predicted; those before are the actuator's history.
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
    # Compare with the record that comes nearest to the drive.
    speed, slower = min(speeds, key=lambda pair: pair[0] / max(pair[1], 1e-300))
    # Noise and sampling change a speed by about a tenth.
    if speed > 1.5 * slower:
        text = (
            f"voltage speed of up to {speed:.3g} V/s exceeds the {slower:.3g} V/s of training; the "
            "bands extrapolate, their level untested, because the lag is not known that well"
        )
        findings.append(Finding("speed", text, "train on a record that is as fast"))
    distance = _distance(posterior, (low, high), voltage, window)
    # It is at most 0.02 for similar drives, and at least 0.03 for others.
    if distance > 0.025:
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


def unexcited_note(findings: Iterable[Finding]) -> str:
    """Name a drive's excitations that the training record lacks; return "" without any."""
    names = {"speed": "fast edges", "slow": "slow holds"}
    kinds = [names[finding.kind] for finding in findings if finding.kind in names]
    return f"this drive excites what the record did not ({', '.join(kinds)})" if kinds else ""


def _covariates(posterior: Posterior, inputs: Inputs, window: slice) -> Iterator[Finding]:
    """Compare the covariates that stages of the model use with their ranges in training."""
    stages = posterior.datasets[0].actuator.stages
    seen_names = {name for stage in stages for name in stage.sees}
    for name in sorted(seen_names & {*inputs.covariates}):
        low, high = covariate_range(posterior, name)
        smallest, largest = inputs.range_of(name, [window])
        slack = 0.02 * (high - low)
        if smallest < low - slack or largest > high + slack:
            text = (
                f"{name} of {smallest:.4g} to {largest:.4g} exceeds the training range "
                f"{low:.4g} to {high:.4g}; the bands extrapolate, their level untested"
            )
            yield Finding("covariate", text, "train on a record that spans this range")


def covariate_range(posterior: Posterior, name: str) -> Span:
    """Return the least and the largest value of a covariate that were fitted."""
    ranges = [data.inputs.range_of(name, data.training) for data in posterior.datasets]
    return Span(min(low for low, _ in ranges), max(high for _, high in ranges))


def _fitted_range(posterior: Posterior) -> tuple[float, float]:
    """Return the lowest and the highest voltage that was fitted, V."""
    windows = [
        data.voltage[training_window]
        for data in posterior.datasets
        for training_window in data.training
    ]
    return min(float(np.min(w)) for w in windows), max(float(np.max(w)) for w in windows)


def _distance(
    posterior: Posterior, span: tuple[float, float], voltage: FloatArray, window: slice
) -> float:
    """Return the mean distance of a drive's loops from those of training, in parts of the range.

    Rate-independent hysteresis follows a branch that begins at the last reversal.
    """
    extent = span[1] - span[0]
    fitted = np.concatenate(
        [
            _branches(data.voltage, training_window, RETURN * extent)
            for data in posterior.datasets
            for training_window in data.training
        ]
    )
    # Another finding covers voltages beyond the range; a drive without a reversal has no loop.
    planned = _branches(np.clip(voltage, *span), window, RETURN * extent)
    if not (fitted.size and planned.size):
        return 0.0
    distances, _ = scipy.spatial.KDTree(fitted / extent).query(planned / extent)
    return float(np.mean(distances))


def _branches(voltage: FloatArray, window: slice, threshold: float) -> FloatArray:
    """Return voltage and last reversal (samples, 2), V, at some thousand samples."""
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
    """Compare the voltage's means over some times T with those of training.

    Creep with the time T follows the mean over T. The creep that training does not show has the
    size ∫ (mean now − mean then) d log T over the times whose means exceed those of training.
    """
    low, high = span
    a_decade, sides = 8, np.array([[-1.0], [1.0]])  # number of times, and sides of the range
    # Another finding covers voltages beyond the range.
    inside = np.clip(voltage[: window.stop], low, high)
    longest = inside.size * interval
    decades = max(math.log10(longest / (PART * turn_time)), 0.0)
    times = longest / 10 ** (np.arange(1 + math.ceil(a_decade * decades)) / a_decade)
    planned = _slow_means(inside, interval, times, [window])
    fitted = []
    for dataset in posterior.datasets:
        interval = dataset.actuator.interval
        means = sides * _slow_means(dataset.voltage, interval, times, dataset.training)
        # For times longer than the record, take the means over its longest time.
        finite = np.flatnonzero(np.isfinite(means[0]))
        fitted.append(means[:, finite[np.searchsorted(finite, np.arange(times.size))]])
    # A mean over a longer time is reached by the mean over a shorter one somewhere.
    before = np.maximum.accumulate(np.max(fitted, axis=0), axis=1)
    excess = np.maximum(np.nan_to_num(sides * planned - before), 0.0)
    # The unit is volts times decades of time; a sine over the whole range has half of it per side.
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

    Creep with the time T follows the mean over the time T before a sample. All samples in the
    windows count that have so much time before them; the result is nan if none has.
    """
    spans = [window.indices(voltage.size)[:2] for window in windows]
    total = np.concatenate([[0.0], np.cumsum(voltage[: spans[-1][1]])])
    extremes = np.full((2, times.size), np.nan)
    for i, length in enumerate(np.maximum(np.rint(times / interval), 1).astype(np.int64).tolist()):
        for start, stop in spans:
            # Means over many samples change slowly: take the last one, and one each fiftieth of T.
            ends = np.arange(stop, max(start, length - 1), -max(length // 50, 1))
            if ends.size:
                means = (total[ends] - total[ends - length]) / length
                extremes[0, i] = np.fmin(extremes[0, i], means.min())
                extremes[1, i] = np.fmax(extremes[1, i], means.max())
    return extremes
