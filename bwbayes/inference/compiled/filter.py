"""The noise's Kalman filter for ``LANES`` models side by side, and the sums its density needs.

Most of a record passes :func:`follow`: each sample has a reading, and the filter has settled. If
readings are missing, or the filter has not settled, or the initial state of the dynamics still
affects it, readings pass :func:`gain` and :func:`innovate`. If ``second`` is None, the second state
of the noise is left out of the compiled code.

An offset never dies out, and the slowest lags of the creep hardly do. But consider a response r
that keeps the part ρ of itself from reading to reading. Once the filter has settled and forgotten
the start of r, the estimates are c r and c₂ r, so that its innovation is (1 − c) r, and r needs no
filter.
"""

from __future__ import annotations

import math

import numpy as np

from bwbayes.arrays import FloatArray, IntArray

# isort: off
# fmt: off
from bwbayes.inference.compiled.lanes import (
    CHANGE, COVARIANCE, COVARIANCE_12, COVARIANCE_22, ESTIMATE, ESTIMATE_2, F, F_12, F_21, F_22,
    GAIN, GAIN_2, GAP, INNOVATION, INVERSE, LANES, LATEST, LOG, PRODUCTS, Q, RATIO, RESPONSE,
    SENSOR, SQUARES, VALUE, inner,
)
# fmt: on
# isort: on


@inner(fastmath={"contract", "nsz"})
def follow(
    state: FloatArray,
    second: bool | None,
    readings: FloatArray,
    displacement: FloatArray,
    decays: FloatArray,
    series: IntArray,
) -> None:
    """Advance a settled filter along complete readings (samples,).

    ``displacement`` is that of the models. ``decays`` is ρ of each response that still matters, and
    ``series`` are their indices: as their innovations are in proportion to them, only Σ ρᵗ η of the
    residual's innovations η has to be added up.
    """
    count = series.size
    for k in range(count):
        for i in range(LANES):
            state[INNOVATION + series[k] * LANES + i] = 0.0
    weight = np.ones(count)
    for t in range(readings.size):
        y, row = readings[t], t * LANES
        for i in range(LANES):
            estimate = state[ESTIMATE + i]
            innovation = y - displacement[row + i] - estimate
            if second is None:
                state[ESTIMATE + i] = state[F + i] * estimate + state[GAIN + i] * innovation
            else:
                other = state[ESTIMATE_2 + i]
                state[ESTIMATE + i] = (
                    state[F + i] * estimate + state[F_12 + i] * other + state[GAIN + i] * innovation
                )
                state[ESTIMATE_2 + i] = (
                    state[F_22 + i] * other
                    + state[F_21 + i] * estimate
                    + state[GAIN_2 + i] * innovation
                )
            state[SQUARES + i] += innovation * innovation
            state[LATEST + i] = innovation
        for k in range(count):
            factor, at = weight[k], INNOVATION + series[k] * LANES
            for i in range(LANES):
                state[at + i] += factor * state[LATEST + i]
            weight[k] *= decays[k]
    if count:
        _fold(state, second, readings.size, weight, decays, series)


