"""Loops measured: what data sheets say of an actuator's hysteresis, with its uncertainty.

Every posterior draw is driven slowly, without dynamics, creep and offset: up and down over the
whole range of the record's voltage until the loop closes (the major loop), the same over half of
that range (the minor loop), and once from the demagnetized state (the initial curve).

Step responses say how fast an actuator rises, whether it overshoots, and how it creeps. Every
posterior draw, demagnetized and at rest, gets an ideal step of the voltage from zero, as in the
paper's Fig. 5. The recursions are exact at any interval, so the displacement a time t after the
step is that of one sample as long as t: the response comes at times that are evenly spaced on a log
axis, from a microsecond to minutes, whatever the sampling rate of the record.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
import scipy

from bwbayes.arrays import FloatArray
from bwbayes.errors import InputError
from bwbayes.inference.posterior import Posterior
from bwbayes.model.actuator import Actuator
from bwbayes.model.declaration import Values
from bwbayes.record.instruments import Scales
from bwbayes.record.record import Record
from bwbayes.shown import brief
from bwbayes.watching import Watch, part, unwatched, watched

# Voltages along a branch: an odd number, so that a symmetric drive passes zero at one of them.
POINTS = 201

# Measures of a loop: their names in a summary, titles and units for people.
MEASURES: Mapping[str, tuple[str, str]] = {
    "range_um": ("Range", "um"),
    "width_at_zero_um": ("Loop width at zero voltage", "um"),
    "max_width_percent": ("Hysteresis (max loop width), of the range", "%"),
    "remanence_um": ("Remanence", "um"),
    "coercive_V": ("Coercive voltage", "V"),
    "area_um_V": ("Area", "um V"),
}


@dataclass(frozen=True)
class Estimate:
    """Mean, sd and equal-tailed 95% interval of a number over the posterior."""

    mean: float
    sd: float
    lower: float
    upper: float

    @classmethod
    def of(cls, values: FloatArray) -> Estimate:
        """Return that of draws (draws,)."""
        lower, upper = np.quantile(values, [0.025, 0.975])
        sd = np.std(values, ddof=1) if values.size > 1 else 0.0
        return cls(float(np.mean(values)), float(sd), float(lower), float(upper))

    @property
    def numbers(self) -> dict[str, float]:
        """The numbers as a summary holds them."""
        return {"mean": self.mean, "sd": self.sd, "lower_95": self.lower, "upper_95": self.upper}


@dataclass(frozen=True)
class Curve:
    """A displacement along a voltage: mean and 95% band, each (points,), um."""

    __repr__ = brief

    mean: FloatArray
    lower: FloatArray
    upper: FloatArray

    @classmethod
    def of(cls, traced: FloatArray) -> Curve:
        """Return that of draws (draws, points)."""
        lower, upper = np.quantile(traced, [0.025, 0.975], axis=0)
        return cls(np.mean(traced, axis=0), lower, upper)


@dataclass(frozen=True)
class TracedLoop:
    """A steady loop of some models: displacements ``rising`` and ``falling`` (models, points), um.

    ``voltage`` (points,) rises, V; ``closed`` says whether the last cycle was as the one before.
    """

    voltage: FloatArray
    rising: FloatArray
    falling: FloatArray
    closed: bool = True


@dataclass(frozen=True)
class Loop:
    """A measured loop: voltages (points,), both branches, and its numbers by their name.

    The names, and what they mean, are those of :func:`measures`; a number is None where the loop
    does not have it.
    """

    __repr__ = brief

    voltage: FloatArray
    rising: Curve
    falling: Curve
    estimates: Mapping[str, Estimate | None]
    closed: bool

    @classmethod
    def of(cls, traced: TracedLoop, scales: Scales) -> Loop:
        """Measure the loops of all draws, in true um and V."""
        estimates = {
            name: None if values is None else Estimate.of(values * scales.factor(MEASURES[name][1]))
            for name, values in measures(traced).items()
        }
        um = scales.factor("um")[:, np.newaxis]
        branches = Curve.of(um * traced.rising), Curve.of(um * traced.falling)
        return cls(traced.voltage, *branches, estimates, traced.closed)

    @property
    def amplitude(self) -> float:
        """Half of the voltage's range, V."""
        return float(np.ptp(self.voltage)) / 2

    @property
    def numbers(self) -> dict[str, object]:
        """The numbers as a summary holds them."""
        low, high = float(self.voltage[0]), float(self.voltage[-1])
        path = {"from_V": low, "to_V": high, "amplitude_V": self.amplitude, "closed": self.closed}
        return path | {n: None if e is None else e.numbers for n, e in self.estimates.items()}


