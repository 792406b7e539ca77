"""Models side by side: structs of rows of ``LANES`` numbers, one row a quantity.

A struct is a class whose attributes are its rows, and an element of a NumPy array; numba reads its
rows as arrays. A compiler can tell that rows of one struct do not overlap, so it makes vectors.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Annotated, Any, ClassVar, get_origin, get_type_hints

import numpy as np
from numpy.typing import NDArray

from bwbayes.arrays import FloatArray, IntArray
from bwbayes.inference.compiled.caching import compile_cached


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
