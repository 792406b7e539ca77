"""What tests of operators given by differential equations share: paths, draws, an integrator."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from itertools import pairwise

import numpy as np
from scipy.integrate import solve_ivp

from bwbayes.arrays import FloatArray
from bwbayes.model.declaration import Context, Ranges
from bwbayes.model.distributions import Distribution
from bwbayes.model.operator import Operator, Span

__all__ = ["RANGES", "SPAN", "by_integration", "columns", "paths", "prior_draws", "single", "w_of"]

RANGES = Ranges(voltage=50.0, displacement=20.0, middle=5.0, time=0.5, bias=10.0)
SPAN = Span(-100.0, 100.0)

Slope = Callable[[float, float, float], float]
"""The state's slope by the voltage at (u, state, direction)."""


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


def single(**values: float) -> dict[str, FloatArray]:
    """Return one model's columns."""
    return {name: np.array([value]) for name, value in values.items()}


def columns(models: Sequence[Mapping[str, float]]) -> dict[str, FloatArray]:
    """Return many models' columns."""
    return {name: np.array([model[name] for model in models]) for name in models[0]}


def w_of(
    operator: Operator,
    column: Mapping[str, FloatArray],
    voltage: FloatArray,
    pieces: Sequence[int] = (),
) -> FloatArray:
    """Return w (models, samples) along a record cut before these samples."""
    memory = operator.begin(column, float(voltage[0]), SPAN, from_rest=False)
    parts = []
    for part in np.split(voltage, pieces):
        w, memory = operator.advance(column, part, memory)
        parts.append(w)
    return np.hstack(parts)


def prior_draws(operator: Operator, size: int, seed: int) -> dict[str, FloatArray]:
    """Draw models from the default priors, cut by floors and bounds; not all of them hold."""
    generator = np.random.default_rng(seed)
    known = Context(RANGES)
    column: dict[str, FloatArray] = {}
    for declared in operator.parameters:
        prior = declared.default(known)
        if not isinstance(prior, Distribution):
            column[declared.name] = np.full(size, prior)
            continue
        least, most = prior.support
        low, high = np.full(size, max(least, declared.floor)), np.full(size, most)
        if declared.bounds is not None:
            below, above = declared.bounds(column)
            low, high = np.maximum(low, below), np.minimum(high, above)
        values, _ = prior.from_normal(generator.standard_normal(size), low, high)
        column[declared.name] = values
    return column
