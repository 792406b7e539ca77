"""C from Python: what is printed does what the function does; what cannot be printed is refused."""

import ctypes
import subprocess
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, strategies as st

from bwbayes.arrays import anywhere, look_up, select
from bwbayes.control.exported import c_functions, to_ascii
from bwbayes.errors import InputError
from tests.control.compiled import STRICT
from tests.programs import needs

ROWS = (0.5, -2.0, 3.0)


def halves(x: Any) -> Any:
    """Halve a number α until it is below one."""
    rounds = 0
    while x > 1.0:
        x /= 2
        rounds += 1
    return x, rounds


def everything(parameters: Any, memory: Any, x: Any, after: Any) -> Any:
    """Do what a step may do."""
    total, low = 0.0, np.floor(x / 3.0)
    for j in range(len(parameters)):
        total += parameters[j] * ROWS[j] - (x - (total - low)) / (2.0 + x**2)
    for k in range(2, -1, -1):
        total = look_up(parameters, k + 0.0 * x) - total * 0.5
    if anywhere((x > 2.0) & (memory[1] < x)):
        part, rounds = halves(x)
        total = total + part * rounds
    else:
        total = -np.minimum(total, select(x < -1.0, np.expm1(x), np.abs(x)))
    after[0], after[1] = x, total
    return total, low


def swaps(x: Any, y: Any) -> Any:
    """Assign in C one after the other, which is something else."""
    x, y = y, x
    return x - y


def divides(x: Any) -> Any:
    """Round down as Python does: by the remainder, not by the quotient in floats."""
    return x // 3.0


def unknown(x: Any) -> Any:
    """Call what C does not have."""
    return sorted([x])


def test_greek_and_signs_have_names() -> None:
    assert "alpha - beta^2 >= phi_1(-z)" == to_ascii("α − β² ≥ φ_1(−z)")


@pytest.mark.parametrize("function", [swaps, divides, unknown])
def test_what_c_does_not_have_is_refused(function: Callable[..., Any]) -> None:
    with pytest.raises(InputError, match=rf"^{function.__name__}: `.*` has no counterpart in C"):
        c_functions([function], {}, "c_")


@pytest.fixture(scope="module")
def compiled(tmp_path_factory: pytest.TempPathFactory) -> Any:
    """Return ``everything`` as a function of C."""
    folder: Path = tmp_path_factory.mktemp("printed")
    shapes = {"parameters": (3,), "memory": (2,), "after": (2,)}
    code = c_functions([everything], shapes, "c_").replace("static double c_everything", "X")
    code = f"#include <math.h>\n{code.replace('X(', 'double c_everything(', 1)}"
    (folder / "printed.c").write_text(code, encoding="ascii")
    command = [needs("cc"), *STRICT, "-Wno-unused", "-shared", "-fPIC", "printed.c", "-o", "c.so"]
    subprocess.run([*command, "-lm"], cwd=folder, check=True)
    function = ctypes.CDLL(str(folder / "c.so")).c_everything
    function.restype = ctypes.c_double
    return function


@given(x=st.floats(-50.0, 50.0))
def test_printed_c_does_what_the_function_does(compiled: Any, x: float) -> None:
    parameters, memory, after = np.array([1.0, 0.1, -0.3]), np.array([0.0, 4.0]), np.zeros(2)
    expected, low = everything(parameters, memory, np.float64(x), after)
    row = ctypes.POINTER(ctypes.c_double)
    written, second = np.zeros(2), ctypes.c_double()
    got = compiled(
        *(values.ctypes.data_as(row) for values in (parameters, memory)),
        ctypes.c_double(x),
        written.ctypes.data_as(row),
        ctypes.byref(second),
    )
    assert (got, second.value) == pytest.approx((float(expected), float(low)), rel=1e-12, abs=1e-12)
    np.testing.assert_allclose(written, after, rtol=1e-12, atol=1e-12)
