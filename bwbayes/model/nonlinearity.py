"""Static nonlinearity: quadratic and cubic terms of the voltage in the displacement.

Measured loops are not symmetric about their middle; a curve without memory beside the hysteresis
says most of that. It is taken about the middle of the voltage's range and in units of half of it,
so that its coefficients are displacements at the edge of the range, as large on any actuator.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.polynomial import Polynomial

from bwbayes.arrays import FloatArray
from bwbayes.errors import InputError, suggestion
from bwbayes.model.declaration import Declaration, Values, normal
from bwbayes.model.inputs import UNIT, Span

# Powers of the voltage, each with its prior sd, as a part of half of the displacement's range. On
# measured stacks the square makes a tenth of that or less, the cube less than that.
TERMS = {"quadratic": (2, 0.15), "cubic": (3, 0.1)}


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

        def declared(name: str, power: int, share: float) -> Declaration:
            return Declaration(
                name,
                "um",
                f"q_{power}",
                f"{name} part of the displacement at the edge of the voltage's range",
                lambda context: normal(0.0, share * context.ranges.displacement),
                loop=True,
                aliases=(f"q{power}",),
            )

        return tuple(declared(name, *TERMS[name]) for name in TERMS if name in self.terms)

    def scaled(self, voltage: FloatArray) -> FloatArray:
        """Return x of voltages of any shape, V."""
        half = self.reference.half
        return (voltage - self.reference.middle) / half if half > 0 else np.zeros_like(voltage)

    def displacement(self, column: Values, voltage: FloatArray) -> FloatArray:
        """Return q₂ x² + q₃ x³ (models, samples), um, along voltages, V.

        These are (samples,), or (models, samples). A reference without any width has none.
        """
        x = self.scaled(voltage)
        columns = [(column[name], TERMS[name][0]) for name in TERMS if name in self.terms]
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
                power = TERMS[name][0]
                coefficients[: power + 1] += np.outer(
                    np.asarray((x**power).coef, np.float64), column[name]
                )
        return coefficients
