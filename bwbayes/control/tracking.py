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
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from bwbayes.arrays import FloatArray
from bwbayes.control.discrete import frequency_response
from bwbayes.control.gains import Gains, Margins, Robustness, design
from bwbayes.control.loop import LoopNoise, LoopPlan, Stand, TrackingErrors, follow
from bwbayes.control.references import SHAPES, reference
from bwbayes.control.sampled import SampledModel, require_inverse
from bwbayes.errors import InputError
from bwbayes.model.actuator import Actuator
from bwbayes.model.operator import Span
from bwbayes.results.standing import Standing
from bwbayes.shown import brief

__all__ = ["CONTROLLERS", "Tracking", "Wishes", "track"]

CONTROLLERS = ("no compensation", "feed-forward", "PID", "PID with feed-forward")
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


@dataclass(frozen=True)
class Wishes:
    """What a loop is to follow, and how safely.

    Parameters
    ----------
    robustness
        The margins that all draws must keep.
    frequencies
        Hz; by default 1, 2 and 5 of each decade from 0.1 Hz to where the mean model's dynamics
        leave 71 % of a sine, or to a tenth of the samples.
    amplitude
        Of the references, um; by default 80 % of what the mean model reaches.
    """

    robustness: Robustness = field(default_factory=Robustness)
    frequencies: tuple[float, ...] | None = None
    amplitude: float | None = None


@dataclass(frozen=True)
class Tracking:
    """How well four controllers follow, for every draw.

    ``rms`` and ``largest`` error, um, and the share of samples ``limited`` by the amplifier are
    (controllers, frequencies, signals, draws), in the order of ``CONTROLLERS``, ``frequencies``,
    Hz, and ``signals``. The references swing by ``amplitude`` about the ``middle``, um; their jumps
    take the time ``rise``, s. ``standing`` is how the validation of the run came out that gave the
    draws.
    """

    __repr__ = brief

    gains: Gains
    margins: Margins
    robustness: Robustness
    stand: Stand
    frequencies: tuple[float, ...]
    signals: tuple[str, ...]
    middle: float
    amplitude: float
    rise: float
    rms: FloatArray
    largest: FloatArray
    limited: FloatArray
    standing: Standing = field(default_factory=Standing)

    @property
    def best(self) -> FloatArray:
        """Share of the draws in which PID with feed-forward has less rms error than either alone.

        (frequencies, signals).
        """
        alone = np.minimum(self.rms[1], self.rms[2])
        share: FloatArray = np.mean(self.rms[3] < alone, axis=-1)
        return share

    def rows(self) -> list[dict[str, Any]]:
        """Return the table: a row for each signal, frequency and controller."""
        return [
            {
                "signal": signal,
                "frequency_Hz": frequency,
                "controller": controller,
                **_of("rms_um", self.rms[c, f, s]),
                **_of("largest_um", self.largest[c, f, s]),
                "limited": float(np.mean(self.limited[c, f, s])),
            }
            for s, signal in enumerate(self.signals)
            for f, frequency in enumerate(self.frequencies)
            for c, controller in enumerate(CONTROLLERS)
        ]

    def to_pandas(self) -> Any:
        """Return the table as a pandas.DataFrame."""
        import pandas as pd  # noqa: PLC0415  # slow to load, and only needed here

        return pd.DataFrame(self.rows())

    def numbers(self) -> dict[str, Any]:
        """Return all of it for a summary, with units in the names."""
        gains, margins, stand = self.gains, self.margins, self.stand
        return {
            "validation": self.standing.numbers,
            "controller": {
                "proportional_V_per_um": gains.proportional,
                "integral_V_per_um_s": gains.integral,
                "derivative_V_s_per_um": gains.derivative,
                "steps_V_per_um": list(gains.steps),
                "interval_s": gains.interval,
                "delay_samples": stand.delay,
            },
            "robustness": {
                "gain_margin_asked": self.robustness.gain,
                "phase_margin_asked_deg": self.robustness.phase,
                "gain_margin_least": float(margins.gain.min()),
                "phase_margin_least_deg": float(margins.phase.min()),
                "crossover_Hz": [float(margins.crossover.min()), float(margins.crossover.max())],
                "circle_criterion_least": float(margins.circle.min()),
                "largest_pole": float(margins.pole.max()),
                "stable": margins.stable,
                "draws": int(margins.gain.size),
            },
            "reference": {
                "middle_um": self.middle,
                "amplitude_um": self.amplitude,
                "rise_s": self.rise,
                "limits_V": list(stand.limits),
            },
            "draws": int(self.rms.shape[-1]),
            "best_share": [
                {"signal": signal, "frequency_Hz": frequency, "share": float(self.best[f, s])}
                for s, signal in enumerate(self.signals)
                for f, frequency in enumerate(self.frequencies)
            ],
            "table": self.rows(),
        }


def _of(name: str, values: FloatArray) -> dict[str, float]:
    """Return mean and 95 % interval over the draws."""
    low, high = np.quantile(values, [0.025, 0.975])
    return {name: float(values.mean()), f"{name}_low": float(low), f"{name}_high": float(high)}