@inner(error_model="numpy")
def _fold(
    state: FloatArray,
    second: bool | None,
    samples: int,
    weight: FloatArray,
    decays: FloatArray,
    series: IntArray,
) -> None:
    """Add the contributions of some samples to the products, and advance the responses.

    ``weight`` is the part of each response that remains after them; products of two are geometric
    sums.
    """
    count = series.size
    for k in range(count):
        at, rho = series[k] * LANES, decays[k]
        for i in range(LANES):
            share, _ = _parts(state, second, i, rho)
            state[VALUE + at + i] = state[RESPONSE + at + i] * (1.0 - share)
        row = PRODUCTS + (series[k] * (series[k] + 1) // 2) * LANES
        for i in range(LANES):
            pull = state[VALUE + at + i] * state[INNOVATION + at + i]
            state[row + i] += pull * state[INVERSE + i]
        for j in range(k + 1):
            other, product = series[j] * LANES, rho * decays[j]
            total = float(samples)
            if product < 1.0:
                total = (1.0 - weight[k] * weight[j]) / (1.0 - product)
            for i in range(LANES):
                cross_product = state[VALUE + at + i] * state[VALUE + other + i]
                state[row + other + i] += cross_product * total * state[INVERSE + i]
    for k in range(count):
        at = series[k] * LANES
        for i in range(LANES):
            response = state[RESPONSE + at + i] * weight[k]
            state[RESPONSE + at + i] = response
            share, part_2 = _parts(state, second, i, decays[k])
            state[ESTIMATE + at + i], state[ESTIMATE_2 + at + i] = (
                response * share,
                response * part_2,
            )


@inner(error_model="numpy")
def _parts(state: FloatArray, second: bool | None, i: int, rho: float) -> tuple[float, float]:
    """Return c and c₂, the ratios of both estimates to a response that keeps ρ of itself."""
    gain, first = float(state[GAIN + i]), rho - state[F + i]
    if second is None:
        return gain / (first + gain), 0.0
    gain_2, last = state[GAIN_2 + i], rho - state[F_22 + i]
    f_12, f_21 = state[F_12 + i], state[F_21 + i]
    total = (first + gain) * last + f_12 * (gain_2 - f_21)
    return (gain * last + f_12 * gain_2) / total, (first * gain_2 + f_21 * gain) / total


@inner(error_model="numpy")
def is_tracked(
    state: FloatArray, second: bool | None, decays: FloatArray, series: IntArray
) -> bool:
    """Tell whether the estimates of all these responses are proportional to them, to rounding."""
    for k in range(series.size):
        at = series[k] * LANES
        for i in range(LANES):
            response = state[RESPONSE + at + i]
            share, part_2 = _parts(state, second, i, decays[k])
            gap = abs(state[ESTIMATE + at + i] - response * share)
            gap_2 = abs(state[ESTIMATE_2 + at + i] - response * part_2) / (1.0 + abs(part_2))
            size = 1e-13 * abs(response)
            if not (gap <= size and gap_2 <= size):
                return False
    return True


@inner()
def is_settled(state: FloatArray) -> bool:
    """Tell whether the last reading changed no model's covariance, except for rounding."""
    settled = True
    for i in range(LANES):
        settled &= state[CHANGE + i] <= 2e-15 * state[COVARIANCE + i]
    return settled


@inner(error_model="numpy")
def gain(
    state: FloatArray,
    second: bool | None,
    gaps: IntArray,
    steps: FloatArray,
    gains: FloatArray,
    gains_2: FloatArray,
    inverse: FloatArray,
) -> None:
    """Advance the covariance along samples (samples,); write both gains and 1/variance of each.

    ``gaps`` and ``steps`` are as in :func:`bwbayes.inference.compiled.kernels.sums`, the others
    (samples times lanes,). Where there is no reading, nothing is written.
    """
    for t in range(gaps.size):
        if gaps[t] > 0:
            # Predict over the missing readings by the filter's step over this gap.
            over = steps[gaps[t] - 1]
            _take_logs(state)
            for i in range(over.size):
                state[GAP + i] = over[i]
            _predict(state, second, GAP)
        if gaps[t] >= 0:
            _advance(state, second)
            row = t * LANES
            for i in range(LANES):
                gains[row + i] = state[GAIN + i]
                gains_2[row + i] = state[GAIN_2 + i]
                inverse[row + i] = state[INVERSE + i]
    _take_logs(state)


@inner(fastmath={"contract", "nsz"})
def innovate(
    second: bool | None,
    gaps: IntArray,
    steps: FloatArray,
    step: FloatArray,
    gains: FloatArray,
    gains_2: FloatArray,
    estimate: FloatArray,
    other: FloatArray,
    values: FloatArray,
) -> None:
    """Turn a series' values, (samples times lanes,), into innovations, 0 without a reading.

    ``step`` is the filter's step from reading to reading, ``estimate`` and ``other`` (lanes,) are
    its estimates of both states of the noise. All arrays are separate, so that a compiler may take
    several lanes at once.
    """
    for t in range(gaps.size):
        row = t * LANES
        if gaps[t] > 0:
            over = steps[gaps[t] - 1]
            for i in range(LANES):
                before = estimate[i]
                estimate[i] = over[i] * before
                if second is not None:
                    estimate[i] += over[LANES + i] * other[i]
                    other[i] = over[3 * LANES + i] * other[i] + over[2 * LANES + i] * before
        if gaps[t] < 0:
            for i in range(LANES):
                values[row + i] = 0.0
        else:
            for i in range(LANES):
                before = estimate[i]
                innovation = values[row + i] - before
                values[row + i] = innovation
                estimate[i] = step[i] * before + gains[row + i] * innovation
                if second is not None:
                    estimate[i] += step[LANES + i] * other[i]
                    other[i] = step[3 * LANES + i] * other[i] + step[2 * LANES + i] * before
                    other[i] += gains_2[row + i] * innovation


@inner(error_model="numpy")
def _advance(state: FloatArray, second: bool | None) -> None:
    """Advance the covariance to the next reading, and write the gain of this one."""
    for i in range(LANES):
        p, sensor = state[COVARIANCE + i], state[SENSOR + i]
        variance = p + sensor
        inverse = 1.0 / variance
        state[INVERSE + i] = inverse
        state[RATIO + i] *= variance / (state[Q + i] + sensor)
        if second is None:
            state[GAIN + i] = state[F + i] * (p * inverse)
            state[COVARIANCE + i] = p * (sensor * inverse)
        else:
            across, remainder = state[COVARIANCE_12 + i], sensor * inverse
            g, g_2 = p * inverse, across * inverse
            state[GAIN + i] = state[F + i] * g + state[F_12 + i] * g_2
            state[GAIN_2 + i] = state[F_22 + i] * g_2 + state[F_21 + i] * g
            state[COVARIANCE + i], state[COVARIANCE_12 + i] = p * remainder, across * remainder
            state[COVARIANCE_22 + i] -= across * g_2
        # Keep the former covariance for a comparison.
        state[CHANGE + i] = p
    _predict(state, second, F)
    for i in range(LANES):
        state[CHANGE + i] = abs(state[COVARIANCE + i] - state[CHANGE + i])


@inner(error_model="numpy")
def _predict(state: FloatArray, second: bool | None, step: int) -> None:
    """Advance the covariance by a step, whose rows begin at ``step``."""
    for i in range(LANES):
        a, p = state[step + i], state[COVARIANCE + i]
        gained = state[step + 4 * LANES + i]
        if second is None:
            state[COVARIANCE + i] = a * a * p + gained
        else:
            b, c = state[step + LANES + i], state[step + 2 * LANES + i]
            d = state[step + 3 * LANES + i]
            p_12, p_22 = state[COVARIANCE_12 + i], state[COVARIANCE_22 + i]
            top, bottom = a * p + b * p_12, a * p_12 + b * p_22
            low, end = d * p_12 + c * p, d * p_22 + c * p_12
            state[COVARIANCE + i] = a * top + b * bottom + gained
            state[COVARIANCE_12 + i] = d * bottom + c * top + state[step + 5 * LANES + i]
            state[COVARIANCE_22 + i] = d * end + c * low + state[step + 6 * LANES + i]


@inner()
def _take_logs(state: FloatArray) -> None:
    """Move the product of variances to the sum of logs, before it gets too large."""
    for i in range(LANES):
        state[LOG + i] += math.log(state[RATIO + i])
        state[RATIO + i] = 1.0


@inner()
def gather(state: FloatArray, readings: int) -> None:
    """Add the contributions of so many readings with one variance to the sums."""
    if readings == 0:
        return
    for i in range(LANES):
        state[PRODUCTS + i] += state[SQUARES + i] * state[INVERSE + i]
        state[SQUARES + i] = 0.0
        typical = state[Q + i] + state[SENSOR + i]
        state[LOG + i] -= readings * math.log(state[INVERSE + i] * typical)
