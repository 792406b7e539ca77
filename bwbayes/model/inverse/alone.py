"""One actuator read backwards, along stretches that go one way.

The offset is taken off, creep and dynamics are undone, and what is left, the drive, is what
hysteresis and gain must make. It turns where the voltage does, so that each stretch is one search
for all of its samples.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from bwbayes.arrays import FloatArray
from bwbayes.errors import InputError
from bwbayes.model.actuator import Actuator, State
from bwbayes.model.inverse.dynamics import undone
from bwbayes.model.inverse.limits import Limits
from bwbayes.model.inverse.stretch import first_crossing, reached
from bwbayes.model.linear import Recursion, Sections
from bwbayes.model.operator import UNIT
from bwbayes.model.reversals import monotone_stretches

__all__ = ["SHORTEST", "One", "Path"]

# Samples that are searched for together; operators that integrate follow as many.
LONGEST = 2048

# The first reach, V at least, in which the voltage at which a record starts is looked for.
SHORTEST = 1e-9


@dataclass(frozen=True)
class Path:
    """Where one model's voltage may go: between low and high, V, at most ``step`` a sample."""

    low: float
    high: float
    step: float = math.inf


class One:
    """One model that is read backwards."""

    def __init__(
        self,
        actuator: Actuator,
        column: Mapping[str, FloatArray],
        from_rest: bool,
        state: State | None,
        slope: float,
    ) -> None:
        self.actuator, self.column, self.state = actuator, column, state
        self.span = actuator.span or UNIT
        self.from_rest = from_rest
        self.slope = slope

    def voltage(
        self, displacement: FloatArray, limits: Limits, nearest: bool, solution: FloatArray | None
    ) -> FloatArray:
        """Return the voltage (samples,) for a displacement; without limits it may be known."""
        drive = displacement - self.column["offset"][0]
        anything = self.anywhere(float(np.max(np.abs(drive))))
        voltage = self._undone(drive, anything) if solution is None else solution
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
        return self._undone(drive, Path(low, high, math.inf if slow else step))

    def anywhere(self, peak: float) -> Path:
        """Return a range of voltages that is wide for displacements up to a peak, um."""
        size = peak / self.slope if self.slope > 0 else 1.0
        # Beyond so many times what a straight line would need no voltage is looked for.
        extent = 30.0 * max(size, abs(self.span.low), abs(self.span.high))
        return Path(-extent, extent)

    def drive(
        self, displacement: FloatArray, sections: Sections, path: Path | None = None
    ) -> FloatArray:
        """Return the drive (samples,) with which dynamics and creep make a displacement.

        Creep that grows with the voltage needs to know where the voltage may go.
        """
        dynamics, *lags = sections.recursions
        creep = self.actuator.creep
        if creep is None:
            return self._driven(displacement, dynamics)
        states = sections.begin(None) if self.state is None else self.state.filter
        strengths = [float(gain[0]) for gain in sections.gains[1:]]
        drive = displacement / (1 + sum(strengths))
        size = float(np.max(np.abs(displacement)))
        for _ in range(200):
            crept = drive[np.newaxis]
            if creep.growing:
                assert path is not None
                crept = creep.drive(self.column, crept, self._static(drive, path))
            remainder = displacement.copy()
            for number, (lag, strength) in enumerate(zip(lags, strengths, strict=True), 1):
                equilibrium = crept[0, 0] if self.state is None else self.state.rest[number][0]
                moved = lag.run(crept - equilibrium, states[number].copy())[0]
                remainder -= strength * (equilibrium + moved)
            before, drive = drive, self._driven(remainder, dynamics)
            change = float(np.max(np.abs(drive - before)))
            if change <= 1e-14 * size:
                return drive
            if not change < 1e3 * size:
                break  # which does not come back
        raise InputError(
            f"reference: creep of {sum(strengths):.3g} of the drive cannot be undone; check the "
            "model's creep and gain"
        )

    def _driven(self, displacement: FloatArray, dynamics: Recursion) -> FloatArray:
        """Return the drive (samples,) with which the dynamics alone make a displacement."""
        if self.state is None:
            return np.asarray(displacement[0] + undone(dynamics, displacement - displacement[0]))
        equilibrium = self.state.rest[0][0]
        return np.asarray(
            equilibrium + undone(dynamics, displacement - equilibrium, self.state.filter[0])
        )

    def _undone(self, displacement: FloatArray, path: Path) -> FloatArray:
        """Undo dynamics and creep, then what is left."""
        sections = self.actuator.sections(self.column)
        return self._static(self.drive(displacement, sections, path), path)

    def begun(self, drive: float, path: Path) -> tuple[float, Any]:
        """Return the voltage where the path starts, V, and the operator's memory there.

        It is known, but for a record that starts in any state: then it is the one that the first
        sample of the drive needs.
        """
        if self.state is not None:
            memory = self.state.hysteresis
            return float(getattr(memory, "voltage", math.nan)), memory
        if self.from_rest:
            return 0.0, self._begin(0.0, from_rest=True)
        start = self._first(drive, path)
        return start, self._begin(start, from_rest=False)

    def _static(self, drive: FloatArray, path: Path) -> FloatArray:
        """Return the voltage (samples,) with which hysteresis and gain make a drive (samples,)."""
        # Steps of the drive below this part of its range are rounding: they turn nothing.
        quantum = 1e-13 * float(np.ptp(drive))
        if quantum > 0:
            drive = drive[0] + quantum * np.round((drive - drive[0]) / quantum)
        result = np.empty_like(drive)
        start, memory = self.begun(float(drive[0]), path)
        done = int(self.state is None and not self.from_rest)
        result[:done] = start
        full = Path(path.low, path.high)
        here, memory = self._along(np.array([start]), memory)
        joined = np.concatenate([here, drive[done:]])
        free, behind = done == 0 and self.state is None, False
        for begin, last, _ in monotone_stretches(joined, LONGEST):
            first = begin
            while first < last:
                end, limit = last, full
                if behind and not free:
                    end = first + 1
                    limit = Path(
                        max(path.low, start - path.step), min(path.high, start + path.step)
                    )
                segment = self._stretch(
                    joined[first + 1 : end + 1], float(here[-1]), start, memory, limit
                )
                fast = np.abs(np.diff(segment, prepend=start)) > path.step
                # The first voltage of a record is not a step from anything.
                fast[0] &= not free
                if behind:
                    behind = bool(segment[0] in (limit.low, limit.high))
                elif fast.any():
                    # From there on a sample at a time, until the drive is where it is to be.
                    segment, behind = segment[: int(np.argmax(fast))], True
                if segment.size:
                    result[done + first : done + first + segment.size] = segment
                    here, memory = self._along(segment, memory)
                    start, free = float(segment[-1]), False
                first += segment.size
        return result

    def _stretch(
        self, target: FloatArray, here: float, start: float, memory: Any, path: Path
    ) -> FloatArray:
        """Return the voltages along one stretch from ``start``, where the drive is ``here``."""
        s = math.copysign(1.0, float(target[-1]) - here)
        edge = path.high if s > 0 else path.low
        # After a limit was met the drive may not be where it was asked to be.
        goal = here + s * np.maximum(s * (target - here), 0.0)
        if goal[-1] == here or s * (edge - start) <= 0:
            return np.full(target.shape, start)
        distance = abs(float(goal[-1]) - here)
        first = distance / self.slope if self.slope > 0 else 1.0
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

    def _first(self, drive: float, path: Path) -> float:
        """Return the first voltage, at which the state is what θ's initial one says."""

        def off(voltage: FloatArray) -> FloatArray:
            at = self._begin(float(voltage[0]), from_rest=False)
            return self._along(voltage, at)[0] - drive

        center = np.clip([self.span.middle], path.low, path.high)
        guess = abs(float(off(center)[0])) / self.slope if self.slope > 0 else 0.0
        reach = np.array([max(self.span.half, guess, SHORTEST)])
        return float(first_crossing(off, center, reach, path.low, path.high)[0])
