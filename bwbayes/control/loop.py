"""The closed loop on a virtual test stand, for all draws of a posterior at once.

Sample by sample: the laser's reading comes in through the ADC, the controller answers with a
command some samples later, the DAC rounds it, the amplifier follows it as fast as it can and no
further than its limits, and the actuator of every draw does what that draw says, with its own
discrepancy and sensor noise. The controllers differ in two things, what they feed forward and
whether they look at the readings, and see the same noise.

A PID controller has the form that a computer runs,

    u[t] = u[t−1] + q₀ e[t] + q₁ e[t−1] + q₂ e[t−2],

whose zeros are put on the poles of the mean model's dynamics, so that one number is left to choose:
how fast it integrates. It is made as large as the margins allow, with every draw of the posterior
and every slope that its hysteresis can have. Hysteresis is a gain between two slopes, from sample
to sample another one; the circle criterion says that the loop is stable however it changes.

References: K. J. Åström and R. M. Murray, Feedback Systems (Princeton, 2008), chapters on frequency
domain analysis and PID control; M. Vidyasagar, Nonlinear Systems Analysis (Prentice Hall, 1993),
for the circle criterion.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np

from bwbayes.arrays import FloatArray
from bwbayes.control.sampled import SampledModel
from bwbayes.errors import InputError
from bwbayes.inference.state_space import Noise, root
from bwbayes.model.inputs import Limits, Span
from bwbayes.record.teststand import Amplifier, LaserSensor
from bwbayes.shown import brief
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

    The ``limits`` are those of commands, and ``allowed`` what the ``amplifier`` leaves of them;
    ``delay`` are the whole samples from a reading to the command that answers it.
    """

    limits: Limits
    delay: int = 1
    amplifier: Amplifier = field(default_factory=Amplifier)
    sensor: LaserSensor = field(default_factory=LaserSensor)

    @property
    def allowed(self) -> Limits:
        """The limits, with a slew that the amplifier is capable of."""
        return replace(self.limits, slew=min(self.limits.slew, self.amplifier.slew))


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


