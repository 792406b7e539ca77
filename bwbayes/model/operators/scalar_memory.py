"""Common base of operators given by a differential equation in the voltage's path.

Their whole memory is one number in each model: a displacement. It changes along the path of the
voltage, and it starts as the parameter ``initial``. An operator of this kind brings a step, or says
how the number changes along a path; where it starts, how pieces of a record are joined, and which
states earlier drives may have left then follow.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from bwbayes.arrays import ArrayLike, BoolArray, FloatArray
from bwbayes.model.declaration import Context, Declaration, Distribution, Values, normal, positive
from bwbayes.model.inputs import Span
from bwbayes.model.operator import OneStateStep, Operator

# Stands for an infinite ceiling, um.
HIGHEST_CEILING = 1e9

Bounds = Callable[[Values], tuple[ArrayLike, ArrayLike]]


class StateMemory(NamedTuple):
    """The last voltage, V, and the state (models,) there, um."""

    voltage: float | FloatArray
    state: FloatArray


class OneState(Operator):
    """An operator that remembers the last voltage and one displacement in each model."""

    def holds(self, column: Values) -> BoolArray:
        """Tell where α < d, or one of them is missing: there the initial curve rises."""
        return np.asarray(column.get("alpha", -np.inf) < column.get("d", np.inf))

    def typical_slope(self, column: Values, span: Span) -> FloatArray:  # noqa: ARG002  # the same anywhere
        """Return d."""
        return column["d"]

    def opening(self, column: Values, half_range: float) -> FloatArray | None:
        """Return β U, or None for an operator without β."""
        return column["beta"] * half_range if "beta" in column else None

    def trace(
        self, column: Values, voltage: FloatArray, state: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Return w (models, samples) along a path, and the state (models,) at its end.

        ``voltage`` (samples,), V; ``state`` (models,), um, is that at its first sample. By default
        that of the operator's step.
        """
        step = self.step(column)
        assert isinstance(step, OneStateStep)
        return step.trace(voltage, state)

    def begin(
        self,
        column: Values,
        voltage: float,
        span: Span,  # noqa: ARG002  # the state says all of the past
        *,
        from_rest: bool,
    ) -> StateMemory:
        """Return the state at the first voltage: ``initial``, or what it becomes from 0 V on."""
        state = self.first_state(column, 0.0 if from_rest else voltage)
        if from_rest and voltage != 0:
            state = self.trace(column, np.array([0.0, voltage]), state)[1]
        return StateMemory(voltage, state)

    def begin_apart(
        self, column: Values, step: OneStateStep, voltage: FloatArray, *, from_rest: bool
    ) -> FloatArray:
        """Return the memory of the operator's step at first voltages (models,) of their own."""
        if not from_rest:
            return step.remembered(StateMemory(voltage, self.first_state(column, voltage)))
        at_zero = step.remembered(StateMemory(0.0, self.first_state(column, 0.0)))
        return step.apply(at_zero, voltage).memory

    def first_state(self, column: Values, voltage: float | FloatArray) -> FloatArray:  # noqa: ARG002  # any
        """Return the state (models,) that ``initial`` means at a voltage, V: by default itself."""
        return column["initial"]

    def advance(
        self, column: Values, voltage: FloatArray, memory: StateMemory
    ) -> tuple[FloatArray, StateMemory]:
        """Return w (models, samples), um, and the memory after the last sample."""
        joined = np.concatenate([[memory.voltage], voltage])
        w, state = self.trace(column, joined, memory.state)
        return w[:, 1:], StateMemory(float(joined[-1]), state)

    def reachable(
        self, column: Values, voltage: float, span: Span
    ) -> tuple[FloatArray, FloatArray]:
        """Return the states (models,) that sweeps through the span leave, lowest and highest.

        From below and from above. No hysteresis at all, as after small and smaller loops, lies
        between.
        """
        remanent = self.left(column, voltage, span)
        return np.minimum(np.min(remanent, axis=0), 0.0), np.maximum(np.max(remanent, axis=0), 0.0)

    def left(self, column: Values, voltage: float, span: Span) -> FloatArray:
        """Return the states (2, models) that sweeps through the span leave, from either side."""
        return np.stack(self.swept(column, voltage, span))

    def swept(self, column: Values, voltage: float, span: Span) -> list[FloatArray]:
        """Return what the operator remembers (models,) of sweeps, from either side."""
        low, high = span
        sweeps = [0.0, high, low, high, low, voltage], [0.0, low, high, low, high, voltage]
        start = np.zeros_like(column["d"])
        return [self.trace(column, np.array(sweep), start)[1] for sweep in sweeps]


def ceiling(alpha: FloatArray, rate: FloatArray) -> FloatArray:
    """Return the largest |h| (models,), um, that a strength α, um/V, and a rate, 1/V, reach."""
    with np.errstate(divide="ignore", over="ignore"):
        return np.minimum(alpha / rate, HIGHEST_CEILING)


# Parameters with the meaning and the priors that they have in the Bouc-Wen model.


def d() -> Declaration:
    """Declare d, the slope behind the hysteresis."""
    return positive(
        "d",
        "um/V",
        r"d",
        "piezoelectric coefficient",
        # A drive that is small for the loop shows d - α, which may be half of d.
        lambda ranges: 1.6 * ranges.slope,
        0.6,
        bounds=lambda earlier: (earlier["alpha"], np.inf),
        limit_at_floor=True,
        aliases=("gain", "d33"),
    )


def alpha() -> Declaration:
    """Declare α, below d."""
    return positive(
        "alpha",
        "um/V",
        r"\alpha",
        "hysteretic displacement per volt at h = 0",
        lambda ranges: 0.7 * ranges.slope,
        bounds=lambda earlier: (-np.inf, earlier["d"]),
        stated_bounds="0 < alpha < d",
        pressed={
            "upper": "the model's slope is zero there; check the displacement's sign and unit, or "
            "fix alpha"
        },
        aliases=("a",),
    )


def beta(scale: float = 1.0, bounds: Bounds | None = None) -> Declaration:
    """Declare β, near 1/U or a ``scale`` of it, where other parameters' bounds favor a large β."""
    description = "hysteresis loop shape"
    return positive(
        "beta",
        "1/V",
        r"\beta",
        description,
        lambda ranges: scale / ranges.voltage,
        2.3,
        limit_at_floor=True,
        bounds=bounds,
    )


def gamma(default: Callable[[Context], Distribution], bounds: Bounds, stated: str) -> Declaration:
    """Declare γ."""
    return Declaration(
        "gamma",
        "1/V",
        r"\gamma",
        "hysteresis loop shape, loading against unloading",
        default,
        bounds=bounds,
        stated_bounds=stated,
        loop=True,
    )


def initial(bounds: Bounds | None = None) -> Declaration:
    """Declare h at the first sample, between bounds if all paths have them."""
    return Declaration(
        "initial",
        "um",
        r"h_0",
        "hysteretic displacement at the first sample",
        lambda context: normal(0.0, 0.3 * context.ranges.reach),
        bounds=bounds,
        scope="record",
        aliases=("h0",),
    )
