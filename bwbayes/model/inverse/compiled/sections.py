"""Recursions side by side read backwards: what drive makes their sum, sample by sample.

The dynamics and the lags of the creep: at each sample the drive that is missing is the displacement
that is asked for, less what the recursions carry on, over what they take up at once.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from bwbayes.arrays import FloatArray

__all__ = ["undone"]


@njit(nogil=True, cache=True, error_model="numpy")
def undone(
    numerator: FloatArray,
    denominator: FloatArray,
    gains: FloatArray,
    rest: FloatArray,
    state: FloatArray,
    begins: bool,
    growth: FloatArray,
    displacement: FloatArray,
) -> None:
    """Write the drives over displacements (models, samples), um.

    Parameters
    ----------
    numerator, denominator
        (models, sections, 3), as in :class:`~bwbayes.model.linear.Recursion`, the dynamics first.
    gains
        (models, sections), the sections' weights.
    rest, state
        (models, sections): the drives, um, at which they were at rest; and (models, sections, 2),
        what they carry on.
    begins
        Whether a record begins, at rest at its first sample; then there is neither of these.
    growth
        How many times the drive acts on the sections after the first, (models, samples); (0, 0) if
        it is once everywhere.
    displacement
        (models, samples), without the offset.
    """
    sections = gains.shape[1]
    # Of each section: what it takes up at once, and later; what it carries on, and its drive.
    b0, b1, b2, a1, a2, weight, z1, z2, before, times = np.ones((10, sections))
    for model in range(displacement.shape[0]):
        row = displacement[model]
        # A drive that is held acts one sample later, and is found from the next sample.
        held = numerator[model, 0, 0] == 0.0
        for i in range(sections):
            b0[i], b1[i], b2[i] = numerator[model, i]
            a1[i], a2[i] = denominator[model, i, 1], denominator[model, i, 2]
            weight[i] = gains[model, i]
            before[i] = rest[model, i]
            z1[i], z2[i] = state[model, i]
        grown = growth[model] if growth.size > 0 else row[:0]
        if begins:
            if grown.size > 0:
                times[1:] = grown[0]
            before[:] = times * (row[0] / np.sum(weight * times))
            z1[:] = z2[:] = 0.0
        drive = before[0]
        for t in range(row.size):
            if grown.size > 0:
                times[1:] = grown[t]
            if not held:
                missing, total = row[t], 0.0
                for i in range(sections):
                    missing -= weight[i] * (before[i] * (1.0 - b0[i]) + z1[i])
                    total += weight[i] * b0[i] * times[i]
                drive = missing / total
            elif t + 1 < row.size and (t > 0 or not begins):
                missing, total = row[t + 1], 0.0
                for i in range(sections):
                    carried = z2[i] - a1[i] * z1[i]
                    missing -= weight[i] * (before[i] * (1.0 - b1[i]) + carried)
                    total += weight[i] * b1[i] * times[i]
                drive = missing / total
            for i in range(sections):
                moved = drive * times[i] - before[i]
                reached = b0[i] * moved + z1[i]
                z1[i] = b1[i] * moved - a1[i] * reached + z2[i]
                z2[i] = b2[i] * moved - a2[i] * reached
            row[t] = drive