def plan_loops(
    model: SampledModel,
    references: Sequence[tuple[FloatArray, int]],
    ends: Span,
    stand: Stand,
    watch: Watch = unwatched,
) -> Iterator[LoopPlan]:
    """Yield what the four controllers do to follow references.

    The ``model`` is the mean one, once for each row of the ``references``: (signals, samples), um,
    with the sample from which on errors count. Slow sweeps between the amplifier's limits end at
    the displacements ``ends``, um. ``watch`` is called with the share that is done, before the
    first is yielded.

    All references are fed forward at once, in the time that the longest takes: it is a step's own
    cost that counts, not how many models do it. The others rest where they end.
    """
    longest = max(desired.shape[1] for desired, _ in references)
    padded = [
        np.pad(desired, ((0, 0), (0, longest - desired.shape[1])), mode="edge")
        for desired, _ in references
    ]
    limits, together = stand.limits.span, np.vstack(padded)
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
    *,
    true: Callable[[FloatArray], FloatArray] = np.positive,
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Close the loop around every draw; return rms and largest error, um, and the share limited.

    All are (controllers, signals, draws). The error is that of the actuator itself in true um, its
    discrepancy included, not of the readings; the share is that of the samples at a limit.

    The ``draws`` are the actuators, whose voltage is held between samples: a row for every
    controller, signal and draw, in this order. The ``generator`` is the source of discrepancy and
    sensor noise; ``watch`` is called with the share that is done. ``true`` returns the
    displacements that readings (..., draws), um, of the sensor of the fitted record stand for.
    """
    controllers, signals, samples = plan.ahead.shape
    shape = controllers, signals, len(noise.parameters)
    # The last sample of the reference is there for those that look one ahead.
    samples -= 1
    low, high = stand.limits.span
    step, reach = stand.amplifier.step, stand.allowed.rate * gains.interval
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
            error = true(moved) - plan.reference[:, t, np.newaxis]
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
            limited += (command <= low) | (command >= high) | (held != level)
        state = draws.forward(state, held.ravel())[1]
    judged = samples - plan.begins
    return np.sqrt(squares / judged), largest, limited / judged


# Where loops are looked at, rad per sample.
ANGLES: FloatArray = np.geomspace(1e-5, np.pi, 1500)


@dataclass(frozen=True)
class Robustness:
    """Margins that every draw must keep: a gain margin, and a phase margin in degrees.

    Raises InputError: a gain margin of 1 or less, or a phase margin outside 0 to 90 degrees.
    """

    gain: float = 2.0
    phase: float = 60.0

    def __post_init__(self) -> None:
        if not 1 < self.gain < math.inf:
            raise InputError(f"gain margin: {self.gain:g}; give a factor above 1, as 2")
        if not 0 < self.phase < 90:
            raise InputError(f"phase margin: {self.phase:g} degrees; give one between 0 and 90")


@dataclass(frozen=True)
class Gains:
    """A PID controller at an interval, in s; errors in um, commands in V.

    ``steps`` are q₀, q₁ and q₂, V/um.
    """

    steps: tuple[float, float, float]
    interval: float

    @property
    def proportional(self) -> float:
        """K_p = −q₁ − 2 q₂, V/um."""
        return -self.steps[1] - 2 * self.steps[2]

    @property
    def integral(self) -> float:
        """K_i = (q₀ + q₁ + q₂) / T, V/(um s)."""
        return sum(self.steps) / self.interval

    @property
    def derivative(self) -> float:
        """K_d = q₂ T, V s/um."""
        return self.steps[2] * self.interval


@dataclass(frozen=True)
class Margins:
    """How far each draw is from instability, (draws,) each.

    ``gain`` is the factor by which the loop's gain could grow; ``phase``, in degrees, what it could
    lag more, at the slope where that is least, below zero where it lags too much already;
    ``crossover``, Hz, where the gain is one at the steepest slope; ``circle`` is above zero where
    the circle criterion holds.
    """

    __repr__ = brief

    gain: FloatArray
    phase: FloatArray
    crossover: FloatArray
    circle: FloatArray

    @property
    def stable(self) -> bool:
        """Whether all draws are stable, however the hysteresis' slope changes.

        The open loop is stable but for its integrator, so that with a gain margin above one it does
        not encircle the critical point.
        """
        return bool(np.all(self.circle > 0) and np.all(self.gain > 1))

    def meet(self, required: Robustness) -> bool:
        """Whether all draws are stable with the required margins."""
        is_robust = (self.gain >= required.gain) & (self.phase >= required.phase)
        return self.stable and bool(is_robust.all())


def design(
    mean: SampledModel, draws: SampledModel, limits: Span, delay: int, required: Robustness
) -> tuple[Gains, Margins]:
    """Return the fastest controller that keeps the margins with all draws, and those margins.

    The controller cancels the poles of the one ``mean`` model; the ``draws`` must be stable at
    voltages within ``limits``, V, with a ``delay`` of whole samples from a reading to the command
    that answers it.

    Raises InputError: no controller of this kind has them.
    """
    slopes = draws.slopes(limits)
    if not slopes[0].min() > 0:
        raise InputError(
            f"track: some draws have slopes as low as {slopes[0].min():.3g} um/V, at which no "
            "controller is stable; narrow the limits"
        )
    poles = mean.sections.denominator[0, 0]

    def gains_of(speed: float) -> Gains:
        first, second, third = (speed * poles / poles.sum()).tolist()
        return Gains((first, second, third), mean.actuator.interval)

    loop = OpenLoop(gains_of(1.0), draws.frequency_response(ANGLES), delay)

    def try_speed(speed: float) -> tuple[Gains, Margins]:
        # A faster controller does what a steeper slope does.
        return gains_of(speed), loop.margins((speed * slopes[0], speed * slopes[1]))

    # An integrator of this speed is at its limit on the steepest slope, whatever the dynamics.
    fastest = 2.0 / float(slopes[1].max())
    slowest = 1e-6 * fastest
    best = try_speed(slowest)
    if not best[1].meet(required):
        raise InputError(
            f"track: no controller of this kind keeps a gain margin of {required.gain:g} and a "
            f"phase margin of {required.phase:g} degrees with all draws; ask for less, or sample "
            "faster"
        )
    while fastest / slowest > 1 + 1e-3:
        speed = math.sqrt(slowest * fastest)
        trial = try_speed(speed)
        if trial[1].meet(required):
            slowest, best = speed, trial
        else:
            fastest = speed
    return best


class OpenLoop:
    """The loop L = C(z) z^−delay P(z) of draws, but for the slope of their hysteresis.

    ``response`` (draws, angles) is that of the linear part P on a grid of angles per sample, rad;
    C = (q₀ + q₁/z + q₂/z²) / (1 − 1/z). From one angle to the next L is taken to go straight, in
    log size and angle.
    """

    def __init__(self, gains: Gains, response: FloatArray, delay: int) -> None:
        back = np.exp(-1j * ANGLES)
        controller = np.polyval(gains.steps[::-1], back) / (1 - back) * back**delay
        loop = controller * response
        self.loop, self.interval = loop, gains.interval
        self.size, self.lag = np.abs(loop), np.angle(-loop)
        with np.errstate(divide="ignore"):
            self.log_size = np.log(self.size)
        self.turned = np.angle(loop[:, 1:] / loop[:, :-1])
        # The size where the loop is real and negative; at the end it is real but for rounding.
        real = (loop.real[:, :-1] < 0) & (loop.imag[:, :-1] * loop.imag[:, 1:] <= 0)
        with np.errstate(divide="ignore", invalid="ignore"):
            fraction = np.clip(np.nan_to_num(-self.lag[:, :-1] / self.turned), 0.0, 1.0)
            crossings = np.exp(self.log_size[:, :-1] + fraction * np.diff(self.log_size, axis=1))
        worst = np.max(np.where(real, crossings, 0.0), axis=1)
        self.worst = np.maximum(worst, np.where(loop.real[:, -1] < 0, self.size[:, -1], 0.0))

    def margins(self, slopes: tuple[FloatArray, FloatArray]) -> Margins:
        """Return the margins of k L, where the slope k lies between two bounds (draws,)."""
        smallest, largest = (slope[:, np.newaxis] for slope in slopes)
        size, lag = self.size, self.lag
        with np.errstate(divide="ignore"):
            gain = 1 / (largest[:, 0] * self.worst)
        # Phase margin: where the size is one at some slope. The lag is least at one of these
        # angles, or at the two ends.
        between = (size * largest >= 1) & (size * smallest <= 1)
        smallest_lag = np.min(np.where(between, np.abs(lag), np.pi), axis=1)
        for slope in (smallest, largest):
            level = self.log_size + np.log(slope)
            crossed = (level[:, :-1] >= 0) != (level[:, 1:] >= 0)
            with np.errstate(divide="ignore", invalid="ignore"):
                fraction = level[:, :-1] / (level[:, :-1] - level[:, 1:])
            at_one = np.abs(lag[:, :-1] + fraction * self.turned)
            least = np.min(np.where(crossed, at_one, np.pi), axis=1)
            smallest_lag = np.minimum(smallest_lag, least)
        phase = np.degrees(np.where(gain < 1, -smallest_lag, smallest_lag))
        circle = np.min(
            ((1 + largest * self.loop) * np.conj(1 + smallest * self.loop)).real, axis=1
        )
        above = size * largest >= 1
        last = ANGLES[::-1][np.argmax(above[:, ::-1], axis=1)]
        crossover = np.where(above.any(axis=1), last, 0.0) / (2 * np.pi * self.interval)
        return Margins(gain, phase, crossover, circle)
