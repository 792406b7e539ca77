"""Linear dynamics and creep between the drive w = d u − h and the displacement x, exact.

Equation (7) of the paper divided by its stiffness, (m/k) x″ + (b/k) x′ + x = w, and as the smaller
alternative one first-order lag, τ x′ + x = w. Both become a recursion on the samples that is exact
for a drive that is held (zero-order, what a DAC does) or goes in straight lines between samples
(first-order, for a measured voltage), and that knows what free responses its unknown start can add.
No step is too long and no pole too fast.

The coefficients are divided differences of the exponential, exp[0, z₁, z₂] and exp[0, 0, z₁, z₂]
with z = pole x interval: written so, equal and nearly equal poles are not special.

A piezo actuator's creep is nearly linear in the drive and in the logarithm of the time: after a
step it grows by about a percent of it per decade. A sum of first-order lags with log-spaced times
does just that, one lag per decade here, each with a strength of its own; equal strengths c give
c log₁₀(t) between the shortest and the longest of the times. The lags stand beside the dynamics,
not behind them: their times are so much longer that the order does not show.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from functools import reduce
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
import scipy
from numpy.typing import NDArray

from bwbayes.arrays import FloatArray
from bwbayes.errors import InputError
from bwbayes.model.declaration import Context, Declaration, Distribution, Values, lognormal, normal
from bwbayes.model.inputs import UNIT, Hold, Span

ComplexArray = NDArray[np.complex128]

# 20 terms of a series in |z| < 1 with factorials below: the rest is under 1e-19.
SERIES_TERMS = 20


@dataclass(frozen=True)
class Recursion:
    """x[t] = Σ numerator[i] w[t−i] − Σ denominator[i] x[t−i], for a batch of models.

    ``numerator`` and ``denominator`` are (models, taps), ``denominator[:, 0]`` is one, and the
    static gain is one. ``free`` (models, unknowns, taps − 1) holds the filter's states that answer
    to a unit of each thing unknown of the dynamics at the first sample: how far the displacement
    is from rest, and how fast it moves, in units of the natural frequency. Without a drive they
    give the free responses.
    """

    numerator: FloatArray
    denominator: FloatArray
    free: FloatArray

    def __post_init__(self) -> None:
        # Numbers that decay within a sample to nearly subnormal ones are set to zero: a processor
        # takes ten times as long with them.
        for taps in (self.numerator, self.denominator, self.free):
            taps[np.abs(taps) < 1e-200] = 0.0

    @property
    def unknowns(self) -> int:
        """How many numbers say in which state the dynamics are."""
        return int(self.free.shape[1])

    def at_rest(self) -> FloatArray:
        """Return the state (models, taps - 1) of a filter at rest at zero."""
        return np.zeros((self.numerator.shape[0], self.numerator.shape[1] - 1))

    def run(self, drive: FloatArray, state: FloatArray) -> FloatArray:
        """Filter ``drive`` (models, samples) in place from ``state``, which moves on with it.

        There is a sample at least.
        """
        if self.numerator.shape[1] == 1:
            return drive  # with a static gain of one, nothing is left to filter
        for row, values in enumerate(drive):
            values[:], state[row] = scipy.signal.lfilter(
                self.numerator[row], self.denominator[row], values, zi=state[row]
            )
        return drive

    def free_responses(self, samples: int) -> FloatArray:
        """Displacement (models, unknowns, samples) after a unit of each, without a drive."""
        models, unknowns, _ = self.free.shape
        responses = np.zeros((models, unknowns, samples))
        for unknown in range(unknowns):
            state, first, size = self.free[:, unknown].copy(), 0, 512
            # States below 10⁻¹⁸ of a unit add nothing to a reading.
            while first < samples and np.any(np.abs(state) > 1e-18):
                self.run(responses[:, unknown, first : first + size], state)
                first, size = first + size, 2 * size
        return responses


class Taps(NamedTuple):
    """Taps (models, sections, 3) and gains (models, sections) of recursions side by side.

    The first is that of the dynamics, the others are the lags of the creep.
    """

    numerator: FloatArray
    denominator: FloatArray
    gains: FloatArray


@dataclass(frozen=True)
class Sections:
    """Recursions side by side: x = Σ Fᵢ[gainᵢ wᵢ], for a batch of models.

    ``gains`` (models,) belong to the ``recursions``, of which each has a drive wᵢ of its own.
    Unknown of the start is what is unknown of each recursion, in their order: what it still moves
    by itself, um, whatever its gain.
    """

    recursions: tuple[Recursion, ...]
    gains: tuple[FloatArray, ...]

    @property
    def taps(self) -> Taps:
        """The taps of all recursions."""
        taps = np.zeros((2, self.gains[0].size, len(self.gains), 3))
        for number, recursion in enumerate(self.recursions):
            taps[0, :, number, : recursion.numerator.shape[1]] = recursion.numerator
            taps[1, :, number, : recursion.denominator.shape[1]] = recursion.denominator
        return Taps(taps[0], taps[1], np.stack(self.gains, axis=1))

    @property
    def zeros(self) -> ComplexArray:
        """Zeros (any,) from one drive to x, of all models: the inverse has them for poles."""
        zeros = []
        for tops, bottoms, gains in zip(*self.taps, strict=True):
            total = np.zeros(1)
            for number, top in enumerate(tops):
                others = np.delete(bottoms, number, axis=0)
                total = np.polyadd(total, reduce(np.polymul, others, gains[number] * top))
            zeros.append(np.roots(total))
        return np.concatenate(zeros).astype(np.complex128)

    def begin(self, initial_transient: FloatArray | None) -> tuple[FloatArray, ...]:
        """Return the states of sections with an ``initial_transient`` (models, unknowns)."""
        if initial_transient is None or not initial_transient.size:
            return tuple(recursion.at_rest() for recursion in self.recursions)
        ends = np.cumsum([recursion.unknowns for recursion in self.recursions])[:-1]
        parts = np.split(initial_transient, ends, axis=1)
        return tuple(
            np.einsum("mu,mut->mt", state, recursion.free)
            for state, recursion in zip(parts, self.recursions, strict=True)
        )

    def run(self, drives: Sequence[FloatArray], states: Sequence[FloatArray]) -> FloatArray:
        """Filter ``drives`` (models, samples) in place from states, which move on; return x."""
        parts = zip(self.recursions, self.gains, drives, states, strict=True)
        result: FloatArray | None = None
        for recursion, gain, drive, state in parts:
            if np.any(gain != 1.0):
                np.multiply(drive, gain[:, np.newaxis], out=drive)
            moved = recursion.run(drive, state)
            result = moved if result is None else np.add(result, moved, out=result)
        assert result is not None
        return result

    def free_responses(self, samples: int) -> FloatArray:
        """Displacement (models, unknowns, samples) after a unit of each, without a drive."""
        responses = [recursion.free_responses(samples) for recursion in self.recursions]
        return np.concatenate(responses, axis=1)


def first_order_lag(lag: FloatArray, interval: float, hold: Hold) -> Recursion:
    """Return the recursion of τ x′ + x = w.

    Parameters
    ----------
    lag
        τ, (models,), s, not negative; zero means no lag (with ``hold="zero"``: that of the hold,
        because a sample is taken just before the held drive changes).
    interval
        Sampling interval, s.
    hold
        Course of the drive between samples.
    """
    with np.errstate(divide="ignore", over="ignore"):
        z = -interval / lag
    decay = np.exp(z)
    now = -_z_phi_2(z) if hold == "first" else np.zeros_like(z)
    numerator = np.stack([now, -np.expm1(z) - now], axis=1)
    unit = np.ones_like(decay)
    return Recursion(numerator, np.stack([unit, -decay], axis=1), unit[:, np.newaxis, np.newaxis])


def second_order(
    mass: FloatArray, damping: FloatArray, stiffness: FloatArray, interval: float, hold: Hold
) -> Recursion:
    """Return the recursion of (m/k) x″ + (b/k) x′ + x = w, equation (7) of the paper.

    The two poles are put in a row, x₁′ = λ₁ (x₁ − w) and x₂′ = λ₂ (x₂ − x₁), whose exact transition
    over an interval has divided differences of exp as its entries; eliminating x₁ leaves a
    recursion for the displacement x₂ with real coefficients, whether the poles are real, equal or
    complex.

    Parameters
    ----------
    mass, damping, stiffness
        (models,), kg, N s/m, N/m; mass and stiffness positive, damping not negative.
    interval
        Sampling interval, s.
    hold
        Course of the drive between samples.
    """
    decay = damping / (2 * mass)
    natural = np.sqrt(stiffness / mass)
    root: ComplexArray = np.sqrt((decay - natural) * (decay + natural) + 0j)
    fast = -(decay + root) * interval
    # The slow pole from the product of both: their difference would cancel.
    slow = (natural * interval) ** 2 / fast
    divided, step, ramp = _divided_differences(slow, fast)

    e_slow, coupling, product = np.exp(slow), -fast * divided, slow * fast
    if hold == "first":
        new_1, new_2 = -_z_phi_2(slow), product * ramp
    else:
        new_1, new_2 = np.zeros_like(slow), np.zeros_like(slow)
    old_1, old_2 = -np.expm1(slow) - new_1, product * step - new_2
    numerator = [
        new_2,
        old_2 + coupling * new_1 - e_slow * new_2,
        coupling * old_1 - e_slow * old_2,
    ]
    # Both are sums over a conjugate pair or over real numbers: the imaginary part is rounding.
    denominator = [np.ones_like(slow), -(e_slow + np.exp(fast)), np.exp(slow + fast)]
    backward = np.stack(denominator, axis=1).real
    # The first two samples of the free responses: of a unit of displacement, and of speed.
    first = np.stack([np.ones_like(natural), np.zeros_like(natural)], axis=1)
    second = np.stack([e_slow - slow * divided, natural * interval * divided], axis=1).real
    free = np.stack([first, second + backward[:, 1:2] * first], axis=2)
    return Recursion(np.stack(numerator, axis=1).real, backward, free)


def _divided_differences(
    slow: ComplexArray, fast: ComplexArray
) -> tuple[ComplexArray, ComplexArray, ComplexArray]:
    """Return exp[z₁, z₂], exp[0, z₁, z₂] and exp[0, 0, z₁, z₂] for |z₁| ≤ |z₂|, Re z ≤ 0.

    Near zero the last two are summed, Σ h_m/(m+2)! and Σ h_m/(m+3)!, with the complete homogeneous
    polynomials h_m = (z₁ + z₂) h_{m−1} − z₁ z₂ h_{m−2}.
    """
    difference = np.exp(slow) * _phi_1(fast - slow)
    near = np.abs(fast) < 1
    gap = np.where(near, 1, fast)
    step = (difference - _phi_1(slow)) / gap
    ramp = (step - _z_phi_2(slow) / np.where(slow == 0, 1, slow)) / gap
    z_1, z_2 = np.where(near, slow, 0), np.where(near, fast, 0)
    before, polynomial = np.zeros_like(z_1), np.ones_like(z_1)
    near_step, near_ramp, factorial = np.zeros_like(z_1), np.zeros_like(z_1), 2.0
    for term in range(SERIES_TERMS):
        near_step += polynomial / factorial
        factorial *= term + 3
        near_ramp += polynomial / factorial
        before, polynomial = polynomial, (z_1 + z_2) * polynomial - z_1 * z_2 * before
    return difference, np.where(near, near_step, step), np.where(near, near_ramp, ramp)


def _phi_1(z: NDArray[Any]) -> NDArray[Any]:
    """(exp(z) − 1) / z, one at zero."""
    safe = np.where(z == 0, 1, z)
    return np.where(z == 0, 1, np.expm1(safe) / safe)


def _z_phi_2(z: NDArray[Any]) -> NDArray[Any]:
    """(exp(z) − 1 − z) / z, zero at zero; −1 for z = −∞."""
    near = np.abs(z) < 1
    inside = np.where(near, z, 0)
    series, term = np.zeros_like(inside), np.ones_like(inside)
    for order in range(2, SERIES_TERMS):
        term = term * inside / order
        series = series + term
    outside = np.where(near, 1, z)
    return np.where(near, series, np.expm1(outside) / outside - 1)


# A part of T: drives are mostly slow for the actuator. The prior is wide, because the lag does not
# follow the drive.
LAG, LAG_SIGMA = 0.005, 2.3


class Filter(ABC):
    """Linear dynamics, exact for a drive that is held or goes straight between samples."""

    @property
    @abstractmethod
    def parameters(self) -> tuple[Declaration, ...]:
        """Its parameters."""

    def unknowns(self, hold: Hold) -> int:
        """Return how many numbers say in which state it is at a record's first sample."""
        values = {parameter.name: np.ones(1) for parameter in self.parameters}
        return self.recursion(values, 1, 1.0, hold).unknowns

    @abstractmethod
    def recursion(self, column: Values, models: int, interval: float, hold: Hold) -> Recursion:
        """Return the recursion of a number of ``models`` with these columns (models,)."""


