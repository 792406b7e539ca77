"""Protocol of a hysteresis operator: voltage in, displacement out, with memory of the path.

An operator is rate-independent: only the path of the voltage counts, not its pace. It works for a
batch of models at once, whose parameters come as columns by name, and for a record in pieces, with
its memory carried from one piece to the next. The history before a record is one number for each
model, ``initial``: a state that an earlier drive within a ``span`` of voltages could have left.

A simulation gives all models one voltage that is known beforehand. In a closed loop each has its
own, and the next one hangs on what the last one did. There a :class:`HysteresisStep` says what the
displacement would be if the voltage went straight from where it stands to somewhere else, and how
steep it is. That takes a bounded time, whatever was before; operators whose memory grows with the
voltage's past, or that are integrated, have no such step.

A step's ``move`` is written once, for numbers and for arrays: with rows of arrays (models,) NumPy
moves all models of a closed loop at once, compiled with numbers it moves one model after the other
(:mod:`bwbayes.model.compiled`), and printed it is C (:mod:`bwbayes.control.exported`). So it is
made of what :mod:`bwbayes.arrays` says.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Any, ClassVar

import numpy as np

from bwbayes.arrays import BoolArray, FloatArray, taking_all_models
from bwbayes.errors import InputError
from bwbayes.model.declaration import Declaration, Values, check, each_model
from bwbayes.model.inputs import PIECE, Span, monotone_stretches
from bwbayes.shown import brief


class HysteresisStep(ABC):
    """A hysteresis operator w = Γ[u] that goes from one voltage (models,) straight to the next.

    Voltages are in V, displacements in um, slopes in um/V, all (models,). The memory is an array
    (models, any).

    Parameters
    ----------
    parameters
        Numbers of the models for ``move``, (models, any); ``ROW`` names them.
    """

    __repr__ = brief

    ROW: ClassVar = ""

    parameters: FloatArray

    def __init__(self, parameters: FloatArray) -> None:
        self.parameters = parameters

    @staticmethod
    @abstractmethod
    def move(parameters: Any, memory: Any, voltage: Any, after: Any) -> tuple[Any, Any]:
        """Return w and dw/du once the voltage has gone there, and write the memory ``after`` it.

        Step of one model, whose parameters and memory are rows, or of all, (any, models).
        """

    @abstractmethod
    def demagnetized(self) -> FloatArray:
        """Return the memory of a demagnetized actuator at zero volts."""

    def remembered(self, memory: Any) -> FloatArray:
        """Return the memory (models, any) of what the operator itself remembers: the same."""
        return np.asarray(memory)

    @abstractmethod
    def slopes(self, limits: Span) -> tuple[FloatArray, FloatArray]:
        """Return bounds of dw/du that hold on every path from the demagnetized state.

        The path keeps within limits, V.
        """

    @abstractmethod
    def coefficients(self) -> dict[str, tuple[Any, str]]:
        """Return what the equation of the first model has: numbers by name, and their units."""

    def apply(
        self, memory: FloatArray, voltage: FloatArray
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return w, dw/du and the memory once the voltage has gone there; that given stays."""
        after = np.empty_like(memory)
        with taking_all_models(self):
            return *self.move(self.parameters.T, memory.T, voltage, after.T), after


