"""Compiled operators: those that remember extrema, loops that relax, and pinned walls.

Operators that remember extrema provide their Everett functions alone. Models are worked out one
after the other, each with a stack: the voltages of the extrema that still count, and the
displacements there. The samples between two changes of that stack are one branch and are worked out
together.

Loops that relax go sample by sample, models side by side. These are Bouc-Wen with n = 1, asymmetric
or not, backlash-like and Duhem loops, by the formulas of
:mod:`bwbayes.model.operators.scalar_memory`. Their φ functions are a series for all models at once
if the fastest of them moves little in a sample; otherwise they are doubled from a smaller argument.

Jiles-Atherton and domain walls go model by model, stretch by stretch, by the functions of the NumPy
engine. An integrator's steps do not end at samples, so this is not a stage that takes sample by
sample: it makes the drive of a whole record, which is given to the other stages.
"""

from __future__ import annotations

from typing import Annotated, NamedTuple

import numpy as np
from numba import njit

from bwbayes.arrays import FloatArray, IntArray, gone
from bwbayes.inference.compiled.lanes import (
    LANES,
    Row,
    Struct,
    Structs,
    compile_cached,
    inner,
    repeat_last,
)
from bwbayes.model.compiled import compiled, formula
from bwbayes.model.declaration import Values
from bwbayes.model.inputs import monotone_stretches
from bwbayes.model.operators import pinned as walls_model, scalar_memory as formulas
from bwbayes.model.operators.extremum_memory import Memory, RemembersExtrema
from bwbayes.model.operators.pinned import KNOTS, LINES, LONGEST, STAGES, Pinned
from bwbayes.model.operators.scalar_memory import BENT, SHORT, RelaxingStep, StateMemory


class Branches(NamedTuple):
    """Numbers and memory of models.

    ``numbers`` (models, any) are those of the operator; (models,) are w₀, w of the last sample, um,
    its direction and the number of extrema in memory; (models, extrema) their voltages, V, and the
    displacements there, um.
    """

    numbers: FloatArray
    equilibrium: FloatArray
    last: FloatArray
    direction: FloatArray
    depth: IntArray
    voltages: FloatArray
    displacements: FloatArray

    @classmethod
    def of(cls, numbers: FloatArray, voltage: FloatArray, memory: Memory) -> Branches:
        """Return the models at the first sample of a voltage."""
        models, extrema = memory.displacement.size, memory.extrema
        levels = np.array([extremum.voltage for extremum in extrema])
        stacks = np.zeros((2, models, deepest(voltage, levels, memory.direction)))
        for slot, (level, displacement, voltage_of_model) in enumerate(extrema):
            stacks[0, :, slot] = level if voltage_of_model is None else voltage_of_model
            stacks[1, :, slot] = displacement
        direction, depth = np.full(models, memory.direction), np.full(models, len(extrema))
        start = memory.displacement
        return cls(numbers, start, start.copy(), direction, depth, *stacks)


@compile_cached()
def deepest(voltage: FloatArray, levels: FloatArray, direction: float) -> int:
    """Return the largest number of extrema in memory, from the models' largest initial extrema.

    A lower extremum is forgotten earlier.
    """
    stack = np.empty(levels.size + voltage.size)
    stack[: levels.size] = levels
    depth = slots = levels.size
    for t in range(1, voltage.size):
        s = np.sign(voltage[t] - voltage[t - 1])
        if s == 0.0:
            continue
        if s == -direction:
            stack[depth] = voltage[t - 1]
            depth += 1
            slots = max(slots, depth)
        direction = s
        depth = _remaining(stack, depth, s, voltage[t])
    return slots


@compile_cached()
def _closing(stack: FloatArray, depth: int, s: float) -> float:
    """Return the voltage at which the branch from the last extremum is forgotten, V, times s.

    It is the same as in :meth:`RemembersExtrema.advance`.
    """
    if depth == 1:
        return np.inf
    closing: float = stack[depth - 2] if depth > 2 else -stack[1]
    return s * closing


