"""Dynamics and creep of many models undone side by side.

Without creep each model's recursion is inverted as a filter
(:mod:`bwbayes.model.inverse.dynamics`). With it there are several recursions side by side, and one
drive for all: it is found sample by sample, compiled, where that does not run away.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from bwbayes.arrays import FloatArray
from bwbayes.model.actuator import State
from bwbayes.model.inverse.alone import One
from bwbayes.model.inverse.rows import of_rows
from bwbayes.model.linear import Sections

__all__ = ["undo", "undoable"]

# Taps of the recursions at most, and of a first-order lag.
TAPS, LAG_TAPS = 3, 2

# A zero may be so far beyond the unit circle by rounding.
ROUNDED = 1e-6


def undo(
    ones: Sequence[One],
    sections: Sections,
    state: State | None,
    growth: FloatArray | None,
    displacement: FloatArray,
) -> None:
    """Write the drives over displacements (models, samples), um, without the offset.

    Parameters
    ----------
    ones, sections, state
        The models, their dynamics and creep, and where they stand.
    growth
        How many times the drive creeps, (models, samples), where that grows with the voltage, of
        what is :func:`undoable`.
    displacement
        (models, samples).
    """
    if growth is None and (len(sections.recursions) == 1 or not undoable(sections)):
        for row, one in enumerate(ones):
            here = of_rows(sections, slice(row, row + 1))
            displacement[row] = one.drive(displacement[row], here)
        return
    # Here, because numba may not be installed, and takes half a second to load.
    from bwbayes.model.inverse.compiled.sections import undone  # noqa: PLC0415

    numerator, denominator = _taps(sections)
    rest = np.zeros(denominator.shape[:2])
    carried = np.zeros((*rest.shape, TAPS - 1))
    if state is not None:
        rest = np.stack(state.rest, axis=1)
        for number, kept in enumerate(state.filter):
            carried[:, number, : kept.shape[1]] = kept
    gains = np.stack(sections.gains, axis=1)
    grown = np.ones((0, 0)) if growth is None else growth
    undone(numerator, denominator, gains, rest, carried, state is None, grown, displacement)


def undoable(sections: Sections) -> bool:
    """Tell whether all models' sections can be undone sample by sample.

    The response of a lag has a positive real part at all frequencies, and so has a sum of lags with
    positive weights: none of its zeros lies outside of the unit circle. With a mass on a spring the
    zeros are looked at.
    """
    if all(one.numerator.shape[1] <= LAG_TAPS for one in sections.recursions):
        return True
    numerator, denominator = _taps(sections)
    total = np.zeros((len(numerator), 1))
    for number, gain in enumerate(sections.gains):
        product = gain[:, np.newaxis] * numerator[:, number]
        for other in range(len(sections.gains)):
            if other != number:
                product = _multiplied(product, denominator[:, other])
        total = product + total
    # A held drive has no first tap; what zeros at zero are added does no harm.
    if not total[:, 0].any():
        total = total[:, 1:]
    if not (total[:, 0] != 0).all():
        return False
    companions = np.zeros((len(total), total.shape[1] - 1, total.shape[1] - 1))
    companions[:, 0] = -total[:, 1:] / total[:, :1]
    companions[:, 1:, :-1] = np.eye(companions.shape[1] - 1)
    return bool(np.max(np.abs(np.linalg.eigvals(companions))) <= 1 + ROUNDED)


def _multiplied(one: FloatArray, other: FloatArray) -> FloatArray:
    """Return the products of polynomials (models, taps)."""
    result = np.zeros((len(one), one.shape[1] + other.shape[1] - 1))
    for place in range(other.shape[1]):
        result[:, place : place + one.shape[1]] += one * other[:, place : place + 1]
    return result


def _taps(sections: Sections) -> tuple[FloatArray, FloatArray]:
    """Return numerators and denominators (models, sections, taps), with zeros where one is less."""
    models, count = sections.gains[0].size, len(sections.gains)
    numerator, denominator = np.zeros((2, models, count, TAPS))
    for number, one in enumerate(sections.recursions):
        numerator[:, number, : one.numerator.shape[1]] = one.numerator
        denominator[:, number, : one.denominator.shape[1]] = one.denominator
    return numerator, denominator
