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


def undone(
    recursion: Recursion, displacement: FloatArray, state: FloatArray | None = None
) -> FloatArray:
    """Return the drive (samples,), um, after which one model has this displacement.

    Parameters
    ----------
    recursion
        That of one model.
    displacement
        (samples,), um, from rest.
    state
        (1, taps - 1), that of the recursion before the first sample; by default a record starts
        at rest, and its first drive is zero.
    """
    numerator, denominator = recursion.numerator[0], recursion.denominator[0]
    forced = displacement.copy()
    if state is not None:
        forced -= recursion.run(np.zeros((1, forced.size)), state.copy())[0]
    if numerator[0] == 0.0 and numerator.size > 1:
        # What the drive before the first sample, or at rest that of the first one, has settled.
        forced[: 2 if state is None else 1] = 0.0
        later: FloatArray = scipy.signal.lfilter(denominator, numerator[1:], forced)[1:]
        last = later[-1:] if later.size else np.zeros(1)
        return np.concatenate([later, last])
    if numerator.size == denominator.size == 1:
        return np.asarray(forced / numerator[0])
    # Then no zero lies outside of the unit circle; to look for them takes as long as the filter.
    if np.abs(numerator[1:]).sum() < numerator[0]:
        return np.asarray(scipy.signal.lfilter(denominator, numerator, forced))
    zeros = np.roots(numerator)
    outside = zeros[np.abs(zeros) > 1]
    if not outside.size:
        return np.asarray(scipy.signal.lfilter(denominator, numerator, forced))
    drive = _looking_ahead(numerator[0], np.asarray(zeros), denominator, forced)
    if state is None:
        drive[0] = 0.0
    return drive


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
