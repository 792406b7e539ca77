"""From a record to a posterior: parameters, noise, point fit, sampling, convergence.

Engines compute the likelihood. ``"numpy"`` is the reference, always there and meant to be read.
``"numba"`` compiles the same computation, ten times faster, and is there if numba is: it comes with
bwbayes where there is a numba for that Python. Both give the same log density to rounding;
``"auto"`` takes the faster one that is there.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from importlib.util import find_spec
from typing import Literal

from bwbayes.errors import InputError

Engine = Literal["numpy", "numba"]
EngineChoice = Literal["auto", "numpy", "numba"]


def resolve_engine(choice: EngineChoice = "auto") -> Engine:
    """Return the engine to use.

    Raises
    ------
    InputError
        ``choice`` is not an engine, or is ``"numba"`` where numba is not installed or switched off.
    """
    if choice not in ("auto", "numpy", "numba"):
        raise InputError(f"engine: {choice!r} is unknown; write one of auto, numpy, numba")
    installed = find_spec("numba") is not None
    # Numba's own switch; what is compiled would then be walked through by Python.
    disabled = os.environ.get("NUMBA_DISABLE_JIT", "0") not in ("", "0")
    if choice == "numba" and not installed:
        raise InputError(
            "engine: numba is not installed; pip install numba, or choose the numpy engine"
        )
    if choice == "numba" and disabled:
        raise InputError("engine: NUMBA_DISABLE_JIT is set; unset it, or choose the numpy engine")
    return "numba" if installed and not disabled and choice != "numpy" else "numpy"


@contextmanager
def stopwatch(engine: Engine) -> Iterator[Callable[[], float]]:
    """Measure the process's CPU time, s, without what an engine needs to compile.

    So a machine's first run, whose functions no cache has, is given the same time as any later one.
    """
    begin = time.process_time()
    if engine == "numpy":
        yield lambda: time.process_time() - begin
        return
    from bwbayes.inference.compiled.lanes import compile_time  # noqa: PLC0415  # needs numba

    with compile_time() as compiling:
        yield lambda: time.process_time() - begin - compiling.seconds
