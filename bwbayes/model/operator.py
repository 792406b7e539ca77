"""Protocol of a hysteresis operator: voltage in, displacement out, with memory of the path.

An operator is rate-independent: only the path of the voltage counts, not its pace. It works for a
batch of models at once, whose parameters come as columns by name, and for a record in pieces, with
its memory carried from one piece to the next. The history before a record is one number for each
model, ``initial``: a state that an earlier drive within a ``span`` of voltages could have left.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Any, NamedTuple

import numpy as np

from bwbayes.arrays import BoolArray, FloatArray
from bwbayes.errors import InputError
from bwbayes.model.declaration import Declaration, Values, check
from bwbayes.model.step import HysteresisStep


class Span(NamedTuple):
    """The least and the largest voltage that earlier drives may have had, V."""

    low: float
    high: float

    @property
    def middle(self) -> float:
        """Its middle, V."""
        return (self.low + self.high) / 2

    @property
    def half(self) -> float:
        """Half of its width, V."""
        return (self.high - self.low) / 2


UNIT = Span(-1.0, 1.0)


def narrower(span: Span, further: tuple[float, ...] = (0.8, 1.0, 1.25)) -> tuple[Span, ...]:
    """Return ranges about a span's middle, evenly from next to nothing to all of it.

    ``further`` is how far up they go, as parts of how far down.
    """
    low, center, half = span.low, span.middle, span.half
    # Fewer ranges leave steps that show; more take longer.
    ends = [(k / 16, min(up * k / 16, 1.0)) for k in range(1, 17) for up in further]
    return tuple(
        dict.fromkeys(Span(max(center - down * half, low), center + up * half) for down, up in ends)
    )


class Operator(ABC):
    """A hysteresis operator: w = Γ[u], um, for a batch of models.

    All columns are (models,), named and in the units of ``parameters``; voltages are in V,
    displacements in um.
    """

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

    def earlier(self, span: Span) -> tuple[Span, ...]:
        """Return the ranges of earlier drives within a span that leave states of their own.

        The span alone, if ``initial`` in it holds all states.
        """
        return (span,)

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
