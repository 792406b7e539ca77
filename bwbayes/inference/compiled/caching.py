"""Compilation with a cache on disk, if one can be written.

numba looks for changes only in the file of the function that is called, but compiles functions of
other files into it. So the name of a cached function contains a digest of all these sources.
"""

from __future__ import annotations

import time
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from hashlib import sha256
from pathlib import Path
from typing import Any, cast

from numba import njit
from numba.core.event import Event, Listener, install_listener

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


@contextmanager
def compile_time() -> Iterator[CompileTime]:
    """Sum up the process's CPU time that numba takes to compile."""
    with install_listener("numba:compile", CompileTime()) as listener:
        yield listener


class CompileTime(Listener):
    """The process's CPU time, in ``seconds``, of what numba has compiled while it listens."""

    def __init__(self) -> None:
        self.seconds, self._depth, self._begin = 0.0, 0, 0.0

    def on_start(self, event: Event) -> None:  # noqa: ARG002
        """Compilation begins; that of a function includes those that it calls."""
        if self._depth == 0:
            self._begin = time.process_time()
        self._depth += 1

    def on_end(self, event: Event) -> None:  # noqa: ARG002
        """Compilation ends."""
        self._depth -= 1
        if self._depth == 0:
            self.seconds += time.process_time() - self._begin
