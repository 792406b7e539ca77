"""Memory of Preisach's model and its kin: the extrema of the voltage that still count.

A voltage that comes back to an earlier turning point closes a loop, and all that happened inside
the loop is forgotten. The memory is a stack of extrema, each nearer to the next than the one
before. It depends on the voltage alone, so all models of a batch share it, and along a branch, from
the last of these extrema to where the voltage turns or closes a loop, the displacement is one array
expression. An operator is told from another by that expression alone, its Everett function.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple

import numpy as np

from bwbayes.arrays import FloatArray, taking_all_models
from bwbayes.model.declaration import Declaration, Distribution, Values, refuse
from bwbayes.model.inputs import PIECE, Span, monotone_stretches
from bwbayes.model.operator import HysteresisStep, Operator

INITIAL = Declaration(
    name="initial",
    unit="-",
    label=r"\xi_0",
    description="state before the record, from the ascending (-1) to the descending branch (+1)",
    default=lambda _: Distribution("uniform", {"lower": -1.0, "upper": 1.0}),
    bounds=lambda _: (-1.0, 1.0),
    stated_bounds="-1 <= initial <= 1",
    scope="record",
)

Branch = Callable[[float | FloatArray, FloatArray], FloatArray]
"""E(start, voltage), um, of all models, where the two broadcast to (models or 1, samples)."""


class Extremum(NamedTuple):
    """A voltage at which the path turned, V, and the displacement there (models,), um.

    ``own`` is the voltage (models,) where it differs from model to model; ``voltage`` is then the
    largest of them, beyond which no model remembers it.
    """

    voltage: float
    displacement: FloatArray
    own: FloatArray | None = None


@dataclass(frozen=True)
class Memory:
    """Where a path stands, ``voltage``, V, and ``displacement`` (models,), um, and what it keeps.

    ``extrema`` are those that still count; the first is the demagnetized state at zero volts.
    ``direction`` is the one in which the path left the last of them, zero if it did not move yet.
    """

    voltage: float
    displacement: FloatArray
    direction: float
    extrema: tuple[Extremum, ...]


class RemembersExtrema(Operator):
    """An operator that remembers the dominant extrema of its voltage.

    From an extremum (u_r, w_r) on, up to where the voltage closes the loop that it turned in,

        w = w_r ± E(u_r, u),

    with the upper sign for a rising voltage. E is the operator's Everett function; it has a factor
    of two in it that other authors write before it. The path from the demagnetized state on, where
    |u| is larger than ever before, is w = ± E(−|u|, |u|) / 2 if the operator is odd.

    The state before a record is one number in each model, ``initial``, from −1 to 1: an earlier
    drive went from the demagnetized state to the span's highest voltage u₊, to its lowest, up to
    m = u₀ + (initial + 1) / 2 (u₊ − u₀), and down to the record's first voltage u₀. So −1 is the
    ascending branch and 1 the descending one, and w at u₀ rises with ``initial`` from one to the
    other.

    A drive over another range leaves other states, which show once the voltage goes beyond what it
    reached. A prediction's unknown initial states include these.

    Sources: F. Preisach, Z. Phys. 94 (1935) 277-302; I. D. Mayergoyz, Mathematical Models of
    Hysteresis (Springer, 1991), for the stack and the Everett function.
    """

    remembers_range: ClassVar = True

    @abstractmethod
    def numbers(self, column: Values) -> FloatArray:
        """Return what ``everett`` needs to know of the models, (models, any)."""

    @staticmethod
    @abstractmethod
    def everett(numbers: Any, start: Any, voltage: Any) -> Any:
        """Return E from one voltage to another, um: zero where they are the same.

        It must be the same whichever of the two is the start. Written once, of what
        :mod:`bwbayes.arrays` says: for one model, all numbers, where it is compiled, and
        for all models at once, with ``numbers`` (any, models, 1).
        """

    def branch(self, column: Values) -> Branch:
        """Return the Everett function of the models."""
        numbers = np.ascontiguousarray(self.numbers(column).T)[:, :, np.newaxis]

        def everett(start: Any, voltage: Any) -> Any:
            with taking_all_models(self):
                return self.everett(numbers, start, voltage)

        return everett

    def check(self, column: Values) -> None:
        """Raise an InputError that names the parameter where a model is outside of the domain."""
        super().check(column)
        initial = column[INITIAL.name]
        refuse(INITIAL.name, np.abs(initial) > 1, initial, "must lie between -1 and 1")

    def begin(self, column: Values, voltage: float, span: Span, *, from_rest: bool) -> Memory:
        """Return the memory at a record's first voltage.

        From rest the voltage came straight from zero volts, where the actuator was demagnetized,
        and ``initial`` does not count. A first voltage outside of the span widens it.
        """
        nothing = np.zeros(column[INITIAL.name].size)
        memory = Memory(0.0, nothing, 0.0, (Extremum(0.0, nothing),))
        if from_rest:
            return self.advance(column, np.array([voltage]), memory)[1]
        low, high = min(span.low, voltage), max(span.high, voltage)
        _, memory = self.advance(column, np.array([high, low]), memory)
        if low == high:
            return memory
        branch = self.branch(column)
        turned = voltage + (column[INITIAL.name] + 1) / 2 * (high - voltage)
        at_turn = memory.displacement + branch(low, turned[:, np.newaxis])[:, 0]
        here = at_turn - branch(turned[:, np.newaxis], np.array([voltage]))[:, 0]
        history = (
            *memory.extrema,
            Extremum(low, memory.displacement),
            Extremum(float(np.max(turned)), at_turn, turned),
        )
        return Memory(voltage, here, -1.0, history)

    def begin_apart(
        self,
        column: Values,
        step: HysteresisStep,
        voltage: FloatArray,
        span: Span,
        *,
        from_rest: bool,
    ) -> FloatArray:
        """Return the memory of the operator's step at first voltages (models,) of their own.

        The voltages have turned where :meth:`begin` says; a step goes from one turn to the next.
        """
        memory = step.demagnetized()
        if not from_rest:
            low, high = np.minimum(span.low, voltage), np.maximum(span.high, voltage)
            turned = voltage + (column[INITIAL.name] + 1) / 2 * (high - voltage)
            for turn in (high, low, turned):
                memory = step.apply(memory, turn)[2]
        return step.apply(memory, voltage)[2]

    def advance(
        self, column: Values, voltage: FloatArray, memory: Memory
    ) -> tuple[FloatArray, Memory]:
        """Return w (models, samples) along the next samples, and the memory after them.

        The memory that is given stays as it is.
        """
        models = memory.displacement.size
        result = np.repeat(memory.displacement[:, np.newaxis], voltage.size, axis=1)
        moves = np.flatnonzero(voltage != memory.voltage)
        if moves.size == 0:
            return result, memory
        # The voltage rests where it was at first, and w does; then each stretch starts at the last.
        rests = int(moves[0])
        path = np.concatenate([[memory.voltage], voltage[rests:]])
        moving = result[:, rests:]
        branch, extrema, ahead = self.branch(column), list(memory.extrema), memory.direction
        here = memory.displacement
        for first, last, direction in monotone_stretches(path, max(PIECE // models, 1)):
            if direction == -ahead:
                extrema.append(Extremum(float(path[first]), here))
            ahead = direction
            _follow(branch, extrema, direction, path[first + 1 : last + 1], moving[:, first:last])
            here = moving[:, last - 1].copy()
            # Models whose own extremum the voltage has passed turn here, if they turn next.
            end, passed = float(path[last]), extrema[-2] if extrema[1:] else None
            if passed is not None and passed.own is not None and end > np.min(passed.own):
                extrema[-2] = Extremum(
                    passed.voltage,
                    np.where(passed.own > end, passed.displacement, here),
                    np.maximum(passed.own, end),
                )
        return result, Memory(float(path[-1]), here, ahead, tuple(extrema))

    def reachable(
        self, column: Values, voltage: float, span: Span
    ) -> tuple[FloatArray, FloatArray]:
        """Return the lowest and highest ``initial`` (models,): −1 and 1, or 0 where all are alike.

        At either end of the span only one state is possible.
        """
        inside = float(span.low < voltage < span.high)
        bound = np.full(column[INITIAL.name].size, inside)
        return -bound, bound

    def typical_slope(self, column: Values, span: Span) -> FloatArray:
        """Return the mean slope from the span's lowest to its highest voltage (models,), um/V."""
        branch, width = self.branch(column), span.high - span.low
        if not width > 0:
            # A single voltage: its volt's part in a million stands for the slope at a turn.
            width = 1e-6 * max(abs(span.low), 1.0)
        climbed = branch(span.low, np.array([[span.low + width]]))
        return np.broadcast_to(climbed[:, 0], column[INITIAL.name].shape) / width


