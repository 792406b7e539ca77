"""Step responses: how fast an actuator rises, whether it overshoots, and how it creeps.

Every posterior draw, demagnetized and at rest, gets an ideal step of the voltage from zero, as in
the paper's Fig. 5. The recursions are exact at any interval, so the displacement a time t after the
step is that of one sample as long as t: the response comes at times that are evenly spaced on a log
axis, from a microsecond to minutes, whatever the sampling rate of the record.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from bwbayes.arrays import FloatArray
from bwbayes.inference.posterior import Posterior
from bwbayes.model.actuator import Actuator
from bwbayes.model.declaration import Values
from bwbayes.prediction.loops import Curve, Estimate, first_passage
from bwbayes.record.instruments import Scales
from bwbayes.record.record import Record
from bwbayes.shown import brief

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
class Step:
    """A step of the voltage from zero to ``height``, V, that is held for ``held``, s."""

    __repr__ = brief

    height: float
    held: float


@dataclass(frozen=True)
class StepResponse:
    """The posterior of a step response.

    ``time`` (times,), s since the step; ``response`` the displacement since then, um; ``crept`` its
    growth from 0.1 s on, um, nan before, and None without creep. The names in ``estimates`` are
    those of :func:`measure_step`; a number is None if the model has none.
    """

    __repr__ = brief

    step: Step
    time: FloatArray
    response: Curve
    crept: Curve | None
    estimates: Mapping[str, Estimate | None]

    @property
    def numbers(self) -> dict[str, object]:
        """Its numbers in ``summary.json``."""
        levels: dict[str, object] = {"height_V": self.step.height, "held_s": self.step.held}
        return levels | {n: None if e is None else e.numbers for n, e in self.estimates.items()}


def step_of(record: Record) -> Step | None:
    """Return the step from zero that a record's voltage is, or None if it is something else."""
    voltage = record.path.voltage
    height = float(np.median(voltage[voltage.size // 2 :]))
    slack = 0.02 * abs(height)
    up = np.abs(voltage - height) <= slack
    first = int(np.argmax(up))
    # One sample may lie on the way.
    if not (slack > 0 and up[first:].all() and np.abs(voltage[: max(first - 1, 1)]).max() <= slack):
        return None
    return Step(height, (record.samples - first) * record.interval)


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
    return {n: measure_step(posterior, draws, step, scales) for n, step in steps.items() if step}


def measure_step(
    posterior: Posterior, draws: FloatArray, step: Step, scales: Scales | None = None
) -> StepResponse:
    """Measure the response to a step.

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
    held = max(step.held, 10 * first)
    time = np.geomspace(first, held, round(60 * np.log10(held / first)) + 1)
    settled, without, creep = _responses(actuator, column, step.height, time)
    estimates: dict[str, Estimate | None] = dict.fromkeys(STEP_MEASURES)
    estimates["level_um"] = Estimate.of(um * settled)
    if actuator.filter.parameters:
        share = without / settled[:, np.newaxis]
        begin, end = (
            np.exp(first_passage(np.log(time), share, fraction)) for fraction in (0.1, 0.9)
        )
        estimates["rise_s"] = Estimate.of(end - begin)
        overshoot = 100 * np.maximum(np.max(share, axis=1) - 1, 0.0)
        estimates["overshoot_percent"] = Estimate.of(overshoot)
    crept = None
    if actuator.creep is not None and held >= 10 * CREEP_FROM:
        before = np.array([np.interp(np.log(CREEP_FROM), np.log(time), row) for row in creep])
        grown = creep - before[:, np.newaxis]
        decades = np.log10(held / CREEP_FROM)
        percent = 100 * grown[:, -1] / (settled + before) / decades
        estimates["creep_percent"] = Estimate.of(percent)
        crept = Curve.of(np.where(time < CREEP_FROM, np.nan, um[:, np.newaxis] * grown))
    return StepResponse(
        step, time, Curve.of(um[:, np.newaxis] * (without + creep)), crept, estimates
    )


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
