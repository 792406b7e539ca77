"""The actuator read backwards: for a displacement over time, the voltage that gives it.

The offset is taken off, what stands behind the dynamics is undone, then creep and dynamics, and
what is left, the drive, is what hysteresis and nonlinearity must make; what stands before them is
undone last. The drive turns where the voltage does, and along a branch
between two turns both go one way: each sample asks for one root of one rising curve, and one walk
along the curve serves all samples. It asks of an operator only to simulate, one model at a time.

The dynamics' recursion on the samples is inverted, not the differential equation: the voltage makes
the displacement again to rounding, at every sample. A displacement that jumps, or whose speed does,
needs a drive that swings from sample to sample around the one of the differential equation, for
about a lag: smooth it first. A drive that is held acts one sample later, so the second sample
cannot be chosen, and the last drive, which acts after the record, stays.

A mass on a spring that is sampled much faster than it swings, driven in straight lines, has
recursions whose inverse runs away (a zero outside of the unit circle, −2 − √3 in the limit). It has
another inverse, which does not: it looks ahead by some samples, and misses the first ones, unless
the displacement begins at rest for as long.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
import scipy
from scipy.optimize import elementwise

from bwbayes.arrays import ArrayLike, FloatArray
from bwbayes.errors import InputError
from bwbayes.model.actuator import Actuator
from bwbayes.model.declaration import Values
from bwbayes.model.inputs import UNIT, Inputs, Limits, monotone_stretches
from bwbayes.model.linear import Recursion
from bwbayes.model.stage import undo_stages

Curve = Callable[[FloatArray], FloatArray]


def inverse(
    actuator: Actuator,
    theta: ArrayLike,
    displacement: ArrayLike,
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
        Reference, (samples,) or (models, samples), um, at the actuator's interval. The
        dynamics are at rest at the first sample.
    from_rest
        The voltage comes from zero, where the actuator was at rest; otherwise the hysteresis starts
        in the state that θ's initial one says.
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
    target = np.atleast_2d(np.asarray(displacement, dtype=np.float64))
    if target.ndim != 2 or target.shape[1] == 0 or len(target) not in (1, len(models)):
        raise InputError(
            f"reference: has shape {target.shape}; give a non-empty row of samples, or one for "
            "each model"
        )
    if not np.isfinite(target).all():
        sample = int(np.argmin(np.isfinite(target).all(axis=0)))
        raise InputError(f"reference: not a finite number in sample {sample}; give every sample")
    columns = actuator.columns(models)
    actuator.check(columns)
    target = np.broadcast_to(target, (len(models), target.shape[1]))
    result = np.empty(target.shape)
    for row, samples in enumerate(target):
        column = {name: values[row : row + 1] for name, values in columns.items()}
        single = _Single(actuator, column, from_rest)
        inputs = actuator.along(np.zeros(samples.size))
        result[row] = single.voltage(samples, inputs, limits or Limits(), nearest)
        # A stage that sees the command is undone with that of the pass before, in 40 at most.
        follows = [stage.name for stage in actuator.stages if "voltage" in stage.sees]
        for _ in range(40 if follows else 0):
            inputs = replace(inputs, voltage=result[row].copy())
            result[row] = single.voltage(samples, inputs, limits or Limits(), nearest)
            change = np.abs(result[row] - inputs.voltage)
            if np.max(change) <= 1e-9 * np.ptp(result[row]):
                break
        else:
            if follows:
                raise InputError(
                    f"reference: what {follows[0]} makes of the command cannot be undone; fit "
                    "without it"
                )
    return result


@dataclass(frozen=True)
class _Single:
    """One model that is read backwards."""

    actuator: Actuator
    column: Values
    from_rest: bool

    @cached_property
    def slope(self) -> float:
        """A typical dw/du, um/V."""
        span = self.actuator.span or UNIT
        return abs(float(np.ravel(self.actuator.hysteresis.typical_slope(self.column, span))[0]))

    def voltage(
        self, displacement: FloatArray, inputs: Inputs, limits: Limits, nearest: bool
    ) -> FloatArray:
        """Return the voltage (samples,) for a displacement; stages see the ``inputs``."""
        actuator, interval = self.actuator, self.actuator.interval
        rest_value = actuator.level_at_rest(self.column, inputs) if self.from_rest else None
        drive = (displacement - self.column["offset"][0])[np.newaxis]
        drive = undo_stages(
            actuator.outputs, self.column, drive, inputs, actuator.timing, rest_value
        )[0]
        span, peak = self.actuator.span or UNIT, float(np.max(np.abs(drive)))
        size = peak / self.slope if self.slope > 0 else 1.0
        # Beyond so many times what a straight line would need no voltage is looked for.
        extent = 30.0 * max(size, abs(span.low), abs(span.high))
        if nearest:
            low, high = max(limits.low, -extent), min(limits.high, extent)
            voltage = self._undo(drive, Limits(low, high, limits.rate))
            return np.clip(self._command(voltage, inputs), low, high)
        voltage = self._command(self._undo(drive, Limits(-extent, extent)), inputs)
        edges = np.abs(voltage) >= extent
        if edges.any():
            sample = int(np.argmax(edges))
            raise InputError(
                f"reference: no voltage gives {displacement[sample]:.6g} um at "
                f"{sample * interval:.6g} s; make it smaller, or say `nearest=True`"
            )
        if why := limits.refuses(voltage, interval):
            raise InputError(
                f"reference: {why}; move its middle, make it smaller or smoother, widen the "
                "limits, or say `nearest=True` for the nearest command"
            )
        return voltage

    def _command(self, voltage: FloatArray, inputs: Inputs) -> FloatArray:
        """Return the command (samples,), V, that makes a voltage at the hysteresis."""
        rest_value = np.zeros(1) if self.from_rest else None
        actuator, path = self.actuator, voltage[np.newaxis]
        command = undo_stages(
            actuator.inputs, self.column, path, inputs, actuator.timing, rest_value
        )
        return np.asarray(command[0])

    def _undo(self, displacement: FloatArray, within: Limits) -> FloatArray:
        """Undo dynamics and creep, then hysteresis and nonlinearity.

        The creep is that of the drive that was found without it, then of the one with that creep,
        until nothing changes.
        """
        sections, creep = self.actuator.sections(self.column), self.actuator.creep
        dynamics, *lags = sections.recursions
        if creep is None:
            return self._static(undone(dynamics, displacement), within)
        strengths = [float(gain[0]) for gain in sections.gains[1:]]
        drive = displacement / (1 + sum(strengths))
        size, change = float(np.max(np.abs(displacement))), 0.0
        for _ in range(200):
            voltage = self._static(drive, within) if creep.growing else np.zeros_like(drive)
            crept = creep.drive(self.column, drive[np.newaxis], voltage)
            remainder = displacement.copy()
            for lag, strength in zip(lags, strengths, strict=True):
                moved = lag.run(crept - crept[:, :1], lag.at_rest())[0]
                remainder -= strength * (crept[0, 0] + moved)
            before, drive = drive, undone(dynamics, remainder)
            change = float(np.max(np.abs(drive - before)))
            if change <= 1e-14 * size:
                return self._static(drive, within)
            if not change < 1e3 * size:
                break  # which does not come back
        raise InputError(
            f"reference: creep of {sum(strengths):.3g} of the drive cannot be undone; check the "
            "model's creep and nonlinearity"
        )

    def _static(self, drive: FloatArray, within: Limits) -> FloatArray:
        """Return the voltage (samples,) with which hysteresis and nonlinearity make a drive."""
        # Steps of the drive below this part of its range are rounding: they turn nothing.
        quantum = 1e-13 * float(np.ptp(drive))
        if quantum > 0:
            drive = drive[0] + quantum * np.round((drive - drive[0]) / quantum)
        start = 0.0 if self.from_rest else self._first_voltage(float(drive[0]), within)
        here, memory = self._along(np.array([start]), self._begin(start))
        # A record from rest may go anywhere at its first sample.
        reach = within.rate * self.actuator.interval
        result, free, behind = [] if self.from_rest else [np.array([start])], self.from_rest, False
        joined = np.concatenate([here, drive if self.from_rest else drive[1:]])
        # So many samples are searched for together; operators that integrate follow as many.
        for begin, last, _ in monotone_stretches(joined, 2048):
            first = begin
            while first < last:
                # Behind the drive, go on sample by sample until it is caught up with.
                end = first + 1 if behind else last
                target = joined[first + 1 : end + 1]
                segment = self._branch(target, float(here[-1]), start, memory, within)
                fast = np.abs(np.diff(segment, prepend=start)) > reach
                fast[0] &= not free
                behind = bool(fast.any())
                if fast[0]:
                    segment = np.array([start + math.copysign(reach, segment[0] - start)])
                elif behind:
                    segment = segment[: int(np.argmax(fast))]
                result.append(segment)
                here, memory = self._along(segment, memory)
                start, free, first = float(segment[-1]), False, first + segment.size
        # A drive that stays where it starts has no branch.
        voltage = np.concatenate([np.empty(0), *result])
        return np.pad(voltage, (0, drive.size - voltage.size), constant_values=start)

    def _branch(
        self, target: FloatArray, here: float, start: float, memory: Any, within: Limits
    ) -> FloatArray:
        """Return the voltages along a branch from ``start``, where the drive is ``here``."""
        s = math.copysign(1.0, float(target[-1]) - here)
        # After a limit was met the drive may not be where it was asked to be.
        rise = np.maximum(s * (target - here), 0.0)
        room = s * ((within.high if s > 0 else within.low) - start)
        if rise[-1] == 0 or room <= 0:
            return np.full(target.shape, start)
        guess = rise[-1] / self.slope if self.slope > 0 else 1.0
        travel = solve_branch(
            lambda travel: s * (self._along(start + s * travel, memory)[0] - here),
            np.maximum.accumulate(rise),
            room,
            guess,
            4 * math.ulp(abs(start) + guess),
        )
        return np.clip(start + s * travel, within.low, within.high)

    def _along(self, voltage: FloatArray, memory: Any) -> tuple[FloatArray, Any]:
        """Return the drive (samples,) along a voltage, and the operator's memory after it."""
        drive, after = self.actuator.drive(self.column, voltage, memory)
        return drive[0], after

    def _begin(self, voltage: float) -> Any:
        operator, span = self.actuator.hysteresis, self.actuator.span or UNIT
        return operator.begin(self.column, voltage, span, from_rest=self.from_rest)

    def _first_voltage(self, drive: float, within: Limits) -> float:
        """Return the voltage at which the state that θ's initial one says makes a drive."""

        def excess(voltage: float) -> float:
            return float(self._along(np.array([voltage]), self._begin(voltage))[0][0]) - drive

        span = self.actuator.span or UNIT
        center = min(max(span.middle, within.low), within.high)
        above = excess(center)
        s, reach = -math.copysign(1.0, above), max(span.half, 1e-9)
        end = center
        while s * excess(end) < 0:
            if end in (within.low, within.high) and end != center:
                return end
            end = min(max(center + s * reach, within.low), within.high)
            reach *= 2
        if not above:
            return center
        return float(scipy.optimize.brentq(excess, center, end, xtol=math.ulp(abs(center) + reach)))


