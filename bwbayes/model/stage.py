"""Stages of the signal path before and behind the hysteresis: from command to reading, in a row.

A :class:`Stage` on the input side changes the voltage on its way to the actuator, one on the output
side what the sensor sees of the displacement:

    command > input stages > hysteresis, nonlinearity > dynamics, creep > output stages > + offset

It is one class in one file. It declares its parameters, and says what it does with a sample:
``settle`` at the first one, if it has a memory, ``move`` at each of the next, and ``undo``, which
is ``move`` the other way round, for commands. Each is written once: NumPy moves all models at once
with it, compiled it moves one after the other (:mod:`bwbayes.model.compiled`), and printed it is C
(:mod:`bwbayes.control.exported`); so it is made of what :mod:`bwbayes.arrays` says.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any, ClassVar, Literal, NamedTuple

import numpy as np

from bwbayes.arrays import FloatArray, taking_all_models
from bwbayes.errors import InputError
from bwbayes.model.declaration import Declaration, Values
from bwbayes.model.inputs import Hold, Inputs
from bwbayes.model.linear import ComplexArray
from bwbayes.shown import brief

Side = Literal["input", "output"]


class Timing(NamedTuple):
    """How samples follow each other: every ``interval`` s, with a ``hold`` in between."""

    interval: float
    hold: Hold


class Stage(ABC):
    """A stage, for a batch of models: values (models, samples) in, values out.

    In V on the input side, in um on the output side. Its ``name`` is what a config calls it.
    """

    __repr__ = brief

    name: ClassVar[str]
    side: ClassVar[Side]
    rate_independent: ClassVar[bool] = False
    """Whether only the path of its values counts, not their pace: then it shapes loops."""
    sees: ClassVar[tuple[str, ...]] = ()
    """Columns of the inputs that it sees: ``"time"``, s since the record began, ``"voltage"``, the
    command, or a covariate. Their values at a sample are then the last of the ``parameters``.
    """
    remembers: ClassVar[int] = 0
    """How many numbers it remembers from sample to sample."""
    starts: ClassVar[Sequence[Mapping[str, float]]] = ({},)
    """Where to climb from in a search: normal scores of parameters by name, also of others that may
    have taken its place.
    """
    advice: ClassVar[str] = ""
    """A remedy on the test stand, instead of a stage of the model."""
    named_only: ClassVar[bool] = False
    """Whether a run only names it where a record shows it, and leaves it to the user to add it."""

    @property
    @abstractmethod
    def parameters(self) -> tuple[Declaration, ...]:
        """Its parameters."""

    def describe(self, values: Mapping[str, float]) -> str:  # noqa: ARG002
        """Say what it does with these values of its parameters, in a phrase."""
        return self.name

    def numbers(self, column: Values, timing: Timing) -> FloatArray:  # noqa: ARG002
        """Return what ``move`` needs to know of models, (models, any), from columns (models,).

        By default the parameters in their order.
        """
        return np.stack([column[declared.name] for declared in self.parameters], axis=1)

    def numbers_at(self, column: Values, timing: Timing, inputs: Inputs) -> FloatArray:
        """Return the same with what the stage sees at the first of inputs."""
        numbers = self.numbers(column, timing)
        first = [np.full(len(numbers), inputs.column(name)[0]) for name in self.sees]
        return np.column_stack([numbers, *first])

    def seen(self, inputs: Inputs) -> FloatArray:
        """Return what it sees of inputs, (columns, samples)."""
        columns = [inputs.column(name) for name in self.sees]
        return np.reshape(columns, (len(columns), inputs.samples))

    def reach(self, column: Values) -> tuple[float, float]:  # noqa: ARG002
        """Return how far before and behind a sample it needs the inputs, s, of models (models,)."""
        return 0.0, 0.0

    @staticmethod
    def settle(parameters: Any, value: Any, after: Any) -> Any:
        """Return what comes out once the stage is at rest at a value, and write its memory.

        Step of one model, whose parameters and memory are rows, or of all, (any, models). A stage
        without memory needs none: ``move`` is enough.
        """
        raise NotImplementedError

    @staticmethod
    @abstractmethod
    def move(parameters: Any, memory: Any, value: Any, after: Any) -> Any:
        """Return what comes out at a sample with this value, and write the memory ``after`` it."""

    @staticmethod
    def undo(parameters: Any, memory: Any, value: Any) -> Any:
        """Return the value with which ``move`` gives this one at the next sample."""
        raise NotImplementedError

    def settled(self, numbers: FloatArray, value: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return what comes out (models,) at rest at a value (models,), and the memory there."""
        memory = np.empty((self.remembers, value.size))
        with taking_all_models(self):
            if not self.remembers:
                return np.asarray(self.move(numbers.T, memory, value, memory)), memory.T
            return np.asarray(self.settle(numbers.T, value, memory)), memory.T

    def begin(
        self,
        column: Values,  # noqa: ARG002
        numbers: FloatArray,
        first: FloatArray,
        timing: Timing,  # noqa: ARG002
    ) -> FloatArray:
        """Return the memory (models, any) before a first value (models,), not from rest.

        By default as it would be at rest; a parameter of a record's own (in ``column``) may say
        more.
        """
        return self.settled(numbers, first)[1]

    def advance(
        self,
        numbers: FloatArray,
        memory: FloatArray,
        values: FloatArray,
        seen: FloatArray | None = None,
    ) -> tuple[FloatArray, FloatArray]:
        """Return what comes out (models, samples) of values, and the memory after them.

        All models take one sample together; a stage without memory takes all samples, too. The
        arguments are not changed. ``seen`` is what the stage sees, (columns, samples); by default
        as ``numbers`` have it.
        """
        if not self.remembers:
            known = [*numbers.T[..., np.newaxis]]
            if seen is not None:
                known[len(known) - len(seen) :] = seen
            with taking_all_models(self):
                return np.asarray(self.move(known, memory.T, values, memory.T)), memory
        result, rows = np.empty(values.shape), numbers.T.copy()
        now, after = memory.T.copy(), np.empty(memory.T.shape)
        with taking_all_models(self):
            for sample in range(values.shape[1]):
                if seen is not None:
                    rows[len(rows) - len(seen) :] = seen[:, sample, np.newaxis]
                result[:, sample] = self.move(rows, now, values[:, sample], after)
                now, after = after, now
        return result, now.T.copy()

    def inverse(
        self,
        numbers: FloatArray,
        memory: FloatArray,
        values: FloatArray,
        seen: FloatArray | None = None,
    ) -> FloatArray:
        """Return the values (models, samples) with which these come out; the others as before.

        Raises
        ------
        InputError
            The stage has no inverse.
        """
        self.require_inverse()
        result, rows = np.empty(values.shape), numbers.T.copy()
        now, after = memory.T.copy(), np.empty(memory.T.shape)
        with taking_all_models(self):
            for sample in range(values.shape[1]):
                if seen is not None:
                    rows[len(rows) - len(seen) :] = seen[:, sample, np.newaxis]
                result[:, sample] = self.undo(rows, now, values[:, sample])
                self.move(rows, now, result[:, sample], after)
                now, after = after, now
        return result

    def response(self, numbers: FloatArray, angles: FloatArray) -> ComplexArray | float:  # noqa: ARG002
        """Return how the stage passes small oscillations on, (models, frequencies), complex.

        ``angles`` (frequencies,) are per sample, rad. By default they pass unchanged.
        """
        return 1.0

    def require_inverse(self) -> None:
        """Raise an InputError if the stage has no ``undo``."""
        if type(self).undo is Stage.undo:
            raise InputError(f"inverse: no command undoes the stage {self.name}; leave it out")