def _follow(
    branch: Branch, extrema: list[Extremum], direction: float, voltage: FloatArray, out: FloatArray
) -> None:
    """Write w along a monotone stretch (samples,) to ``out``, and drop the extrema it wipes out."""
    done = 0
    while True:
        # A branch is forgotten at the extremum before the last. Before the first of all was none:
        # at its mirror image the path joins the first curve again.
        closing = direction * (extrema[-2].voltage if extrema[2:] else -extrema[-1].voltage)
        end = int(np.searchsorted(direction * voltage, closing)) if extrema[1:] else voltage.size
        if end > done:
            _along(branch, extrema, direction, voltage[done:end], out[:, done:end])
        if end == voltage.size:
            return
        done = max(end, done)
        # A loop is closed and forgotten, or the first curve is joined again.
        del extrema[-2 if extrema[2:] else -1 :]


def _along(
    branch: Branch, extrema: list[Extremum], direction: float, voltage: FloatArray, out: FloatArray
) -> None:
    """Write w along a part of a stretch that wipes nothing out to ``out`` (models, samples)."""

    def from_extremum(start: Extremum, voltages: FloatArray) -> FloatArray:
        turned = start.voltage if start.own is None else start.own[:, np.newaxis]
        moved = direction * branch(turned, voltages)
        moved += start.displacement[:, np.newaxis]
        return moved

    last = extrema[-1]
    if not extrema[1:]:
        out[:] = 0.5 * np.sign(voltage) * branch(-np.abs(voltage), np.abs(voltage))
        return
    before = extrema[-2].own
    if before is None:
        out[:] = from_extremum(last, voltage)
        return
    # Some models have come back to their own extremum, and went on as if it had not been.
    early = int(np.searchsorted(voltage, np.min(before)))
    out[:, :early] = from_extremum(last, voltage[:early])
    late = voltage[early:]
    if late.size:
        inside = late < before[:, np.newaxis]
        out[:, early:] = np.where(
            inside, from_extremum(last, late), from_extremum(extrema[-3], late)
        )