def track(
    actuator: Actuator,
    theta: FloatArray,
    noise: LoopNoise,
    stand: Stand,
    wishes: Wishes,
    generator: np.random.Generator,
    every: FloatArray | None = None,
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
    wishes
        What is to be followed, and how safely.
    generator
        Source of discrepancy and sensor noise.
    every
        (draws, parameters): all draws that the controller must be stable with, and whose mean is
        the model; by default those that are simulated.

    Raises
    ------
    InputError
        A model that has no step or no inverse, margins that cannot be had, frequencies that are too
        fast or too slow, or an amplitude that is out of reach.
    """
    every = theta if every is None else every
    mean = SampledModel.of(actuator, every.mean(axis=0)[np.newaxis])
    draws = SampledModel.of(actuator, every)
    limits = stand.limits
    require_inverse(mean, limits)
    frequencies = _frequencies(mean, wishes.frequencies)
    ends = _reach(mean, limits)
    amplitude = _amplitude(wishes.amplitude, ends)
    # A range about zero needs no way to its middle.
    middle = ends.middle if abs(ends.middle) > ROUND * amplitude else 0.0
    rise = _rise(mean)
    gains, kept = design(mean, draws, limits, stand.delay, wishes.robustness)

    names = tuple(SHAPES)
    rows = SampledModel.of(actuator, np.tile(theta, (len(CONTROLLERS) * len(names), 1)))
    references = [
        reference(frequency, actuator.interval, middle, amplitude, rise)
        for frequency in frequencies
    ]
    models = SampledModel.of(
        actuator, np.tile(every.mean(axis=0), (len(frequencies) * len(names), 1))
    )
    fed = _fed(models, [desired for desired, _ in references], stand)
    followed: list[TrackingErrors] = []
    for (desired, begins), (command, reached) in zip(references, fed, strict=True):
        plan = _plan(desired, begins, command, reached, ends, limits)
        followed.append(follow(plan, gains, rows, noise, stand, generator))
    rms, largest, limited = (np.stack(part, axis=1) for part in zip(*followed, strict=True))
    return Tracking(
        gains,
        kept,
        wishes.robustness,
        stand,
        frequencies,
        names,
        middle,
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
    longest = max(one.shape[1] for one in references)
    desired = np.vstack(
        [np.pad(one, ((0, 0), (0, longest - one.shape[1])), mode="edge") for one in references]
    )
    command, reached = np.zeros_like(desired), np.zeros_like(desired)
    state = model.begin(np.zeros(model.models))
    last, close = np.zeros(model.models), CLOSE * stand.amplifier.step
    for t in range(longest - 1):
        reached[:, t] = model.displacement(state)
        guess = 2 * state.voltage - last
        last = state.voltage
        command[:, t], state = model.inverse(state, desired[:, t + 1], stand.limits, guess, close)
    reached[:, -1], command[:, -1] = model.displacement(state), state.voltage
    ends = np.cumsum([one.shape[0] for one in references])[:-1]
    parts = zip(references, np.split(command, ends), np.split(reached, ends), strict=True)
    return [(fed[:, : one.shape[1]], gone[:, : one.shape[1]]) for one, fed, gone in parts]


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
    memory = mean.step.demagnetised()
    ends = []
    for voltage in (0.0, limits.high, limits.low, limits.high, limits.low):
        w, _, memory = mean.drive(memory, np.array([voltage]))
        ends.append(float(w[0]))
    return Span(ends[4] - ends[0], ends[3] - ends[0])


def _amplitude(given: float | None, ends: Span) -> float:
    """Return the references' amplitude, um."""
    if given is None:
        return PART * ends.half
    if not 0 < given <= ends.half:
        raise InputError(
            f"amplitude: {given:g} um; give one above 0 and within the mean model's reach, which "
            f"is {ends.half:.3g} um about {ends.middle:.3g} um"
        )
    return given


def _rise(mean: SampledModel) -> int:
    """Return how many samples a jump of a reference is to take.

    A lag τ needs w = x + τ x′. A jump by two amplitudes that takes four times τ, with a speed that
    is a Hann window, stays within the reach that the amplitude is 80 % of.
    """
    turns = np.geomspace(1e-4, np.pi, 400)
    left = np.abs(frequency_response(mean.sections, turns))[0]
    slow = turns[left < LEFT]
    return max(round(4 / float(slow[0])), 1) if slow.size else 1


def _frequencies(mean: SampledModel, given: Sequence[float] | None) -> tuple[float, ...]:
    """Return the frequencies, Hz."""
    interval = mean.actuator.interval
    fastest = 1 / (PER_PERIOD * interval)
    if given is not None:
        for one in given:
            slowest = 3 / (MOST_SAMPLES * interval)
            if not slowest <= one <= fastest:
                raise InputError(
                    f"frequencies: {one:g} Hz; at this rate give some from {slowest:.3g} to "
                    f"{fastest:.3g} Hz"
                )
        if not given:
            raise InputError("frequencies: none is given; give some in Hz")
        return tuple(given)
    chosen: list[float] = []
    for decade in range(math.floor(math.log10(SLOWEST)), math.ceil(math.log10(fastest)) + 1):
        for digit in DECADE:
            one = round(digit * 10.0**decade, 12)
            if one > fastest:
                return tuple(chosen)
            chosen.append(one)
            left = np.abs(frequency_response(mean.sections, np.array([2 * np.pi * one * interval])))
            if left[0, 0] < LEFT:
                return tuple(chosen)
    return tuple(chosen)
