"""Ornstein-Uhlenbeck processes of unit variance, for discrepancies whose size is known."""

from __future__ import annotations

import numpy as np
from scipy.signal import lfilter

from bwbayes.arrays import FloatArray

__all__ = ["process"]


def process(samples: int, step: float, generator: np.random.Generator) -> FloatArray:
    """Draw a stationary process (samples,) that forgets by exp(-step) from sample to sample."""
    remembered = np.exp(-step)
    shocks = generator.standard_normal(samples)
    shocks[1:] *= np.sqrt(1 - remembered**2)
    drawn: FloatArray = lfilter([1.0], [1.0, -remembered], shocks)
    return drawn