@dataclass(frozen=True)
class Loops:
    """The loops of an actuator, from its posterior.

    ``major`` goes over the whole range of the record's voltage, ``minor`` over half of it about the
    same middle; ``initial`` is the curve from the demagnetized state, along ``initial_voltage``
    (points,), V.
    """

    __repr__ = brief

    major: Loop
    minor: Loop
    initial_voltage: FloatArray
    initial: Curve

    @property
    def numbers(self) -> dict[str, object]:
        """The loops as ``summary.json`` has them, the initial curve at every fifth voltage."""
        curve = {
            "voltage_V": self.initial_voltage,
            "mean_um": self.initial.mean,
            "lower_95_um": self.initial.lower,
            "upper_95_um": self.initial.upper,
        }
        return {
            "major": self.major.numbers,
            "minor": self.minor.numbers,
            "initial_curve": {name: values[::5].tolist() for name, values in curve.items()},
        }


def measure_loops(
    posterior: Posterior,
    draws: FloatArray,
    watch: Watch = unwatched,
    scales: Scales | None = None,
) -> Loops:
    """Measure the loops of every draw (draws, free), in the range of the records' voltages.

    These are as the monitor reads them; ``scales`` of the draws turn what is measured into true um
    and V, by default ones. ``watch`` is called with the share that is done.

    Raises
    ------
    InputError
        A voltage that does not change.
    """
    scales = scales or Scales.exact(len(draws))
    actuator, column, low, high = driven(posterior, draws)
    quarter = (high - low) / 4
    major, minor = (
        Loop.of(steady_loop(actuator, column, *edges), scales)
        for edges in watched([(low, high), (low + quarter, high - quarter)], part(watch, 0.0, 0.9))
    )
    voltage, curve = initial_curve(actuator, column, low, high)
    watch(1.0)
    initial = Curve.of(scales.factor("um")[:, np.newaxis] * curve)
    return Loops(major, minor, voltage, initial)


def driven(posterior: Posterior, draws: FloatArray) -> tuple[Actuator, Values, float, float]:
    """Return what loops are measured of: actuator, its parameters by name, the voltage's range.

    ``draws`` are (draws, free); of several records the actuator is that of the first, and the
    range, V, that of all.
    """
    _, single, record_draws = next(posterior.each(draws))
    column = single.likelihood.table.columns(single.prior.theta(record_draws))
    low = min(float(np.min(record.voltage)) for record in posterior.datasets)
    high = max(float(np.max(record.voltage)) for record in posterior.datasets)
    return single.likelihood.actuator, column, low, high


def steady_loop(
    actuator: Actuator, column: Values, low: float, high: float, points: int = POINTS
) -> TracedLoop:
    """Drive models from the demagnetized state up and down until the loop closes.

    All rate-independent parts of the ``actuator`` count, but no offset; ``column`` has columns
    (models,) of its parameters, by name. The voltage turns at ``low`` and ``high``, V; ``points``
    is the odd number of voltages along a branch.

    Raises
    ------
    InputError
        ``low`` is not below ``high``, or an even number of points.
    """
    voltage = _voltages(low, high, points)
    actuator, theta = _still(actuator, column)
    _, state = actuator.advance(theta, np.zeros(1), from_rest=True)
    # After two cycles, then after twice as many each time, a thousand at most.
    cycles, closed = 2, False
    while not closed and cycles <= 1024:
        # Between two turns nothing needs to be sampled: what is exact is so for any step.
        moved, state = actuator.advance(theta, np.tile([high, low], cycles), state)
        changed = np.abs(moved[:, -2:] - moved[:, -4:-2])
        closed = bool(np.all(changed <= 1e-9 * np.abs(moved[:, -2:-1] - moved[:, -1:])))
        cycles *= 2
    rising, state = actuator.advance(theta, voltage, state)
    falling, _ = actuator.advance(theta, voltage[::-1], state)
    return TracedLoop(voltage, rising, falling[:, ::-1], closed)