@compile_cached()
def _remaining(stack: FloatArray, depth: int, s: float, u: float) -> int:
    """Return the number of extrema that remain once a voltage has reached u in direction s."""
    while s * u >= _closing(stack, depth, s):
        depth -= 2 if depth > 2 else 1
    return depth


@compile_cached()
def _ends(voltage: FloatArray, first: int, last: int) -> IntArray:
    """Return the index of the voltage's next reversal, for samples ``first`` to ``last``."""
    ends = np.full(last - first, last)
    direction, following = 0.0, last
    for t in range(last - 1, max(first, 1) - 1, -1):
        s = np.sign(voltage[t] - voltage[t - 1])
        if s != 0.0:
            ends[t - first] = ends[following - first] if s == direction else following
            direction, following = s, t
    return ends


@compile_cached()
def along_branches(
    operator: RemembersExtrema,
    models: Branches,
    group: int,
    voltage: FloatArray,
    first: int,
    out: FloatArray,
) -> None:
    """Write w − w₀ of samples from ``first`` on to ``out`` (samples, lanes); advance the memory."""
    last = first + len(out)
    w, ends = np.empty(len(out)), _ends(voltage, first, last)
    count = min(LANES, models.equilibrium.size - group * LANES)
    for i in range(count):
        model = group * LANES + i
        voltages, displacements = models.voltages[model], models.displacements[model]
        here, direction = models.last[model], models.direction[model]
        depth, begin = models.depth[model], first
        while begin < last:
            before, u = voltage[max(begin - 1, 0)], voltage[begin]
            s = np.sign(u - before)
            if s == 0.0:
                w[begin - first] = here
                begin += 1
                continue
            if s == -direction:
                voltages[depth], displacements[depth] = before, here
                depth += 1
            direction = s
            depth = _remaining(voltages, depth, s, u)
            closing, end = _closing(voltages, depth, s), ends[begin - first]
            if s * voltage[end - 1] >= closing:
                end = begin + 1
                while s * voltage[end] < closing:
                    end += 1
            turned, level = voltages[depth - 1], displacements[depth - 1]
            branch = w[begin - first : end - first]
            _branch(
                operator, models.numbers[model], turned, level, s, depth,
                voltage[begin:end], branch,
            )  # fmt: skip
            here, begin = branch[-1], end
        models.last[model], models.direction[model], models.depth[model] = here, direction, depth
        for t in range(len(out)):
            out[t, i] = w[t] - models.equilibrium[model]
    repeat_last(count, out)


@compile_cached(error_model="numpy", fastmath={"contract", "nsz"})
def _branch(
    operator: RemembersExtrema,
    numbers: FloatArray,
    turned: float,
    level: float,
    s: float,
    depth: int,
    voltage: FloatArray,
    w: FloatArray,
) -> None:
    """Write w along a branch from an extremum on; on the first branch it moves half as far."""
    first = depth == 1
    half_step = 0.5 * s if first else s
    for t in range(voltage.size):
        u = voltage[t]
        w[t] = level + half_step * formula(operator, numbers, -u if first else turned, u)


relax, bent = compiled(formulas.relax), compiled(formulas.bent)
series, third = compiled(formulas.series), compiled(formulas.third)
relaxed = compiled(formulas.relaxed)


class LoopState(Struct):
    """Numbers and memory of models.

    The rates that apply, of those for falling and rising voltages below zero and above (``pair``),
    are copied to separate rows: a compiler makes vectors of rows at known places.
    """

    rest: Row
    h: Row
    d: Annotated[FloatArray, (3,)]
    alpha: Annotated[FloatArray, (3,)]
    rates: Annotated[FloatArray, (8,)]
    pair: Row
    against: Row
    ahead: Row
    fastest: Row
    before: Row
    z: Row
    phi_1: Row
    phi_2: Row
    phi_3: Row
    w: Row


