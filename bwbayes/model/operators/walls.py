"""The equation of pinned walls along a rising voltage, and what integrates it.

It is that of :class:`~bwbayes.model.operators.pinned.Pinned`. Where P_an is below P_irr, P follows
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

from typing import Any, Final, NamedTuple

import numpy as np

from bwbayes.arrays import FloatArray, anywhere, select

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