def solve_branch(
    curve: Curve, rise: FloatArray, room: float, guess: float, resolution: float
) -> FloatArray:
    """Return the travels (samples,), V, after which a curve has risen as far as is asked for.

    Parameters
    ----------
    curve
        The rise (points,), um, after travels (points,) that grow, V; zero at the start.
    rise
        (samples,), um, not negative and never falling.
    room
        Travel beyond which the curve is not followed, V; returned where it does not rise enough.
    guess
        A first guess of how far the path goes, V.
    resolution
        Tolerance of a travel, V.
    """
    reach = min(guess, room)
    while reach < room and curve(np.array([reach]))[0] < rise[-1]:
        reach = min(2 * reach, room)
    points = reach * np.linspace(0.0, 1.0, 33)
    heights = np.maximum.accumulate(np.concatenate([[0.0], curve(points[1:])]))
    above = np.clip(np.searchsorted(heights, rise), 1, points.size - 1)
    travel = np.where(rise <= 0, 0.0, reach)
    # Those that are not reached, or not left, need no search.
    sought = (rise > 0) & (rise < heights[-1])
    if not sought.any():
        return travel

    def excess(travel: FloatArray, rise: FloatArray) -> FloatArray:
        # Travels in any order are walked along as a path.
        order = np.argsort(travel, kind="stable")
        values = np.empty_like(travel)
        values[order] = curve(travel[order])
        return values - rise

    brackets = points[above[sought] - 1], points[above[sought]]
    tolerances = {"xatol": resolution, "xrtol": 0.0, "fatol": 0.0, "frtol": 0.0}
    travel[sought] = elementwise.find_root(  # type: ignore[call-overload]  # asks for keywords
        excess, brackets, args=(rise[sought],), tolerances=tolerances, maxiter=100
    ).x
    return travel


