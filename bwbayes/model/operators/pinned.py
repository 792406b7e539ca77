"""Pinned walls that bend: common base of the Jiles-Atherton and the domain wall model.

Without pinning sites the polarization would follow the effective field along the anhysteretic
curve, saturating at either end. Walls that are pinned lag behind it: they move irreversibly only
once the field pulls them forward, and bend reversibly in between. Both models are one equation,
with another field and another anhysteretic curve.

There is no closed form. Where the walls do not move, one implicit equation remains, which is
solved to rounding; where they move, an implicit method of order five with steps of its own for
each model follows them, with an error below 1e-6 of the range of the displacement.

Along a rising voltage the equation is that of :class:`Pinned`. Where P_an is below P_irr, P follows
from an implicit equation, which is solved to rounding; from where they meet, which is known in
closed form, an implicit method of order five takes over, with steps of its own for each model:
walls that are hardly pinned follow P_an within a voltage k that is small against all others. An
explicit method would have to take steps as short as that, however smooth the solution is. A
Rosenbrock method puts the slopes f_u and f_p into its stages, and takes steps as long as the
solution allows, none of which costs an iteration. For dp/du = f(u, p) it is

    k_i = (f(u + c_i h, p + Σ_j A_ij k_j) + d_i h f_u + Σ_j C_ij k_j / h) / (1/(γ h) − f_p),  j < i,

with p + Σ B_i k_i at the end of the step, an estimated error of k_8, and in between, at θ h,

    p + θ Σ B_i k_i + θ (1 − θ) (K_1 + θ (K_2 + θ K_3)),   K_m = Σ H_mi k_i.

All is written once, of what :mod:`bwbayes.arrays` says: for arrays of models, and compiled for one.
``spins`` says which curve L is: tanh, or that of Langevin.

Notes
-----
Rodas5P: G. Steinebach, Construction of Rosenbrock-Wanner method Rodas5P and numerical benchmarks
within the Julia Differential Equations package, BIT Numerical Mathematics 63, 27 (2023),
doi:10.1007/s10543-023-00967-x.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, ClassVar, Final, NamedTuple

import numpy as np

from bwbayes.arrays import FloatArray, anywhere, select
from bwbayes.model.declaration import Declaration, Distribution, Values, check, positive, refuse
from bwbayes.model.inputs import Span, monotone_stretches
from bwbayes.model.operators.scalar_memory import OneState, initial

STAGES = 8


def _below(*numbers: float) -> FloatArray:
    """Return a matrix (STAGES, STAGES) with these numbers below its diagonal, by rows."""
    matrix = np.zeros((STAGES, STAGES))
    matrix[np.tril_indices(STAGES, -1)] = numbers
    return matrix


# γ, c and d.
SHIFT = 0.21193756319429014
# fmt: off
PLACES: Final = np.array([
    0.0, 0.6358126895828704, 0.4095798393397535, 0.9769306725060716, 0.4288403609558664, 1.0, 1.0,
    1.0,
])
DRIFTS: Final = np.array([
    0.21193756319429014, -0.42387512638858027, -0.3384627126235924, 1.8046452872882734,
    2.325825639765069, 0.0, 0.0, 0.0,
])

# A, whose last rows are B but for ones, B, C and H.
_LAST = (
    -7.502846399306121, 2.561846144803919, -11.627539656261098, -0.18268767659942256,
    0.030198172008377946,
)
WEIGHTS: Final = _below(
    3.0,
    2.849394379747939, 0.45842242204463923,
    -6.954028509809101, 2.489845061869568, -10.358996098473584,
    2.8029986275628964, 0.5072464736228206, -0.3988312541770524, -0.04721187230404641,
    *_LAST,
    *_LAST, 1.0,
    *_LAST, 1.0, 1.0,
)
END: Final = np.array([*_LAST, 1.0, 1.0, 1.0])
COUPLINGS: Final = _below(
    -14.155112264123755,
    -17.97296035885952, -2.859693295451294,
    147.12150275711716, -1.41221402718213, 71.68940251302358,
    165.43517024871676, -0.4592823456491126, 42.90938336958603, -5.961986721573306,
    24.854864614690072, -3.0009227002832186, 47.4931110020768, 5.5814197821558125,
    -0.6610691825249471,
    30.91273214028599, -3.1208243349937974, 77.79954646070892, 34.28646028294783,
    -19.097331116725623, -28.087943162872662,
    37.80277123390563, -3.2571969029072276, 112.26918849496327, 66.9347231244047,
    -40.06618937091002, -54.66780262877968, -9.48861652309627,
)
BETWEEN: Final = np.array([
    [
        25.948786856663858, -2.5579724845846235, 10.433815404888879, -2.3679251022685204,
        0.524948541321073, 1.1241088310450404, 0.4272876194431874, -0.17202221070155493,
    ],
    [
        -9.91568850695171, -0.9689944594115154, 3.0438037242978453, -24.495224566215796,
        20.176138334709044, 15.98066361424651, -6.789040303419874, -6.710236069923372,
    ],
    [
        11.419903575922262, 2.8879645146136994, 72.92137995996029, 80.12511834622643,
        -52.072871366152654, -59.78993625266729, -0.15582684282751913, 4.883087185713722,
    ],
])
# fmt: on


# Steps that are remembered at a time, and what of each: where it begins, V, how long it is, the
# displacement there, how much it changes, and the bend in between, um.
KNOTS, LINES = 128, 7


class Walls(NamedTuple):
    """The numbers of the equation, each a number, (models,) or (models, 1).

    ``saturation`` P_s, um; ``field`` E₀, V; ``coupling`` a, V/um; ``pinning`` k, V; ``reversible``
    c; ``lag`` is the largest that |P_an − P_irr| can get, um; ``slope`` that of the anhysteretic
    displacement at zero, with the coupling, um/V.
    """

    saturation: Any
    field: Any
    coupling: Any
    pinning: Any
    reversible: Any
    lag: Any
    slope: Any


def curve(spins: bool, y: Any) -> tuple[Any, Any]:
    """Return L and L′: tanh y, or coth y − 1/y and 1/y² − 1/sinh² y."""
    size = np.abs(y)
    decay = np.exp(-2.0 * size)
    if spins:
        return np.tanh(y), 4.0 * decay / (1.0 + decay) ** 2
    level, slope = 0.0 * size, 0.0 * size
    if anywhere(size < 1.0):
        # L(y)/y is a quotient of polynomials of y², its continued fraction cut off: to 4e-14.
        near = np.minimum(size, 1.0)
        square = near * near
        above = ((square + 594.0) * square + 45045.0) * square + 675675.0
        below = ((36.0 * square + 6930.0) * square + 270270.0) * square + 2027025.0
        quotient = above / below
        level = near * quotient
        slope = 1.0 - level * level - 2.0 * quotient
    if anywhere(size >= 1.0):
        inverse = 1.0 / np.maximum(size, 1.0)
        ratio = 2.0 * decay / np.maximum(1.0 - decay, 0.5)
        level = select(size < 1.0, level, 1.0 + ratio - inverse)
        far_slope = inverse * inverse - 2.0 * ratio / np.maximum(1.0 - decay, 0.5)
        slope = select(size < 1.0, slope, far_slope)
    return np.copysign(level, y), slope


def field_at(spins: bool, level: Any) -> Any:
    """Return the field in units of E₀ at which L is ``level``, between −1 and 1."""
    if spins:
        return np.arctanh(level)
    size = np.abs(level)
    y = size * (3.0 - size * size) / (1.0 - size * size)  # within 5%
    for _ in range(4):
        reached, slope = curve(spins, y)
        y = y - (reached - size) / slope
    return np.copysign(y, level)


def at_rest(spins: bool, walls: Any, fixed: Any, u: Any) -> Any:
    """Return P at voltages u while P_irr is ``fixed``, um.

    By Newton's method in the effective field x = u + a P. From a start beyond the root, seen from
    zero, the steps never leave its side. An element that has converged stays, whatever the others
    do.
    """
    saturation, field, coupling, _, reversible, _, _ = walls
    base = u + coupling * (1.0 - reversible) * fixed
    share = coupling * reversible * saturation
    near = np.abs(base) / (1.0 - share * (1.0 if spins else 1.0 / 3.0) / field)
    x = np.copysign(np.minimum(near, np.abs(base) + share), base)
    for _ in range(200):
        level, slope = curve(spins, x / field)
        step = (x - base - share * level) / (1.0 - share * slope / field)
        going = np.abs(step) > 1e-15 * (np.abs(x) + field)
        if not anywhere(going):
            break
        x = x - select(going, step, 0.0)
    level, _ = curve(spins, x / field)
    return reversible * saturation * level + (1.0 - reversible) * fixed


def irreversible(spins: bool, walls: Any, p: Any, u: Any) -> Any:
    """Return P_irr, um, of a displacement at a voltage."""
    level, _ = curve(spins, (u + walls[2] * p) / walls[1])
    return (p - walls[4] * walls[0] * level) / (1.0 - walls[4])


def moves_from(spins: bool, walls: Any, fixed: Any, start: Any, end: Any) -> Any:
    """Return the voltage from which walls move forward, V: where P_an reaches P_irr.

    From ``start`` on, and until ``end``: there, if the rest is rounding beside the field.
    """
    # Closer to saturation that field is not sharp: walls are followed from a smaller one on.
    sharp = 1.0 - 1e-6
    level = np.minimum(np.maximum(fixed / walls[0], -sharp), sharp)
    here = np.maximum(walls[1] * field_at(spins, level) - walls[2] * fixed, start)
    return select(end - here > 1e-15 * walls[1], here, end)


def first_step(walls: Any) -> Any:
    """Return the first step of walls that begin to move, a part of the voltage they lag behind."""
    return 0.1 * (walls[3] - walls[2] * walls[5])


def slopes(spins: bool, walls: Any, u: Any, p: Any) -> tuple[Any, Any, Any]:
    """Return f = dP/du while walls move forward under a rising voltage, f_u and f_p."""
    saturation, field, coupling, pinning, reversible, lag, _ = walls
    y = (u + coupling * p) / field
    level, slope = curve(spins, y)
    bend = -2.0 * level * slope
    if not spins:
        # Where the rest is rounding, the first term of the series is left.
        small = np.abs(y) < 1e-4
        safe = select(small, 1.0, y)
        bend = select(small, -2.0 * y / 15.0, bend - 2.0 * (slope - level / safe) / safe)
    behind = np.minimum(np.maximum((saturation * level - p) / (1.0 - reversible), 0.0), lag)
    slope, bend = slope * saturation / field, bend * saturation / field**2
    feedback, moving = 1.0 - coupling * reversible * slope, pinning - coupling * behind
    forward = (reversible * slope + (1.0 - reversible) * behind / moving) / feedback
    # How f grows as walls lag further behind P_an.
    pull = pinning / (moving * moving * feedback)
    along = reversible * (1.0 + coupling * forward) / feedback * bend + pull * slope
    return forward, along, coupling * along - pull


def weighted(weights: Any, stages: Any, count: int) -> Any:
    """Return a weighted sum of the first stages, term by term, so that no model sees another."""
    total = 0.0 * stages[0]
    for stage in range(count):
        total = total + weights[stage] * stages[stage]
    return total


def integrate(
    spins: bool, walls: Any, u: Any, p: Any, step: Any, end: Any, scale: Any, stages: Any,
    knots: Any,
) -> tuple[Any, Any, Any, int]:  # fmt: skip
    """Let walls move from voltages u and displacements p to a voltage ``end``, or near.

    Every model has its own steps, the next of which is ``step``, with an error of 1e-8 of the
    ``scale``. They are written to ``knots`` (KNOTS, LINES, ...), for :func:`interpolate`;
    ``stages`` (STAGES, ...) are zeros to work on. Return u, p, step and the number of knots.
    """
    _, field, coupling, _, _, _, steepest = walls
    count = 0
    while count < len(knots) and anywhere(u < end):
        active = u < end
        # At most the field's scale, or a part of the way to its zero: a longer one could jump over
        # the bend of the curve. On a grid what is rounding in an error does not grow.
        away = np.abs(u + coupling * p) / (1.0 + coupling * steepest)
        largest = np.maximum(0.25 * away / field, 1.0)
        notch = np.floor(4.0 * np.log2(np.minimum(step / field, largest)))
        best = field * np.exp2(notch / 4.0)
        last = best >= end - u
        h = select(active & last, end - u, best)
        slope, drift, jacobian = slopes(spins, walls, u, p)
        shifted = 1.0 / (SHIFT * h) - jacobian
        for stage in range(STAGES):
            if stage > 0:
                near = p + weighted(WEIGHTS[stage], stages, stage)
                slope, _, _ = slopes(spins, walls, u + PLACES[stage] * h, near)
            coupled = weighted(COUPLINGS[stage], stages, stage) / h
            stages[stage] = (slope + DRIFTS[stage] * h * drift + coupled) / shifted
        change = weighted(END, stages, STAGES)
        first = weighted(BETWEEN[0], stages, STAGES)
        second = weighted(BETWEEN[1], stages, STAGES)
        third = weighted(BETWEEN[2], stages, STAGES)
        # In between it is as good as the slope in the middle says that it is.
        halfway = p + 0.5 * change + 0.25 * (first + 0.5 * (second + 0.5 * third))
        slope, _, _ = slopes(spins, walls, u + 0.5 * h, halfway)
        off = np.abs((slope - (change + 0.25 * (second + third)) / h) / shifted)
        error = np.maximum(np.abs(stages[STAGES - 1]), off) / (1e-8 * scale)
        good = active & (error <= 1.0)
        # A step that failed stands before the one that did not, and counts for nothing.
        knots[count, 0], knots[count, 1], knots[count, 2] = u, h, p
        knots[count, 3], knots[count, 4] = change, first
        knots[count, 5], knots[count, 6] = second, third
        factor = 0.9 * np.maximum(error, 1e-12) ** -0.2
        step = select(active, h * np.minimum(np.maximum(factor, 0.2), 5.0), step)
        u, p = select(good, select(last, end, u + h), u), select(good, p + change, p)
        count += 1
    return u, p, step, count


def interpolate(
    knots: FloatArray, start: float, stop: float, points: FloatArray, out: FloatArray
) -> None:
    """Write one model's displacements ``out`` (points,) at voltages between start and stop."""
    first = np.searchsorted(points, start, side="right")
    last = np.searchsorted(points, stop, side="right")
    row = np.searchsorted(knots[:, 0], points[first:last], side="left") - 1
    fraction = (points[first:last] - knots[:, 0][row]) / knots[:, 1][row]
    bend = knots[:, 4][row] + fraction * (knots[:, 5][row] + fraction * knots[:, 6][row])
    inner = knots[:, 3][row] + (1.0 - fraction) * bend
    out[first:last] = knots[:, 2][row] + fraction * inner


