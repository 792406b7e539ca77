"""The closed loop on a virtual test stand, for all draws of a posterior at once.

Sample by sample: the laser's reading comes in through the ADC, the controller answers with a
command some samples later, the DAC rounds it, the amplifier follows it as fast as it can and no
further than its limits, and the actuator of every draw does what that draw says, with its own
discrepancy and sensor noise. The controllers differ in two things, what they feed forward and
whether they look at the readings, and see the same noise.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from bwbayes.arrays import FloatArray
from bwbayes.control.gains import Gains
from bwbayes.control.sampled import SampledModel
from bwbayes.inference.state_space import Noise, root
from bwbayes.model.operator import Span
from bwbayes.record.teststand import Amplifier, LaserSensor
from bwbayes.watching import Watch, unwatched, watched

# Each with whether it looks at the readings.
CONTROLLERS = {
    "no compensation": False,
    "feed-forward": False,
    "PID": True,
    "PID with feed-forward": True,
}


@dataclass(frozen=True)
class Stand:
    """The hardware between a controller and its actuator.

    Parameters
    ----------
    limits
        The voltages that the amplifier gives, V.
    delay
        Whole samples from a reading to the command that answers it.
    amplifier
        The stand's amplifier, with the DAC's step and the slew rate.
    sensor
        The stand's sensor, with the ADC's step.
    """

    limits: Span
    delay: int = 1
    amplifier: Amplifier = field(default_factory=Amplifier)
    sensor: LaserSensor = field(default_factory=LaserSensor)


class LoopNoise(NamedTuple):
    """The noise of each draw: a noise model, and its parameters (draws, any)."""

    model: Noise
    parameters: FloatArray

    def walk(
        self, interval: float, generator: np.random.Generator
    ) -> Iterator[tuple[FloatArray, FloatArray]]:
        """Yield discrepancy and sensor noise, (draws,) each, um, sample by sample without end."""
        model, theta = self.model.at(interval), self.parameters
        decay_matrix, shocks = model.transition(theta), root(model.process_covariance(theta))
        scores = generator.standard_normal((len(theta), model.states))
        state = np.einsum("dj,dji->di", scores, root(model.stationary(theta)))
        while True:
            sensor = model.sensor_noise(theta, generator.standard_normal((len(theta), 1)))
            yield state @ model.observe, sensor[:, 0]
            scores = generator.standard_normal(state.shape)
            state = np.einsum("dij,dj->di", decay_matrix, state) + np.einsum(
                "dj,dji->di", scores, shocks
            )


class LoopPlan(NamedTuple):
    """The controllers' gains, feedforward and targets for some signals.

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


def plan_loops(
    model: SampledModel,
    references: Sequence[tuple[FloatArray, int]],
    ends: Span,
    stand: Stand,
    watch: Watch = unwatched,
) -> Iterator[LoopPlan]:
    """Yield what the four controllers do to follow references.

    Parameters
    ----------
    model
        The mean model, once for each row of the references.
    references
        (signals, samples), um, with the sample from which on errors count.
    ends
        The displacements, um, that slow sweeps between the amplifier's limits end at.
    stand
        The test stand.
    watch
        Called with the share that is done, before the first is yielded.

    Notes
    -----
    All references are fed forward at once, in the time that the longest takes: it is a step's own
    cost that counts, not how many models do it. The others rest where they end.
    """
    longest = max(desired.shape[1] for desired, _ in references)
    padded = [
        np.pad(desired, ((0, 0), (0, longest - desired.shape[1])), mode="edge")
        for desired, _ in references
    ]
    limits, together = stand.limits, np.vstack(padded)
    # Voltages for the displacements (models, samples), and where the models go with them.
    voltages, displacements = np.zeros_like(together), np.zeros_like(together)
    state, last = model.begin(np.zeros(model.models)), np.zeros(model.models)
    # A voltage is known to a small part of the DAC's step.
    tolerance = 1e-4 * stand.amplifier.step
    for t in watched(range(longest - 1), watch):
        displacements[:, t] = model.displacement(state)
        guess, last = 2 * state.voltage - last, state.voltage
        voltages[:, t], state = model.inverse(state, together[:, t + 1], limits, guess, tolerance)
    displacements[:, -1], voltages[:, -1] = model.displacement(state), state.voltage
    fed = voltages, displacements
    for (desired, begins), *parts in zip(
        references, *(np.split(values, len(references)) for values in fed), strict=True
    ):
        command, reached = (series[:, : desired.shape[1]] for series in parts)
        linear = limits.middle + (desired - ends.middle) * limits.half / ends.half
        nothing = np.zeros_like(desired)
        yield LoopPlan(
            np.stack([np.clip(linear, *limits), command, nothing, command]),
            np.stack([nothing, nothing, desired, reached]),
            tuple(CONTROLLERS.values()),
            desired,
            begins,
        )


def follow(
    plan: LoopPlan,
    gains: Gains,
    draws: SampledModel,
    noise: LoopNoise,
    stand: Stand,
    generator: np.random.Generator,
    watch: Watch = unwatched,
) -> TrackingErrors:
    """Close the loop around every draw.

    Parameters
    ----------
    plan
        Controllers and signals.
    gains
        Gains of the controllers with feedback.
    draws
        The actuators, whose voltage is held between samples; a row for every controller, signal
        and draw, in this order.
    noise
        Noise parameters of the draws.
    stand
        The test stand.
    generator
        Source of discrepancy and sensor noise.
    watch
        Called with the share that is done.
    """
    controllers, signals, samples = plan.ahead.shape
    shape = controllers, signals, len(noise.parameters)
    # The last sample of the reference is there for those that look one ahead.
    samples -= 1
    low, high = stand.limits
    step, reach = stand.amplifier.step, stand.amplifier.slew * gains.interval
    looks = np.array(plan.looks)[:, np.newaxis, np.newaxis]

    state = draws.begin(np.zeros(draws.models))
    held = np.zeros(shape)
    answers = [np.zeros(shape) for _ in range(stand.delay)]
    answer, errors = np.zeros(shape), [np.zeros(shape), np.zeros(shape)]
    squares, largest, limited = np.zeros(shape), np.zeros(shape), np.zeros(shape)
    noises = noise.walk(gains.interval, generator)
    for t in watched(range(samples), watch):
        drift, white = next(noises)
        moved = draws.displacement(state).reshape(shape) + drift
        if t >= plan.begins:
            error = moved - plan.reference[:, t, np.newaxis]
            squares += error**2
            np.maximum(largest, np.abs(error), out=largest)
        reading = moved + white
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
    judged = samples - plan.begins
    return TrackingErrors(np.sqrt(squares / judged), largest, limited / judged)