class Relaxing(NamedTuple):
    """Structs (groups,) of :class:`LoopState`, and w₀ (models,), um.

    Also whether f or a of any model is curved, and whether a rate depends on a sign.
    """

    loops: Structs
    equilibrium: FloatArray
    curved: bool
    signed: bool

    @classmethod
    def of(cls, step: RelaxingStep, memory: FloatArray, voltage: float) -> Relaxing:
        """Return models with a step's memory at a voltage."""
        numbers, h = step.parameters, memory[:, 1]
        d, alpha, rates = numbers[:, :3], numbers[:, 3:6], numbers[:, 6:]
        rest = voltage * (d[:, 0] + voltage * (d[:, 1] + voltage * d[:, 2])) - h
        fastest = np.abs(rates).max(axis=1)
        named = {"rest": rest, "h": h, "d": d, "alpha": alpha, "rates": rates, "fastest": fastest}
        named |= {"against": rates[:, 0], "ahead": rates[:, 4]}
        return cls(LoopState.filled(named), rest, step.curved, step.signed)


@inner()
def relaxing(
    owner: None,  # noqa: ARG001
    models: Relaxing,
    group: int,
    voltage: FloatArray,
    first: int,
    out: FloatArray,
) -> None:
    """Write w − w₀ of samples from ``first`` on to ``out`` (samples, lanes); advance h."""
    loops, curved, signed = models.loops[group], models.curved, models.signed
    fastest, w = loops.fastest, loops.w
    steepest = 0.0
    for i in range(LANES):
        steepest = max(steepest, fastest[i])
    for t in range(len(out)):
        u = voltage[first + t]
        before = voltage[first + t - 1] if first + t > 0 else u
        # If the rates depend on the voltage's sign, go to zero volts and on from there.
        end = 0.0 if signed and before * u < 0.0 else u
        while True:
            if signed:
                _take(loops, before, end)
            _move(loops, before, end, steepest, curved)
            if end == u:
                break
            before, end = end, u
        for i in range(LANES):
            out[t, i] = w[i]


@inner()
def _take(loops: LoopState, before: float, u: float) -> None:
    """Select the rates that apply between two voltages."""
    pair = 2 * int(u > before) + int(before + u > 0.0)
    if loops.pair[0] == pair:
        return
    loops.pair[0] = pair
    for i in range(LANES):
        loops.against[i] = loops.rates[pair, i]
        loops.ahead[i] = loops.rates[4 + pair, i]


@inner()
def _move(loops: LoopState, before: float, u: float, steepest: float, curved: bool) -> None:
    """Move h along a step on which the voltage keeps its sign, and write w − w₀."""
    s, v = 1.0 if u > before else -1.0, abs(u - before)
    short = v * steepest <= (BENT if curved else SHORT)
    if not short:
        _phi(loops, s, v, steepest, curved)
    if curved:
        _bend(loops, s, before, u, v, short)
    elif _straight(loops, s, u, v, short) > 0:
        _cross(loops, s, u, v)


@inner(fastmath={"contract", "nsz"})
def _straight(loops: LoopState, s: float, u: float, v: float, short: bool) -> int:
    """Move h along a step, with φ₁ known or z small; return how many models passed zero."""
    h, d, alpha, rest = loops.h, loops.d[0], loops.alpha[0], loops.rest
    against, ahead, phi_1 = loops.against, loops.ahead, loops.phi_1
    before, w = loops.before, loops.w
    passed = 0
    for i in range(LANES):
        g = s * h[i]
        # Read all rows first: a compiler does not make vectors of conditional reads.
        slow, fast, phi = against[i], ahead[i], phi_1[i]
        rate = slow if g < 0.0 else fast
        new = relax(g, v, alpha[i], rate, series(rate * v) if short else phi)
        passed += (g < 0.0) & (new > 0.0)
        before[i] = g
        h[i] = s * new
        w[i] = d[i] * u - s * new - rest[i]
    return passed


