"""An operator's step, compiled: the same function as NumPy's, for one model after the other.

A compiled function takes a step as an argument and is compiled for its type. So an operator of any
module is as fast as one of this package, and a run compiles only its own. The cache on disk follows
the sources.

It needs numba, which is loaded when something is compiled, not before.
"""

from __future__ import annotations

import inspect
import linecache
import math
import re
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from hashlib import sha256
from pathlib import Path
from typing import Any, cast

import numpy as np
from numba import njit, types
from numba.core.errors import NumbaError
from numba.extending import (
    NativeValue,
    models,
    overload,
    register_jitable,
    register_model,
    typeof_impl,
    unbox,
)

from bwbayes.arrays import anywhere, gone, look_up, select
from bwbayes.errors import InputError
from bwbayes.model.operator import HysteresisStep
from bwbayes.model.operators.extremum_memory import RemembersExtrema
from bwbayes.model.stage import Stage

# A function of each sample allocates nothing: counting references would take longer than all of the
# arithmetic. It becomes a part of its caller's loop, or there would be no vectors.
INNER: Mapping[str, Any] = {
    "nogil": True,
    "error_model": "numpy",
    "fastmath": {"contract", "nsz"},
    "_nrt": False,
    "forceinline": True,
}


# exp(r) by its series, for |r| up to log(2) / 2; log(2) in two parts, the first of few bits; and a
# number that leaves no bits for less than one.
SERIES = tuple(1 / math.factorial(order) for order in range(1, 15))
LOG_2_HIGH, LOG_2_LOW = 0.6931471803691238, 1.9082149292705877e-10
WHOLE = 1.5 * 2.0**52


class FormulaType(types.Type):
    """The type of what brings a formula, by its class and a digest of the formula's sources.

    A step and a stage bring their ``move``, an operator that remembers extrema its ``everett``. The
    cache on disk knows the ``kind``, the class, by its name alone: a class of the user's own module
    need not be there when others are looked up beside it.
    """

    kind: Any

    def __reduce__(self) -> tuple[Any, ...]:
        """Let what is kept on disk be found again by the class's name."""
        return FormulaType, (self.name,)


@typeof_impl.register(HysteresisStep)
@typeof_impl.register(Stage)
@typeof_impl.register(RemembersExtrema)
def _type_of(formula: HysteresisStep | RemembersExtrema | Stage, _: Any) -> FormulaType:
    kind: Any = type(formula)
    # Reading the sources takes longer than a short record: a class does so once. It keeps its type
    # by another name than numba's own, by which a subclass would be taken for its base.
    if "_formula_type" not in vars(kind):
        files = sorted({inspect.getfile(inner) for inner in _functions(_formula_of(kind))})
        # Which knows the cells of a notebook too.
        lines = (line for file in files for line in linecache.getlines(file))
        digest = sha256("".join(lines).encode()).hexdigest()[:16]
        kind._formula_type = FormulaType(f"{kind.__module__}:{kind.__qualname__}@{digest}")
        kind._formula_type.kind = kind
    return cast("FormulaType", kind._formula_type)


def _formula_of(kind: Any) -> Callable[..., Any]:
    """Return the formula of a class."""
    function: Callable[..., Any]
    function = kind.everett if issubclass(kind, RemembersExtrema) else kind.move
    return function


register_model(FormulaType)(models.OpaqueModel)


@unbox(FormulaType)  # type: ignore[no-untyped-call, untyped-decorator]
def _unbox(kind: Any, formula: Any, context: Any) -> Any:  # noqa: ARG001  # its type says all
    return NativeValue(context.context.get_dummy_value())  # type: ignore[no-untyped-call]


def formula(owner: Any, *arguments: Any) -> Any:
    """Return what the formula that an owner brings makes of numbers, where it is compiled."""
    return _formula_of(type(owner))(*arguments)


@overload(formula, jit_options=cast("Any", INNER), strict=False)
def _formula(owner: Any, *arguments: Any) -> Any:  # noqa: ARG001
    """Return the function of an owner's class, with all that it calls made known to numba."""
    inner = compiled(_formula_of(owner.kind))
    return lambda owner, *arguments: inner(*arguments)  # noqa: ARG005


def compiled[Function: Callable[..., Any]](function: Function) -> Function:
    """Return a function of numbers, compiled, with all that it calls made known to numba."""
    for helper in _functions(function)[1:]:
        register_jitable(**INNER)(helper)
    return cast("Function", njit(**INNER)(function))


@contextmanager
def compiling(owner: Any) -> Iterator[None]:
    """Refuse what numba cannot compile of the formula that an owner brings.

    Raises InputError: it cannot; the text names the formula, its line, and what it may be made of.
    """
    try:
        yield
    except NumbaError as error:
        if owner is None:
            raise
        function = _formula_of(type(owner))
        paths = [inspect.getfile(one) for one in _functions(function)]
        files = {Path(path).name: path for path in paths}
        where = "it"
        # Numba says the innermost call first.
        for name, line in re.findall(r'File "(?:[^"]*/)?([^"/]+)", line (\d+)', str(error)):
            if name in files:
                source = linecache.getline(files[name], int(line)).strip()
                where = f"`{source}` (line {line} of {name})"
                break
        raise InputError(
            f"{function.__module__}:{function.__qualname__}: numba cannot compile {where}; write "
            "it with arithmetic, NumPy's functions of a number, and bwbayes.arrays.select in place "
            'of np.where; or take engine = "numpy"'
        ) from None


def _functions(function: Callable[..., Any]) -> list[Callable[..., Any]]:
    """Return a function and all of Python's that it calls, but those that numba knows already."""
    functions, names = [function], set(function.__code__.co_names)
    for name in sorted(names - {"anywhere", "gone", "look_up", "select"}):
        helper = function.__globals__.get(name)
        if inspect.isfunction(helper):
            functions += [f for f in _functions(helper) if f not in functions]
    return functions


overload(anywhere)(lambda condition: lambda condition: condition)  # noqa: ARG005
overload(select)(
    lambda condition, yes, no: lambda condition, yes, no: yes if condition else no  # noqa: ARG005
)
overload(look_up)(lambda rows, index: lambda rows, index: rows[np.intp(index)])  # noqa: ARG005


@overload(gone, jit_options=cast("Any", INNER))
def _overload_gone(z: Any) -> Any:  # noqa: ARG001
    """Return 1 − exp(−z) without a call, so that a compiler makes vectors of it.

    exp(−z) is 2⁻ᵏ exp(r) with k whole, whose bits are put where a number's exponent is.
    """

    def without_call(z: Any) -> Any:
        z = min(z, 708.0)
        shifted = z * (1.0 / math.log(2.0)) + WHOLE
        k = shifted - WHOLE
        r = (k * LOG_2_HIGH - z) + k * LOG_2_LOW
        series = SERIES[12]
        for order in range(11, -1, -1):
            series = SERIES[order] + r * series
        bits = np.float64(shifted).view(np.int64)
        scale = np.int64((np.int64(1023) << 52) - (bits << 52)).view(np.float64)
        return (1.0 - scale) - scale * (r * series)

    return without_call
