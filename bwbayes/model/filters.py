"""Linear dynamics as parts: none, a first-order lag, or a mass on a spring.

A filter follows the drive that the hysteresis leaves. It declares its parameters and becomes a
recursion on the samples (:mod:`bwbayes.model.linear`), which knows what free responses its unknown
start can add.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass

import numpy as np

from bwbayes.model.declaration import Context, Declaration, Values, lognormal
from bwbayes.model.distributions import Distribution
from bwbayes.model.linear import Hold, Recursion, first_order_lag, no_dynamics, second_order

# A part of T: drives are mostly slow for the actuator. The prior is wide, because the lag does not
# follow the drive.
LAG, LAG_SIGMA = 0.005, 2.3


class Filter(ABC):
    """Linear dynamics, exact for a drive that is held or goes straight between samples."""

    @property
    @abstractmethod
    def parameters(self) -> tuple[Declaration, ...]:
        """Its parameters."""

    def unknowns(self, hold: Hold) -> int:
        """Return how many numbers say in which state it is at a record's first sample."""
        values = {parameter.name: np.ones(1) for parameter in self.parameters}
        return self.recursion(values, 1, 1.0, hold).unknowns

    @abstractmethod
    def recursion(self, column: Values, models: int, interval: float, hold: Hold) -> Recursion:
        """Return the recursion of a number of ``models`` with these columns (models,)."""


@dataclass(frozen=True)
class NoDynamics(Filter):
    """No dynamics, x = w: the displacement follows the drive at once, or with the hold."""

    parameters: tuple[Declaration, ...] = ()

    def recursion(self, column: Values, models: int, interval: float, hold: Hold) -> Recursion:  # noqa: ARG002  # nothing to tell it
        """Return x = w; see :func:`~bwbayes.model.linear.no_dynamics`."""
        return no_dynamics(models, hold)


@dataclass(frozen=True)
class Lag(Filter):
    """One first-order lag, τ x′ + x = w."""

    parameters: tuple[Declaration, ...] = (
        Declaration(
            "lag",
            "s",
            r"\tau_\mathrm{lag}",
            "time constant of the first-order lag",
            lambda context: lognormal(LAG * context.ranges.time, LAG_SIGMA),
            floor=0.0,
            limit_at_floor=True,
            aliases=("tau", "time_constant"),
        ),
    )

    def recursion(self, column: Values, models: int, interval: float, hold: Hold) -> Recursion:  # noqa: ARG002  # the column has them
        """Return that of :func:`~bwbayes.model.linear.first_order_lag`."""
        return first_order_lag(column["lag"], interval, hold)


def _damping(context: Context) -> Distribution | None:
    """Return the prior of the damping that gives such a lag, if the stiffness is known."""
    stiffness = context.value("stiffness")
    if stiffness is None:
        return None
    return lognormal(LAG * context.ranges.time * stiffness, LAG_SIGMA)


@dataclass(frozen=True)
class SecondOrder(Filter):
    """Equation (7) of the paper, (m/k) x″ + (b/k) x′ + x = w."""

    parameters: tuple[Declaration, ...] = tuple(
        Declaration(
            name,
            unit,
            label,
            description,
            default,
            floor=0.0,
            limit_at_floor=name == "damping",
            aliases=(label,),
            without_default="a record shows mass and stiffness only through the damping",
        )
        for name, unit, label, description, default in (
            ("mass", "kg", "m", "effective mass", lambda _: None),
            ("damping", "N s/m", "b", "effective damping", _damping),
            ("stiffness", "N/m", "k", "mechanical stiffness", lambda _: None),
        )
    )

    def recursion(self, column: Values, models: int, interval: float, hold: Hold) -> Recursion:  # noqa: ARG002  # the columns have them
        """Return that of :func:`~bwbayes.model.linear.second_order`."""
        return second_order(column["mass"], column["damping"], column["stiffness"], interval, hold)