@inner()
def _cross(loops: LoopState, s: float, u: float, v: float) -> None:
    """Redo the models whose g passed zero within the step, where its rate changes."""
    d, alpha = loops.d[0], loops.alpha[0]
    for i in range(LANES):
        g = loops.before[i]
        if g < 0.0 < s * loops.h[i]:
            new, _ = relaxed(g, v, alpha[i], 0.0, 0.0, loops.against[i], loops.ahead[i])
            loops.h[i] = s * new
            loops.w[i] = d[i] * u - s * new - loops.rest[i]


@inner(fastmath={"contract", "nsz"})
def _bend(loops: LoopState, s: float, before: float, u: float, v: float, short: bool) -> None:
    """Move h along a step with one rate and a strength that changes, with φ known or z small."""
    hs, ahead, rest, w = loops.h, loops.ahead, loops.rest, loops.w
    d, d2, d3 = loops.d[0], loops.d[1], loops.d[2]
    alpha, alpha1, alpha2 = loops.alpha[0], loops.alpha[1], loops.alpha[2]
    first, second, third_ = loops.phi_1, loops.phi_2, loops.phi_3
    for i in range(LANES):
        rate = ahead[i]
        strength = alpha[i] + before * (alpha1[i] + before * alpha2[i])
        tilt = alpha1[i] + 2 * before * alpha2[i]
        phi_1, phi_2, phi_3 = first[i], second[i], third_[i]
        if short:
            phi_3 = third(rate * v)
            phi_2 = 0.5 - rate * v * phi_3
            phi_1 = 1.0 - rate * v * phi_2
        g, twist = s * hs[i], 2.0 * alpha2[i]
        h = s * bent(g, v, strength, rate, s * tilt, twist, phi_1, phi_2, phi_3)
        hs[i] = h
        w[i] = u * (d[i] + u * (d2[i] + u * d3[i])) - h - rest[i]


@inner(fastmath={"contract", "nsz"})
def _phi(loops: LoopState, s: float, v: float, steepest: float, curved: bool) -> None:
    """Work out φ₁, and φ₂ and φ₃ if they are needed, by their series and doublings of z.

    φ₁(−2z) = φ₁ (1 + e⁻ᶻ)/2, φ₂(−2z) = (φ₁² + 2 φ₂)/4, φ₃(−2z) = (φ₁ φ₂ + φ₂ + 2 φ₃)/8.
    """
    h, against, ahead, z = loops.h, loops.against, loops.ahead, loops.z
    phi_1, phi_2, phi_3 = loops.phi_1, loops.phi_2, loops.phi_3
    length, doublings = v, 0
    while length * steepest > (BENT if curved else SHORT):
        length *= 0.5
        doublings += 1
    for i in range(LANES):
        slow, fast = against[i], ahead[i]
        z[i] = (slow if s * h[i] < 0.0 else fast) * length
        phi_1[i] = series(z[i])
    if curved:
        for i in range(LANES):
            phi_3[i] = third(z[i])
            phi_2[i] = 0.5 - z[i] * phi_3[i]
            phi_1[i] = 1.0 - z[i] * phi_2[i]
    for _ in range(doublings):
        if curved:
            for i in range(LANES):
                phi_3[i] = 0.125 * (phi_1[i] * phi_2[i] + phi_2[i] + 2.0 * phi_3[i])
                phi_2[i] = 0.25 * (phi_1[i] * phi_1[i] + 2.0 * phi_2[i])
        for i in range(LANES):
            phi_1[i] *= 1.0 - 0.5 * z[i] * phi_1[i]
            z[i] = 2.0 * z[i]


@inner()
def steps_moved(
    step: RelaxingStep,
    numbers: FloatArray,
    memory: FloatArray,
    voltage: FloatArray,
    after: FloatArray,
    w: FloatArray,
) -> None:
    """Move models to individual voltages (lanes,); write w and the memory after them.

    ``numbers`` have a further row, whether any model's f, a or rate is more than a constant.
    """
    each = numbers[-1, 0] > 0.0
    passed = 0 if each else _moved_apart(numbers, memory, voltage, after, w)
    if each or passed > 0:
        for i in range(LANES):
            # If h passed zero, its rate has changed on the way.
            if each or memory[1, i] * after[1, i] < 0.0:
                w[i], _ = formula(step, numbers[:, i], memory[:, i], voltage[i], after[:, i])