@dataclass(frozen=True)
class NoDynamics(Filter):
    """No dynamics, x = w: the displacement follows the drive at once, or with the hold."""

    parameters: tuple[Declaration, ...] = ()

    def recursion(self, column: Values, models: int, interval: float, hold: Hold) -> Recursion:  # noqa: ARG002  # no parameters
        """Return x = w: all that is left is the hold.

        A drive that is held changes just after the sample, so the displacement follows one sample
        later: the limit of a lag that goes to zero.
        """
        if hold == "zero":
            return first_order_lag(np.zeros(models), interval, hold)
        unity = np.ones((models, 1))
        return Recursion(unity, unity, np.empty((models, 0, 0)))


@dataclass(frozen=True)
class Lag(Filter):
    """One first-order lag, τ x′ + x = w."""

    parameters: tuple[Declaration, ...] = (
        Declaration(
            "lag",
            "s",
            r"\tau_\mathrm{lag}",
            "time constant of the first-order lag",
            lambda context: lognormal(LAG * context.ranges.time, LAG_SIGMA),
            floor=0.0,
            limit_at_floor=True,
            aliases=("tau", "time_constant"),
        ),
    )

    def recursion(self, column: Values, models: int, interval: float, hold: Hold) -> Recursion:  # noqa: ARG002  # the column has them
        """Return that of :func:`~bwbayes.model.linear.first_order_lag`."""
        return first_order_lag(column["lag"], interval, hold)


