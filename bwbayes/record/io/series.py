"""What a file holds: series of numbers, each with its path, its unit where the file states one.

The readers of all formats make a :class:`Source`; which of its series are time, voltage and
displacement is the matter of :mod:`bwbayes.record.io.columns`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bwbayes.errors import InputError

__all__ = ["MAXIMUM_SAMPLES", "Series", "Source", "damaged", "real_numbers", "vectors"]

MAXIMUM_SAMPLES = 10**8

# Columns that a matrix may have; one with more is a picture, or has its samples in another order.
_MOST_COLUMNS = 64


@dataclass(frozen=True)
class Series:
    """A row of numbers in a file.

    ``name`` is its path in the file, ``leaf`` the last part of it, ``unit`` what the file states
    beside the name; ``load`` returns its ``size`` numbers.
    """

    name: str
    size: int
    load: Callable[[], NDArray[Any]]
    unit: str = ""
    leaf: str = ""

    @property
    def label(self) -> str:
        """The name without the path."""
        return self.leaf or self.name

    @property
    def group(self) -> str:
        """Where in the file it stands."""
        return self.name.removesuffix(self.label)


@dataclass(frozen=True)
class Source:
    """What a file holds.

    ``notes`` are what it says in words (`voltage_is`, `origin`, `interval_s`), by the group of the
    series that they are of. ``first_line`` is the line of the first sample in a text file.
    ``interval`` and ``start``, s, are those of a file that states them in place of a time column.
    """

    path: Path
    series: tuple[Series, ...]
    notes: Mapping[str, Mapping[str, str]] = field(default_factory=dict)
    first_line: int | None = None
    interval: float | None = None
    start: float = 0.0


def vectors(
    group: str, leaf: str, shape: Any, dtype: Any, load: Any, unit: str = ""
) -> Iterator[Series]:
    """Yield the series of numbers in an array: the array, its columns, or a table's fields.

    Parameters
    ----------
    group, leaf
        The path of the array, with a separator at its end, and its name.
    shape, dtype
        Those of the array that ``load()`` returns; what are no numbers is passed over.
    unit
        Of its numbers, if that is stated.
    """
    if shape is None:
        return
    long = [n for n in shape if n != 1]
    if dtype.names:
        for field in dtype.names:
            inner = partial(lambda load, field: load()[field], load, field)
            yield from vectors(f"{group}{leaf}.", field, shape, dtype[field], inner, unit)
    elif dtype.kind not in "iuf":
        yield Series(f"{group}{leaf}", max(shape, default=1), load, unit, leaf)
    elif max(shape, default=1) > MAXIMUM_SAMPLES:
        return
    elif len(long) <= 1:
        size = int(np.prod(shape, dtype=np.int64))
        yield Series(f"{group}{leaf}", size, lambda: np.ravel(load()), unit, leaf)
    elif len(long) == 2 and min(long) <= _MOST_COLUMNS:
        by_row = long[0] < long[1]
        for i in range(min(long)):
            name = f"{leaf}[{i + 1}]"
            take = partial(_column, load, i, by_row)
            yield Series(f"{group}{name}", max(long), take, unit, name)


def _column(load: Any, number: int, by_row: bool) -> NDArray[Any]:
    matrix = np.squeeze(load())
    column: NDArray[Any] = matrix[number] if by_row else matrix[:, number]
    return column


def damaged(where: object, error: Exception) -> InputError:
    """Return the error of a file that a reader stumbled over, in whatever way it did."""
    reason = " ".join(str(error).split())[:80] or type(error).__name__
    return InputError(f"{where}: damaged or cut off ({reason}); write it again")


def real_numbers(series: Series, where: str) -> NDArray[Any]:
    """Return the numbers of a series, which stands ``where``.

    Raises
    ------
    InputError
        They are not real numbers, or damaged.
    """
    try:
        values = np.asarray(series.load())
    except InputError:
        raise
    except Exception as error:
        raise damaged(where, error) from error
    if values.dtype.kind not in "iuf":
        kinds = {"c": "complex numbers", "b": "logical values"}
        problem = kinds.get(values.dtype.kind, "text or another type that is not a number")
        raise InputError(f"{where}: holds {problem}; store real numbers")
    return values
