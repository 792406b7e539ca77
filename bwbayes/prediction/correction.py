"""A band that has failed validation, corrected from the readings that it failed on.

The held-out readings fall into blocks longer than their residual is correlated, so that blocks are
nearly independent, and as good as a block of the next record of the same kind of drive. With F_j(f)
the share of block j's readings inside the band, f times as wide about its mean, and n blocks,

    f = the least one with  Σ_j F_j(f) >= level (n + 1),

which covers at least ``level`` of the next block's readings on average, whatever the model's error
is like: conformal risk control (Angelopoulos et al., ICLR 2024, equation (4)), with the share that
is missed for the risk. There is none with fewer than 19 blocks, and here with fewer than twenty.

A lead-in tells a record's offset from readings with the model's error, and the next record has
another lead-in. So each block is judged about the means that lead-ins elsewhere in the record would
have given, and F_j(f) is the mean over these. Other differences between records, such as an initial
state that a lead-in has told badly, the blocks of one record do not show: with these, the next
record is covered less.
"""

from __future__ import annotations

import math

import numpy as np
import scipy

from bwbayes.arrays import BoolArray, FloatArray, IntArray
from bwbayes.prediction.bands import Bands, Correction


def correct(bands: Bands) -> Correction:
    """Return the correction of a 95% sensor band from its readings after ``scored_from``."""
    assert bands.measured is not None
    scored = bands.scored(bands.measured)
    residual = np.where(scored, bands.measured - bands.mean, 0.0)
    edges = [edge["sensor", 95] - bands.mean for edge in (bands.lower, bands.upper)]

    length = math.ceil(residual_memory(residual / np.maximum(bands.sd("sensor"), 1e-150), scored))
    blocks = _blocks(bands, scored, length)
    block_s = length * bands.interval
    least = 20
    if len(blocks) < least:
        return Correction(None, len(blocks), block_s, least * block_s)
    shifts = _shifts(bands)
    rows = np.concatenate(blocks)
    share = np.concatenate([np.full(one.size, 1 / one.size / shifts.size) for one in blocks])
    share = np.tile(share, shifts.size)
    # Each reading's own factor: how much wider the band has to be to reach it.
    away = (residual[rows] - shifts[:, np.newaxis]).ravel()
    below, above = (np.tile(np.abs(edge[rows]), shifts.size) for edge in edges)
    reached = np.abs(away) / np.maximum(np.where(away < 0, below, above), np.finfo(float).tiny)
    order = np.argsort(reached)
    # The share of all blocks inside, as the band grows; rounding must not ask for one reading more.
    inside = np.cumsum(share[order]) + 1e-9
    first = int(np.searchsorted(inside, 0.95 * (len(blocks) + 1)))
    return Correction(float(reached[order][first]), len(blocks), block_s)


def _shifts(bands: Bands) -> FloatArray:
    """Return by how much lead-ins elsewhere in the record would have moved the mean, um.

    These are the means of the residual over stretches as long as the lead-in, which itself has
    none; evenly along the record, a hundred or as many as memory allows.
    """
    assert bands.measured is not None
    residual = bands.measured - bands.mean
    if bands.lead_in is None or not bands.lead_in.tells_offset:
        return np.zeros(1)
    length = round((bands.lead_in.stop - bands.lead_in.start) / bands.interval)
    count = min(max(10_000_000 // residual.size, 1), 100)
    starts = np.linspace(0, max(residual.size - length, 0), count).astype(int)
    known = np.isfinite(residual)
    sums, counts = (
        np.concatenate([[0.0], np.cumsum(values)])
        for values in (np.where(known, residual, 0.0), known)
    )
    readings = (counts[length:] - counts[:-length])[starts]
    totals = (sums[length:] - sums[:-length])[starts]
    shifts: FloatArray = totals[readings > 0] / readings[readings > 0]
    return shifts


def residual_memory(z: FloatArray, scored: BoolArray) -> float:
    """Return the integrated autocorrelation time, in samples, of residuals z (samples,).

    Those ``scored``; zero elsewhere. About zero, not their mean: an error that stays is correlated
    all along. The sum ends where pairs of neighbors no longer fall or are negative (Geyer's initial
    monotone sequence), and is twice the time of an exponential correlation.
    """
    products, pairs = (
        scipy.signal.correlate(series, series, method="fft")[z.size - 1 :]
        for series in (z, scored.astype(np.float64))
    )
    has_pairs = np.rint(pairs) > 0
    correlation = np.where(has_pairs, products, 0.0) / np.maximum(np.rint(pairs), 1.0)
    if correlation[0] <= 0:
        return 1.0
    correlation = correlation[: 2 * (z.size // 2)] / correlation[0]
    sums = correlation.reshape(-1, 2).sum(axis=1)
    last = int(np.argmax(sums <= 0)) if (sums <= 0).any() else sums.size
    return max(float(2 * np.sum(np.minimum.accumulate(sums[:last])) - 1), 1.0)


def _blocks(bands: Bands, scored: BoolArray, length: int) -> list[IntArray]:
    """Cut windows into blocks of ``length`` samples or more; return each one's scored samples."""
    blocks: list[IntArray] = []
    for window in bands.windows:
        rows = np.arange(max(window.start, bands.scored_from), window.stop)
        if count := rows.size // length:
            blocks += [block[scored[block]] for block in np.array_split(rows, count)]
    return [block for block in blocks if block.size]
