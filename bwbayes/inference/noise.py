"""The noises: white, with a rough or a smooth discrepancy, or with a sensor of another noise.

A sensor's noise may have heavy tails, or grow with the voltage's speed.
Or one's own by its import path. Each is a :class:`~bwbayes.inference.state_space.Noise` that says
how its discrepancy goes on.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from bwbayes.arrays import FloatArray
from bwbayes.inference.state_space import Noise
from bwbayes.model.declaration import Context, Declaration, Distribution, lognormal, round_to_scale
from bwbayes.model.registry import build_part


def _sensor_sd(context: Context) -> Distribution:
    """Return the default prior of the sensor's sd, above what its readings may be rounded by."""
    if rounding := round_to_scale(context.ranges.rounding):
        # Rounding may be all the noise there is; a model that misses some of it needs many times
        # that.
        return Distribution("lognorm", {"s": 4.0, "loc": rounding, "scale": rounding})
    usual = lognormal(0.006 * context.ranges.displacement, 2.0)
    if not (resolution := round_to_scale(context.ranges.resolution)):
        return usual
    scale, width = usual.arguments["median"], usual.arguments["sigma"]
    return Distribution("lognorm", {"s": width, "loc": resolution, "scale": scale})


SENSOR_SD = Declaration(
    "sensor_sd",
    "um",
    r"s",
    "sd of the sensor noise",
    _sensor_sd,
    floor=0.0,
    pressed={"lower": "record with a finer resolution; the readings show no noise but rounding"},
    aliases=("noise",),
)
DISCREPANCY_SD = Declaration(
    "discrepancy_sd",
    "um",
    r"\sigma",
    "sd of the model discrepancy",
    # Its order of magnitude is unknown. A prior that is level down to zero would claim some
    # discrepancy where there is none, and make a right model's bands too wide.
    lambda context: lognormal(1e-5 * context.ranges.displacement, 4.0),
    floor=0.0,
    aliases=("sigma",),
)
DISCREPANCY_TIME = Declaration(
    "discrepancy_time",
    "s",
    r"\tau",
    "correlation time of the model discrepancy",
    lambda context: lognormal(0.5 * context.ranges.time, 0.8),
    floor=0.0,
)
# The integral over a time, by Gauss and Legendre, where the fast rate times it is below one.
NODES, WEIGHTS = np.polynomial.legendre.leggauss(8)


@dataclass(frozen=True)
class WhiteNoise(Noise):
    """Sensor noise alone, independent normal errors of sd s. Right only if the model is."""

    declarations: ClassVar[tuple[Declaration, ...]] = (SENSOR_SD,)
    observe: ClassVar = np.zeros(0)

    def stationary(self, theta: FloatArray) -> FloatArray:
        """Return the covariance of no state."""
        return np.zeros((len(theta), 0, 0))

    def transition(self, theta: FloatArray, readings: float | FloatArray = 1.0) -> FloatArray:
        """Return the transition of no state."""
        return np.zeros((len(theta), *np.shape(readings), 0, 0))

    def whiten(
        self,
        theta: FloatArray,
        series: FloatArray,
        skipped: FloatArray | None = None,
    ) -> tuple[FloatArray, FloatArray]:
        """Divide by the sensor's sd."""
        if self.tailed or self.paced:
            return super().whiten(theta, series, skipped)
        log_determinant: FloatArray = 2 * series.shape[2] * np.log(theta[:, 0])
        return series / theta[:, :1, np.newaxis], log_determinant

    def correlation_time(self, theta: FloatArray) -> FloatArray:
        """Zero."""
        return np.zeros(len(theta))


@dataclass(frozen=True)
class StudentNoise(WhiteNoise):
    """Sensor noise of a Student t distribution: now and then a reading is far off.

    Its density with ν degrees of freedom and the scale s is

        p(e) ∝ (1 + e²/(ν s²))^(−(ν + 1)/2),   ``sensor_tail`` = 1/ν.

    1/ν = 0 is the normal one, 1 Cauchy's. It has no sd at ν ≤ 2: ``sensor_sd`` is half the width
    that holds 68% of it, which is the sd of a normal one, and hardly depends on outliers. Beside a
    discrepancy, ``"discrepancy + student"``, an outlier is told from it by the readings around: see
    :mod:`~bwbayes.inference.heavy_tails`.

    Notes
    -----
    K. L. Lange, R. J. A. Little, J. M. G. Taylor, Robust statistical modeling using the t
    distribution, Journal of the American Statistical Association 84, 881-896 (1989),
    doi:10.1080/01621459.1989.10478852.
    """

    declarations: ClassVar = (
        SENSOR_SD,
        # Uniform, so that neither a normal distribution (0) nor a Cauchy (1) is far from anything.
        Declaration(
            "sensor_tail",
            "",
            r"1/\nu",
            "1 over the degrees of freedom of the sensor noise, 0 if it is normal",
            lambda _: Distribution("uniform", {"lower": 0.0, "upper": 1.0}),
            floor=0.0,
            pressed={"upper": "find out what spoils so many readings; a loose contact, a lost bit"},
        ),
    )
    tailed: ClassVar = True

    def inverse_df(self, theta: FloatArray) -> FloatArray:
        """Return 1/ν."""
        return theta[:, 1]


