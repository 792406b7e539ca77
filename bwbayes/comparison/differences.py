"""Is one score better than another, or is it luck? Differences with paired errors.

Two models are judged on the same readings, so what makes a reading hard to predict is hard for
both. The differences of their scores, reading by reading, lack that; what is left of their
correlation along the record a block bootstrap allows for.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from bwbayes.arrays import FloatArray
from bwbayes.results.scores import BLOCK_TIMES, FEWEST_BLOCKS, block_bootstrap_error, block_length

__all__ = ["SMALL", "SURE", "Difference", "paired"]

# Standard errors beyond which a difference is not taken for luck ...
SURE = 2.0

# ... and nats over all readings, each counted as much as it is independent, below which it is small
# whatever its error: two models that predict nearly the same differ by the luck of one fit, of
# which the readings' scatter knows nothing.
SMALL = 4.0


@dataclass(frozen=True)
class Difference:
    """A difference of scores, the larger the better, and its standard error.

    ``blocks`` are the stretches of the readings that are as good as independent: fewer than some
    ten make the error itself uncertain. ``total`` is the difference over all readings, each counted
    as much as it is independent of the others.

    Notes
    -----
    T. Sivula, M. Magnusson, A. Vehtari, Uncertainty in Bayesian leave-one-out cross-validation
    based model comparison, arXiv:2008.10296, for differences below four nats.
    """

    value: float
    error: float
    blocks: float = np.inf
    total: float = np.inf

    @property
    def beyond(self) -> bool:
        """Whether the first is worse by more than ``SURE`` errors, however little that is."""
        return self.value < -SURE * self.error

    @property
    def worse(self) -> bool:
        """Whether the first is worse for sure: beyond its error, and not by little."""
        return self.beyond and abs(self.total) > SMALL


def paired(one: FloatArray, other: FloatArray, generator: np.random.Generator) -> Difference:
    """Compare the scores of the same readings: the mean of one − other, and its error.

    Parameters
    ----------
    one, other
        (readings,) scores in order of time, the larger the better.
    generator
        Draws the blocks.
    """
    with np.errstate(invalid="ignore"):
        series = one - other
    if not np.isfinite(series).all():
        # A reading that one model holds for impossible settles it, unless both do.
        sides = bool(np.isneginf(one).any()), bool(np.isneginf(other).any())
        value = {(True, False): -np.inf, (False, True): np.inf}.get(sides, np.nan)
        return Difference(value, 0.0 if sides[0] != sides[1] else np.inf)
    block = block_length(series)
    error = block_bootstrap_error(series, block, generator)
    used = max(1, min(block, series.size // FEWEST_BLOCKS))
    mean, blocks = float(np.mean(series)), series.size / used
    # A block is three times as long as the readings that count for one.
    independent = min(series.size, BLOCK_TIMES * blocks)
    return Difference(mean, error, blocks, mean * independent)
