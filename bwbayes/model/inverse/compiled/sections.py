"""First-order lags side by side read backwards: what drive makes their sum, sample by sample.

A lag as the dynamics, or none, and the lags of the creep: at each sample the drive that is missing
is the displacement that is asked for, less what the lags carry on, over what they take up at once.
This does not run away: the response of a lag has a positive real part at all frequencies, and so
has a sum of them with positive weights, so that none of its zeros lies outside of the unit circle.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from bwbayes.arrays import FloatArray

__all__ = ["undone_lags"]


@njit(nogil=True, cache=True, error_model="numpy")
def undone_lags(
    numerator: FloatArray,
    decay: FloatArray,
    gains: FloatArray,
    rest: FloatArray,
    state: FloatArray,
    begins: bool,
    displacement: FloatArray,
) -> None:
    """Write the drives over displacements (models, samples), um.

    Parameters
    ----------
    numerator
        (models, lags, 2), of x[t] = b₀ w[t] + b₁ w[t−1] + decay x[t−1]; a held drive has no b₀.
    decay, gains
        (models, lags), and the lags' weights.
    rest, state
        (models, lags): the drives, um, at which they were at rest, and what they carry on.
    begins
        Whether a record begins, at rest at its first sample; then there is neither of these.
    """
    models, samples = displacement.shape
    lags = gains.shape[1]
    carried = np.empty(lags)
    for model in range(models):
        row, weight, left = displacement[model], gains[model], decay[model]
        held = numerator[model, 0, 0] == 0.0
        now = numerator[model, :, 1 if held else 0].copy()
        later = numerator[model, :, 0 if held else 1].copy()
        total = np.sum(weight * now)
        if begins:
            level = row[0] / np.sum(weight)
            before = np.full(lags, level)
            carried[:] = 0.0
        else:
            before = rest[model]
            carried[:] = state[model]
        base = np.sum(weight * before * (1.0 - now))
        if held:
            # A drive acts one sample later: the first one of a record is that of its rest.
            drive = before[0]
            for t in range(samples):
                if t + 1 < samples and (t > 0 or not begins):
                    missing = row[t + 1] - base
                    for i in range(lags):
                        missing -= weight[i] * left[i] * carried[i]
                    drive = missing / total
                for i in range(lags):
                    carried[i] = now[i] * (drive - before[i]) + left[i] * carried[i]
                row[t] = drive
            continue
        for t in range(samples):
            missing = row[t] - base
            for i in range(lags):
                missing -= weight[i] * carried[i]
            drive = missing / total
            for i in range(lags):
                moved = now[i] * (drive - before[i])
                carried[i] = later[i] * (drive - before[i]) + left[i] * (moved + carried[i])
            row[t] = drive