@dataclass(frozen=True)
class PacedNoise(WhiteNoise):
    """Sensor noise that grows with the speed v of the voltage: variance s² (1 + (v / v_s)²).

    As of readings whose times scatter, or of a sensor that is disturbed by the motion. Beside a
    discrepancy it is ``"discrepancy + paced"``.
    """

    declarations: ClassVar = (
        SENSOR_SD,
        Declaration(
            "sensor_speed",
            "V/s",
            "v_s",
            "speed of the voltage at which the sensor's noise has twice its variance at rest",
            # The mean speed of a triangle over the range; noise that does not grow lies far above.
            lambda context: lognormal(2 * context.ranges.voltage / context.ranges.time, 1.5),
            floor=0.0,
        ),
    )
    paced: ClassVar = True

    def sensor_variance(self, theta: FloatArray, speed: FloatArray) -> FloatArray:
        """Return s² (1 + (v / v_s)²)."""
        grown = 1 + np.square(speed / theta[:, 1:2])
        return np.asarray(theta[:, :1] ** 2 * grown)


@dataclass(frozen=True)
class DiscrepancyNoise(Noise):
    """A rough discrepancy, an Ornstein-Uhlenbeck process, which forgets exponentially.

    It claims the least of what a model misses: that two readings have less in common the farther
    they are apart, exp(−t/τ).

    Notes
    -----
    G. E. Uhlenbeck, L. S. Ornstein, On the theory of the Brownian motion, Physical Review 36,
    823-841 (1930), doi:10.1103/PhysRev.36.823.
    """

    declarations: ClassVar = (SENSOR_SD, DISCREPANCY_SD, DISCREPANCY_TIME)
    observe: ClassVar = np.ones(1)

    def stationary(self, theta: FloatArray) -> FloatArray:
        """Return σ²."""
        return theta[:, 1, np.newaxis, np.newaxis] ** 2

    def transition(self, theta: FloatArray, readings: float | FloatArray = 1.0) -> FloatArray:
        """Return exp(−t/τ)."""
        decay = np.exp(-np.multiply.outer(self.interval / theta[:, 2], readings))
        return decay[..., np.newaxis, np.newaxis]

    def process_covariance(self, theta: FloatArray, readings: float = 1.0) -> FloatArray:
        """Return σ² (1 − exp(−2t/τ))."""
        gained = -(theta[:, 1] ** 2) * np.expm1(-2 * readings * self.interval / theta[:, 2])
        return gained[:, np.newaxis, np.newaxis]

    def correlation_time(self, theta: FloatArray) -> FloatArray:
        """Return τ (models,), s."""
        return theta[:, 2]


# Below it is an Ornstein-Uhlenbeck process to rounding, and nothing can be divided by its square.
LEAST_QUALITY = 1e-9


