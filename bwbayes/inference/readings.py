"""Readings: which samples of a record the likelihood looks at.

The model is simulated along every voltage sample; only some samples have a reading that counts:
those inside the training windows that are not missing. :class:`Readings` says which these are and
how far apart, so that the noise knows how much of its discrepancy is left from one to the next.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from bwbayes.arrays import FloatArray, IntArray
from bwbayes.errors import InputError
from bwbayes.shown import brief


@dataclass(frozen=True)
class Readings:
    """Readings of a record, in order of time.

    Parameters
    ----------
    rows
        (readings,) the sample of each.
    values
        (readings,), um.
    stride
        Samples from one reading to the next, where none is missing.
    skipped
        (readings,) readings that are missing just before each one: how much farther than ``stride``
        it is from the one before, in strides.
    """

    __repr__ = brief

    rows: IntArray
    values: FloatArray
    stride: int
    skipped: FloatArray

    @classmethod
    def of(cls, displacement: FloatArray, windows: Sequence[slice]) -> Readings:
        """Take the readings in windows (slices) of a displacement (samples,); nan marks a gap.

        Raises
        ------
        InputError
            There is none.
        """
        rows = np.concatenate([np.arange(w.start, w.stop) for w in windows]).astype(np.int64)
        rows = rows[np.isfinite(displacement[rows])]
        if not rows.size:
            raise InputError("record.train: it holds no reading; give another window")
        gaps = np.diff(rows)
        stride = int(gaps.min()) if gaps.size else 1
        skipped = np.concatenate([[0.0], (gaps - stride) / stride])
        return cls(rows, displacement[rows], stride, skipped)

    @cached_property
    def gaps(self) -> tuple[FloatArray, IntArray]:
        """Numbers of missing readings (kinds,), 0 first, and which is before each (readings,)."""
        numbers, which = np.unique(np.append(self.skipped, 0.0), return_inverse=True)
        return numbers, which[:-1]

    @property
    def samples(self) -> int:
        """Samples of the record up to the last reading."""
        return int(self.rows[-1]) + 1

    @property
    def where(self) -> slice | IntArray:
        """The rows as an index: a slice, which copies nothing, if no reading is missing."""
        if self.skipped.any():
            return self.rows
        return slice(int(self.rows[0]), self.samples, self.stride)
