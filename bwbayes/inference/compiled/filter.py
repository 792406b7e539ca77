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
from typing import Annotated

import numpy as np

from bwbayes.arrays import FloatArray, IntArray
from bwbayes.inference.compiled.lanes import LANES, Row, Struct, Structs, inner
from bwbayes.model.linear import MOST_TIMES

# The series that are filtered: the residual, the record's own offset, two free responses of the
# dynamics, those of the creep.
SERIES = 4 + MOST_TIMES

Each = Annotated[FloatArray, (SERIES,)]
Matrix = Annotated[FloatArray, (2, 2)]

# Where products of innovations are, by the indices of their series.
PAIR = np.array(
    [[max(i, j) * (max(i, j) + 1) // 2 + min(i, j) for j in range(SERIES)] for i in range(SERIES)]
)


class Transition(Struct):
    """The filter's step from a reading to the next."""

    f: Matrix
    q: Matrix


class FilterState(Struct):
    """Numbers and memory of the filter.

    Each series has a value, estimates of both states of the noise and an innovation; a response
    also has the two numbers of its recursion. ``products`` are sums of products of innovations over
    their variances, of pairs i ≥ j of series; ``log`` is the sum of the variances' logarithms, less
    those of Q₁₁ + s².
    """

    step: Transition
    sensor: Row
    covariance: Row
    covariance_12: Row
    covariance_22: Row
    change: Row
    gain: Row
    gain_2: Row
    inverse: Row
    ratio: Row
    log: Row
    squares: Row
    latest: Row
    value: Each
    estimate: Each
    estimate_2: Each
    innovation: Each
    response: Each
    response_2: Each
    products: Annotated[FloatArray, (SERIES * (SERIES + 1) // 2,)]


@inner()
def begin(state: FilterState) -> None:
    """Complete the state at the first reading, before which the covariance is stationary."""
    for i in range(LANES):
        state.covariance_22[i] = state.covariance[i]
        state.ratio[i], state.change[i] = 1.0, np.inf


@inner(fastmath={"contract", "nsz"})
def follow(
    state: FilterState,
    second: bool | None,
    readings: FloatArray,
    displacement: FloatArray,
    decays: FloatArray,
    series: IntArray,
) -> None:
    """Advance a settled filter along complete readings (samples,).

    ``displacement`` (samples, lanes) is that of the models. ``decays`` is ρ of each response that
    still matters, and ``series`` are their indices: as their innovations are in proportion to them,
    only Σ ρᵗ η of the residual's innovations η has to be added up.
    """
    step, gain, gain_2, innovations = state.step, state.gain, state.gain_2, state.innovation
    estimate, estimate_2 = state.estimate[0], state.estimate_2[0]
    f_11, f_12, f_21, f_22 = step.f[0, 0], step.f[0, 1], step.f[1, 0], step.f[1, 1]
    squares, latest = state.squares, state.latest
    count = series.size
    for k in range(count):
        for i in range(LANES):
            innovations[series[k], i] = 0.0
    weight = np.ones(count)
    for t in range(readings.size):
        y = readings[t]
        for i in range(LANES):
            before = estimate[i]
            innovation = y - displacement[t, i] - before
            if second is None:
                estimate[i] = f_11[i] * before + gain[i] * innovation
            else:
                other = estimate_2[i]
                estimate[i] = f_11[i] * before + f_12[i] * other + gain[i] * innovation
                estimate_2[i] = f_22[i] * other + f_21[i] * before + gain_2[i] * innovation
            squares[i] += innovation * innovation
            latest[i] = innovation
        for k in range(count):
            factor, total = weight[k], innovations[series[k]]
            for i in range(LANES):
                total[i] += factor * latest[i]
            weight[k] *= decays[k]
    if count:
        _fold(state, second, readings.size, weight, decays, series)


@inner(error_model="numpy")
def _fold(
    state: FilterState,
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
    value, response, inverse = state.value, state.response, state.inverse
    count = series.size
    for k in range(count):
        at, rho = series[k], decays[k]
        for i in range(LANES):
            share, _ = _parts(state, second, i, rho)
            value[at, i] = response[at, i] * (1.0 - share)
        row = at * (at + 1) // 2
        for i in range(LANES):
            pull = value[at, i] * state.innovation[at, i]
            state.products[row, i] += pull * inverse[i]
        for j in range(k + 1):
            other, product = series[j], rho * decays[j]
            total = float(samples)
            if product < 1.0:
                total = (1.0 - weight[k] * weight[j]) / (1.0 - product)
            for i in range(LANES):
                cross_product = value[at, i] * value[other, i]
                state.products[row + other, i] += cross_product * total * inverse[i]
    for k in range(count):
        at = series[k]
        for i in range(LANES):
            response[at, i] *= weight[k]
            share, part_2 = _parts(state, second, i, decays[k])
            state.estimate[at, i] = response[at, i] * share
            state.estimate_2[at, i] = response[at, i] * part_2


@inner(error_model="numpy")
def _parts(state: FilterState, second: bool | None, i: int, rho: float) -> tuple[float, float]:
    """Return c and c₂, the ratios of both estimates to a response that keeps ρ of itself."""
    step = state.step
    gain, first = float(state.gain[i]), rho - step.f[0, 0, i]
    if second is None:
        return gain / (first + gain), 0.0
    gain_2, last = state.gain_2[i], rho - step.f[1, 1, i]
    f_12, f_21 = step.f[0, 1, i], step.f[1, 0, i]
    total = (first + gain) * last + f_12 * (gain_2 - f_21)
    return (gain * last + f_12 * gain_2) / total, (first * gain_2 + f_21 * gain) / total


@inner(error_model="numpy")
def is_tracked(
    state: FilterState, second: bool | None, decays: FloatArray, series: IntArray
) -> bool:
    """Tell whether the estimates of all these responses are proportional to them, to rounding."""
    for k in range(series.size):
        at = series[k]
        for i in range(LANES):
            response = state.response[at, i]
            share, part_2 = _parts(state, second, i, decays[k])
            gap = abs(state.estimate[at, i] - response * share)
            gap_2 = abs(state.estimate_2[at, i] - response * part_2) / (1.0 + abs(part_2))
            size = 1e-13 * abs(response)
            if not (gap <= size and gap_2 <= size):
                return False
    return True


@inner()
def is_heard(state: FilterState, series: int) -> bool:
    """Tell whether the unknown initial state still matters to any model in one of its series.

    A response below 10⁻¹⁸ of its initial size adds nothing. A response that no longer matters is
    set to zero: numbers that decay for ever become subnormal, with which a processor takes ten
    times as long.
    """
    response, response_2 = state.response[series], state.response_2[series]
    estimate, estimate_2 = state.estimate[series], state.estimate_2[series]
    heard = False
    for i in range(LANES):
        if max(abs(response[i]), abs(response_2[i]), abs(estimate[i]), abs(estimate_2[i])) > 1e-18:
            heard = True
        else:
            response[i] = response_2[i] = estimate[i] = estimate_2[i] = 0.0
    return heard


@inner()
def is_settled(state: FilterState) -> bool:
    """Tell whether the last reading changed no model's covariance, except for rounding."""
    settled = True
    for i in range(LANES):
        settled &= state.change[i] <= 2e-15 * state.covariance[i]
    return settled


@inner(error_model="numpy")
def gain(
    state: FilterState,
    second: bool | None,
    gaps: IntArray,
    steps: Structs,
    gains: FloatArray,
    gains_2: FloatArray,
    inverse: FloatArray,
) -> None:
    """Advance the covariance along samples (samples,); write both gains and 1/variance of each.

    ``gaps`` and ``steps`` are as in :func:`bwbayes.inference.compiled.kernels.sums`, the others
    (samples, lanes). Where there is no reading, nothing is written.
    """
    for t in range(gaps.size):
        if gaps[t] > 0:
            # Predict over the missing readings.
            _take_logs(state)
            _predict(state, second, steps[gaps[t]])
        if gaps[t] >= 0:
            _advance(state, second)
            for i in range(LANES):
                gains[t, i] = state.gain[i]
                gains_2[t, i] = state.gain_2[i]
                inverse[t, i] = state.inverse[i]
    _take_logs(state)


@inner(fastmath={"contract", "nsz"})
def innovate(
    second: bool | None,
    gaps: IntArray,
    steps: Structs,
    gains: FloatArray,
    gains_2: FloatArray,
    estimate: FloatArray,
    other: FloatArray,
    values: FloatArray,
) -> None:
    """Turn a series' values, (samples, lanes), into innovations, 0 without a reading.

    ``estimate`` and ``other`` (lanes,) are its estimates of both states of the noise.
    """
    step = steps[0]
    for t in range(gaps.size):
        if gaps[t] > 0:
            over = steps[gaps[t]]
            for i in range(LANES):
                before = estimate[i]
                estimate[i] = over.f[0, 0, i] * before
                if second is not None:
                    estimate[i] += over.f[0, 1, i] * other[i]
                    other[i] = over.f[1, 1, i] * other[i] + over.f[1, 0, i] * before
        if gaps[t] < 0:
            for i in range(LANES):
                values[t, i] = 0.0
        else:
            for i in range(LANES):
                before = estimate[i]
                innovation = values[t, i] - before
                values[t, i] = innovation
                estimate[i] = step.f[0, 0, i] * before + gains[t, i] * innovation
                if second is not None:
                    estimate[i] += step.f[0, 1, i] * other[i]
                    other[i] = step.f[1, 1, i] * other[i] + step.f[1, 0, i] * before
                    other[i] += gains_2[t, i] * innovation


@inner(error_model="numpy")
def _advance(state: FilterState, second: bool | None) -> None:
    """Advance the covariance to the next reading, and write the gain of this one."""
    step, sensors, change = state.step, state.sensor, state.change
    covariance, covariance_12 = state.covariance, state.covariance_12
    for i in range(LANES):
        p, sensor = covariance[i], sensors[i]
        variance = p + sensor
        inverse = 1.0 / variance
        state.inverse[i] = inverse
        state.ratio[i] *= variance / (step.q[0, 0, i] + sensor)
        if second is None:
            state.gain[i] = step.f[0, 0, i] * (p * inverse)
            covariance[i] = p * (sensor * inverse)
        else:
            across, remainder = covariance_12[i], sensor * inverse
            g, g_2 = p * inverse, across * inverse
            state.gain[i] = step.f[0, 0, i] * g + step.f[0, 1, i] * g_2
            state.gain_2[i] = step.f[1, 1, i] * g_2 + step.f[1, 0, i] * g
            covariance[i], covariance_12[i] = p * remainder, across * remainder
            state.covariance_22[i] -= across * g_2
        # Keep the former covariance for a comparison.
        change[i] = p
    _predict(state, second, step)
    for i in range(LANES):
        change[i] = abs(covariance[i] - change[i])


@inner(error_model="numpy")
def _predict(state: FilterState, second: bool | None, step: Transition) -> None:
    """Advance the covariance by a step."""
    covariance, covariance_12 = state.covariance, state.covariance_12
    covariance_22 = state.covariance_22
    for i in range(LANES):
        a, p, gained = step.f[0, 0, i], covariance[i], step.q[0, 0, i]
        if second is None:
            covariance[i] = a * a * p + gained
        else:
            b, c, d = step.f[0, 1, i], step.f[1, 0, i], step.f[1, 1, i]
            p_12, p_22 = covariance_12[i], covariance_22[i]
            top, bottom = a * p + b * p_12, a * p_12 + b * p_22
            low, end = d * p_12 + c * p, d * p_22 + c * p_12
            covariance[i] = a * top + b * bottom + gained
            covariance_12[i] = d * bottom + c * top + step.q[0, 1, i]
            covariance_22[i] = d * end + c * low + step.q[1, 1, i]


@inner()
def _take_logs(state: FilterState) -> None:
    """Move the product of variances to the sum of logs, before it gets too large."""
    for i in range(LANES):
        state.log[i] += math.log(state.ratio[i])
        state.ratio[i] = 1.0


@inner()
def gather(state: FilterState, readings: int) -> None:
    """Add the contributions of so many readings with one variance to the sums."""
    if readings == 0:
        return
    for i in range(LANES):
        state.products[0, i] += state.squares[i] * state.inverse[i]
        state.squares[i] = 0.0
        typical = state.step.q[0, 0, i] + state.sensor[i]
        state.log[i] -= readings * math.log(state.inverse[i] * typical)