def _damping(context: Context) -> Distribution | None:
    """Return the prior of the damping that gives such a lag, if the stiffness is known."""
    stiffness = context.value("stiffness")
    if stiffness is None:
        return None
    return lognormal(LAG * context.ranges.time * stiffness, LAG_SIGMA)


@dataclass(frozen=True)
class SecondOrder(Filter):
    """Equation (7) of the paper, (m/k) x″ + (b/k) x′ + x = w."""

    parameters: tuple[Declaration, ...] = tuple(
        Declaration(
            name,
            unit,
            label,
            description,
            default,
            floor=0.0,
            limit_at_floor=name == "damping",
            aliases=(label,),
            without_default="a record shows mass and stiffness only through the damping",
        )
        for name, unit, label, description, default in (
            ("mass", "kg", "m", "effective mass", lambda _: None),
            ("damping", "N s/m", "b", "effective damping", _damping),
            ("stiffness", "N/m", "k", "mechanical stiffness", lambda _: None),
        )
    )

    def recursion(self, column: Values, models: int, interval: float, hold: Hold) -> Recursion:  # noqa: ARG002  # the columns have them
        """Return that of :func:`~bwbayes.model.linear.second_order`."""
        return second_order(column["mass"], column["damping"], column["stiffness"], interval, hold)


