"""Compilation with a cache on disk, if one can be written.

numba looks for changes only in the file of the function that is called, but compiles functions of
other files into it. So the name of a cached function contains a digest of all these sources.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable
from hashlib import sha256
from pathlib import Path
from typing import Any, cast

from numba import njit

from bwbayes.errors import InputWarning


def _digest() -> str:
    """Return a digest of the sources of the compiled likelihood and of the models."""
    compiled = Path(__file__).parent
    sources = [*compiled.glob("*.py"), *(compiled.parents[1] / "model").rglob("*.py")]
    return sha256(b"".join(path.read_bytes() for path in sorted(sources))).hexdigest()[:16]


SOURCES = _digest()


def compile_cached[Function: Callable[..., Any]](**options: Any) -> Callable[[Function], Function]:
    """Return numba's decorator with a cache; if none can be written, without one, and warn."""

    def decorate(function: Function) -> Function:
        name = function.__qualname__
        try:
            function.__qualname__ = f"{name}-{SOURCES}"  # numba names the cached code after it
            return cast("Function", njit(nogil=True, cache=True, **options)(function))
        except RuntimeError as error:
            if "cannot cache" not in str(error):
                raise
        finally:
            function.__qualname__ = name
        # Warn at one place for all functions, so that the warning is shown once.
        warnings.warn(
            "numba: no cache can be written, so that every process compiles anew; set "
            "NUMBA_CACHE_DIR to a writable folder",
            InputWarning,
            stacklevel=1,
        )
        return cast("Function", njit(nogil=True, **options)(function))

    return decorate