Advance = Callable[
    [Stage, FloatArray, FloatArray, FloatArray, FloatArray | None], tuple[FloatArray, FloatArray]
]
"""Runs a stage along values, as :meth:`Stage.advance` does."""


def begin_stages(
    stages: Sequence[Stage],
    column: Values,
    first: FloatArray,
    inputs: Inputs,
    timing: Timing,
    rest_value: FloatArray | None = None,
) -> tuple[FloatArray, ...]:
    """Return the memories of stages in a row just before a record's first value (models,).

    ``rest_value`` (models,) is the value at zero volts, where the actuator was at rest, if it came
    straight from there; otherwise what was before is not known.
    """
    memories = []
    for stage in stages:
        numbers = stage.numbers_at(column, timing, inputs)
        if rest_value is None:
            memory = stage.begin(column, numbers, first, timing)
        else:
            rested, at_rest = stage.settled(numbers, rest_value)
            # A rate-independent stage has come along the whole path from there.
            memory = at_rest if stage.rate_independent else stage.settled(numbers, first)[1]
            rest_value = rested
        memories.append(memory)
        seen = stage.seen(inputs[:1])
        first = stage.advance(numbers, memory, first[:, np.newaxis], seen)[0][:, 0]
    return tuple(memories)


def undo_stages(
    stages: Sequence[Stage],
    column: Values,
    values: FloatArray,
    inputs: Inputs,
    timing: Timing,
    rest_value: FloatArray | None = None,
) -> FloatArray:
    """Return the values (models, samples) with which these come out behind stages in a row.

    ``inputs`` and ``rest_value`` as in :func:`begin_stages`.

    Raises
    ------
    InputError
        A stage that has no inverse.
    """
    at_rest = []
    for stage in stages:
        stage.require_inverse()
        at_rest.append(rest_value)
        if rest_value is not None:
            rest_value = stage.settled(stage.numbers_at(column, timing, inputs), rest_value)[0]
    for stage, rested in zip(reversed(stages), reversed(at_rest), strict=True):
        numbers, first = stage.numbers_at(column, timing, inputs), values[:, 0].copy()
        memories = begin_stages((stage,), column, first, inputs, timing, rested)
        # The first output depends on the first input.
        for _ in range(40):
            out, _ = stage.advance(numbers, memories[0], first[:, np.newaxis])
            first = first + (values[:, 0] - out[:, 0])
            memories = begin_stages((stage,), column, first, inputs, timing, rested)
        values = stage.inverse(numbers, memories[0], values, stage.seen(inputs))
    return values


def pass_stages(
    stages: Sequence[Stage],
    column: Values,
    values: FloatArray,
    memories: Sequence[FloatArray],
    inputs: Inputs,
    timing: Timing,
    advance: Advance | None = None,
) -> tuple[FloatArray, tuple[FloatArray, ...]]:
    """Let values (models, samples) pass stages in a row; return them, and the memories.

    The ``inputs`` are those of the same samples; ``advance`` replaces :meth:`Stage.advance`.
    """
    after = []
    for stage, memory in zip(stages, memories, strict=True):
        numbers = stage.numbers_at(column, timing, inputs)
        advance_stage = stage.advance if advance is None else partial(advance, stage)
        values, reached = advance_stage(numbers, memory, values, stage.seen(inputs))
        after.append(reached)
    return values, tuple(after)