def initial_curve(
    actuator: Actuator, column: Values, low: float, high: float, points: int = POINTS
) -> tuple[FloatArray, FloatArray]:
    """Return the voltages (points,), V, and the curve (models, points), um, from the virgin state.

    The demagnetized actuator at zero volts goes straight to ``low``, and another time straight to
    ``high``; where both lie on one side of zero, only to the farther one. Parameters as in
    :func:`steady_loop`.
    """
    voltage = _voltages(min(low, 0.0), max(high, 0.0), points)
    actuator, theta = _still(actuator, column)
    curves = [np.empty((len(theta), 0))] * 2
    for number, side in enumerate((voltage[voltage < 0][::-1], voltage[voltage >= 0])):
        if side.size:
            curves[number] = actuator.displacement(theta, side, from_rest=True)
    return voltage, np.concatenate([curves[0][:, ::-1], curves[1]], axis=1)


def measures(traced: TracedLoop) -> dict[str, FloatArray | None]:
    """Measure a loop of models: each number (models,), None where the loop does not have it.

    With x↑ and x↓ the displacement on the way up and on the way down, x₊ and x₋ that at the highest
    and at the lowest voltage, and x_m = (x₊ + x₋) / 2 the loop's middle:

    ``range_um``
        x₊ − x₋.
    ``width_at_zero_um``
        x↓(0) − x↑(0), positive where the displacement lags behind the voltage; None if the loop
        does not go through zero volts.
    ``max_width_percent``
        The largest x↓ − x↑ at one voltage as a part of the range: what data sheets call hysteresis.
    ``remanence_um``
        x↓(0) − x_m: what remains at zero volts after the highest voltage, against the middle; half
        of the width in a loop that is symmetric about zero.
    ``coercive_V``
        (u↑ − u↓) / 2, with u↑ and u↓ the voltages at which x↑ and x↓ pass the middle x_m: half of
        the loop's width there. In a loop that is symmetric about zero it is the voltage that takes
        the displacement back to zero, as the coercive field does a polarization. Both are None
        unless the loop is about zero volts, u↓ ≤ 0 ≤ u↑ in the mean of the models: the middle of
        a unipolar drive is no state without a field.
    ``area_um_V``
        −∮ x du = ∮ u dx over one cycle, positive where the displacement lags: the energy lost in a
        cycle, in µJ, once multiplied with the actuator's force per volt, N/V.
    """
    voltage, rising, falling = traced.voltage, traced.rising, traced.falling
    gap, size = falling - rising, rising[:, -1] - falling[:, 0]
    middle = (rising[:, -1] + falling[:, 0]) / 2
    # A displacement may fall with the voltage.
    sign = np.where(size < 0, -1.0, 1.0)[:, np.newaxis]
    up, down = (
        first_passage(voltage, sign * (x - middle[:, np.newaxis]), 0.0) for x in (rising, falling)
    )
    through_zero = bool(voltage[0] < 0 < voltage[-1])
    about_zero = through_zero and bool(np.nanmean(down) <= 0 <= np.nanmean(up))
    return {
        "range_um": size,
        "width_at_zero_um": _at_zero(voltage, gap) if through_zero else None,
        "max_width_percent": 100 * np.max(gap, axis=1) / np.abs(size),
        "remanence_um": _at_zero(voltage, falling) - middle if about_zero else None,
        "coercive_V": (up - down) / 2 if about_zero else None,
        "area_um_V": np.asarray(scipy.integrate.simpson(gap, x=voltage, axis=1)),
    }


def _voltages(low: float, high: float, points: int) -> FloatArray:
    """Return voltages (points,) from the lowest to the highest."""
    if not low < high:
        raise InputError(
            f"loops: {low:g} to {high:g} V is not a range; give a voltage that changes"
        )
    if points < 3 or points % 2 == 0:
        raise InputError(f"loops: {points} points along a branch; give an odd number from 3 on")
    return np.linspace(low, high, points)


