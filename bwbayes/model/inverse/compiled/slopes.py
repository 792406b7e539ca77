"""How flat a cubic is at its flattest: what a drive's slope is compared with."""

from __future__ import annotations

from numba import njit

__all__ = ["flattest"]


@njit(nogil=True, cache=True, error_model="numpy")
def flattest(line: tuple[float, float, float], v: float) -> float:
    """Return the least slope of line[0] v + line[1] v² + line[2] v³ from zero to v."""
    least = min(line[0], line[0] + v * (2.0 * line[1] + 3.0 * v * line[2]))
    if line[2] != 0.0:
        middle = -line[1] / (3.0 * line[2])
        if 0.0 < middle < v:
            least = min(least, line[0] + middle * (2.0 * line[1] + 3.0 * middle * line[2]))
    return float(least)
