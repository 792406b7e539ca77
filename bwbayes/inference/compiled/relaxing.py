"""The stage of loops that relax: sample by sample, models side by side.

These are Bouc-Wen with n = 1, asymmetric or not, backlash-like and Duhem loops, by the formulas of
:mod:`bwbayes.model.operators.scalar_memory`. Their φ functions are a series for all models at once
if the fastest of them moves little in a sample; otherwise they are doubled from a smaller argument.
"""

from __future__ import annotations

import numpy as np

from bwbayes.arrays import FloatArray, gone
from bwbayes.inference.compiled.lanes import LANES, inner
from bwbayes.model.compiled import compiled, formula
from bwbayes.model.operators import scalar_memory as formulas
from bwbayes.model.operators.scalar_memory import BENT, SHORT, RelaxingStep

relax, bent = compiled(formulas.relax), compiled(formulas.bent)
series, third = compiled(formulas.series), compiled(formulas.third)
relaxed = compiled(formulas.relaxed)

# Rows of a model's numbers and memory; each name is the offset of a row. D and ALPHA have three
# rows each. The rates that apply, of those for falling and rising voltages below zero and above,
# are copied to separate rows: a compiler makes vectors of rows at known places.
REST, H, D, ALPHA, RATES, BEFORE, Z, PHI_1, PHI_2, PHI_3, AGAINST, AHEAD, PAIR, W, FASTEST = (
    LANES * row for row in (0, 1, 2, 5, 8, 16, 17, 18, 19, 20, 21, 22, 23, 24, 25)
)


