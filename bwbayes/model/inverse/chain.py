"""The actuator read backwards: for a displacement over time, the voltage that gives it.

The offset is taken off, creep and dynamics are undone (:mod:`bwbayes.model.inverse.dynamics`), and
what is left, the drive, is what hysteresis and gain must make. They do so along stretches that go
one way: the drive turns where the voltage does, so that each stretch is one search, or one closed
form, for all of its samples (:meth:`bwbayes.model.operator.Operator.inverse`).

What is done to each model is done to it alone: the models of a batch have voltages of their own.
Many n = 1 Bouc-Wen models go sample by sample instead, which is faster for them
(:mod:`bwbayes.model.inverse.together`).
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.optimize import brentq

from bwbayes.arrays import ArrayLike, BoolArray, FloatArray
from bwbayes.errors import InputError
from bwbayes.model.actuator import Actuator, State
from bwbayes.model.drive import monotone_stretches
from bwbayes.model.inverse.dynamics import undone
from bwbayes.model.inverse.limits import Limits
from bwbayes.model.inverse.stretch import reached
from bwbayes.model.inverse.together import able, voltages
from bwbayes.model.linear import Recursion
from bwbayes.model.operator import UNIT
from bwbayes.model.operators.backlash_like import BacklashLike
from bwbayes.model.operators.bouc_wen import BoucWen

__all__ = ["inverse"]

# Samples that are searched for together; operators that integrate follow as many.
LONGEST = 2048

# From so many models on they go side by side, and so many of them at a time.
MANY, BATCH = 50, 1000

# Steps of the drive below this part of its range are rounding: they turn nothing.
QUANTUM = 1e-13

# A voltage beyond so many times what a straight line would need is not looked for.
FARTHEST = 30.0

# Rounds in which creep and drive are made to agree, and the part of the range to which they do.
ROUNDS, AGREED = 200, 1e-14

# Rounds whose changes are so many times the displacement do not come back.
RUNAWAY = 1e3


@dataclass(frozen=True)
class _Path:
    """Where one model's voltage may go: between low and high, V, at most ``step`` a sample."""

    low: float
    high: float
    step: float = math.inf


def inverse(
    actuator: Actuator,
    theta: ArrayLike,
    displacement: ArrayLike,
    state: State | None = None,
    *,
    from_rest: bool = False,
    limits: Limits | None = None,
    nearest: bool = False,
) -> FloatArray:
    """Return the voltage with which :meth:`Actuator.displacement` is the given one.

    Parameters
    ----------
    actuator
        Its ``span`` says which voltages earlier drives had, where the start is not from rest.
    theta
        (models, parameters), as of :meth:`Actuator.displacement`.
    displacement
        What is asked for, (samples,) or (models, samples), um, at the actuator's interval.
    state
        Where an earlier piece of a record left the models (of one voltage, with as many models);
        by default a record starts: the dynamics are at rest at the first sample, and the
        hysteresis is in the state that θ's initial one says.
    from_rest
        The voltage comes from zero, where the actuator was at rest.
    limits
        Those of the amplifier; by default none.
    nearest
        Give the nearest command where the limits do not allow for the one that is asked for: with
        each drive as close to the one asked for as the limits let it be, given what came before.

    Returns
    -------
    FloatArray
        (models, samples), V. With it, the displacement is the one that is asked for to rounding
        (Jiles-Atherton and domain walls: to their own error), but for what nothing can reach: the
        second sample with a held voltage, which acts one sample later, and the first ones where a
        mass on a spring is sampled much faster than it swings, if it does not begin at rest.

    Raises
    ------
    InputError
        A displacement that is empty, not finite or of another shape; one that no voltage reaches,
        or none within the limits, with its place and time.
    """
    models = np.atleast_2d(np.asarray(theta, dtype=np.float64))
    asked = _checked(displacement, len(models))
    ones = []
    for row, model in enumerate(models):
        column = actuator.columns(model[np.newaxis])
        actuator.check(column)
        ones.append(_One(actuator, column, from_rest, _row(state, row)))
    asked = np.broadcast_to(asked, (len(models), asked.shape[1]))
    result = np.empty(asked.shape)
    known = _together(ones, actuator.columns(models), asked, result)
    for row, one in enumerate(ones):
        made = result[row] if known[row] else None
        result[row] = one.voltage(asked[row], limits or Limits(), nearest, made)
    return result


