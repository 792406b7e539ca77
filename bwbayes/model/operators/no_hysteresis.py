"""No hysteresis: displacement in proportion to the voltage.

The model to hold all others against. Where it does as well as they do, a record shows no
hysteresis.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from bwbayes.arrays import FloatArray
from bwbayes.model.declaration import Declaration, Values, lognormal
from bwbayes.model.operator import HysteresisStep
from bwbayes.model.operators.scalar_memory import OneState, RelaxingStep, d, initial


@dataclass(frozen=True)
class NoHysteresis(OneState):
    """No hysteresis, w = d u in um, with d in um/V and the voltage u in V.

    It remembers nothing: ``initial`` is fixed at zero and has no effect.

    Notes
    -----
    The linear actuator of IEEE Standard on Piezoelectricity 176 (1987), at one frequency.
    """

    @property
    def parameters(self) -> tuple[Declaration, ...]:
        """d, and a placeholder for the initial state."""
        slope = replace(d(), default=lambda c: lognormal(c.ranges.slope, 0.6), bounds=None)
        return slope, replace(initial(), default=lambda _: 0.0)

    def first_state(self, column: Values, voltage: float | FloatArray) -> FloatArray:  # noqa: ARG002  # any
        """Return zero."""
        return np.zeros_like(column["d"])

    def step(self, column: Values) -> HysteresisStep:
        """Return d u."""
        nothing = np.zeros_like(column["d"])
        return RelaxingStep.of([column["d"]], [nothing], nothing, nothing)
