"""The exported C file, compiled with warnings as errors, as functions of arrays."""

import ctypes
import subprocess
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.ctypeslib import ndpointer

from bwbayes.arrays import FloatArray
from bwbayes.control.exported import Exported, c_functions

STRICT = ("-std=c99", "-Wall", "-Wextra", "-Werror", "-pedantic", "-O2")

# One call for each sample, as in a controller.
DRIVER = """
void run_FUNCTION(double begin, const double *values, double *result, double *held, size_t count);
void run_FUNCTION(double begin, const double *values, double *result, double *held, size_t count)
{
    actuator_state state;
    size_t i;
    actuator_begin(&state, begin);
    for (i = 0; i < count; i++) {
        result[i] = actuator_FUNCTION(&state, values[i]);
        held[i] = state.held;
    }
}
"""
BEGINNING = """
#include "actuator.c"
#include <stddef.h>
size_t state_bytes(void);
size_t state_bytes(void) { return sizeof(actuator_state); }
"""


def compiled_functions(
    functions: Sequence[Callable[..., Any]],
    shapes: Mapping[str, tuple[int, ...]],
    folder: Path,
    compiler: str,
) -> ctypes.CDLL:
    """Return Python functions as a library of C, in a folder; their names begin with ``c_``."""
    code = c_functions(functions, shapes, "c_").replace("static double c_", "double c_")
    (folder / "printed.c").write_text(f"#include <math.h>\n{code}", encoding="ascii")
    run_compiler(compiler, folder, "-shared", "-fPIC", "printed.c", "-o", "printed.so", "-lm")
    library = ctypes.CDLL(str(folder / "printed.so"))
    for function in functions:
        getattr(library, f"c_{function.__name__}").restype = ctypes.c_double
    return library


def run_compiler(compiler: str, folder: Path, *arguments: str) -> None:
    done = subprocess.run(
        [compiler, *STRICT, *arguments], cwd=folder, capture_output=True, text=True, check=False
    )
    assert (0, "") == (done.returncode, done.stderr)


class Compiled:
    """A model in C, in a folder; ``compiler`` is its path."""

    def __init__(self, made: Exported, folder: Path, compiler: str) -> None:
        (folder / "actuator.c").write_text(made.c_code(), encoding="ascii")
        # With nothing before it, as an engineer would compile it, and a loop behind it.
        functions = ["forward", *(["inverse"] if made.without_inverse is None else [])]
        loops = [DRIVER.replace("FUNCTION", one) for one in functions]
        (folder / "driver.c").write_text("".join([BEGINNING, *loops]), encoding="ascii")
        run_compiler(compiler, folder, "-shared", "-fPIC", "driver.c", "-o", "actuator.so", "-lm")
        self._library = ctypes.CDLL(str(folder / "actuator.so"))
        self._library.state_bytes.restype = ctypes.c_size_t

    @property
    def bytes(self) -> int:
        """Size of the state."""
        return int(self._library.state_bytes())

    def run(self, function: str, begin: float, values: FloatArray) -> FloatArray:
        """Return what ``forward`` or ``inverse`` makes of values (samples,), one call each."""
        return self.run_with_flags(function, begin, values)[0]

    def run_with_flags(
        self, function: str, begin: float, values: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Return the same, and whether a voltage was held (samples,)."""
        array = ndpointer(np.float64, flags="C")
        call = getattr(self._library, f"run_{function}")
        call.argtypes = [ctypes.c_double, array, array, array, ctypes.c_size_t]
        call.restype = None
        result, held = np.empty((2, values.size))
        call(begin, np.ascontiguousarray(values), result, held, values.size)
        return result, held
