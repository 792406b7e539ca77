"""Where a drive goes up and down through a level, and what a model does there."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from bwbayes.arrays import FloatArray, IntArray

__all__ = ["Crossings", "crossings", "passed"]


class Crossings(NamedTuple):
    """Samples after which a voltage goes up and down through a level, V."""

    level: float
    rising: IntArray
    falling: IntArray

    @property
    def both(self) -> bool:
        """Whether it goes both ways."""
        return bool(self.rising.size and self.falling.size)


def crossings(path: FloatArray) -> Crossings:
    """Return where a voltage (samples,) passes zero, or the middle of a drive beside it."""
    low, high = float(np.min(path)), float(np.max(path))
    level = 0.0 if low < 0 < high else (low + high) / 2
    above = path > level
    up, down = ~above[:-1] & above[1:], above[:-1] & ~above[1:]
    return Crossings(level, np.flatnonzero(up), np.flatnonzero(down))


def passed(displacement: FloatArray, path: FloatArray, at: IntArray, level: float) -> FloatArray:
    """Displacement (models,) where a path passes a level, the mean over all passages, um."""
    before, after = path[at], path[at + 1]
    fraction = (level - before) / (after - before)
    passed = displacement[:, at] * (1 - fraction) + displacement[:, at + 1] * fraction
    mean: FloatArray = np.mean(passed, axis=1)
    return mean
