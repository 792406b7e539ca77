"""Operators whose whole memory is one number in each model, a displacement, and their steps.

It changes along the path of the voltage by a differential equation, and it starts as the parameter
``initial``. An operator of this kind brings a step, or says how the number changes along a path;
where it starts, how pieces of a record are joined, and which states earlier drives may have left
then follow.

Bouc-Wen with n = 1 and its kin relax along the path. The hysteretic displacement h behind a curve f
follows the voltage u with a strength a and a rate c,

    w = f(u) − h,   f = d u + d₂ u² + d₃ u³,   dg/dv = a(u) − c g,   a = α + α₁ u + α₂ u²,

along a piece of direction s, with v = |u − u₀| and g = s h. The rate may be one below g = 0 and
another above, and may depend on the signs of s and u. Between zeros of g and u it is exact:

    g = g₀ + v [(a(u₀) − c g₀) φ₁ + v (s a′(u₀) φ₂ + v a″ φ₃)],   φ at −c v.

So Bouc-Wen with n = 1, asymmetric or not, backlash-like and Duhem loops are one step.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import cached_property
from typing import Any, ClassVar, NamedTuple, Self

import numpy as np

from bwbayes.arrays import ArrayLike, BoolArray, FloatArray, anywhere, select
from bwbayes.model.declaration import Context, Declaration, Distribution, Values, normal, positive
from bwbayes.model.inputs import Span
from bwbayes.model.operator import HysteresisStep, OneStateStep, Operator

# Stands for an infinite ceiling, um.
HIGHEST_CEILING = 1e9

# Bounds that other parameters put on one may be rounded by this part.
SLACK = 1e-12

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
        self,
        column: Values,
        step: HysteresisStep,
        voltage: FloatArray,
        span: Span,
        *,
        from_rest: bool,
    ) -> FloatArray:
        """Return the memory of the operator's step at first voltages (models,) of their own."""
        if not isinstance(step, OneStateStep):
            return super().begin_apart(column, step, voltage, span, from_rest=from_rest)
        if not from_rest:
            return step.remembered(StateMemory(voltage, self.first_state(column, voltage)))
        at_zero = step.remembered(StateMemory(0.0, self.first_state(column, 0.0)))
        return step.apply(at_zero, voltage)[2]

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


# Stands for a rate of exactly zero: (1 - exp(-c v)) / c is v to machine precision at this c.
TINY = 1e-100

# With a rate below zero, h = α / c is a state of unstable rest, and for β = 0 it is the ceiling
# itself. A start that rounding puts on it or beyond is taken to lie this fraction of the way there.
INSIDE = 1 - 1e-14

# φ₁(−z) = Σ (−z)^k / (k + 1)! and φ₃(−z) = Σ (−z)^k / (k + 3)!, to 3e-14 up to so large a z.
SHORT, BENT = 0.1, 0.25
SERIES, THIRD = (
    tuple((-1.0) ** k / math.factorial(k + order) for k in range(9)) for order in (1, 3)
)


