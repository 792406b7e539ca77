"""Linear dynamics read backwards: the drive that makes a displacement, sample by sample.

The recursion on the samples is inverted, not the differential equation: what it returns makes the
displacement again to rounding, at every sample. A displacement that jumps, or whose speed does,
needs a drive that swings from sample to sample around the one of the differential equation, for
about a lag: smooth it first.

A drive that is held acts one sample later. So the second sample cannot be chosen, and the last
drive acts after the record: it stays.

A mass on a spring that is sampled much faster than it swings, driven in straight lines, has
recursions whose inverse runs away (a zero outside of the unit circle, −2 − √3 in the limit). It has
another inverse, which does not: it looks ahead by some samples, and misses the first ones, unless
the displacement begins at rest for as long.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import scipy
from numpy.typing import NDArray

from bwbayes.arrays import FloatArray
from bwbayes.model.linear import Recursion

__all__ = ["undone"]


def undone(recursion: Recursion, displacement: FloatArray) -> FloatArray:
    """Return the drive (samples,), um, after which one model has a displacement (samples,), um.

    The model is at rest at the first sample.
    """
    numerator, denominator = recursion.numerator[0], recursion.denominator[0]
    moved: FloatArray = displacement - displacement[0]
    zeros = np.roots(numerator)
    if numerator[0] == 0.0 and numerator.size > 1:
        # The second sample has been settled by the first drive.
        moved[:2] = 0.0
        later = scipy.signal.lfilter(denominator, numerator[1:], moved)[1:]
        drive: FloatArray = np.append(later, later[-1:] if later.size else 0.0)
    elif (np.abs(zeros) <= 1).all():
        drive = scipy.signal.lfilter(denominator, numerator, moved)
    else:
        drive = _looking_ahead(numerator[0], np.asarray(zeros), denominator, moved)
        drive[0] = 0.0
    return np.asarray(displacement[0] + drive)


def _looking_ahead(
    first: float, zeros: NDArray[Any], denominator: FloatArray, forced: FloatArray
) -> FloatArray:
    """Undo zeros inside of the unit circle forwards, and those outside of it backwards."""
    drive = scipy.signal.lfilter(denominator, [first], forced).astype(np.complex128)
    for zero in zeros[np.abs(zeros) <= 1]:
        drive = scipy.signal.lfilter([1.0], [1.0, -zero], drive)
    for zero in zeros[np.abs(zeros) > 1]:
        # w[t-1] = (w[t] - v[t]) / zero, from a drive that does not change after the end.
        end = drive[-1] / (1 - zero)
        before, _ = scipy.signal.lfilter(
            [-1 / zero], [1.0, -1 / zero], drive[:0:-1], zi=[end / zero]
        )
        drive = np.concatenate([before[::-1], [end]])
    return np.asarray(drive.real.copy())
