"""The compiled Jiles-Atherton and domain wall model: model by model, stretch by stretch.

The functions are those of the NumPy engine, for one model. An integrator's steps do not end at
samples, so this is not a stage that takes sample by sample: it makes the drive of a whole record,
which is given to the other stages.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from bwbayes.arrays import FloatArray, IntArray
from bwbayes.inference.compiled.caching import compile_cached
from bwbayes.model.compiled import compiled
from bwbayes.model.declaration import Values
from bwbayes.model.inputs import monotone_stretches
from bwbayes.model.operators import pinned as formulas
from bwbayes.model.operators.pinned import KNOTS, LINES, LONGEST, STAGES, Pinned
from bwbayes.model.operators.scalar_memory import StateMemory

at_rest, moves_from = compiled(formulas.at_rest), compiled(formulas.moves_from)
first_step, integrate = compiled(formulas.first_step), compiled(formulas.integrate)
irreversible = compiled(formulas.irreversible)
interpolate = njit(nogil=True)(formulas.interpolate)


def drive(
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
