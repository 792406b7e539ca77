"""The actuator: voltage in, displacement out, for a batch of parameter vectors at once.

It is put together from parts. A hysteresis operator makes the drive w of the voltage's path, to
which a polynomial gain may add; linear dynamics follow the drive (equations (6) to (8) of the
paper), creep may add to what they do, and the sensor adds its offset. An
:class:`Actuator` says which parts there are, what the voltage does between samples, and how long
those are apart; the parameters come as the columns of a matrix θ, in the order in which the parts
declare them. A long record can be walked through in pieces: the :class:`State` at the end of one
piece starts the next.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, get_args

import numpy as np

from bwbayes.arrays import ArrayLike, FloatArray
from bwbayes.errors import InputError
from bwbayes.model.creep import Creep
from bwbayes.model.declaration import Declaration, Values, check, normal
from bwbayes.model.filters import Filter
from bwbayes.model.gain import PolynomialGain
from bwbayes.model.linear import Hold, Sections
from bwbayes.model.operator import Operator, Span
from bwbayes.model.operators.bouc_wen import BoucWen
from bwbayes.model.registry import DYNAMICS, made
from bwbayes.shown import brief

OFFSET = Declaration(
    "offset",
    "um",
    r"y_0",
    "sensor offset",
    lambda context: normal(context.ranges.middle, context.ranges.reach),
    scope="record",
    aliases=("y0",),
)


@dataclass(frozen=True)
class State:
    """All that a batch of models remembers after a piece of a record.

    ``hysteresis`` is the operator's memory; ``rest`` are the drives at the record's first sample,
    at which dynamics and creep were at rest, (models,) each, um; ``filter`` are the states of their
    recursions, (models, taps - 1) each.
    """

    __repr__ = brief

    hysteresis: Any
    rest: tuple[FloatArray, ...]
    filter: tuple[FloatArray, ...]


@dataclass(frozen=True)
class Actuator:
    """An actuator with hysteresis and linear dynamics.

    Parameters
    ----------
    dynamics
        ``"none"``; ``"lag"``, one first-order lag; ``"second-order"``, equation (7); or the import
        path of another filter.
    hold
        ``"first"``: the drive goes straight from sample to sample (a measured voltage);
        ``"zero"``: it is held until the next sample (the command of a DAC).
    interval
        Sampling interval, s, above zero.
    hysteresis
        The operator that makes the drive.
    gain
        What is added to the drive without a memory.
    creep
        What is added to the displacement with a long one.
    span
        The voltages that drives before a record may have had, V; by default those of the voltage
        that is simulated.

    Raises
    ------
    InputError
        An unknown ``dynamics`` or ``hold``, or an ``interval`` that is not positive and finite.
    """

    __repr__ = brief

    dynamics: str = "lag"
    hold: Hold = "first"
    interval: float = 1e-3
    hysteresis: Operator = field(default_factory=BoucWen)
    gain: PolynomialGain | None = None
    creep: Creep | None = None
    span: Span | None = None

    def __post_init__(self) -> None:
        made("dynamics", self.dynamics, DYNAMICS, {}, Filter)
        if self.hold not in get_args(Hold):
            choices = ", ".join(get_args(Hold))
            raise InputError(f"hold: {self.hold!r} is unknown; write one of {choices}")
        if not 0 < self.interval < math.inf:
            raise InputError(f"interval: {self.interval:.6g}; must be positive and finite, in s")

    @cached_property
    def filter(self) -> Filter:
        """The linear dynamics."""
        return made("dynamics", self.dynamics, DYNAMICS, {}, Filter)

    @cached_property
    def declarations(self) -> tuple[Declaration, ...]:
        """The parameters that the parts declare, in the order of θ's columns."""
        parts = (self.hysteresis, self.gain, self.filter, self.creep)
        return (*(d for part in parts if part is not None for d in part.parameters), OFFSET)

    @cached_property
    def parameters(self) -> tuple[str, ...]:
        """Names of θ's columns."""
        return tuple(declaration.name for declaration in self.declarations)

    @cached_property
    def unknowns(self) -> int:
        """How many numbers say how dynamics and creep are at a record's first sample."""
        return self.filter.unknowns(self.hold) + (len(self.creep.times) if self.creep else 0)

    def displacement(
        self, theta: ArrayLike, voltage: ArrayLike, *, from_rest: bool = False
    ) -> FloatArray:
        """Displacement of every model along one voltage.

        Parameters
        ----------
        theta
            (models, parameters), the columns and their units as in :attr:`declarations`.
        voltage
            (samples,), V.
        from_rest
            The voltage came from zero, where the actuator was at rest.

        Returns
        -------
        FloatArray
            (models, samples), um.

        Raises
        ------
        InputError
            θ of a wrong shape or outside the model's domain: not finite, or what a part refuses.
            The text names the parameter.
        """
        return self.advance(theta, voltage, from_rest=from_rest)[0]

    def advance(
        self,
        theta: ArrayLike,
        voltage: ArrayLike,
        state: State | None = None,
        unrest: FloatArray | None = None,
        *,
        from_rest: bool = False,
    ) -> tuple[FloatArray, State]:
        """Displacement along the next piece of a record, and the state at its end.

        Shapes and units as in :meth:`displacement`. Without a ``state`` the record starts here: the
        hysteresis is in the state that θ's initial one says; dynamics and creep are at rest at the
        first drive, or ``unrest`` (models, unknowns) away from there, um: the dynamics (also how
        fast they move, where there is a mass), then each lag of the creep; (models, 0) is rest.
        """
        models = np.atleast_2d(np.asarray(theta, dtype=np.float64))
        if models.ndim != 2 or models.shape[1] != len(self.parameters):
            raise InputError(
                f"theta: has shape {models.shape}; its columns are {', '.join(self.parameters)}"
            )
        path = np.asarray(voltage, dtype=np.float64)
        if path.ndim != 1 or path.size == 0:
            raise InputError(f"voltage: has shape {path.shape}; give a non-empty row of samples")
        if not np.isfinite(path).all():
            raise InputError("voltage: must be finite; check the record")
        column = self.columns(models)
        self.check(column)
        sections = self.sections(column)
        if state is None:
            memory = self.begin(column, path, from_rest=from_rest)
        else:
            memory = state.hysteresis
        drive, hysteresis = self.drive(column, path, memory)
        drives = [drive]
        if self.creep is not None:
            crept = self.creep.drive(column, drive, path)
            drives += [crept.copy() for _ in self.creep.times]
        if state is None:
            equilibrium, filtered = tuple(w[:, 0].copy() for w in drives), sections.begin(unrest)
        else:
            equilibrium, filtered = state.rest, tuple(carried.copy() for carried in state.filter)
        # The recursions see the drives' distance from rest, so that they start at zero exactly.
        for drive, before in zip(drives, equilibrium, strict=True):
            np.subtract(drive, before[:, np.newaxis], out=drive)
        result = sections.run(drives, filtered)
        level = sum(gain * before for gain, before in zip(sections.gains, equilibrium, strict=True))
        result += (level + column["offset"])[:, np.newaxis]
        return result, State(hysteresis, equilibrium, filtered)

    def drive(self, column: Values, path: FloatArray, memory: Any) -> tuple[FloatArray, Any]:
        """Return what hysteresis and gain make of a path (samples,), V, (models, samples), um.

        And the operator's memory after it.
        """
        drive, after = self.hysteresis.advance(column, path, memory)
        if self.gain is not None:
            drive += self.gain.displacement(column, path)
        return drive, after

    def columns(self, theta: FloatArray) -> dict[str, FloatArray]:
        """Return the columns (models,) of θ (models, parameters) by name."""
        return dict(zip(self.parameters, theta.T, strict=True))

    def begin(self, column: Mapping[str, FloatArray], path: FloatArray, *, from_rest: bool) -> Any:
        """Return the operator's memory at the first sample of a record."""
        span = self.range_of(path)
        return self.hysteresis.begin(column, float(path[0]), span, from_rest=from_rest)

    def within(self, voltage: FloatArray) -> Actuator:
        """Return the actuator with a span; by default the range of a whole record's voltage."""
        return replace(self, span=self.range_of(voltage))

    def range_of(self, voltage: FloatArray) -> Span:
        """Return the voltages that earlier drives may have had, V."""
        return self.span or Span(float(np.min(voltage)), float(np.max(voltage)))

    def check(self, column: Mapping[str, FloatArray]) -> None:
        """Raise an InputError where a model is outside of the domain of a part."""
        self.hysteresis.check(column)
        self.filter.check(column)
        for part in (self.gain, self.creep):
            check(part.parameters if part else (), column, ("creep_growth",))
        check((OFFSET,), column)

    def sections(self, column: Values) -> Sections:
        """Return dynamics and creep of models given by the columns (models,) of θ."""
        models = column["offset"].size
        dynamics = self.filter.recursion(column, models, self.interval, self.hold)
        if self.creep is None:
            return Sections((dynamics,), (np.ones(models),))
        lags = self.creep.recursions(models, self.interval, self.hold)
        strengths = (column[name] for name in self.creep.names)
        return Sections((dynamics, *lags), (np.ones(models), *strengths))