class OneStateStep(HysteresisStep):
    """A step that remembers the voltage, one displacement h, and maybe more that follows from both.

    Its memory is (models, ``remembers``), zeros where it follows.
    """

    remembers: ClassVar[int] = 2

    def demagnetized(self) -> FloatArray:
        """Return zero volts and h = 0."""
        return np.zeros((len(self.parameters), self.remembers))

    def remembered(self, memory: Any) -> FloatArray:
        """Return voltage and h."""
        return self._at(memory.voltage, memory.state)

    def _at(self, voltage: float | FloatArray, state: FloatArray) -> FloatArray:
        memory = self.demagnetized()
        memory[:, 0], memory[:, 1] = voltage, state
        return memory

    def trace(self, voltage: FloatArray, state: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return w (models, samples) along a path (samples,), V, and h (models,) at its end.

        ``state`` (models,), um, is h at its first sample.
        """
        w = np.empty((state.size, voltage.size))
        w[:, 0], _, _ = self.apply(self._at(voltage[0], state), np.full(state.size, voltage[0]))
        if np.ptp(voltage) == 0:
            w[:] = w[:, :1]
            return w, state
        for first, last, _ in monotone_stretches(voltage, max(PIECE // max(state.size, 1), 1)):
            ahead = slice(first + 1, last + 1)
            w[:, ahead], states = self.along(voltage[first], state, voltage[ahead])
            state = states[:, -1].copy()
        return w, state

    def along(
        self, start: float, state: FloatArray, voltage: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Return w and h (models, samples) along voltages (samples,) that go one way.

        From a voltage ``start``, where h is ``state`` (models,); each goes there straight.
        """
        numbers, memory = self.parameters.T[..., np.newaxis], self._at(start, state).T
        after = np.empty((*memory.shape, voltage.size))
        with taking_all_models(self):
            w, _ = self.move(numbers, memory[..., np.newaxis], voltage, after)
        return w, after[1]


class Operator(ABC):
    """A hysteresis operator: w = Γ[u], um, for a batch of models.

    All columns are (models,), named and in the units of ``parameters``; voltages are in V,
    displacements in um.
    """

    # Whether drives of another range leave states that ``initial`` does not hold.
    remembers_range: ClassVar = False

    @property
    @abstractmethod
    def parameters(self) -> tuple[Declaration, ...]:
        """Its parameters; the last is ``initial``, of scope ``record``."""

    def check(self, column: Values) -> None:
        """Raise an InputError that names the parameter where a model is outside of the domain.

        By default where a parameter is not finite, or below its floor.
        """
        check(self.parameters, column)

    @abstractmethod
    def begin(self, column: Values, voltage: float, span: Span, *, from_rest: bool) -> Any:
        """Return the memory at a record's first voltage.

        From rest the voltage came straight from zero volts, where the actuator was demagnetized
        (or in the state ``initial``, where that is a displacement). Otherwise ``initial`` says
        which of the reachable states it is.
        """

    def begin_apart(
        self,
        column: Values,
        step: HysteresisStep,
        voltage: FloatArray,
        span: Span,
        *,
        from_rest: bool,
    ) -> FloatArray:
        """Return the memory of the operator's ``step`` at first voltages (models,) of their own.

        By default of one model after the other.
        """
        del step  # that of all models
        return np.concatenate(
            [
                self.step(values).remembered(
                    self.begin(values, float(first), span, from_rest=from_rest)
                )
                for values, first in zip(each_model(column), voltage, strict=True)
            ]
        )

    @abstractmethod
    def advance(self, column: Values, voltage: FloatArray, memory: Any) -> tuple[FloatArray, Any]:
        """Return w (models, samples) along the next samples, and the memory after them.

        The memory that is given stays as it is.
        """

    @abstractmethod
    def reachable(
        self, column: Values, voltage: float, span: Span
    ) -> tuple[FloatArray, FloatArray]:
        """Return the lowest and highest ``initial`` (models,) that earlier drives could leave."""

    def left(self, column: Values, voltage: float, span: Span) -> FloatArray:
        """Return the ``initial`` (any, models) that drives to and fro through the span leave.

        On either branch of the loop; by default the lowest and the highest that are reachable.
        """
        return np.stack(self.reachable(column, voltage, span))

    @abstractmethod
    def typical_slope(self, column: Values, span: Span) -> FloatArray:
        """Return a typical slope dw/du (models,), um/V: the scale of an unknown start."""

    def step(self, column: Values) -> HysteresisStep:  # noqa: ARG002  # it has none
        """Return what goes from one voltage straight to the next in a bounded time.

        With it the operator runs in a closed loop and as C, and many models are read backwards, and
        the likelihood is worked out, compiled.

        Raises
        ------
        InputError
            The operator has none, as this one.
        """
        raise InputError(
            f"hysteresis: {type(self).__name__} has no step of bounded time for a controller; take "
            "one that has, such as bouc-wen, duhem or plays"
        )

    def holds(self, column: Values) -> BoolArray | np.bool_:
        """Tell which models (models,) meet what the bounds of single parameters do not say.

        A column may be missing.
        """
        del column
        return np.True_

    def opening(self, column: Values, half_range: float) -> FloatArray | None:
        """Return how far (models,) a drive of half a range (V) opens the loop; one closes it.

        None if this operator cannot say.
        """
        del column, half_range
        return None