@inner(fastmath={"contract", "nsz"}, error_model="numpy")
def _moved_apart(
    numbers: FloatArray,
    memory: FloatArray,
    voltage: FloatArray,
    after: FloatArray,
    w: FloatArray,
) -> int:
    """Move models with a constant strength and one rate; return how many passed zero."""
    passed = 0
    for i in range(LANES):
        d, alpha, against, ahead = numbers[0, i], numbers[3, i], numbers[6, i], numbers[10, i]
        before, h, u = memory[0, i], memory[1, i], voltage[i]
        s = 1.0 if u >= before else -1.0
        v = abs(u - before)
        g = s * h
        rate = against if g < 0.0 else ahead
        z = rate * v
        is_short = abs(z) <= SHORT
        # As in `_phi`, h forgets its initial state long before a negative rate has grown it so far.
        far = gone(max(z, -100.0)) / (1.0 if is_short else z)
        new = relax(g, v, alpha, rate, series(z) if is_short else far)
        passed += (g < 0.0) & (new > 0.0)
        after[0, i] = u
        after[1, i] = s * new
        w[i] = d * u - s * new
    return passed


at_rest, moves_from = compiled(walls_model.at_rest), compiled(walls_model.moves_from)
first_step, integrate = compiled(walls_model.first_step), compiled(walls_model.integrate)
irreversible = compiled(walls_model.irreversible)
interpolate = njit(nogil=True)(walls_model.interpolate)


def pinned_drive(
    operator: Pinned, column: Values, voltage: FloatArray, memory: StateMemory
) -> tuple[FloatArray, StateMemory]:
    """Return w (models, samples), um, and the memory after it, as ``operator.advance`` does."""
    joined = np.concatenate([[memory.voltage], voltage])
    stretches = list(monotone_stretches(joined, LONGEST))
    ends = np.array([[stretch.first, stretch.last] for stretch in stretches], dtype=np.int64)
    directions = np.array([stretch.direction for stretch in stretches])
    walls = np.stack(operator.walls(column), axis=1)
    state = np.array(memory.state)
    w = _follow(operator.spins, walls, joined, ends, directions, state)[:, 1:]
    return w, StateMemory(float(joined[-1]), state)


@compile_cached()
def _follow(
    spins: bool,
    walls: FloatArray,
    voltage: FloatArray,
    ends: IntArray,
    directions: FloatArray,
    state: FloatArray,
) -> FloatArray:
    """Return w (models, samples) along stretches, and advance irreversible displacements."""
    result = np.empty((state.size, voltage.size))
    stages, knots = np.zeros(STAGES), np.empty((KNOTS, LINES))
    for model in range(state.size):
        row, fixed = walls[model], state[model]
        group = row[0], row[1], row[2], row[3], row[4], row[5], row[6]
        result[model, 0] = at_rest(spins, group, fixed, voltage[0])
        for stretch in range(directions.size):
            first, last = ends[stretch]
            s = directions[stretch]
            u = s * voltage[first : last + 1]
            # The mirrored model rises.
            fixed, out = s * fixed, np.empty(u.size)
            end = u[-1]
            here = moves_from(spins, group, fixed, u[0], end)
            t = 1
            while t < u.size and u[t] <= here:
                out[t] = at_rest(spins, group, fixed, u[t])
                t += 1
            if here < end:
                p, step = at_rest(spins, group, fixed, here), first_step(group)
                scale = min(group[0], group[6] * (end - here))
                while here < end:
                    start = here
                    here, p, step, count = integrate(
                        spins, group, start, p, step, end, scale, stages, knots
                    )
                    interpolate(knots[:count], start, here, u, out)
                fixed = irreversible(spins, group, p, end)
            result[model, first + 1 : last + 1] = s * out[1:]
            fixed = s * fixed
        state[model] = fixed
    return result
