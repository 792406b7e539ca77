"""Compile and keep what is compiled on disk, where a place can be written."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from typing import Any, cast

from numba import njit

from bwbayes.errors import InputWarning


def compile_cached[Function: Callable[..., Any]](**options: Any) -> Callable[[Function], Function]:
    """Return numba's decorator with a cache; without one, and a warning, if none can be written."""

    def decorate(function: Function) -> Function:
        try:
            return cast("Function", njit(nogil=True, cache=True, **options)(function))
        except RuntimeError as error:
            if "cannot cache" not in str(error):
                raise
        # At one place for all functions, so that it is shown once.
        warnings.warn(
            "numba: no cache can be written, so that every process compiles anew; set "
            "NUMBA_CACHE_DIR to a writable folder",
            InputWarning,
            stacklevel=1,
        )
        return cast("Function", njit(nogil=True, **options)(function))

    return decorate
