"""The stage of loops that relax: sample by sample, models side by side.

These are Bouc-Wen with n = 1, asymmetric or not, backlash-like and Duhem loops, by the formulas of
:mod:`bwbayes.model.operators.scalar_memory`. Their φ functions are a series for all models at once
if the fastest of them moves little in a sample; otherwise they are doubled from a smaller argument.
"""

from __future__ import annotations

from typing import Annotated, NamedTuple

import numpy as np

from bwbayes.arrays import FloatArray, gone
from bwbayes.inference.compiled.lanes import LANES, Row, Struct, Structs, inner
from bwbayes.model.compiled import compiled, formula
from bwbayes.model.operators import scalar_memory as formulas
from bwbayes.model.operators.scalar_memory import BENT, SHORT, RelaxingStep

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
