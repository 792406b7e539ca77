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
from bwbayes.control.discrete import frequency_response
from bwbayes.control.sampled import SampledModel
from bwbayes.errors import InputError
from bwbayes.model.operator import Span
from bwbayes.shown import brief

__all__ = ["Gains", "Margins", "Robustness", "design", "margins"]

# Angles per sample, rad, at which a loop is looked at, and the slowest of them.
ANGLES, SLOWEST = 1500, 1e-5

# The search for the fastest controller ends when it is known to this part.
PRECISION = 1e-3


@dataclass(frozen=True)
class Robustness:
    """What every draw must keep: a gain margin, and a phase margin in degrees.

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
    the circle criterion holds; ``pole`` is the largest of the closed loop at its steepest slope,
    below one if it is stable.
    """

    __repr__ = brief

    gain: FloatArray
    phase: FloatArray
    crossover: FloatArray
    circle: FloatArray
    pole: FloatArray

    @property
    def stable(self) -> bool:
        """Whether all draws are stable, however the hysteresis' slope changes."""
        return bool(np.all(self.circle > 0) and np.all(self.pole < 1))


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
    lowest = draws.slopes(limits)[0]
    if not lowest.min() > 0:
        raise InputError(
            f"track: some draws have slopes as low as {lowest.min():.3g} um/V, at which no "
            "controller is stable; narrow the limits"
        )
    poles = mean.sections.denominator[0, 0]
    shape = poles / poles.sum()

    def gains_of(speed: float) -> Gains:
        first, second, third = (speed * shape).tolist()
        return Gains((first, second, third), mean.actuator.interval)

    # An integrator of this speed is at its limit on the steepest slope, whatever the dynamics.
    high = 2.0 / float(draws.slopes(limits)[1].max())
    low = 1e-6 * high
    robust = _keeps(margins(gains_of(low), draws, limits, delay, poles=False), required)
    if not robust:
        raise InputError(
            f"track: no controller of this kind keeps a gain margin of {required.gain:g} and a "
            f"phase margin of {required.phase:g} degrees with all draws; ask for less, or sample "
            "faster"
        )
    while high / low > 1 + PRECISION:
        trial = math.sqrt(low * high)
        robust = _keeps(margins(gains_of(trial), draws, limits, delay, poles=False), required)
        low, high = (trial, high) if robust else (low, trial)
    gains = gains_of(low)
    result = margins(gains, draws, limits, delay)
    if not result.stable:
        raise InputError(
            "track: some draws are unstable with the margins that were asked for; ask for more"
        )
    return gains, result


def _keeps(result: Margins, required: Robustness) -> bool:
    satisfied = (
        (result.gain >= required.gain) & (result.phase >= required.phase) & (result.circle > 0)
    )
    return bool(np.all(satisfied))


def margins(
    gains: Gains, draws: SampledModel, limits: Span, delay: int, *, poles: bool = True
) -> Margins:
    """Return the margins of every draw; without ``poles`` those are left at zero.

    The loop is L = k C(z) z^−delay P(z) with a slope k of the hysteresis, the linear part P and
    C = (q₀ + q₁/z + q₂/z²) / (1 − 1/z).
    """
    turns = np.geomspace(SLOWEST, np.pi, ANGLES)
    back = np.exp(-1j * turns)
    controller = np.polyval(gains.steps[::-1], back) / (1 - back) * back**delay
    loop = controller * frequency_response(draws.sections, turns)
    smallest, largest = (slope[:, np.newaxis] for slope in draws.slopes(limits))
    size = np.abs(loop)
    with np.errstate(divide="ignore"):
        log_size = np.log(size)
    angle = np.angle(-loop)
    turned = np.angle(loop[:, 1:] / loop[:, :-1])
    # Where the loop is real and negative; at the end it is real but for rounding.
    real = (loop.real[:, :-1] < 0) & (loop.imag[:, :-1] * loop.imag[:, 1:] <= 0)
    with np.errstate(divide="ignore", invalid="ignore"):
        fraction = np.clip(np.nan_to_num(-angle[:, :-1] / turned), 0.0, 1.0)
        log_real = log_size[:, :-1] + fraction * np.diff(log_size, axis=1)
    worst = np.max(np.where(real, np.exp(log_real), 0.0), axis=1)
    worst = np.maximum(worst, np.where(loop.real[:, -1] < 0, size[:, -1], 0.0))
    with np.errstate(divide="ignore"):
        gain = 1 / (largest[:, 0] * worst)
    # Where it has the size one at some slope: the lag is least at one of these frequencies, which
    # are those in between and, on straight lines from angle to angle, the two ends.
    between = (size * largest >= 1) & (size * smallest <= 1)
    lag = np.min(np.where(between, np.abs(angle), np.pi), axis=1)
    for slope in (smallest, largest):
        level = log_size + np.log(slope)
        crossed = (level[:, :-1] >= 0) != (level[:, 1:] >= 0)
        with np.errstate(divide="ignore", invalid="ignore"):
            fraction = level[:, :-1] / (level[:, :-1] - level[:, 1:])
        at_one = np.abs(angle[:, :-1] + fraction * turned)
        lag = np.minimum(lag, np.min(np.where(crossed, at_one, np.pi), axis=1))
    phase = np.degrees(lag)
    phase = np.where(gain < 1, -phase, phase)
    circle = np.min(((1 + largest * loop) * np.conj(1 + smallest * loop)).real, axis=1)
    above = size * largest >= 1
    last = turns[np.maximum(ANGLES - 1 - np.argmax(above[:, ::-1], axis=1), 0)]
    crossover = np.where(above.any(axis=1), last, 0.0) / (2 * np.pi * gains.interval)
    pole = np.zeros(draws.models)
    if poles:
        for row in range(draws.models):
            pole[row] = _largest_pole(gains, draws, row, float(largest[row, 0]), delay)
    return Margins(gain, phase, crossover, circle, pole)


def _largest_pole(gains: Gains, draws: SampledModel, row: int, slope: float, delay: int) -> float:
    """Return the largest pole of the closed loop at one slope."""
    top, bottom = np.zeros(1), np.ones(1)
    sections = draws.sections
    for number, gain in enumerate(sections.gains[row]):
        above, below = gain * sections.numerator[row, number], sections.denominator[row, number]
        top = _sum(np.convolve(top, below), np.convolve(above, bottom))
        bottom = np.convolve(bottom, below)
    opened = np.convolve(bottom, [1.0, -1.0])
    fed = slope * np.convolve(np.convolve(top, gains.steps), np.eye(1, delay + 1, delay)[0])
    roots = np.roots(_sum(opened, fed))
    return float(np.max(np.abs(roots), initial=0.0))


def _sum(first: FloatArray, second: FloatArray) -> FloatArray:
    """Add polynomials in 1/z."""
    longest = max(first.size, second.size)
    return np.pad(first, (0, longest - first.size)) + np.pad(second, (0, longest - second.size))
