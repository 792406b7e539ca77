"""Slow and obvious operators: integrators, plays one by one, extrema looked for anew each time."""

import math
from collections.abc import Callable, Mapping, Sequence
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from scipy.integrate import solve_ivp

from bwbayes.arrays import FloatArray
from bwbayes.model.declaration import Context, Distribution, Ranges
from bwbayes.model.inputs import Span
from bwbayes.model.operator import Operator

RANGES = Ranges(voltage=50.0, displacement=20.0, middle=5.0, time=0.5, bias=10.0)
SPAN = Span(-100.0, 100.0)

Rows = dict[str, FloatArray]
Everett = Callable[[float, float], float]
Slope = Callable[[float, float, float], float]
"""The state's slope by the voltage at (u, state, direction)."""


def rows(**columns: float | Sequence[float] | FloatArray) -> Rows:
    size = max(np.size(values) for values in columns.values())
    return {name: np.resize(np.asarray(v, dtype=float), size) for name, v in columns.items()}


def run(
    operator: Operator,
    column: Mapping[str, FloatArray],
    voltage: FloatArray,
    span: Span | None = SPAN,
) -> FloatArray:
    start = Span(0.0, 0.0) if span is None else span
    memory = operator.begin(column, float(voltage[0]), start, from_rest=span is None)
    return operator.advance(column, voltage, memory)[0]


