"""Maxwell-slip: springs that slip, in parallel; Prandtl-Ishlinskii read from the other side.

A spring that slips beyond a strain r (a stop) follows the voltage up to there, then stays: its
strain is s = u − z, with z the play of threshold r. What the springs hold back of the actuator's
displacement is its hysteresis. A sum of stops is therefore a sum of plays with another linear part,
and the work is done by :mod:`bwbayes.model.operators.prandtl_ishlinskii`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from bwbayes.arrays import BoolArray, FloatArray
from bwbayes.model.declaration import Declaration, Values
from bwbayes.model.operators.memory import INITIAL, Branch, RemembersExtrema, refuse
from bwbayes.model.operators.prandtl_ishlinskii import (
    Lines,
    checked_thresholds,
    lines_branch,
    numbered,
    of_gain,
    plays_lines,
)

__all__ = ["MaxwellSlip"]


@dataclass(frozen=True)
class MaxwellSlip(RemembersExtrema):
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

    Raises
    ------
    InputError
        No threshold, or thresholds that are not positive and increasing.

    Notes
    -----
    Source: M. Goldfarb and N. Celanovic, Modeling piezoelectric stack actuators for control of
    micromanipulation, IEEE Control Systems 17 (1997) 69-79.
    """

    thresholds: int | tuple[float, ...] = 10

    def __post_init__(self) -> None:
        object.__setattr__(self, "thresholds", checked_thresholds(self.thresholds))

    @property
    def parameters(self) -> tuple[Declaration, ...]:
        """d, the α_j, the largest threshold if it is not given, and the start."""
        slope = Declaration(
            name="d",
            unit="um/V",
            label="d",
            description="displacement per volt of long sweeps, when all elements slip",
            default=of_gain(1.4, 0.5),
            floor=0.0,
            loop=True,
        )
        return (slope, *numbered(self.thresholds, "alpha", r"\alpha", "of element"), INITIAL)

    def check(self, column: Values) -> None:
        """Raise an InputError that names the parameter where a model is outside of the domain."""
        super().check(column)
        demand = "must not be less than the sum of all alpha, or the displacement turns back"
        refuse("d", ~self.holds(column), column["d"], demand)

    def holds(self, column: Values) -> BoolArray:
        """Tell where Σ α_j ≤ d: the displacement goes where the voltage goes."""
        held: BoolArray = np.asarray(self._slope(column) >= 0)
        return held

    def branch(self, column: Values) -> Branch:
        """Return the Everett function of the plays."""
        return lines_branch(self.lines(column))

    def lines(self, column: Values) -> Lines:
        """Return the lines that E is made of."""
        return plays_lines(self.thresholds, "alpha", self._slope(column), column)

    def _slope(self, column: Values) -> FloatArray:
        """Return the slope just after a turn, d − Σ α_j."""
        elements = [p.name for p in self.parameters if p.name.startswith("alpha_")]
        held = sum(column.get(name, np.array(0.0)) for name in elements)
        return np.asarray(column.get("d", np.array(np.inf)) - held)
