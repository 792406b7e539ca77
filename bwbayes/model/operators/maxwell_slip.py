"""Maxwell-slip: springs that slip, in parallel; Prandtl-Ishlinskii read from the other side.

A spring that slips beyond a strain r (a stop) follows the voltage up to there, then stays: its
strain is s = u − z, with z the play of threshold r. The displacement that the springs hold back is
the hysteresis. A sum of stops is therefore a sum of plays with another linear part, and the work is
done by :mod:`bwbayes.model.operators.prandtl_ishlinskii`.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from bwbayes.arrays import ArrayLike, FloatArray
from bwbayes.model.declaration import Declaration, Values, positive, refuse
from bwbayes.model.operators.extremum_memory import INITIAL
from bwbayes.model.operators.prandtl_ishlinskii import Plays

ELEMENT = "alpha_"


@dataclass(frozen=True)
class MaxwellSlip(Plays):
    """Elements that slip at given strains r_j, V, each holding back α_j, um/V, until it does.

    ::

        w = d u − h,   h = Σ α_j s_j,   s_j = u − z_j,   |s_j| ≤ r_j

    with z_j the play of threshold r_j: the same as :class:`Plays
    <bwbayes.model.operators.prandtl_ishlinskii.Plays>` with weights α_j and the slope d − Σ α_j
    just after a turn, which must not be negative. As in the Bouc-Wen model, d is the slope of long
    sweeps and h the hysteretic displacement.

    Parameters
    ----------
    thresholds
        As in :class:`Plays <bwbayes.model.operators.prandtl_ishlinskii.Plays>`.

    Notes
    -----
    Source: M. Goldfarb and N. Celanovic, Modeling piezoelectric stack actuators for control of
    micromanipulation, IEEE Control Systems 17 (1997) 69-79.
    """

    weight = "alpha", r"\alpha", "element"

    @property
    def parameters(self) -> tuple[Declaration, ...]:
        """d, the α_j, the largest threshold if it is not given, and the start."""
        slope = positive(
            "d",
            "um/V",
            "d",
            "displacement per volt of long sweeps, when all elements slip",
            lambda ranges: 1.4 * ranges.slope,
            0.5,
            bounds=lambda earlier: (_held(earlier), np.inf),
            stated_bounds="the sum of all alpha <= d",
        )
        return (slope, *(_below_d(element) for element in self.elements()), INITIAL)

    def check(self, column: Values) -> None:
        """Raise an InputError that names the parameter where a model is outside of the domain."""
        super().check(column)
        back = self.slope(column) < -1e-9 * column["d"]  # by rounding it may be below zero
        demand = "must not be less than the sum of all alpha, or the displacement turns back"
        refuse("d", back, column["d"], demand)

    def slope(self, column: Values) -> FloatArray:
        """Return the slope just after a turn, d − Σ α_j."""
        return np.asarray(column["d"] - _held(column))


def _below_d(element: Declaration) -> Declaration:
    """Return a declaration that leaves room for the other elements; the threshold as it is."""
    if not element.name.startswith(ELEMENT):
        return element

    def bounds(earlier: Values) -> tuple[ArrayLike, ArrayLike]:
        others = {name: values for name, values in earlier.items() if name != element.name}
        return 0.0, others.get("d", np.array(np.inf)) - _held(others)

    return replace(element, bounds=bounds)


def _held(earlier: Values) -> FloatArray:
    """Return Σ α_j of those that are known."""
    return np.asarray(sum(values for name, values in earlier.items() if name.startswith(ELEMENT)))