def _still(actuator: Actuator, column: Values) -> tuple[Actuator, FloatArray]:
    """Return the actuator without pace, and θ (models, parameters) demagnetized and unmoved."""
    still, zeros = actuator.static, np.zeros_like(column["initial"])
    values = {**column, "initial": zeros, "offset": zeros}
    return still, np.stack([values[name] for name in still.parameters], axis=1)


def _at_zero(voltage: FloatArray, branch: FloatArray) -> FloatArray:
    """Return a branch (models, points) at zero volts, (models,)."""
    after = int(np.searchsorted(voltage, 0.0))
    fraction = voltage[after] / (voltage[after] - voltage[after - 1])
    between: FloatArray = fraction * branch[:, after - 1] + (1 - fraction) * branch[:, after]
    return between


def first_passage(axis: FloatArray, values: FloatArray, level: float) -> FloatArray:
    """Return where on an axis (points,) values (models, points) first reach a level, (models,).

    On straight lines between the points; nan where they never do.
    """
    reached = values >= level
    after = np.argmax(reached, axis=1)
    rows, before = np.arange(after.size), np.maximum(after - 1, 0)
    low, high = values[rows, before], values[rows, after]
    share = np.where(after > 0, (level - low) / np.where(high > low, high - low, 1.0), 0.0)
    at = axis[before] + share * (axis[after] - axis[before])
    return np.where(reached.any(axis=1), at, np.nan)


# Time after a step from which creep is counted, s, as data sheets do.
CREEP_FROM = 0.1

# Measures of a step response: their names in a summary, titles and units for people.
STEP_MEASURES: Mapping[str, tuple[str, str]] = {
    "level_um": ("Displacement, without creep", "um"),
    "rise_s": ("Rise time, 10 to 90%", "s"),
    "overshoot_percent": ("Overshoot", "%"),
    "creep_percent": ("Creep per decade of time", "%"),
}


@dataclass(frozen=True)
class StepResponse:
    """The posterior of the response to a step from zero to ``height``, V, ``held`` so long, s.

    ``time`` (times,), s since the step; ``response`` the displacement since then, um; ``crept`` its
    growth from 0.1 s on, um, nan before, and None without creep. The names in ``estimates`` are
    those of :func:`measure_step`; a number is None if the model has none.
    """

    __repr__ = brief

    height: float
    held: float
    time: FloatArray
    response: Curve
    crept: Curve | None
    estimates: Mapping[str, Estimate | None]

    @property
    def numbers(self) -> dict[str, object]:
        """Its numbers in ``summary.json``."""
        levels: dict[str, object] = {"height_V": self.height, "held_s": self.held}
        return levels | {n: None if e is None else e.numbers for n, e in self.estimates.items()}


