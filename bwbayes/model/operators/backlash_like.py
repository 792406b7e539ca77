"""Backlash-like hysteresis: a loop that opens and settles at the same rate in both directions.

It is the Bouc-Wen model with n = 1 and γ = 0, written otherwise, and the same code.
"""

from __future__ import annotations

from dataclasses import dataclass

from bwbayes.model.declaration import Declaration, Values
from bwbayes.model.operator import HysteresisStep
from bwbayes.model.operators.scalar_memory import (
    OneState,
    RelaxingStep,
    alpha,
    beta,
    ceiling,
    d,
    initial,
)


@dataclass(frozen=True)
class BacklashLike(OneState):
    """Backlash-like hysteresis of Su and others, exact.

    The displacement w in um follows the voltage u in V by

        dw = a |du| (c u − w) + b du.

    With h = c u − w this is dh = (c − b) du − a |du| h: n = 1 Bouc-Wen hysteresis with d = c,
    α = c − b, β = a and γ = 0, so d, α (um/V) and β (1/V) are its parameters. The slope at rest, b,
    is positive where α < d.

    Notes
    -----
    C.-Y. Su, Y. Stepanenko, J. Svoboda, T. P. Leung, Robust adaptive control of a class of
    nonlinear systems with unknown backlash-like hysteresis, IEEE Transactions on Automatic Control
    45 (2000).
    """

    @property
    def parameters(self) -> tuple[Declaration, ...]:
        """d, α, β and the initial h."""
        start = initial(lambda e: (-(top := ceiling(e["alpha"], e["beta"])), top))
        return d(), alpha(), beta(), start

    def step(self, column: Values) -> HysteresisStep:
        """Return that of n = 1 Bouc-Wen hysteresis with γ = 0."""
        return RelaxingStep.of([column["d"]], [column["alpha"]], column["beta"], column["beta"])
