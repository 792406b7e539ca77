"""How well a displacement is followed, with and without a model, for every draw of a posterior.

Four controllers are compared on the paper's signals, from slow to where the dynamics matter: a
linear command (no compensation), the mean model's inverse (feed-forward), a PID controller, and a
PID controller beside the feed-forward. The last one compares the reading with what the mean model
says the fed command does, so that it answers what the model does not know and nothing else.
All begin demagnetized at zero volts, and 0 um of a reference is where the actuator stands there.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from bwbayes.arrays import FloatArray
from bwbayes.control.gains import Robustness, design
from bwbayes.control.loop import LoopNoise, LoopPlan, Stand, TrackingErrors, follow
from bwbayes.control.references import TRACKED, tracking_signals
from bwbayes.control.sampled import SampledModel, require_inverse
from bwbayes.control.tracked import CONTROLLERS, Tracking
from bwbayes.errors import InputError
from bwbayes.model.actuator import Actuator
from bwbayes.model.operator import Span

__all__ = ["track"]

LOOKS = (False, False, True, True)

# Of the reach of the mean model, what a reference swings by unless told otherwise.
PART = 0.8

# Frequencies of a decade, and the slowest, Hz.
DECADE, SLOWEST = (1.0, 2.0, 5.0), 0.1

# What dynamics that matter leave of a sine: half of its power.
LEFT = math.sqrt(0.5)

# Samples that a period must have.
PER_PERIOD = 10

# A middle that is nearer to zero than this part of the amplitude is zero.
ROUND = 1e-3

# Most samples of a signal.
MOST_SAMPLES = 1_000_000

# A feed-forward voltage is known to this part of the DAC's step.
CLOSE = 1e-4


def track(
    actuator: Actuator,
    theta: FloatArray,
    noise: LoopNoise,
    stand: Stand,
    generator: np.random.Generator,
    *,
    robustness: Robustness | None = None,
    frequencies: Sequence[float] | None = None,
    amplitude: float | None = None,
    all_theta: FloatArray | None = None,
) -> Tracking:
    """Follow the paper's signals with four controllers.

    Parameters
    ----------
    actuator
        Parts and the controller's interval; the voltage is held.
    theta
        (draws, parameters): the actuators that are simulated.
    noise
        Of those draws.
    stand
        The test stand.
    generator
        Source of discrepancy and sensor noise.
    robustness
        The margins that all draws must keep.
    frequencies
        Hz; by default 1, 2 and 5 of each decade from 0.1 Hz to where the mean model's dynamics
        leave 71 % of a sine, or to a tenth of the samples.
    amplitude
        Of the references, um; by default 80 % of what the mean model reaches.
    all_theta
        (draws, parameters): all draws that the controller must be stable with, and whose mean is
        the model; by default those that are simulated.

    Raises
    ------
    InputError
        A model that has no step or no inverse, margins that cannot be had, frequencies that are too
        fast or too slow, or an amplitude that is out of reach.
    """
    robustness = robustness or Robustness()
    all_theta = theta if all_theta is None else all_theta
    mean = SampledModel.of(actuator, all_theta.mean(axis=0)[np.newaxis])
    draws = SampledModel.of(actuator, all_theta)
    limits = stand.limits
    require_inverse(mean, limits)
    frequencies = _frequencies(mean, frequencies)
    ends = _reach(mean, limits)
    amplitude = _amplitude(amplitude, ends)
    # A range about zero needs no way to its middle.
    center = ends.middle if abs(ends.middle) > ROUND * amplitude else 0.0
    rise = _rise(mean)
    gains, satisfied = design(mean, draws, limits, stand.delay, robustness)

    names = tuple(TRACKED)
    rows = SampledModel.of(actuator, np.tile(theta, (len(CONTROLLERS) * len(names), 1)))
    references = [
        tracking_signals(frequency, actuator.interval, center, amplitude, rise)
        for frequency in frequencies
    ]
    models = SampledModel.of(
        actuator, np.tile(all_theta.mean(axis=0), (len(frequencies) * len(names), 1))
    )
    fed = _fed(models, [desired for desired, _ in references], stand)
    followed: list[TrackingErrors] = []
    for (desired, begins), (command, reached) in zip(references, fed, strict=True):
        plan = _plan(desired, begins, command, reached, ends, limits)
        followed.append(follow(plan, gains, rows, noise, stand, generator))
    rms, largest, limited = (np.stack(results, axis=1) for results in zip(*followed, strict=True))
    return Tracking(
        gains,
        satisfied,
        robustness,
        stand,
        frequencies,
        names,
        center,
        amplitude,
        rise * actuator.interval,
        rms,
        largest,
        limited,
    )


def _fed(
    model: SampledModel, references: Sequence[FloatArray], stand: Stand
) -> list[tuple[FloatArray, FloatArray]]:
    """Return the voltage for each reference (signals, samples), and where the model goes with it.

    All at once, in the time that the longest takes: it is a step's own cost that counts, not how
    many models do it. Of that length the others rest where they end.
    """
    longest = max(reference.shape[1] for reference in references)
    desired = np.vstack(
        [
            np.pad(reference, ((0, 0), (0, longest - reference.shape[1])), mode="edge")
            for reference in references
        ]
    )
    command, reached = np.zeros_like(desired), np.zeros_like(desired)
    state = model.begin(np.zeros(model.models))
    last, tolerance = np.zeros(model.models), CLOSE * stand.amplifier.step
    for t in range(longest - 1):
        reached[:, t] = model.displacement(state)
        guess = 2 * state.voltage - last
        last = state.voltage
        command[:, t], state = model.inverse(
            state, desired[:, t + 1], stand.limits, guess, tolerance
        )
    reached[:, -1], command[:, -1] = model.displacement(state), state.voltage
    ends = np.cumsum([reference.shape[0] for reference in references])[:-1]
    parts = zip(references, np.split(command, ends), np.split(reached, ends), strict=True)
    return [
        (fed[:, : reference.shape[1]], delivered[:, : reference.shape[1]])
        for reference, fed, delivered in parts
    ]


def _plan(
    desired: FloatArray,
    begins: int,
    command: FloatArray,
    reached: FloatArray,
    ends: Span,
    limits: Span,
) -> LoopPlan:
    """Return what the four controllers do to follow references (signals, samples)."""
    slope = ends.half / limits.half
    linear = np.clip(limits.middle + (desired - ends.middle) / slope, *limits)
    nothing = np.zeros_like(desired)
    return LoopPlan(
        np.stack([linear, command, nothing, command]),
        np.stack([nothing, nothing, desired, reached]),
        LOOKS,
        desired,
        begins,
    )


def _reach(mean: SampledModel, limits: Span) -> Span:
    """Return the displacements, um, that slow sweeps between the limits end at."""
    memory = mean.step.demagnetized()
    ends = []
    for voltage in (0.0, limits.high, limits.low, limits.high, limits.low):
        w, _, memory = mean.drive(memory, np.array([voltage]))
        ends.append(float(w[0]))
    return Span(ends[4] - ends[0], ends[3] - ends[0])


def _amplitude(amplitude: float | None, ends: Span) -> float:
    """Return the references' amplitude, um."""
    if amplitude is None:
        return PART * ends.half
    if not 0 < amplitude <= ends.half:
        raise InputError(
            f"amplitude: {amplitude:g} um; give one above 0 and within the mean model's reach, "
            f"which is {ends.half:.3g} um about {ends.middle:.3g} um"
        )
    return amplitude


