"""Array types that all of bwbayes shares, and elementary functions of numbers and arrays alike.

A formula made of these functions, of arithmetic and of NumPy's functions of a number serves both:
with arrays NumPy works it out for all models at once; compiled with numbers it goes from model to
model (:mod:`bwbayes.model.compiled`).
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from bwbayes.errors import InputError

__all__ = [
    "ArrayLike",
    "BoolArray",
    "FloatArray",
    "Floating",
    "IntArray",
    "anywhere",
    "gone",
    "look_up",
    "select",
    "taking_all_models",
]

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]
Floating = NDArray[np.floating]  # of either precision
IntArray = NDArray[np.int64]


def anywhere(condition: Any) -> Any:
    """Tell whether a condition holds, or does so at any place of an array."""
    return np.any(condition)


def select(condition: Any, yes: Any, no: Any) -> Any:
    """Return one of two numbers, or of two at each place of arrays."""
    return np.where(condition, yes, no)


def gone(z: Any) -> Any:
    """Return 1 − exp(−z), to rounding, for z ≥ −700."""
    return -np.expm1(-z)


def look_up(rows: Any, index: Any) -> Any:
    """Return the number at a place, a whole float, in a row, or at one in each column of rows."""
    if rows.ndim == 1:
        return rows[np.asarray(index).astype(np.intp)]
    models = np.arange(rows.shape[1]).reshape(-1, *(1,) * (index.ndim - 1))
    # The rows of a step are columns of its parameters: no copy is made here.
    numbers = rows.reshape(rows.shape[:2]).T
    return numbers.ravel().take(models * len(rows) + index.astype(np.intp))


@contextmanager
def taking_all_models(owner: object) -> Iterator[None]:
    """Refuse a formula of one number that an owner brings: an ``if``, a function of ``math``."""
    try:
        yield
    except (TypeError, ValueError) as error:
        if not re.search("truth value|Python scalars", str(error)):
            raise
        raise InputError(
            f"{type(owner).__module__}:{type(owner).__qualname__}: its formula takes one number, "
            "not all models at once; write bwbayes.arrays.select(condition, yes, no) in place "
            "of if, and NumPy's functions in place of those of math"
        ) from None
