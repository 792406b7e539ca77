"""Is one score better than another, or is it luck? Differences with paired errors.

Two models are judged on the same readings, so what makes a reading hard to predict is hard for
both. The differences of their scores, reading by reading, lack that; what is left of their
correlation along the record a block bootstrap allows for.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from bwbayes.arrays import FloatArray
from bwbayes.results.scores import FEWEST_BLOCKS, block_bootstrap_error, block_length

__all__ = ["SURE", "Difference", "paired"]

# Standard errors beyond which a difference is not taken for luck.
SURE = 2.0


@dataclass(frozen=True)
class Difference:
    """A difference of scores, the larger the better, and its standard error.

    ``blocks`` are the stretches of the readings that are as good as independent: fewer than some
    ten make the error itself uncertain.
    """

    value: float
    error: float
    blocks: float = np.inf

    @property
    def worse(self) -> bool:
        """Whether the first is worse for sure: by more than ``SURE`` errors."""
        return self.value < -SURE * self.error

    @property
    def better(self) -> bool:
        """Whether the first is better for sure."""
        return self.value > SURE * self.error


def paired(one: FloatArray, other: FloatArray, generator: np.random.Generator) -> Difference:
    """Compare the scores of the same readings: the mean of one − other, and its error.

    Parameters
    ----------
    one, other
        (readings,) scores in order of time, the larger the better.
    generator
        Draws the blocks.
    """
    series = one - other
    if not np.isfinite(series).all():
        # A reading that one model holds for impossible settles it, unless both do.
        sides = np.isneginf(one).any(), np.isneginf(other).any()
        value = {(True, False): -np.inf, (False, True): np.inf}.get(sides, np.nan)
        return Difference(value, 0.0 if sides[0] != sides[1] else np.inf)
    block = block_length(series)
    error = block_bootstrap_error(series, block, generator)
    blocks = series.size / max(1, min(block, series.size // FEWEST_BLOCKS))
    return Difference(float(np.mean(series)), error, blocks)
