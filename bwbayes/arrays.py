"""The array types that all of bwbayes shares."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

__all__ = ["ArrayLike", "BoolArray", "FloatArray", "Floating", "IntArray"]

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]
Floating = NDArray[np.floating]  # of either precision
IntArray = NDArray[np.int64]
