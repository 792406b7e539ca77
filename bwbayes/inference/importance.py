"""Importance: draws of one distribution, chosen so that they are draws of another one."""

from __future__ import annotations

import numpy as np

from bwbayes.arrays import FloatArray, IntArray

# Draws that are left at least, in effect.
MIN_EFFECTIVE = 100


def resample(evidence: FloatArray, generator: np.random.Generator) -> IntArray:
    """Choose as many draws by their log evidence (draws,), some several times; return their rows.

    Evidence may single out a few draws: then it counts by a power below one, with which the weights
    w leave (Σ w)² / Σ w² = :data:`MIN_EFFECTIVE` draws, or all of fewer. So bands have enough of
    them, and are rather too wide.
    """
    draws, best = evidence.size, np.max(evidence)
    if draws <= MIN_EFFECTIVE or not np.isfinite(best):
        return np.arange(draws)

    def effective(power: float) -> float:
        weights = np.exp(power * (evidence - best))
        return float(np.sum(weights) ** 2 / np.sum(weights**2))

    low, power = 0.0, 1.0
    if effective(power) < MIN_EFFECTIVE:
        # Draws that are not possible never count.
        high = power
        for _ in range(50):
            power = (low + high) / 2
            low, high = (power, high) if effective(power) > MIN_EFFECTIVE else (low, power)
    total = np.cumsum(np.exp(power * (evidence - best)))
    # Evenly: of equal weights, each draw once.
    levels = (np.arange(draws) + generator.uniform()) / draws
    rows: IntArray = np.minimum(np.searchsorted(total, levels * total[-1]), draws - 1)
    return rows
