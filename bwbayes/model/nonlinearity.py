"""Static nonlinearity: quadratic and cubic terms of the voltage in the displacement.

Measured loops are not symmetric about their middle; a curve without memory beside the hysteresis
says most of that. It is taken about the middle of the voltage's range and in units of half of it,
so that its coefficients are displacements at the edge of the range, as large on any actuator.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.polynomial import Polynomial

from bwbayes.arrays import FloatArray
from bwbayes.errors import InputError, suggestion
from bwbayes.model.declaration import Context, Declaration, Distribution, Values, normal
from bwbayes.model.inputs import UNIT, Span


class Term(NamedTuple):
    """A power of the voltage: which, its label, and its default prior."""

    power: int
    label: str
    default: Callable[[Context], Distribution]


# On measured stacks the square makes a tenth of the half range or less, the cube less than that.
TERMS = {
    "quadratic": Term(2, r"q_2", lambda context: normal(0.0, 0.15 * context.ranges.displacement)),
    "cubic": Term(3, r"q_3", lambda context: normal(0.0, 0.1 * context.ranges.displacement)),
}


@dataclass(frozen=True)
class PolynomialNonlinearity:
    """Static nonlinearity: displacement q₂ x² + q₃ x³ in um, with x = (u − m)/U.

    m and U are the middle and half of the range of the voltage u, V; q₂ and q₃ are in um.

    Parameters
    ----------
    terms
        ``"quadratic"``, ``"cubic"``, or both.
    reference
        The range of the voltage that the coefficients are for: that of the record that is fitted.

    Raises
    ------
    InputError
        An unknown term.
    """

    terms: Sequence[str] = tuple(TERMS)
    reference: Span = UNIT

    def __post_init__(self) -> None:
        for term in self.terms:
            if term not in TERMS:
                raise InputError(f"nonlinearity: {term!r} is unknown; {suggestion(term, TERMS)}")

    @property
    def parameters(self) -> tuple[Declaration, ...]:
        """The coefficients, um."""
        return tuple(
            Declaration(
                name,
                "um",
                term.label,
                f"{name} part of the displacement at the edge of the voltage's range",
                term.default,
                loop=True,
                aliases=(f"q{term.power}",),
            )
            for name, term in TERMS.items()
            if name in self.terms
        )

    def scaled(self, voltage: FloatArray) -> FloatArray:
        """Return x of voltages of any shape, V."""
        half = self.reference.half
        return (voltage - self.reference.middle) / half if half > 0 else np.zeros_like(voltage)

    def displacement(self, column: Values, voltage: FloatArray) -> FloatArray:
        """Return q₂ x² + q₃ x³ (models, samples), um, along voltages, V.

        These are (samples,), or (models, samples). A reference without any width has none.
        """
        x = self.scaled(voltage)
        columns = [(column[name], TERMS[name].power) for name in TERMS if name in self.terms]
        return sum(
            (q[:, np.newaxis] * x**power for q, power in columns), start=np.zeros((1, x.shape[-1]))
        )

    def powers(self, column: Values) -> FloatArray:
        """Return the coefficients (4, models) of 1, u, u² and u³, um/Vᵏ, of the nonlinearity."""
        models = np.broadcast(*column.values()).size
        coefficients = np.zeros((4, models))
        half = self.reference.half
        if half > 0:
            x = Polynomial([-self.reference.middle / half, 1 / half])
            for name in self.terms:
                power = TERMS[name].power
                coefficients[: power + 1] += np.outer(
                    np.asarray((x**power).coef, np.float64), column[name]
                )
        return coefficients