def step_of(record: Record) -> tuple[float, float] | None:
    """Return height, V, and length, s, of the step from zero that a record's voltage is.

    None if it is something else.
    """
    voltage = record.path.voltage
    height = float(np.median(voltage[voltage.size // 2 :]))
    slack = 0.02 * abs(height)
    up = np.abs(voltage - height) <= slack
    first = int(np.argmax(up))
    # One sample may lie on the way.
    if not (slack > 0 and up[first:].all() and np.abs(voltage[: max(first - 1, 1)]).max() <= slack):
        return None
    return height, (record.samples - first) * record.interval


def measure_steps(
    posterior: Posterior,
    draws: FloatArray,
    records: Mapping[str, Record],
    scales: Scales | None = None,
) -> dict[str, StepResponse]:
    """Measure the step responses of those records, by name, whose voltage is a step from zero.

    ``scales`` are as of :func:`measure_step`.
    """
    steps = {name: step_of(record) for name, record in records.items()}
    return {n: measure_step(posterior, draws, *step, scales) for n, step in steps.items() if step}


def measure_step(
    posterior: Posterior,
    draws: FloatArray,
    height: float,
    held: float,
    scales: Scales | None = None,
) -> StepResponse:
    """Measure the response to a step to ``height``, V, that is ``held`` so long, s.

    With x(t) the displacement since the step, x_d(t) that without creep, x_∞ where x_d settles, and
    c(t) = x(t) − x_d(t):

    ``level_um``
        x_∞.
    ``rise_s``
        From the first time at which x_d passes 10% of x_∞ to the first at which it passes 90%;
        None without dynamics.
    ``overshoot_percent``
        By how much the largest x_d exceeds x_∞, zero if it does not; None without dynamics.
    ``creep_percent``
        100 (c(T) − c(0.1 s)) / (x_∞ + c(0.1 s)) / log₁₀(T / 0.1 s), with T the end of the step;
        None without creep, or if T is less than a second.

    ``draws`` (draws, free) are parameters in their own units; their ``scales`` turn readings into
    true um, by default ones.
    """
    um = (scales or Scales.exact(len(draws))).factor("um")
    _, single, record_draws = next(posterior.each(draws))
    column = single.likelihood.table.columns(single.prior.theta(record_draws))
    column |= {"initial": np.zeros(len(draws)), "offset": np.zeros(len(draws))}
    actuator = replace(single.likelihood.actuator, hold="zero")
    first = 1e-6  # s: shorter than any rise
    last = max(held, 10 * first)
    time = np.geomspace(first, last, round(60 * np.log10(last / first)) + 1)
    settled, without, creep = _responses(actuator, column, height, time)
    estimates: dict[str, Estimate | None] = dict.fromkeys(STEP_MEASURES)
    estimates["level_um"] = Estimate.of(um * settled)
    if actuator.filter.parameters:
        share = without / settled[:, np.newaxis]
        begin, end = (
            np.exp(first_passage(np.log(time), share, fraction)) for fraction in (0.1, 0.9)
        )
        estimates["rise_s"] = Estimate.of(end - begin)
        # A response that only rises has no overshoot, but for rounding.
        overshoot = np.round(100 * np.maximum(np.max(share, axis=1) - 1, 0.0), 9)
        estimates["overshoot_percent"] = Estimate.of(overshoot)
    crept = None
    if actuator.creep is not None and last >= 10 * CREEP_FROM:
        before = np.array([np.interp(np.log(CREEP_FROM), np.log(time), row) for row in creep])
        grown = creep - before[:, np.newaxis]
        decades = np.log10(last / CREEP_FROM)
        percent = 100 * grown[:, -1] / (settled + before) / decades
        estimates["creep_percent"] = Estimate.of(percent)
        crept = Curve.of(np.where(time < CREEP_FROM, np.nan, um[:, np.newaxis] * grown))
    response = Curve.of(um[:, np.newaxis] * (without + creep))
    return StepResponse(height, held, time, response, crept, estimates)


def _responses(
    actuator: Actuator, column: Values, height: float, time: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return what a step from zero volts brings, um.

    Where the dynamics settle (models,), and the displacement since the step (models, times):
    without creep, and what creep adds to it.
    """
    voltage = np.array([0.0, height])
    still = actuator.static
    theta = np.stack([column[name] for name in still.parameters], axis=1)
    drive = still.displacement(theta, voltage, from_rest=True)
    settled = drive[:, 1] - drive[:, 0]
    steps = [settled]
    if actuator.creep is not None:
        crept = actuator.creep.drive(column, drive, voltage)
        steps += [crept[:, 1] - crept[:, 0]] * len(actuator.creep.times)
    parts = np.empty((2, settled.size, time.size))
    for i, t in enumerate(time.tolist()):
        sections = replace(actuator, interval=t).sections(column)
        taps = [(r.numerator, r.denominator[:, 1]) for r in sections.recursions]
        # A recursion's output for a unit that has been held for one sample.
        units = [top[:, 1] + (1 - back) * top[:, 0] for top, back in taps]
        moved = [gain * u * by for gain, u, by in zip(sections.gains, units, steps, strict=True)]
        parts[:, :, i] = moved[0], sum(moved[1:], start=np.zeros_like(settled))
    return settled, parts[0], parts[1]