def _together(
    ones: Sequence[_One], columns: Mapping[str, FloatArray], asked: FloatArray, result: FloatArray
) -> BoolArray:
    """Write the voltages without limits of models that go side by side; tell which do."""
    actuator, state, from_rest = ones[0].actuator, ones[0].state, ones[0].from_rest
    kind = isinstance(actuator.hysteresis, BoucWen | BacklashLike)
    if not kind or actuator.gain is not None or actuator.creep is not None or len(ones) < MANY:
        return np.zeros(len(ones), dtype=bool)
    memory, start = columns["initial"], 0.0 if from_rest else None
    if state is not None:
        memory = np.array([one.state.hysteresis.state[0] for one in ones if one.state])
        start = float(state.hysteresis.voltage)
    known = able(columns, memory)
    rows = np.flatnonzero(known)
    for part in (rows[i : i + BATCH] for i in range(0, rows.size, BATCH)):
        here = {name: values[part] for name, values in columns.items()}
        dynamics = actuator.sections(here).recursions[0]
        for place, row in enumerate(part):
            its = _of_row(dynamics, place)
            result[row] = ones[row].drive(asked[row] - columns["offset"][row], its)
        result[part] = voltages(here, result[part], memory[part], start)
    return known


def _checked(displacement: ArrayLike, models: int) -> FloatArray:
    asked = np.atleast_2d(np.asarray(displacement, dtype=np.float64))
    if asked.ndim != 2 or asked.shape[1] == 0 or len(asked) not in (1, models):
        raise InputError(
            f"reference: has shape {asked.shape}; give a non-empty row of samples, or one for each "
            "model"
        )
    if not np.isfinite(asked).all():
        sample = int(np.argmin(np.isfinite(asked).all(axis=0)))
        raise InputError(f"reference: not a finite number in sample {sample}; give every sample")
    return asked


def _row(state: State | None, row: int) -> State | None:
    """Return the state of one of a batch's models."""
    if state is None:
        return None
    return State(
        _of_row(state.hysteresis, row),
        tuple(one[row : row + 1] for one in state.rest),
        tuple(one[row : row + 1] for one in state.filter),
    )


def _of_row(memory: Any, row: int) -> Any:
    """Return a memory with its arrays (models,) cut to one model, whatever it is made of."""
    if isinstance(memory, np.ndarray):
        return memory[row : row + 1]
    if isinstance(memory, tuple):
        parts = [_of_row(one, row) for one in memory]
        return type(memory)(*parts) if hasattr(memory, "_fields") else tuple(parts)
    if hasattr(memory, "__dataclass_fields__"):
        return type(memory)(
            **{name: _of_row(getattr(memory, name), row) for name in memory.__dataclass_fields__}
        )
    return memory