def drawn(operator: Operator, size: int, seed: int) -> Rows:
    """Draw models that hold from the default priors, cut by floors and bounds."""
    generator = np.random.default_rng(seed)
    known, size = Context(RANGES), 3 * size + 20
    column: Rows = {}
    for declared in operator.parameters:
        prior = declared.default(known)
        if not isinstance(prior, Distribution):
            column[declared.name] = np.full(size, prior)
            continue
        least, most = prior.support
        low, high = np.full(size, max(least, declared.floor)), np.full(size, most)
        below, above = declared.limits(column)
        low, high = np.maximum(low, below), np.minimum(high, above)
        values, _ = prior.from_normal(generator.standard_normal(size), low, high)
        column[declared.name] = values
    holds = np.flatnonzero(np.broadcast_to(operator.holds(column), size))[: (size - 20) // 3]
    return {name: values[holds] for name, values in column.items()}


def paths() -> dict[str, FloatArray]:
    """Voltages from a start that is not zero: turns, plateaus, huge and tiny steps."""
    generator = np.random.default_rng(7)
    corners = generator.normal(0.0, 60.0, 13)
    walk = np.interp(np.linspace(0, 12, 12 * 7 + 1), np.arange(13), corners)
    plateaus = np.repeat(walk[:30], generator.integers(1, 4, 30))
    sizes = 10.0 ** generator.uniform(-9, 2.5, 40) * generator.choice([-1, 1], 40)
    return {
        "walk": walk,
        "plateaus": plateaus,
        "steps of all sizes": 30.0 + np.cumsum(sizes),
        "one huge step": np.array([-3.0, 3000.0, 2999.0, -1e4]),
        "still": np.full(4, -12.0),
        "unipolar": 50 + 50 * np.sin(np.linspace(0.3, 9.0, 60)),
    }


def by_integration(
    voltage: FloatArray, slope: Slope, initial: float, kinks: Sequence[Callable[..., float]] = ()
) -> FloatArray:
    """Integrate from sample to sample with DOP853 at 1e-12, anew at every kink.

    ``kinks`` are functions of (u, state) that change their sign at one.
    """
    states = [initial]
    for before, after in pairwise(voltage.tolist()):
        states.append(_step(before, after, states[-1], slope, kinks))
    return np.array(states)


def _step(
    u: float, end: float, state: float, slope: Slope, kinks: Sequence[Callable[..., float]]
) -> float:
    if u == end:
        return state
    s = float(np.sign(end - u))

    def rate(v: float, y: FloatArray) -> list[float]:
        return [s * slope(u + s * v, float(y[0]), s)]

    def event(kink: Callable[..., float]) -> Callable[..., float]:
        def crossed(v: float, y: FloatArray) -> float:
            return kink(u + s * v, float(y[0]))

        crossed.terminal = True  # type: ignore[attr-defined]
        return crossed

    whole = abs(end - u)
    solved = solve_ivp(
        rate,
        (0.0, whole),
        [state],
        method="DOP853",
        rtol=1e-12,
        atol=1e-13,
        events=[event(kink) for kink in kinks] or None,
    )
    assert solved.success
    if solved.status == 0:
        return float(solved.y[0, -1])
    # A little beyond the kink with Euler's rule, which is as exact as needed there.
    least = 1e-11 * max(whole, 1.0)
    past, got = float(solved.t[-1]) + least, float(solved.y[0, -1])
    if past >= whole:
        return got
    got += least * rate(past, np.array([got]))[0]
    return _step(u + s * past, end, got, slope, kinks)


def walk(seed: int, turns: int = 25) -> FloatArray:
    """Go between random turning points with plateaus, steps of 1e-7 V and steps in one piece."""
    generator = np.random.default_rng(seed)
    corners = np.append(generator.normal(20.0, 60.0, turns), [50.0, 49.0, 50.0, -10.0, 50.0])
    parts = [np.zeros(1) + corners[0]]
    for start, end in pairwise(corners):
        count = int(generator.integers(1, 9))
        straight = np.linspace(start, end, count + 1)[1:]
        tiny = end + np.sign(end - start) * 1e-7 * np.arange(1, generator.integers(1, 4))
        parts += [straight, np.repeat(straight[-1], generator.integers(0, 3)), tiny]
    return np.concatenate(parts)


def path(initial: float, voltage: FloatArray, span: Span | None) -> list[float]:
    """Return all voltages from the demagnetized state on, of which the record is the end."""
    first = float(voltage[0])
    before = [0.0]
    if span is not None:
        high, low = max(span.high, first), min(span.low, first)
        before = [0.0, high, low, first + (initial + 1) / 2 * (high - first)]
    return before + [float(u) for u in voltage]


def by_extrema(everett: Everett, voltages: Sequence[float], samples: int) -> FloatArray:
    """Return w of the last samples: for each, its dominant extrema out of all voltages so far.

    The first is the largest |u|; then in turn the lowest and highest of what came after the last.
    """
    result = []
    for end in range(len(voltages) - samples + 1, len(voltages) + 1):
        so_far = list(voltages[:end])
        at = max(range(end), key=lambda k: (abs(so_far[k]), k))
        peak = so_far[at]
        w = math.copysign(everett(-abs(peak), abs(peak)) / 2, peak)
        sign = -1.0 if peak > 0 else 1.0
        while at < end - 1:
            ahead = max(range(at + 1, end), key=lambda k: (sign * so_far[k], k))
            w += sign * everett(so_far[at], so_far[ahead])
            at, sign = ahead, -sign
        result.append(w)
    return np.array(result)


def by_plays(
    slope: float, thresholds: FloatArray, weights: FloatArray, voltages: Sequence[float]
) -> FloatArray:
    """Update plays voltage by voltage, and return w at all voltages; the first must be zero."""
    z = np.zeros_like(thresholds)
    result = []
    for u in voltages:
        z = np.maximum(u - thresholds, np.minimum(u + thresholds, z))
        result.append(slope * u + float(weights @ z))
    return np.array(result)


class Model(NamedTuple):
    """α in um/V, β and γ in um^(1−n)/V, and n."""

    alpha: float
    beta: float
    gamma: float
    exponent: float = 1.0


def random_walk(seed: int, turns: int = 25, samples: int = 6) -> FloatArray:
    """Go straight between random turning points; (turns x samples + 1,), V."""
    generator = np.random.default_rng(seed)
    corners = generator.normal(0.0, 60.0, turns + 1)
    return np.interp(np.linspace(0, turns, turns * samples + 1), np.arange(turns + 1), corners)


def assert_close(expected: FloatArray, got: FloatArray, tolerance: float) -> None:
    np.testing.assert_allclose(got, expected, rtol=0, atol=tolerance * np.abs(expected).max())