def undone(recursion: Recursion, displacement: FloatArray) -> FloatArray:
    """Return the drive (samples,), um, after which one model has a displacement (samples,), um.

    The model is at rest at the first sample.
    """
    numerator, denominator = recursion.numerator[0], recursion.denominator[0]
    moved: FloatArray = displacement - displacement[0]
    zeros = np.roots(numerator)
    if numerator[0] == 0.0 and numerator.size > 1:
        # The second sample has been settled by the first drive.
        moved[:2] = 0.0
        later = scipy.signal.lfilter(denominator, numerator[1:], moved)[1:]
        drive: FloatArray = np.append(later, later[-1:] if later.size else 0.0)
    elif (np.abs(zeros) <= 1).all():
        drive = scipy.signal.lfilter(denominator, numerator, moved)
    else:
        # Zeros inside of the unit circle are undone forwards, those outside of it backwards.
        path = scipy.signal.lfilter(denominator, numerator[:1], moved).astype(np.complex128)
        for zero in zeros[np.abs(zeros) <= 1]:
            path = scipy.signal.lfilter([1.0], [1.0, -zero], path)
        for zero in zeros[np.abs(zeros) > 1]:
            # w[t-1] = (w[t] - v[t]) / zero, from a drive that does not change after the end.
            end = path[-1] / (1 - zero)
            before, _ = scipy.signal.lfilter(
                [-1 / zero], [1.0, -1 / zero], path[:0:-1], zi=[end / zero]
            )
            path = np.concatenate([before[::-1], [end]])
        drive = path.real.copy()
        drive[0] = 0.0
    return np.asarray(displacement[0] + drive)