def rows(step: RelaxingStep, memory: FloatArray, voltage: float) -> FloatArray:
    """Return the stage's initial rows, (models, rows), with w₀ first, for the step's memory."""
    numbers, h = step.parameters, memory[:, 1]
    group = np.zeros((h.size, FASTEST // LANES + 1))
    d = numbers.T
    group[:, 0] = voltage * (d[0] + voltage * (d[1] + voltage * d[2])) - h
    group[:, 1], group[:, 2:16], group[:, 21:23] = h, numbers, numbers[:, [6, 10]]
    group[:, 25] = np.abs(numbers[:, 6:]).max(axis=1)
    return group


def planned(step: RelaxingStep) -> FloatArray:
    """Return whether f or a of any model is curved, and whether a rate depends on a sign."""
    curved = step.parameters[:, [1, 2, 4, 5]].any()
    return np.array([[curved, step.signed]], dtype=np.float64)


@inner()
def relaxing(
    step: RelaxingStep,  # noqa: ARG001
    group: FloatArray,
    plan: FloatArray,
    voltage: FloatArray,
    first: int,
    last: int,
    out: FloatArray,
) -> None:
    """Write w − w₀ of samples ``first`` to ``last`` to ``out`` and move h on."""
    curved, signed = plan[0, 0] > 0.0, plan[0, 1] > 0.0
    steepest = 0.0
    for i in range(LANES):
        steepest = max(steepest, group[FASTEST + i])
    for t in range(first, last):
        u = voltage[t]
        before = voltage[t - 1] if t > 0 else u
        row = (t - first) * LANES
        # If the rates depend on the voltage's sign, go to zero volts and on from there.
        end = 0.0 if signed and before * u < 0.0 else u
        while True:
            if signed:
                _take(group, before, end)
            _move(group, before, end, steepest, curved)
            if end == u:
                break
            before, end = end, u
        for i in range(LANES):
            out[row + i] = group[W + i]


@inner()
def _take(group: FloatArray, before: float, u: float) -> None:
    """Select the rates that apply between two voltages."""
    pair = 2 * int(u > before) + int(before + u > 0.0)
    if group[PAIR] == pair:
        return
    group[PAIR] = pair
    for i in range(LANES):
        group[AGAINST + i] = group[RATES + pair * LANES + i]
        group[AHEAD + i] = group[RATES + (4 + pair) * LANES + i]


@inner()
def _move(group: FloatArray, before: float, u: float, steepest: float, curved: bool) -> None:
    """Move h along a step on which the voltage keeps its sign, and write w − w₀."""
    s, v = 1.0 if u > before else -1.0, abs(u - before)
    short = v * steepest <= (BENT if curved else SHORT)
    if not short:
        _phi(group, s, v, steepest, curved)
    if curved:
        _bend(group, s, before, u, v, short)
    elif _straight(group, s, u, v, short) > 0:
        _cross(group, s, u, v)


@inner(fastmath={"contract", "nsz"})
def _straight(group: FloatArray, s: float, u: float, v: float, short: bool) -> int:
    """Move h along a step, with φ₁ known or z small; return how many models passed zero."""
    passed = 0
    for i in range(LANES):
        g = s * group[H + i]
        # Read all rows first: a compiler does not make vectors of conditional reads.
        slow, fast, phi = group[AGAINST + i], group[AHEAD + i], group[PHI_1 + i]
        rate = slow if g < 0.0 else fast
        new = relax(g, v, group[ALPHA + i], rate, series(rate * v) if short else phi)
        passed += (g < 0.0) & (new > 0.0)
        group[BEFORE + i] = g
        group[H + i] = s * new
        group[W + i] = group[D + i] * u - s * new - group[REST + i]
    return passed


@inner()
def _cross(group: FloatArray, s: float, u: float, v: float) -> None:
    """Redo the models whose g passed zero within the step, where its rate changes."""
    for i in range(LANES):
        g = group[BEFORE + i]
        if g < 0.0 < s * group[H + i]:
            new, _ = relaxed(g, v, group[ALPHA + i], 0.0, 0.0, group[AGAINST + i], group[AHEAD + i])
            group[H + i] = s * new
            group[W + i] = group[D + i] * u - s * new - group[REST + i]


@inner(fastmath={"contract", "nsz"})
def _bend(group: FloatArray, s: float, before: float, u: float, v: float, short: bool) -> None:
    """Move h along a step with one rate and a strength that changes, with φ known or z small."""
    for i in range(LANES):
        rate, h = group[AHEAD + i], group[H + i]
        alpha, alpha1, alpha2 = (
            group[ALPHA + i],
            group[ALPHA + LANES + i],
            group[ALPHA + 2 * LANES + i],
        )
        strength, tilt = alpha + before * (alpha1 + before * alpha2), alpha1 + 2 * before * alpha2
        phi_1, phi_2, phi_3 = group[PHI_1 + i], group[PHI_2 + i], group[PHI_3 + i]
        if short:
            phi_3 = third(rate * v)
            phi_2 = 0.5 - rate * v * phi_3
            phi_1 = 1.0 - rate * v * phi_2
        h = s * bent(s * h, v, strength, rate, s * tilt, 2.0 * alpha2, phi_1, phi_2, phi_3)
        group[H + i] = h
        f = u * (group[D + i] + u * (group[D + LANES + i] + u * group[D + 2 * LANES + i]))
        group[W + i] = f - h - group[REST + i]


@inner(fastmath={"contract", "nsz"})
def _phi(group: FloatArray, s: float, v: float, steepest: float, curved: bool) -> None:
    """Work out φ₁, and φ₂ and φ₃ if they are needed, by their series and doublings of z.

    φ₁(−2z) = φ₁ (1 + e⁻ᶻ)/2, φ₂(−2z) = (φ₁² + 2 φ₂)/4, φ₃(−2z) = (φ₁ φ₂ + φ₂ + 2 φ₃)/8.
    """
    length, doublings = v, 0
    while length * steepest > (BENT if curved else SHORT):
        length *= 0.5
        doublings += 1
    for i in range(LANES):
        slow, fast = group[AGAINST + i], group[AHEAD + i]
        z = (slow if s * group[H + i] < 0.0 else fast) * length
        group[Z + i] = z
        group[PHI_1 + i] = series(z)
    if curved:
        for i in range(LANES):
            z = group[Z + i]
            phi_3 = third(z)
            phi_2 = 0.5 - z * phi_3
            group[PHI_3 + i], group[PHI_2 + i], group[PHI_1 + i] = phi_3, phi_2, 1.0 - z * phi_2
    for _ in range(doublings):
        if curved:
            for i in range(LANES):
                phi_1, phi_2 = group[PHI_1 + i], group[PHI_2 + i]
                group[PHI_3 + i] = 0.125 * (phi_1 * phi_2 + phi_2 + 2.0 * group[PHI_3 + i])
                group[PHI_2 + i] = 0.25 * (phi_1 * phi_1 + 2.0 * phi_2)
        for i in range(LANES):
            z, phi_1 = group[Z + i], group[PHI_1 + i]
            group[PHI_1 + i] = phi_1 * (1.0 - 0.5 * z * phi_1)
            group[Z + i] = 2.0 * z


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