class RelaxingStep(OneStateStep):
    """w = f(u) − h, with h that relaxes along the voltage's path: dg/dv = a(u) − c g, g = s h."""

    ROW: ClassVar = "d, d2, d3, α, α1, α2, and the rates c against and ahead, by direction and sign"

    @classmethod
    def of(
        cls,
        curve: Sequence[FloatArray] | FloatArray,
        strength: Sequence[FloatArray] | FloatArray,
        against: FloatArray,
        ahead: FloatArray,
    ) -> Self:
        """Return the step of a curve, a strength, and rates.

        Parameters
        ----------
        curve, strength
            d, d₂ and d₃, and α, α₁ and α₂, or the first of each, (models,), um/V, um/V² and um/V³.
        against, ahead
            c for g < 0 and from there on, 1/V: (models,), or (4, models) for directions and signs
            of the voltage of (−1, −1), (−1, 1), (1, −1) and (1, 1). Where one is not the other, α₁
            and α₂ are zero.
        """
        numbers = np.zeros((curve[0].size, 14))
        rows = numbers.T
        rows[: len(curve)], rows[3 : 3 + len(strength)] = curve, strength
        rows[6:10], rows[10:] = against, ahead
        rates = numbers[:, 6:]
        rates[np.abs(rates) < TINY] = TINY
        return cls(numbers)

    @cached_property
    def curved(self) -> bool:
        """Whether any model's f or a is more than d u or α."""
        return bool(self.parameters[:, [1, 2, 4, 5]].any())

    @cached_property
    def signed(self) -> bool:
        """Whether any model's rates know the signs of the voltage or its direction."""
        rates = self.parameters[:, 6:].reshape(-1, 2, 4)
        return bool((rates != rates[..., :1]).any())

    @staticmethod
    def move(parameters: Any, memory: Any, voltage: Any, after: Any) -> tuple[Any, Any]:
        """Return f(u) − h and its slope f′ − a + c g."""
        alpha, alpha1, alpha2 = parameters[3], parameters[4], parameters[5]
        start, up = memory[0], voltage >= memory[0]
        s, travel = select(up, 1.0, -1.0), np.abs(voltage - start)
        # The travel to zero volts, if that is ahead: there the rates may change.
        early = select(s * start < 0.0, np.minimum(np.abs(start), travel), travel)
        toward = s * start < 0.0
        against = select(
            toward,
            select(up, parameters[8], parameters[7]),
            select(up, parameters[9], parameters[6]),
        )
        ahead = select(
            toward,
            select(up, parameters[12], parameters[11]),
            select(up, parameters[13], parameters[10]),
        )
        strength, tilt = alpha + start * (alpha1 + start * alpha2), alpha1 + 2.0 * start * alpha2
        g, rate = relaxed(s * memory[1], early, strength, s * tilt, 2.0 * alpha2, against, ahead)
        if anywhere(travel > early):
            late = travel - early
            against = select(up, parameters[9], parameters[6])
            ahead = select(up, parameters[13], parameters[10])
            further, faster = relaxed(g, late, alpha, s * alpha1, 2.0 * alpha2, against, ahead)
            g, rate = select(late > 0.0, further, g), select(late > 0.0, faster, rate)
        after[0], after[1] = voltage, s * g
        w = voltage * (parameters[0] + voltage * (parameters[1] + voltage * parameters[2])) - s * g
        slope = parameters[0] + voltage * (2.0 * parameters[1] + 3.0 * voltage * parameters[2])
        return w, slope - (alpha + voltage * (alpha1 + voltage * alpha2)) + rate * g

    def slopes(self, limits: Span) -> tuple[FloatArray, FloatArray]:  # noqa: ARG002  # anywhere
        """Return d − α + c g at the ceilings: h is steepest just after a turn. f and a are even."""
        d, alpha = self.parameters.T[[0, 3]]
        against, ahead = self.parameters.T[6:].reshape(2, 2, 2, -1)
        tops = alpha / np.maximum(ahead.min(axis=1), TINY)
        lowest = alpha + np.max(np.maximum(against, 0.0) * tops[::-1, np.newaxis], axis=(0, 1))
        highest = np.max(ahead * tops[:, np.newaxis], axis=(0, 1)) - alpha
        return d - lowest, d + np.maximum(highest, 0.0)

    def coefficients(self) -> dict[str, tuple[Any, str]]:
        """Return d to d₃ and α to α₂, but zeros, and the rates, by signs if they differ."""
        names = ("d", "d2", "d3", "alpha", "alpha1", "alpha2")
        units = ("um/V", "um/V^2", "um/V^3") * 2
        values, rates = np.split(self.parameters[0], [6])
        rows = zip(names, values.tolist(), units, strict=True)
        slopes = {name: (value, unit) for name, value, unit in rows if value or name == "d"}
        return slopes | {
            name: (rate.tolist() if self.signed else float(rate[0, 0]), "1/V")
            for name, rate in zip(("against", "ahead"), rates.reshape(2, 2, 2), strict=True)
        }