@dataclass(frozen=True)
class SmoothNoise(Noise):
    """A smooth discrepancy, a driven oscillator: what a model misses of an actuator has no corners.

    An Ornstein-Uhlenbeck process is rough at every scale, so that at high sampling rates it takes
    slow misfit for something unlikely, and the answer depends on the rate. The process here has a
    quality Q besides:

        ẍ + (ω/Q) ẋ + ω² x = white noise,   ω = 1/(τ Q),   τ = ∫₀^∞ ρ(t) dt.

    Q = 1/2 is a Matérn process of order 3/2, 1/√2 the one whose spectrum is as level as can be up
    to its corner; for Q → 0 it becomes an Ornstein-Uhlenbeck process of the same σ and τ. The
    states are x and ẋ/ω. With the rates a ≤ b that solve λ² − λ ω/Q + ω² = 0, and
    S(t) = (e^(−a t) − e^(−b t))/(b − a):

        F(t) = [[e^(−a t) + a S,  ω S], [−ω S,  e^(−b t) − a S]].

    Notes
    -----
    As :class:`DiscrepancyNoise`; as a kernel in D. Foreman-Mackey, E. Agol, S. Ambikasaran,
    R. Angus, Fast and scalable Gaussian process modeling with applications to astronomical time
    series, The Astronomical Journal 154, 220 (2017), doi:10.3847/1538-3881/aa9332.
    """

    declarations: ClassVar = (
        *DiscrepancyNoise.declarations,
        # Up to 1/√2 the spectrum, ∝ 1/((ω² − ω₀²)² + ω² ω₀²/Q²), has no peak. A process that
        # resonates has hardly any power at low frequencies, so that a slow misfit would be taken
        # for the parameters'. Were 1/2 the most, low ones would be extrapolated from high ones, the
        # more the finer a record is sampled.
        Declaration(
            "discrepancy_quality",
            "",
            "Q",
            "quality of the model discrepancy, 0.5 for Matérn 3/2, less if it is rougher",
            lambda _: Distribution("uniform", {"lower": 0.0, "upper": math.sqrt(0.5)}),
            floor=0.0,
            pressed={"upper": "try other parts of the model; what it misses oscillates"},
        ),
    )
    observe: ClassVar = np.array([1.0, 0.0])

    def for_new_readings(self, theta: FloatArray, missed: Callable[[], float]) -> FloatArray:
        """Take the discrepancy's size from the residuals, not from the kernel.

        Readings fix how the process moves at high frequencies, σ²/τ³; what σ adds at low ones is an
        extrapolation. The residual's mean square is σ² + s², less the part that the fit took into
        the parameters, whose own uncertainty a band has besides.
        """
        sized = theta.copy()
        sized[:, 1] = np.sqrt(np.maximum(missed() - theta[:, 0] ** 2, 0.0))
        return sized

    def stationary(self, theta: FloatArray) -> FloatArray:
        """Return σ² times the unit matrix."""
        return theta[:, 1, np.newaxis, np.newaxis] ** 2 * np.eye(2)

    def correlation_time(self, theta: FloatArray) -> FloatArray:
        """Return τ (models,), s."""
        return theta[:, 2]

    def transition(self, theta: FloatArray, readings: float | FloatArray = 1.0) -> FloatArray:
        """Return F over the time of so many readings."""
        return _oscillation(theta, readings * self.interval)

    def process_covariance(self, theta: FloatArray, readings: float = 1.0) -> FloatArray:
        """Return σ² (1 − F Fᵀ); over short times from the integral of driven motion.

        White noise drives the second state.
        """
        _, process, time, quality = theta.T
        quality = np.maximum(quality, LEAST_QUALITY)
        fast = (1 + np.sqrt(np.maximum(1 - 4 * quality**2, 0))) / (2 * time * quality**2)
        fast = np.maximum(fast, 1 / (time * quality))
        transitions, passed = self.transition(theta, readings), readings * self.interval
        gained = np.eye(2) - transitions @ np.swapaxes(transitions, 1, 2)
        short = fast * passed < 1
        if short.any():
            pushed = _oscillation(theta[short], passed * (1 + NODES) / 2)[..., 1]
            total = np.einsum("mti,mtj,t->mij", pushed, pushed, WEIGHTS)
            scale = passed / (time * quality**2)[short]
            gained[short] = scale[:, np.newaxis, np.newaxis] * total
        gained *= (process**2)[:, np.newaxis, np.newaxis]
        return gained


def _oscillation(theta: FloatArray, time: float | FloatArray) -> FloatArray:
    """Return F (models, times, 2, 2) over times (times,), s; (models, 2, 2) over one."""
    shape = (-1, *[1] * np.ndim(time))
    memory, quality = (theta[:, column].reshape(shape) for column in (2, 3))
    quality = np.maximum(quality, LEAST_QUALITY)
    frequency = 1 / (memory * quality)
    mean_rate = frequency / (2 * quality)
    # At Q = 1/2 both rates are the same.
    rate_difference = np.maximum(np.sqrt(np.abs(1 - 4 * quality**2)) * mean_rate, 1e-150)
    fast = mean_rate + rate_difference
    slow = frequency * (frequency / fast)
    lasting = np.exp(-slow * time)
    swelled = -lasting * np.expm1(-2 * rate_difference * time) / (2 * rate_difference)
    first, last = lasting + slow * swelled, np.exp(-fast * time) - slow * swelled
    swings = quality > 0.5
    if swings.any():
        decay, angle = np.exp(-mean_rate * time), rate_difference * time
        sine, cosine = decay * np.sin(angle) / rate_difference, decay * np.cos(angle)
        first = np.where(swings, cosine + mean_rate * sine, first)
        last = np.where(swings, cosine - mean_rate * sine, last)
        swelled = np.where(swings, sine, swelled)
    across = frequency * swelled
    rows = np.stack([first, across, -across, last], axis=-1)
    return rows.reshape(*first.shape, 2, 2)


NOISES: Mapping[str, Callable[..., Noise]] = {
    "discrepancy": DiscrepancyNoise,
    "smooth": SmoothNoise,
    "student": StudentNoise,
    "paced": PacedNoise,
    "white": WhiteNoise,
}


def noise_model(kind: str, interval: float) -> Noise:
    """Return the noise of that name (or import path) for readings ``interval`` seconds apart.

    ``kind`` may be a sum, such as ``"discrepancy + smooth"``.

    Raises
    ------
    InputError
        No noise goes by that name.

    Examples
    --------
    >>> [declared.name for declared in noise_model("discrepancy", 1e-3).declarations]
    ['sensor_sd', 'discrepancy_sd', 'discrepancy_time']
    """
    options = {"interval": interval}
    first, *others = (
        build_part("noise", k.strip(), NOISES, options, Noise) for k in kind.split("+")
    )
    return sum(others, start=first)
