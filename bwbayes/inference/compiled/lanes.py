"""Compilation with a cache on disk, and models side by side, for all compiled functions.

numba looks for changes only in the file of the function that is called, but compiles functions of
other files into it. So the name of a cached function contains a digest of all these sources.

Models are side by side in structs of rows of ``LANES`` numbers, one row a quantity. A struct is a
class whose attributes are its rows, and an element of a NumPy array; numba reads its rows as
arrays. A compiler can tell that rows of one struct do not overlap, so it makes vectors.
"""

from __future__ import annotations

import math
import time
import warnings
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from hashlib import sha256
from pathlib import Path
from typing import Annotated, Any, ClassVar, cast, get_origin, get_type_hints

import numpy as np
from numba import njit
from numba.core.event import Event, Listener, install_listener
from numpy.typing import NDArray

from bwbayes.arrays import FloatArray, IntArray
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
    """The process's CPU time of what numba has compiled while it listens."""

    def __init__(self) -> None:
        self._ended, self._depth, self._begin = 0.0, 0, 0.0

    @property
    def seconds(self) -> float:
        """The time so far, that of a compilation that goes on included."""
        return self._ended + (time.process_time() - self._begin if self._depth else 0.0)

    def on_start(self, event: Event) -> None:  # noqa: ARG002
        """Compilation begins; that of a function includes those that it calls."""
        if self._depth == 0:
            self._begin = time.process_time()
        self._depth += 1

    def on_end(self, event: Event) -> None:  # noqa: ARG002
        """Compilation ends."""
        self._depth -= 1
        if self._depth == 0:
            self._ended += time.process_time() - self._begin


def read_only(values: FloatArray) -> FloatArray:
    """Return a read-only view; numba compiles functions anew for arrays that may be written."""
    view = values.view()
    view.flags.writeable = False
    return view


def inner(**options: Any) -> Any:
    """Compile a function that only compiled functions call, without the wrappers for Python."""
    options |= {"no_cpython_wrapper": True, "no_cfunc_wrapper": True}
    return compile_cached(**options)


# Models side by side: four vector registers of eight numbers, which hide each other's latency.
LANES = 32

# A row of a struct; several rows are `Annotated[FloatArray, (number,)]`, matrices of rows (2, 2).
Row = Annotated[FloatArray, ()]

# Structs (groups,) that Python fills.
Structs = NDArray[np.void]


class Struct:
    """Numbers and memory of ``LANES`` models: each attribute of a subclass is a row, or several."""

    layout: ClassVar[np.dtype[np.void]]

    def __init_subclass__(cls) -> None:
        """Lay out the rows in memory, in their order."""
        fields: list[Any] = []
        for name, row in get_type_hints(cls, include_extras=True).items():
            if get_origin(row) is Annotated:
                fields.append((name, np.float64, (*row.__metadata__[0], LANES)))
            elif name != "layout":
                fields.append((name, row.layout))
        cls.layout = np.dtype(fields)

    @classmethod
    def filled(
        cls, named: Mapping[str, FloatArray], rows: IntArray | slice = slice(None), *shape: int
    ) -> Structs:
        """Return structs (groups, *shape) with values (models, ...) of some models, by their names.

        Others are 0, and so are further rows of several. Spare lanes repeat the last model.
        """
        models = len(next(iter(named.values()))[rows])
        groups, spare = -(-models // LANES), -models % LANES
        # Vectors should not straddle the cache's lines (of 64 bytes).
        size, line = cls.layout.itemsize * groups * math.prod(shape), 64
        room = np.zeros(size + line, np.uint8)
        begin = -room.ctypes.data % line
        structs = room[begin : begin + size].view(cls.layout).reshape(groups, *shape)
        for name, values in named.items():
            chosen = values[rows]
            if spare:
                chosen = np.concatenate([chosen, np.repeat(chosen[-1:], spare, axis=0)])
            lanes, filled = chosen.reshape(groups, LANES, *chosen.shape[1:]), structs[name]
            if lanes.ndim > 2:
                lanes = lanes.transpose(0, *range(2, lanes.ndim), 1)
                filled = filled[tuple(map(slice, lanes.shape))]
            filled[:] = lanes
        return structs


def apart(lanes: FloatArray, models: int) -> FloatArray:
    """Return models (models, ...) that were side by side (groups, ..., lanes)."""
    return lanes.swapaxes(1, -1).reshape(-1, *lanes.shape[1:-1])[:models]


@inner()
def repeat_last(models: int, lanes: FloatArray) -> None:
    """Repeat the last of some models in spare lanes (samples, lanes)."""
    for t in range(len(lanes)):
        for i in range(models, LANES):
            lanes[t, i] = lanes[t, models - 1]
