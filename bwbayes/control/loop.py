"""The closed loop on a virtual test stand, for all draws of a posterior at once.

Sample by sample: the laser's reading comes in through the ADC, the controller answers with a
command some samples later, the DAC rounds it, the amplifier follows it as fast as it can and no
further than its limits, and the actuator of every draw does what that draw says, with its own
discrepancy and sensor noise. The controllers differ in two things, what they feed forward and
whether they look at the readings, and see the same noise.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from bwbayes.arrays import FloatArray
from bwbayes.control.gains import Gains
from bwbayes.control.sampled import SampledModel
from bwbayes.model.operator import Span
from bwbayes.record.teststand import Amplifier, LaserSensor

__all__ = ["LoopNoise", "LoopPlan", "Stand", "TrackingErrors", "follow"]


@dataclass(frozen=True)
class Stand:
    """What is between a controller and its actuator.

    Parameters
    ----------
    limits
        The voltages that the amplifier gives, V.
    delay
        Whole samples from a reading to the command that answers it.
    amplifier
        Of it are the DAC's step and the slew.
    sensor
        Of it is the ADC's step.
    """

    limits: Span
    delay: int = 1
    amplifier: Amplifier = field(default_factory=Amplifier)
    sensor: LaserSensor = field(default_factory=LaserSensor)


class LoopNoise(NamedTuple):
    """What each draw has beside its actuator: sds, um, and the discrepancy's time, s; (draws,)."""

    sensor: FloatArray
    discrepancy: FloatArray
    time: FloatArray


class LoopPlan(NamedTuple):
    """What controllers do on some signals.

    ``ahead`` (controllers, signals, samples), V, is fed forward; ``targets`` (controllers, signals,
    samples), um, is what the readings are compared with, and ``looks`` (controllers,) whether they
    are. ``reference`` (signals, samples), um, is what is to be followed; errors count from sample
    ``begins`` on.
    """

    ahead: FloatArray
    targets: FloatArray
    looks: tuple[bool, ...]
    reference: FloatArray
    begins: int


class TrackingErrors(NamedTuple):
    """How well: ``rms`` and ``largest`` error, um, and the share of samples at a limit.

    All are (controllers, signals, draws). The error is that of the actuator itself, its discrepancy
    included, not of the readings.
    """

    rms: FloatArray
    largest: FloatArray
    limited: FloatArray


def follow(
    plan: LoopPlan,
    gains: Gains,
    draws: SampledModel,
    noise: LoopNoise,
    stand: Stand,
    generator: np.random.Generator,
) -> TrackingErrors:
    """Close the loop around every draw.

    Parameters
    ----------
    plan
        Controllers and signals.
    gains
        Of those controllers that look.
    draws
        The actuators, whose voltage is held between samples; a row for every controller, signal
        and draw, in this order.
    noise
        Of the draws.
    stand
        The test stand.
    generator
        Source of discrepancy and sensor noise.
    """
    controllers, signals, samples = plan.ahead.shape
    count = noise.sensor.size
    shape = controllers, signals, count
    # The last sample of the reference is there for those that look one ahead.
    samples -= 1
    low, high = stand.limits
    step, reach = stand.amplifier.step, stand.amplifier.slew * gains.interval
    looks = np.array(plan.looks)[:, np.newaxis, np.newaxis]
    decay = np.exp(-gains.interval / noise.time)
    shock = noise.discrepancy * np.sqrt(-np.expm1(-2 * gains.interval / noise.time))

    state = draws.begin(np.zeros(draws.models))
    held = np.zeros(shape)
    answers = [np.zeros(shape) for _ in range(stand.delay)]
    answer, errors = np.zeros(shape), [np.zeros(shape), np.zeros(shape)]
    drift = noise.discrepancy * generator.standard_normal(count)
    squares, largest, limited = np.zeros(shape), np.zeros(shape), np.zeros(shape)
    for t in range(samples):
        moved = draws.displacement(state).reshape(shape) + drift
        if t >= plan.begins:
            error = moved - plan.reference[:, t, np.newaxis]
            squares += error**2
            np.maximum(largest, np.abs(error), out=largest)
        reading = moved + noise.sensor * generator.standard_normal(count)
        np.round(reading / stand.sensor.step, out=reading)
        reading *= stand.sensor.step
        errors = [plan.targets[:, :, t, np.newaxis] - reading, *errors[:2]]
        change = sum(gain * error for gain, error in zip(gains.steps, errors, strict=True))
        # Kept to what the amplifier can still give: that is all there is of anti-windup.
        late = min(t + stand.delay, samples)
        ahead = plan.ahead[:, :, late, np.newaxis]
        answer = np.clip(answer + change * looks, low - ahead, high - ahead) * looks
        answers.append(answer)
        command = plan.ahead[:, :, t, np.newaxis] + answers.pop(0)
        level = np.clip(step * np.round(command / step), low, high)
        held = np.clip(level, held - reach, held + reach)
        if t >= plan.begins:
            limited += (command <= low) | (command >= high)
        state = draws.forward(state, held.ravel())[1]
        drift = decay * drift + shock * generator.standard_normal(count)
    judged = samples - plan.begins
    return TrackingErrors(np.sqrt(squares / judged), largest, limited / judged)