def relaxed(
    g: Any, travel: Any, strength: Any, tilt: Any, bend: Any, against: Any, ahead: Any
) -> tuple[Any, Any]:
    """Return g = s h after a travel, V, in direction s, and the rate c then.

    dg/dv = a − c g, with the rate c against for g < 0 and ahead from there on, 1/V, and a, um/V, at
    first the strength, with the first derivative tilt and the second one bend by v.
    """
    unstable = (travel > 0.0) & (g < 0.0) & (against < 0.0)
    g = select(unstable, np.maximum(g, INSIDE * strength / against), g)
    rate = select(g < 0.0, against, ahead)
    reached = relax(g, travel, strength, rate, phi(rate * travel))
    if anywhere((tilt != 0.0) | (bend != 0.0)):
        phi_1, phi_2, phi_3 = phi_functions(rate * travel)
        reached = bent(g, travel, strength, rate, tilt, bend, phi_1, phi_2, phi_3)
    passed = (g < 0.0) & (reached > 0.0) & (against != ahead)
    if anywhere(passed):
        # Models that do not pass need not have a place where they would.
        lost = np.maximum(-np.minimum(g, 0.0) * against / strength, -INSIDE)
        remaining = np.maximum(travel - np.log1p(lost) / against, 0.0)
        reached = select(passed, strength * remaining * phi(ahead * remaining), reached)
        rate = select(passed, ahead, rate)
    return reached, rate


def relax(g: Any, travel: Any, strength: Any, rate: Any, phi_1: Any) -> Any:
    """Return g after a travel with a constant strength, with φ₁ at minus the rate times it."""
    return g + (strength - rate * g) * (travel * phi_1)


def bent(
    g: Any, travel: Any, strength: Any, rate: Any, tilt: Any, bend: Any, phi_1: Any, phi_2: Any,
    phi_3: Any,
) -> Any:  # fmt: skip
    """Return the same where the strength changes, with φ₁, φ₂ and φ₃ there."""
    return g + travel * (
        (strength - rate * g) * phi_1 + travel * (tilt * phi_2 + travel * (bend * phi_3))
    )


def series(z: Any) -> Any:
    """Return φ₁(−z) = (1 − exp(−z))/z where z is small."""
    end = SERIES[4] + z * (SERIES[5] + z * (SERIES[6] + z * SERIES[7]))
    return SERIES[0] + z * (SERIES[1] + z * (SERIES[2] + z * (SERIES[3] + z * end)))


def third(z: Any) -> Any:
    """Return φ₃(−z) = (1/2 − φ₂(−z))/z where z is small."""
    end = THIRD[4] + z * (THIRD[5] + z * (THIRD[6] + z * (THIRD[7] + z * THIRD[8])))
    return THIRD[0] + z * (THIRD[1] + z * (THIRD[2] + z * (THIRD[3] + z * end)))


def phi(z: Any) -> Any:
    """Return φ₁(−z) = (1 − exp(−z))/z, by its series where z is small."""
    if anywhere(np.abs(z) > SHORT):
        # With a rate below zero, h has left any start and passed zero when it grew by exp(100).
        grown = np.expm1(np.minimum(-z, 100.0))
        return select(z == 0.0, 1.0, -grown / select(z == 0.0, 1.0, z))
    return series(z)


def phi_functions(z: Any) -> tuple[Any, Any, Any]:
    """Return φ₁, φ₂ and φ₃ at −z, for z ≥ 0, a number or an array, to 3e-14.

    φ₁(−z) = (1 − exp(−z))/z, φ₂(−z) = (1 − φ₁)/z, φ₃(−z) = (1/2 − φ₂)/z; at zero they are 1, 1/2
    and 1/6. Each falls with z and stays positive. Where z is not small nothing cancels.
    """
    near = np.minimum(z, BENT)
    phi_3 = third(near)
    phi_2 = 0.5 - near * phi_3
    phi_1 = 1.0 - near * phi_2
    if anywhere(z > BENT):
        large = np.maximum(z, BENT)
        one_far = -np.expm1(-large) / large
        two_far = (1.0 - one_far) / large
        phi_3 = select(z > BENT, (0.5 - two_far) / large, phi_3)
        phi_2, phi_1 = select(z > BENT, two_far, phi_2), select(z > BENT, one_far, phi_1)
    return phi_1, phi_2, phi_3