# Times that a model may have.
MOST_TIMES = 8


@dataclass(frozen=True)
class Creep:
    """Creep: slow lags beside the dynamics, one for each of the given times.

    Creep adds to the output of the dynamics, driven by w in um,

        x_creep = Σ cᵢ Lᵢ,   Tᵢ Lᵢ′ + Lᵢ = w (1 + κ |u| / U),

    with strengths cᵢ and κ without unit, times Tᵢ in s, and U the largest voltage.

    Parameters
    ----------
    times
        Tᵢ, s, rising.
    growing
        Whether the creep grows with the voltage by κ.
    reference
        The range of the voltage that κ is for: that of the record that is fitted.

    Raises
    ------
    InputError
        Times that are not positive and rising, none or too many.
    """

    times: tuple[float, ...]
    growing: bool = False
    reference: Span = UNIT

    def __post_init__(self) -> None:
        rising = all(earlier < later for earlier, later in pairwise((0.0, *self.times)))
        if not rising or not 0 < len(self.times) <= MOST_TIMES or not math.isfinite(self.times[-1]):
            raise InputError(
                f"creep: {list(self.times)} are not valid times; give up to {MOST_TIMES} positive "
                "ones in s that rise, or true"
            )

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the strengths."""
        return tuple(f"creep_{number}" for number in range(1, len(self.times) + 1))

    @property
    def parameters(self) -> tuple[Declaration, ...]:
        """The strengths cᵢ, and κ if the creep grows with the voltage."""
        strengths = tuple(
            Declaration(
                name,
                "-",
                rf"c_{number}",
                f"creep with a time of {time:g} s, as a part of the drive",
                lambda _: self.strength,
            )
            for number, (name, time) in enumerate(zip(self.names, self.times, strict=True), 1)
        )
        if not self.growing:
            return strengths
        growth = Declaration(
            "creep_growth",
            "-",
            r"\kappa",
            "growth of the creep from no voltage to the largest, as a part of it",
            lambda _: Distribution("halfnormal", {"scale": 1.0}),
            floor=0.0,
            limit_at_floor=True,
        )
        return (*strengths, growth)

    @property
    def strength(self) -> Distribution:
        """The default prior of each strength, by how many decades of time a lag stands for."""
        decades = 1.0
        if len(self.times) > 1:
            decades = math.log10(self.times[-1] / self.times[0]) / (len(self.times) - 1)
        # Published are 0.5 to 3% a decade. A normal prior, of which one in twenty-five is below
        # zero: strengths are linear in the displacement, and so their posterior is nearly normal.
        return normal(0.0175 * decades, 0.01 * decades)

    def reach(self, column: Values) -> FloatArray:
        """Return how much of a drive each lag may have kept from before a record, (models, lags).

        √(cᵢ² + c²) with a published strength c. Were it cᵢ alone, a strength next to zero would
        stand for a known start: the posterior would have a narrow ridge there, and the start be
        taken for a measurement of the strengths. A model without any creep has kept nothing.
        """
        strengths = np.stack([column[name] for name in self.names], axis=1)
        creeps = np.any(strengths != 0.0, axis=1, keepdims=True)
        return creeps * np.hypot(strengths, self.strength.arguments["mean"])

    def drive(self, column: Values, drive: FloatArray, voltage: FloatArray) -> FloatArray:
        """Return what creeps, w (1 + κ |u| / U) (models, samples), um, as a new array."""
        if not self.growing:
            return drive.copy()
        size = self.size(voltage)
        crept: FloatArray = drive * (1 + column["creep_growth"][:, np.newaxis] * size)
        return crept

    def size(self, voltage: FloatArray) -> FloatArray:
        """Return |u| / U (samples,), with U the largest voltage of the reference."""
        largest = max(abs(self.reference.low), abs(self.reference.high))
        return np.abs(voltage) / largest if largest > 0 else np.zeros_like(voltage)

    def recursions(self, models: int, interval: float, hold: Hold) -> tuple[Recursion, ...]:
        """Return the lags Lᵢ, the same for all of a number of models."""
        return tuple(first_order_lag(np.full(models, time), interval, hold) for time in self.times)


def creep_times(interval: float, duration: float) -> Sequence[float]:
    """Return powers of ten in s, from ten samples to three lengths of a record.

    At least one: that next to the record's length.
    """
    first = math.ceil(math.log10(10 * interval))
    last = max(math.floor(math.log10(3 * duration)), first)
    return [10.0**power for power in range(max(first, last - MOST_TIMES + 1), last + 1)]
