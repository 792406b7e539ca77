"""Hysteresis a sample at a time, each model with a voltage of its own.

A simulation gives all models one voltage that is known beforehand. In a closed loop, and read
backwards, each has its own, and the next one hangs on what the last one did. Here an operator says
what its displacement would be if the voltage went straight from where it stands to somewhere else,
and how steep it is there. That takes a bounded time, whatever was before; operators whose memory
grows with the voltage's past, or that are integrated, have no such step.

A step's ``move`` is written once, for numbers and for arrays: with rows of arrays (models,) NumPy
moves all models of a closed loop at once, compiled with numbers it moves one model after the other
(:mod:`bwbayes.model.compiled`), and printed it is C (:mod:`bwbayes.control.codegen`). So it is made
of what :mod:`bwbayes.model.elementwise` says.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple

import numpy as np

from bwbayes.arrays import BoolArray, FloatArray

if TYPE_CHECKING:
    from bwbayes.model.operator import Span

__all__ = ["Gone", "HysteresisStep", "OneStateStep"]


class Gone(NamedTuple):
    """What is once a voltage has gone there: w (models,), um, dw/du (models,), and the memory."""

    w: FloatArray
    slope: FloatArray
    memory: FloatArray


class HysteresisStep(ABC):
    """A hysteresis operator w = Γ[u] that goes from one voltage (models,) straight to the next.

    Voltages are in V, displacements in um, slopes in um/V, all (models,). What it remembers is an
    array (models, any). One that is not ``lean`` takes longer than NumPy does along a stretch: the
    likelihood does without it.
    """

    lean: ClassVar[bool] = True

    @property
    @abstractmethod
    def parameters(self) -> FloatArray:
        """What ``move`` needs to know of the models, (models, any)."""

    @staticmethod
    @abstractmethod
    def move(parameters: Any, memory: Any, voltage: Any, after: Any) -> tuple[Any, Any]:
        """Return w and dw/du once the voltage has gone there, and write the memory ``after`` it.

        Of one model, whose parameters and memory are numbers in a row, or of all, (any, models).
        """

    @abstractmethod
    def demagnetized(self) -> FloatArray:
        """Return the memory of a demagnetized actuator at zero volts."""

    @abstractmethod
    def remembered(self, memory: Any) -> FloatArray:
        """Return the memory (models, any) of what the operator itself remembers."""

    @abstractmethod
    def begun(self, voltage: FloatArray, initial: FloatArray, span: Span) -> FloatArray:
        """Return the memory (models, any) of models that start at voltages (models,), V.

        In the states that the ``initial`` ones (models,) say, within a span of earlier voltages.
        """

    @abstractmethod
    def slopes(self, limits: Span) -> tuple[FloatArray, FloatArray]:
        """Return bounds of dw/du that hold on every path from the demagnetized state.

        The path keeps within limits, V.
        """

    @abstractmethod
    def coefficients(self) -> dict[str, tuple[Any, str]]:
        """Return what the equation of the first model has: numbers by name, and their units."""

    def holds(self, memory: FloatArray) -> BoolArray:
        """Tell which models (models,) the step is for, where they stand; by default all."""
        return np.ones(len(memory), dtype=np.bool_)

    def go(self, memory: FloatArray, voltage: FloatArray) -> Gone:
        """Return what is once the voltage has gone there; the memory that is given stays."""
        after = np.empty_like(memory)
        return Gone(*self.move(self.parameters.T, memory.T, voltage, after.T), after)


class OneStateStep(HysteresisStep):
    """A step that remembers the voltage and one displacement h, (models, 2)."""

    def demagnetized(self) -> FloatArray:
        """Return zero volts and h = 0."""
        return np.zeros((len(self.parameters), 2))

    def remembered(self, memory: Any) -> FloatArray:
        """Return voltage and h."""
        pairs = np.empty((memory.state.size, 2))
        pairs[:, 0], pairs[:, 1] = memory.voltage, memory.state
        return pairs

    def along(
        self, start: float, state: FloatArray, voltage: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Return w and h (models, samples) along voltages (samples,) that go one way.

        From a voltage ``start``, where h is ``state`` (models,); each goes there straight.
        """
        memory = np.stack([np.full_like(state, start), state])[:, :, np.newaxis]
        after = np.empty((2, state.size, voltage.size))
        w, _ = self.move(self.parameters.T[:, :, np.newaxis], memory, voltage[np.newaxis], after)
        return w, after[1]

    def begun(self, voltage: FloatArray, initial: FloatArray, span: Span) -> FloatArray:  # noqa: ARG002  # the state says all of the past
        """Return voltage and h."""
        return np.stack([voltage, initial], axis=1)