class _One:
    """One model that is read backwards."""

    def __init__(
        self,
        actuator: Actuator,
        column: Mapping[str, FloatArray],
        from_rest: bool,
        state: State | None,
    ) -> None:
        self.actuator, self.column, self.state = actuator, column, state
        self.span = actuator.span or UNIT
        self.from_rest = from_rest
        self.slope = float(np.abs(actuator.hysteresis.gain(column, self.span)[0]))

    def voltage(
        self, displacement: FloatArray, limits: Limits, nearest: bool, made: FloatArray | None
    ) -> FloatArray:
        """Return the voltage (samples,) for a displacement; without limits it may be known."""
        drive = displacement - self.column["offset"][0]
        anything = self._anywhere(drive)
        voltage = self._undone(drive, anything) if made is None else made
        edges = (voltage <= anything.low) | (voltage >= anything.high)
        if edges.any() and not nearest:
            sample = int(np.argmax(edges))
            raise InputError(
                f"reference: no voltage gives {displacement[sample]:.6g} um at "
                f"{sample * self.actuator.interval:.6g} s; make it smaller, or ask for the nearest "
                "command"
            )
        if not nearest:
            limits.require(voltage, displacement, self.actuator.interval)
            return voltage
        step = limits.rate * self.actuator.interval
        low, high = max(limits.low, anything.low), min(limits.high, anything.high)
        slow = bool((np.abs(np.diff(voltage)) <= step).all())
        if slow and (voltage >= low).all() and (voltage <= high).all():
            return voltage
        return self._undone(drive, _Path(low, high, math.inf if slow else step))

    def _anywhere(self, drive: FloatArray) -> _Path:
        """Return a range of voltages that is wide for a drive."""
        size = float(np.max(np.abs(drive))) / self.slope if self.slope > 0 else 1.0
        most = FARTHEST * max(size, abs(self.span.low), abs(self.span.high))
        return _Path(-most, most)

    def drive(self, displacement: FloatArray, dynamics: Recursion) -> FloatArray:
        """Return the drive (samples,) with which the dynamics make a displacement."""
        if self.state is None:
            return np.asarray(displacement[0] + undone(dynamics, displacement - displacement[0]))
        rest = self.state.rest[0][0]
        return np.asarray(rest + undone(dynamics, displacement - rest, self.state.filter[0]))

    def _undone(self, displacement: FloatArray, path: _Path) -> FloatArray:
        """Undo dynamics and creep, then what is left."""
        sections = self.actuator.sections(self.column)
        dynamics, *lags = sections.recursions
        states = sections.begin(None) if self.state is None else self.state.filter
        creep = self.actuator.creep
        if creep is None:
            return self._static(self.drive(displacement, dynamics), path)
        strengths = [float(gain[0]) for gain in sections.gains[1:]]
        drive = displacement / (1 + sum(strengths))
        close = AGREED * float(np.max(np.abs(displacement)))
        for _ in range(ROUNDS):
            crept = drive[np.newaxis]
            if creep.growing:
                crept = creep.drive(self.column, crept, self._static(drive, path))
            left = displacement.copy()
            for number, (lag, strength) in enumerate(zip(lags, strengths, strict=True), 1):
                rest = crept[0, 0] if self.state is None else self.state.rest[number][0]
                moved = lag.run(crept - rest, states[number].copy())[0]
                left -= strength * (rest + moved)
            before, drive = drive, self.drive(left, dynamics)
            change = float(np.max(np.abs(drive - before)))
            if change <= close:
                return self._static(drive, path)
            if not change < RUNAWAY * float(np.max(np.abs(displacement))):
                break
        raise InputError(
            f"reference: creep of {sum(strengths):.3g} of the drive cannot be undone; check the "
            "model's creep and gain"
        )

    def _static(self, drive: FloatArray, path: _Path) -> FloatArray:
        """Return the voltage (samples,) with which hysteresis and gain make a drive (samples,)."""
        quantum = QUANTUM * float(np.ptp(drive))
        if quantum > 0:
            drive = drive[0] + quantum * np.round((drive - drive[0]) / quantum)
        result = np.empty_like(drive)
        done = 0
        if self.state is not None:
            memory = self.state.hysteresis
            start = float(getattr(memory, "voltage", math.nan))
        elif self.from_rest:
            memory = self._begin(0.0, from_rest=True)
            start = 0.0
        else:
            start = result[0] = self._first(float(drive[0]), path)
            memory, done = self._begin(start, from_rest=False), 1
        whole = _Path(path.low, path.high)
        here, memory = self._along(np.array([start]), memory)
        joined = np.concatenate([here, drive[done:]])
        longest = LONGEST if math.isinf(path.step) else 1
        for first, last, _ in monotone_stretches(joined, longest):
            if last == first:
                continue
            limit = whole
            # The first voltage of a record is not a step from anything.
            if first + done > 0 or self.state is not None:
                limit = _Path(max(path.low, start - path.step), min(path.high, start + path.step))
            part = self._stretch(
                joined[first + 1 : last + 1], float(here[-1]), start, memory, limit
            )
            result[done + first : done + last] = part
            here, memory = self._along(part, memory)
            start = float(part[-1])
        return result

    def _stretch(
        self, target: FloatArray, here: float, start: float, memory: Any, path: _Path
    ) -> FloatArray:
        """Return the voltages along one stretch from ``start``, where the drive is ``here``."""
        s = math.copysign(1.0, float(target[-1]) - here)
        edge = path.high if s > 0 else path.low
        # After a limit was met the drive may not be where it was asked to be.
        goal = here + s * np.maximum(s * (target - here), 0.0)
        if goal[-1] == here or s * (edge - start) <= 0:
            return np.full(target.shape, start)
        if self.actuator.gain is None:
            operator = self.actuator.hysteresis
            return operator.inverse(self.column, goal, memory, start, edge)
        asked = abs(float(goal[-1]) - here)
        first = asked / self.slope if self.slope > 0 else 1.0
        return reached(lambda u: self._along(u, memory)[0], goal, start, edge, first)

    def _along(self, voltage: FloatArray, memory: Any) -> tuple[FloatArray, Any]:
        """Return the drive (samples,) along a voltage, and the operator's memory after it."""
        drive, after = self.actuator.hysteresis.advance(self.column, voltage, memory)
        if self.actuator.gain is not None:
            drive = drive + self.actuator.gain.displacement(self.column, voltage)
        return drive[0], after

    def _begin(self, voltage: float, *, from_rest: bool) -> Any:
        operator = self.actuator.hysteresis
        return operator.begin(self.column, voltage, self.span, from_rest=from_rest)

    def _first(self, drive: float, path: _Path) -> float:
        """Return the first voltage, at which the state is what θ's initial one says."""

        def off(voltage: float) -> float:
            at = self._begin(voltage, from_rest=False)
            return float(self._along(np.array([voltage]), at)[0][0]) - drive

        low, high = path.low, path.high
        middle = min(max(self.span.middle, low), high)
        s = -1.0 if off(middle) > 0 else 1.0
        reach = max(self.span.half, abs(off(middle)) / self.slope if self.slope > 0 else 0.0, 1e-9)
        edge = high if s > 0 else low
        while s * (edge - middle) > reach and s * off(middle + s * reach) < 0:
            reach = 2 * reach
        far = middle + s * min(reach, abs(edge - middle))
        if s * off(far) < 0:
            return far
        return float(brentq(off, middle, far, xtol=1e-15 * max(abs(far), 1.0), rtol=1e-14))
