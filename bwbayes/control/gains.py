"""Gains of a PID controller that keep a stated distance from instability for every draw.

The controller has the form that a computer runs,

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
from dataclasses import dataclass

import numpy as np

from bwbayes.arrays import FloatArray
from bwbayes.control.sampled import SampledModel
from bwbayes.errors import InputError
from bwbayes.model.operator import Span
from bwbayes.shown import brief

# Where loops are looked at, rad per sample.
ANGLES: FloatArray = np.geomspace(1e-5, np.pi, 1500)


@dataclass(frozen=True)
class Robustness:
    """Margins that every draw must keep: a gain margin, and a phase margin in degrees.

    Raises
    ------
    InputError
        A gain margin of 1 or less, or a phase margin outside 0 to 90 degrees.
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

    Parameters
    ----------
    mean
        The one model whose poles the controller cancels.
    draws
        The models that must be stable.
    limits
        The voltages that may occur, V.
    delay
        Whole samples from a reading to the command that answers it.
    required
        The margins.

    Raises
    ------
    InputError
        No controller of this kind has them.
    """
    slopes = draws.slopes(limits)
    if not slopes[0].min() > 0:
        raise InputError(
            f"track: some draws have slopes as low as {slopes[0].min():.3g} um/V, at which no "
            "controller is stable; narrow the limits"
        )
    poles = mean.sections.denominator[0, 0]

    response = draws.frequency_response(ANGLES)

    def try_speed(speed: float) -> tuple[Gains, Margins]:
        first, second, third = (speed * poles / poles.sum()).tolist()
        gains = Gains((first, second, third), mean.actuator.interval)
        return gains, margins(gains, response, slopes, delay)

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


def margins(
    gains: Gains, response: FloatArray, slopes: tuple[FloatArray, FloatArray], delay: int
) -> Margins:
    """Return the margins of draws with a response (draws, angles) and bounds of the slope (draws,).

    The loop is L = k C(z) z^−delay P(z) with a slope k of the hysteresis, the linear part P and
    C = (q₀ + q₁/z + q₂/z²) / (1 − 1/z). It is looked at on a grid of angles per sample, rad, and
    taken to go straight, in log size and angle, from one to the next.
    """
    back = np.exp(-1j * ANGLES)
    controller = np.polyval(gains.steps[::-1], back) / (1 - back) * back**delay
    loop = controller * response
    smallest, largest = (slope[:, np.newaxis] for slope in slopes)
    size, lag = np.abs(loop), np.angle(-loop)
    with np.errstate(divide="ignore"):
        log_size = np.log(size)
    turned = np.angle(loop[:, 1:] / loop[:, :-1])
    # Gain margin: where the loop is real and negative; at the end it is real but for rounding.
    real = (loop.real[:, :-1] < 0) & (loop.imag[:, :-1] * loop.imag[:, 1:] <= 0)
    with np.errstate(divide="ignore", invalid="ignore"):
        fraction = np.clip(np.nan_to_num(-lag[:, :-1] / turned), 0.0, 1.0)
        crossings = np.exp(log_size[:, :-1] + fraction * np.diff(log_size, axis=1))
    worst = np.max(np.where(real, crossings, 0.0), axis=1)
    worst = np.maximum(worst, np.where(loop.real[:, -1] < 0, size[:, -1], 0.0))
    with np.errstate(divide="ignore"):
        gain = 1 / (largest[:, 0] * worst)
    # Phase margin: where the size is one at some slope. The lag is least at one of these angles,
    # or at the two ends.
    between = (size * largest >= 1) & (size * smallest <= 1)
    smallest_lag = np.min(np.where(between, np.abs(lag), np.pi), axis=1)
    for slope in (smallest, largest):
        level = log_size + np.log(slope)
        crossed = (level[:, :-1] >= 0) != (level[:, 1:] >= 0)
        with np.errstate(divide="ignore", invalid="ignore"):
            fraction = level[:, :-1] / (level[:, :-1] - level[:, 1:])
        at_one = np.abs(lag[:, :-1] + fraction * turned)
        smallest_lag = np.minimum(smallest_lag, np.min(np.where(crossed, at_one, np.pi), axis=1))
    phase = np.degrees(np.where(gain < 1, -smallest_lag, smallest_lag))
    circle = np.min(((1 + largest * loop) * np.conj(1 + smallest * loop)).real, axis=1)
    above = size * largest >= 1
    last = ANGLES[::-1][np.argmax(above[:, ::-1], axis=1)]
    crossover = np.where(above.any(axis=1), last, 0.0) / (2 * np.pi * gains.interval)
    return Margins(gain, phase, crossover, circle)