# Samples that one stretch is followed for: a number that does not depend on the batch.
LONGEST = 2048

# Weaker pinning, as a part of the field's scale, would open no loop, and stronger coupling leaves
# hardly any slope before the loop closes.
WEAKEST, STRONGEST = 1e-3, 0.98


class Pinned(OneState):
    """Hysteresis by pinned walls, with an error below 1e-6 of the range.

    The displacement P in um follows the voltage u in V, to which the field is proportional, by

        P_an = P_s L((u + a P)/E₀),   P = c P_an + (1 − c) P_irr,
        dP_irr/du = (P_an − P_irr) / (k s − a (P_an − P_irr)),

    with s the voltage's direction, and P_irr constant where P_an − P_irr does not have the sign of
    s. L is what the walls would follow without pinning, E₀ in V the scale of the field, and a P in
    V the field that the displacement itself makes (a in V/um). Parameters are

    - d = P_s L′(0) / (E₀ (1 − η)), the slope of the anhysteretic displacement at zero, um/V,
    - P_s, the displacement at saturation, um,
    - η = a P_s L′(0) / E₀, how much of that slope the coupling makes, without unit,
    - k, the voltage by which pinned walls lag behind, V,
    - c, the reversible part, without unit,
    - P_an − P_irr at the first sample, um: how far walls lag behind, positive after a rise.

    With 0 ≤ η < 1 nothing is polarized by itself, |P_an − P_irr| stays below k d (1 − η), and the
    denominator keeps its sign.
    """

    spins: ClassVar[bool]

    @property
    def parameters(self) -> tuple[Declaration, ...]:
        """d, the saturation, the coupling, the pinning, the reversible part, and the start."""
        return (
            positive(
                "d",
                "um/V",
                r"d",
                "slope of the displacement without hysteresis, at zero volts",
                lambda ranges: 1.2 * ranges.slope,
                0.6,
                aliases=("gain", "d33"),
            ),
            positive(
                "saturation", "um", r"P_s", "displacement at saturation", lambda r: 4.0 * r.reach
            ),
            _fraction(
                "coupling", r"\eta", "share of the slope that the walls' coupling makes", 1.0, 3.0
            ),
            positive(
                "pinning",
                "V",
                r"k",
                "voltage by which pinned walls lag behind",
                lambda ranges: 0.25 * ranges.voltage,
                bounds=lambda earlier: (WEAKEST * self._field(earlier), np.inf),
                stated_bounds=f"at least {WEAKEST:g} of the field's scale",
            ),
            _fraction("reversible", "c", "part of the walls' motion that is reversible", 2.0, 2.0),
            replace(
                initial(),
                description="how far the walls lag behind at the first sample",
                bounds=lambda e: (-(lag := e["pinning"] * e["d"] * (1 - e["coupling"])), lag),
                stated_bounds="|initial| <= pinning d (1 - coupling)",
            ),
        )

    def check(self, column: Values) -> None:
        """Raise an InputError where a parameter is not finite or outside of its bounds."""
        check(self.parameters, column)
        for name in ("coupling", "reversible"):
            refuse(name, column[name] > STRONGEST, column[name], f"must be at most {STRONGEST:g}")
        weak = column["pinning"] < (1 - 1e-9) * WEAKEST * self.walls(column).field
        demand = f"must be at least {WEAKEST:g} of saturation/d, the voltage that saturates"
        refuse("pinning", weak, column["pinning"], demand)
        bound = (1 + 1e-9) * self.walls(column).lag
        demand = "must lie within pinning d (1 - coupling) of zero"
        refuse("initial", np.abs(column["initial"]) > bound, column["initial"], demand)

    def opening(self, column: Values, half_range: float) -> FloatArray:
        """Return U/k."""
        return half_range / column["pinning"]

    def first_state(self, column: Values, voltage: float | FloatArray) -> FloatArray:
        """Return P_irr (models,) of walls that lag behind P_an by ``initial``, um.

        P = P_an − (1 − c) (P_an − P_irr), so that P_an is what all walls would do in another field.
        """
        walls, behind = self.walls(column), column["initial"]
        reversible = walls._replace(reversible=np.ones_like(behind))
        elsewhere = voltage - walls.coupling * (1 - walls.reversible) * behind
        total = at_rest(self.spins, reversible, np.zeros_like(behind), elsewhere)
        return np.asarray(total - behind)

    def left(self, column: Values, voltage: float, span: Span) -> FloatArray:
        """Return how far behind (2, models) sweeps through the span leave the walls, um."""
        walls, behind = self.walls(column), []
        for fixed in self.swept(column, voltage, span):
            p = at_rest(self.spins, walls, fixed, np.full_like(fixed, voltage))
            level, _ = curve(self.spins, (voltage + walls.coupling * p) / walls.field)
            behind.append(np.clip(walls.saturation * level - fixed, -walls.lag, walls.lag))
        return np.stack(behind)

    def trace(
        self, column: Values, voltage: FloatArray, state: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Return the displacement P (models, samples), and P_irr at the end."""
        walls = self.walls(column)
        result = np.empty((state.size, voltage.size))
        result[:, 0] = at_rest(self.spins, walls, state, np.full_like(state, voltage[0]))
        for first, last, s in monotone_stretches(voltage, LONGEST):
            # The mirrored models rise.
            along, state = self._rise(walls, s * state, s * voltage[first : last + 1])
            result[:, first + 1 : last + 1], state = s * along[:, 1:], s * state
        return result, state

    def _rise(
        self, walls: Walls, fixed: FloatArray, u: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Return P (models, points) along rising voltages (points,), and P_irr at the end.

        ``fixed`` is P_irr (models,) at the first.
        """
        # From where P_an reaches P_irr, walls move forward until the voltage turns.
        here = moves_from(self.spins, walls, fixed, u[0], u[-1])
        resting = int(np.searchsorted(u, np.max(here, initial=u[0]), side="right"))
        along = np.empty((fixed.size, u.size))
        columns = Walls(*(values[:, np.newaxis] for values in walls))
        along[:, :resting] = at_rest(self.spins, columns, fixed[:, np.newaxis], u[:resting])
        moving = here < u[-1]
        p, step = at_rest(self.spins, walls, fixed, here), first_step(walls)
        scale = np.minimum(walls.saturation, walls.slope * np.where(moving, u[-1] - here, 1.0))
        stages, knots = np.zeros((STAGES, fixed.size)), np.empty((KNOTS, LINES, fixed.size))
        while (here < u[-1]).any():
            start = here
            here, p, step, count = integrate(
                self.spins, walls, start, p, step, u[-1], scale, stages, knots
            )
            for model in np.flatnonzero(start < here):
                steps = knots[:count, :, model]
                interpolate(steps, start[model], here[model], u, along[model])
        return along, np.where(moving, irreversible(self.spins, walls, p, u[-1]), fixed)

    def walls(self, column: Values) -> Walls:
        """Return the numbers of the equation."""
        bare = column["d"] * (1 - column["coupling"])
        return Walls(
            column["saturation"],
            self._field(column),
            column["coupling"] / bare,
            column["pinning"],
            column["reversible"],
            column["pinning"] * bare,
            column["d"],
        )

    def _field(self, column: Values) -> FloatArray:
        """Return E₀ = P_s L′(0) / (d (1 − η)), V."""
        slope = 1.0 if self.spins else 1 / 3
        return slope * column["saturation"] / (column["d"] * (1 - column["coupling"]))


def _fraction(name: str, label: str, description: str, a: float, b: float) -> Declaration:
    """Declare a number from zero to nearly one, with a beta distribution for its prior."""
    return Declaration(
        name,
        "-",
        label,
        description,
        lambda _: Distribution("beta", {"a": a, "b": b}),
        floor=0.0,
        reaches_floor=True,
        bounds=lambda _: (0.0, STRONGEST),
        stated_bounds=f"0 <= {name} <= {STRONGEST:g}",
        loop=True,
    )


@dataclass(frozen=True)
class JilesAtherton(Pinned):
    """Jiles-Atherton hysteresis: pinned walls with L(y) = coth y − 1/y, L′(0) = 1/3.

        P_an = P_s L((u + a P)/E₀),   P = c P_an + (1 − c) P_irr,
        dP_irr/du = (P_an − P_irr) / (k s − a (P_an − P_irr)),

    with s the voltage's direction, as in :class:`Pinned`.

    Notes
    -----
    D. C. Jiles, D. L. Atherton, Theory of ferromagnetic hysteresis, Journal of Magnetism and
    Magnetic Materials 61, 48-60 (1986), doi:10.1016/0304-8853(86)90066-1.
    """

    spins = False


@dataclass(frozen=True)
class DomainWall(Pinned):
    """Domain wall hysteresis: pinned walls with L(y) = tanh y, L′(0) = 1.

        P_an = P_s L((u + a P)/E₀),   P = c P_an + (1 − c) P_irr,
        dP_irr/du = (P_an − P_irr) / (k s − a (P_an − P_irr)),

    with s the voltage's direction, as in :class:`Pinned`.

    Notes
    -----
    R. C. Smith, Z. Ounaies, A domain wall model for hysteresis in piezoelectric materials, Journal
    of Intelligent Material Systems and Structures 11, 62-79 (2000); the paper's reference 19.
    """

    spins = True
