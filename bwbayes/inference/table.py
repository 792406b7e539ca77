"""The table of a model's parameters: one order of θ's columns, and everybody asks by name.

The actuator's parameters come first, then the noise's, each in the order in which their parts
declare them.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

from bwbayes.arrays import FloatArray
from bwbayes.inference.noise import Noise
from bwbayes.model.actuator import Actuator
from bwbayes.model.declaration import Declaration, Scope

__all__ = ["Table"]


@dataclass(frozen=True)
class Table:
    """The parameters of an actuator and of a noise, in the order of θ's columns."""

    actuator_part: Actuator
    noise_part: Noise

    @cached_property
    def declarations(self) -> tuple[Declaration, ...]:
        """The parameters as their parts declare them."""
        return (*self.actuator_part.declarations, *self.noise_part.declarations)

    @cached_property
    def names(self) -> tuple[str, ...]:
        """Names of θ's columns."""
        return tuple(declaration.name for declaration in self.declarations)

    def of_scope(self, scope: Scope) -> tuple[str, ...]:
        """Return the names of parameters of the actuator, or of one record."""
        return tuple(d.name for d in self.declarations if d.scope == scope)

    @property
    def loop(self) -> tuple[str, ...]:
        """Names of the parameters that shape the loop."""
        return tuple(d.name for d in self.declarations if d.loop)

    def columns(self, theta: FloatArray) -> dict[str, FloatArray]:
        """Return the columns (models,) of θ (models, parameters) by name."""
        return dict(zip(self.names, theta.T, strict=True))

    def actuator(self, theta: FloatArray) -> FloatArray:
        """Return the columns of θ that the actuator takes, (models, its parameters)."""
        return theta[:, : len(self.actuator_part.parameters)]

    def noise(self, theta: FloatArray) -> FloatArray:
        """Return the columns of θ that the noise takes, (models, its parameters)."""
        return theta[:, len(self.actuator_part.parameters) :]

    def replaced(self, theta: FloatArray, name: str, values: FloatArray) -> FloatArray:
        """Return a copy of θ (models, parameters) with other values (models,) of one parameter."""
        theta = theta.copy()
        theta[:, self.names.index(name)] = values
        return theta