def _rise(mean: SampledModel) -> int:
    """Return how many samples a jump of a reference is to take.

    A lag τ needs w = x + τ x′. A jump by two amplitudes that takes four times τ, with a speed that
    is a Hann window, stays within the reach that the amplitude is 80 % of.
    """
    turns = np.geomspace(1e-4, np.pi, 400)
    response = np.abs(mean.frequency_response(turns))[0]
    slow = turns[response < LEFT]
    return max(round(4 / float(slow[0])), 1) if slow.size else 1


def _frequencies(mean: SampledModel, frequencies: Sequence[float] | None) -> tuple[float, ...]:
    """Return the frequencies, Hz."""
    interval = mean.actuator.interval
    fastest = 1 / (PER_PERIOD * interval)
    if frequencies is not None:
        for frequency in frequencies:
            slowest = 3 / (MOST_SAMPLES * interval)
            if not slowest <= frequency <= fastest:
                raise InputError(
                    f"frequencies: {frequency:g} Hz; at this rate give some from {slowest:.3g} to "
                    f"{fastest:.3g} Hz"
                )
        if not frequencies:
            raise InputError("frequencies: none is given; give some in Hz")
        return tuple(frequencies)
    chosen: list[float] = []
    for decade in range(math.floor(math.log10(SLOWEST)), math.ceil(math.log10(fastest)) + 1):
        for digit in DECADE:
            frequency = round(digit * 10.0**decade, 12)
            if frequency > fastest:
                return tuple(chosen)
            chosen.append(frequency)
            response = np.abs(mean.frequency_response(np.array([2 * np.pi * frequency * interval])))
            if response[0, 0] < LEFT:
                return tuple(chosen)
    return tuple(chosen)
