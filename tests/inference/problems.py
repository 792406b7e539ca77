"""Small posteriors to test with: short records of the ring bender, and toy targets.

:func:`worst_score` tests whether moves leave a target as it is. Its walkers start as exact draws; a
right move keeps them so: the expected mean and mean square of every coordinate stay what they are
at every step. Twelve independent ensembles give each an error, so a t-score with 11 degrees of
freedom; |t| > ``ALARM`` = 7 is an alarm, which a right move gives in one of 2,000 tests of 18
statistics. For the Gaussian the standard errors are 0.5 % (Student-t) and 3 % (snooker) of a
variance, so a variance that is wrong by 6 or 30 % is found nearly always; the banana's tails are
known only 14 % well.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from typing import cast

import numpy as np
from emcee.moves import Move

from bwbayes.arrays import FloatArray
from bwbayes.inference.defaults import ranges_of
from bwbayes.inference.map_estimate import PointFit
from bwbayes.inference.noise import noise_model
from bwbayes.inference.parameter_table import ParameterTable
from bwbayes.inference.parameters import JointPrior, Parameter
from bwbayes.inference.posterior import Dataset, Posterior
from bwbayes.model.actuator import Actuator
from bwbayes.model.declaration import Context, Declaration, Ranges
from bwbayes.model.distributions import Distribution
from bwbayes.model.linear import Hold
from bwbayes.record.record import Record
from bwbayes.record.teststand import RingBender
from bwbayes.sampling.ensemble import advance, start
from bwbayes.sampling.proposals import StudentMixture
from tests.declared import NAMES, context, declared, joint, parameter

__all__ = [
    "ALARM",
    "INTERVAL",
    "TARGETS",
    "TRUE_NOISE",
    "Known",
    "Target",
    "decaying_sine",
    "gaussian",
    "joint_prior",
    "posterior_of",
    "posterior_of_record",
    "ring_bender",
    "short_posterior",
    "single",
    "student",
    "target",
    "truth",
    "worst_score",
]

INTERVAL = 0.01

TRUE_NOISE = {"sensor_sd": 0.3, "discrepancy_sd": 0.8, "discrepancy_time": 0.2}
TRUE_LAG = 0.02

REPLICATES = 12
ALARM = 7.0


def decaying_sine(samples: int, periods: float = 4.0, amplitude: float = 100.0) -> FloatArray:
    """Return a voltage (samples,) from rest whose amplitude decays to a tenth."""
    part = np.arange(samples) / samples
    voltage: FloatArray = -amplitude * np.sin(2 * np.pi * periods * part) * (1 - 0.9 * part)
    return voltage


def truth(posterior: Posterior) -> FloatArray:
    """Return the θ (1, parameters) that the simulated records come from."""
    table = RingBender()
    known = {**{n: getattr(table, n, 0.0) for n in NAMES}, **TRUE_NOISE, "lag": TRUE_LAG}
    return np.array([[known[name] for name in posterior.prior.names]])


def ring_bender(actuator: Actuator, noise: str, voltage: FloatArray, seed: int) -> FloatArray:
    """Simulate the displacement (samples,) of the paper's ring bender, um."""
    generator = np.random.default_rng(seed)
    table = RingBender()
    theta = [TRUE_LAG if n == "lag" else getattr(table, n) for n in actuator.parameters]
    clean = actuator.displacement(np.array([theta]), voltage)[0]
    reading: FloatArray = clean + TRUE_NOISE["sensor_sd"] * generator.standard_normal(voltage.size)
    if noise == "white":
        return reading
    kept = np.exp(-actuator.interval / TRUE_NOISE["discrepancy_time"])
    state = TRUE_NOISE["discrepancy_sd"] * generator.standard_normal()
    for sample in range(voltage.size):
        reading[sample] += state
        fresh = TRUE_NOISE["discrepancy_sd"] * np.sqrt(1 - kept**2) * generator.standard_normal()
        state = kept * state + fresh
    return reading


def joint_prior(
    names: tuple[str, ...],
    ranges: Ranges,
    fixed: Mapping[str, float],
    priors: Mapping[str, Distribution] | None = None,
) -> JointPrior:
    """Return the default joint prior, but for ``fixed`` values and other ``priors``."""
    stated = fixed.get("exponent", 1.0)
    known = context(ranges, stated, 4.1e5)
    return joint(list(parameters_of((declared(name) for name in names), known, fixed, priors)))


def parameters_of(
    declarations: Iterable[Declaration],
    known: Context,
    fixed: Mapping[str, float],
    priors: Mapping[str, Distribution] | None = None,
) -> Iterator[Parameter]:
    """Yield parameters: fixed, with other priors, or as their parts declare them."""
    for one in declarations:
        given = fixed.get(one.name, (priors or {}).get(one.name))
        default = one.default(known) if given is None else given
        assert default is not None
        yield Parameter.of(one, default)


def posterior_of(
    voltage: FloatArray,
    displacement: FloatArray,
    actuator: Actuator,
    noise: str,
    fixed: Mapping[str, float] | None = None,
    *,
    training: tuple[slice, ...] | None = None,
    priors: Mapping[str, Distribution] | None = None,
    from_rest: bool = True,
) -> Posterior:
    """Return the posterior with default priors, of a record that starts from rest."""
    model = noise_model(noise, actuator.interval)
    fixed = {"initial": 0.0} if fixed is None else fixed
    ranges = ranges_of(voltage, displacement, actuator.interval)
    known = context(ranges, fixed.get("exponent", 1.0), 4.1e5)
    parameters = parameters_of(ParameterTable(actuator, model).declarations, known, fixed, priors)
    prior = JointPrior(parameters, actuator.hysteresis.holds)
    windows = training or (slice(0, voltage.size),)
    one = Dataset(voltage, displacement, windows, actuator, model, from_rest)
    return Posterior((one,), prior)


def short_posterior(
    noise: str = "discrepancy",
    samples: int = 400,
    dynamics: str = "none",
    fixed: Mapping[str, float] | None = None,
    *,
    seed: int = 1,
    training: tuple[slice, ...] | None = None,
    priors: Mapping[str, Distribution] | None = None,
) -> Posterior:
    """Return the posterior of a short simulated record of the ring bender."""
    actuator = Actuator(dynamics, "first", INTERVAL)
    voltage = decaying_sine(samples)
    displacement = ring_bender(actuator, noise, voltage, seed)
    return posterior_of(
        voltage, displacement, actuator, noise, fixed, training=training, priors=priors
    )


def posterior_of_record(record: Record, fixed: Mapping[str, float]) -> Posterior:
    """Return the posterior of a record from the virtual test stand, with default priors."""
    assert record.displacement is not None
    hold: Hold = "zero" if record.voltage_is == "command" else "first"
    actuator = Actuator("second-order", hold, record.interval)
    return posterior_of(record.voltage, record.displacement, actuator, "discrepancy", fixed)


def single(
    name: str, prior: Distribution, lower: float = -np.inf, upper: float = np.inf
) -> JointPrior:
    """Return the joint prior of one parameter alone."""
    return joint([parameter(name, prior, lower, upper)])


@dataclass(frozen=True)
class Unchanged:
    """A prior whose coordinates are the parameters."""

    dimensions: int

    def constrain(self, coordinates: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the coordinates (models, free), and no density."""
        return coordinates, np.zeros(coordinates.shape[0])


@dataclass(frozen=True)
class Target:
    """A density with the interface that the sampler needs of a posterior."""

    log_density: Callable[[FloatArray], FloatArray]
    prior: Unchanged


@dataclass(frozen=True)
class Gaussian:
    """log N(x; 0, C) up to a constant, given the precision C⁻¹ (free, free)."""

    precision: FloatArray = field(repr=False)

    def __call__(self, x: FloatArray) -> FloatArray:
        """Return (models,) at x (models, free)."""
        density: FloatArray = -0.5 * np.sum((x @ self.precision) * x, axis=1)
        return density


def target(log_density: Callable[[FloatArray], FloatArray], free: int) -> Posterior:
    """Return a target that the sampler takes for a posterior."""
    return cast(Posterior, Target(log_density, Unchanged(free)))


def gaussian(free: int, correlation: float = 0.5) -> tuple[Posterior, PointFit]:
    """Return a Gaussian target of unit variances and equal correlations, and its point fit."""
    covariance = np.full((free, free), correlation) + (1 - correlation) * np.eye(free)
    posterior = target(Gaussian(np.linalg.inv(covariance)), free)
    mode = np.zeros(free)
    return posterior, PointFit(mode, covariance, 0.0, mode[np.newaxis], 25 * np.eye(free))


@dataclass(frozen=True)
class Known:
    """A target of which log density, exact draws and moments are known.

    ``moments`` are the means and mean squares (2, free) of what ``view`` makes of the coordinates.
    """

    free: int
    log_density: Callable[[FloatArray], FloatArray]
    draw: Callable[[np.random.Generator, int], FloatArray]
    proposal: StudentMixture
    moments: FloatArray
    view: Callable[[FloatArray], FloatArray] = lambda x: x


def student(center: FloatArray, factor: FloatArray) -> StudentMixture:
    """Return one Student-t distribution as a proposal."""
    return StudentMixture(np.ones(1), center[np.newaxis], factor[np.newaxis])


def nine_dimensional_gaussian() -> Known:
    posterior, point = gaussian(9, 0.6)
    factor = np.linalg.cholesky(point.covariance)
    return Known(
        9,
        posterior.log_density,
        lambda generator, count: generator.standard_normal((count, 9)) @ factor.T,
        student(np.full(9, 0.1), factor),
        np.array([[0.0] * 9, [1.0] * 9]),
    )


def banana() -> Known:
    def log_density(x: FloatArray) -> FloatArray:
        bend = (x[:, 1] - x[:, 0] ** 2) / 0.5
        density: FloatArray = -0.5 * (x[:, 0] ** 2 + bend**2)
        return density

    def draw(generator: np.random.Generator, count: int) -> FloatArray:
        first, second = generator.standard_normal((2, count))
        return np.stack([first, first**2 + 0.5 * second], axis=1)

    proposal = student(np.array([0.0, 1.0]), np.diag([1.2, 1.6]))
    return Known(2, log_density, draw, proposal, np.array([[0.0, 1.0], [1.0, 3.25]]))


def bounded() -> Known:
    """Return an exponential and a uniform coordinate, both with hard walls."""

    def log_density(x: FloatArray) -> FloatArray:
        inside = (x[:, 0] > 0) & (x[:, 1] > 0) & (x[:, 1] < 1)
        return np.where(inside, -x[:, 0], -np.inf)

    def draw(generator: np.random.Generator, count: int) -> FloatArray:
        return np.stack([generator.exponential(size=count), generator.uniform(size=count)], axis=1)

    proposal = student(np.array([1.0, 0.5]), np.diag([1.0, 0.3]))
    return Known(2, log_density, draw, proposal, np.array([[1.0, 0.5], [2.0, 1 / 3]]))


def bimodal() -> Known:
    """Two humps of different weight, 0.3 at -2 and 0.7 at 2 in the first of three coordinates."""

    def log_density(x: FloatArray) -> FloatArray:
        rest = -0.5 * np.sum(x[:, 1:] ** 2, axis=1)
        humps = np.stack([-0.5 * ((x[:, 0] - m) / 0.7) ** 2 for m in (-2, 2)])
        density: FloatArray = rest + np.logaddexp(np.log(0.3) + humps[0], np.log(0.7) + humps[1])
        return density

    def draw(generator: np.random.Generator, count: int) -> FloatArray:
        x = generator.standard_normal((count, 3))
        x[:, 0] = 0.7 * x[:, 0] + np.where(generator.uniform(size=count) < 0.3, -2, 2)
        return x

    proposal = student(np.zeros(3), np.diag([2.0, 1.0, 1.0]))
    return Known(3, log_density, draw, proposal, np.array([[0.8, 0.0, 0.0], [4.49, 1.0, 1.0]]))


def wedge() -> Known:
    """Return a coordinate near one, and another just below it, as gamma near beta: a wall askew."""

    def log_density(x: FloatArray) -> FloatArray:
        gap = x[:, 0] - x[:, 1]
        inside = (gap > 0) & (gap < 2 * x[:, 0])
        return np.where(inside, -0.5 * ((x[:, 0] - 1) / 0.1) ** 2 - gap / 0.02, -np.inf)

    def draw(generator: np.random.Generator, count: int) -> FloatArray:
        first = generator.normal(1, 0.1, count)
        return np.stack([first, first - generator.exponential(0.02, count)], axis=1)

    # Shaped as the ridge: the second coordinate follows the first.
    proposal = student(np.array([1.0, 0.98]), np.array([[0.1, 0.0], [0.1, 0.02]]))
    moments = np.array([[1.0, 0.02], [1.01, 8e-4]])
    return Known(2, log_density, draw, proposal, moments, _with_gap)


def _with_gap(x: FloatArray) -> FloatArray:
    """Return the first coordinate and its gap to the second, (..., 2)."""
    return np.stack([x[..., 0], x[..., 0] - x[..., 1]], axis=-1)


def far_modes() -> Known:
    """Two modes twenty sds apart, weighing 0.3 and 0.7: no step that is local goes across."""

    def log_density(x: FloatArray) -> FloatArray:
        rest = -0.5 * np.sum(x[:, 1:] ** 2, axis=1)
        modes = np.stack([-0.5 * (x[:, 0] - m) ** 2 for m in (-10, 10)])
        density: FloatArray = rest + np.logaddexp(np.log(0.3) + modes[0], np.log(0.7) + modes[1])
        return density

    def draw(generator: np.random.Generator, count: int) -> FloatArray:
        x = generator.standard_normal((count, 3))
        x[:, 0] += np.where(generator.uniform(size=count) < 0.3, -10, 10)
        return x

    proposal = student(np.zeros(3), np.diag([10.0, 1.0, 1.0]))
    return Known(3, log_density, draw, proposal, np.array([[4.0, 0.0, 0.0], [101.0, 1.0, 1.0]]))


TARGETS = {
    "gaussian": nine_dimensional_gaussian(),
    "banana": banana(),
    "bounded": bounded(),
    "wedge": wedge(),
    "bimodal": bimodal(),
    "far modes": far_modes(),
}


def worst_score(
    known: Known, moves: list[tuple[Move, float]], steps: int = 120, seed: int = 1
) -> float:
    """Largest |t| of means and mean squares over the replicates."""
    walkers = 200
    posterior = target(known.log_density, known.free)
    origin = np.zeros(known.free)
    _, point = gaussian(known.free)
    result = []
    for child in np.random.SeedSequence(seed).spawn(REPLICATES):
        generator = np.random.default_rng(child)
        draws = known.draw(generator, walkers)
        flat = target(lambda x: np.zeros(len(x)), known.free)
        state = start(flat, replace(point, mode=origin), 0, walkers, generator)
        state = replace(state, coordinates=draws, log_density=known.log_density(draws))
        chain = known.view(advance(posterior, [moves], [state], steps)[0].coordinates)
        result.append([np.mean(chain**power, axis=(0, 1)) for power in (1, 2)])
    means = np.array(result)
    error = np.std(means, axis=0, ddof=1) / np.sqrt(REPLICATES)
    scores: FloatArray = np.abs(np.mean(means, axis=0) - known.moments) / error
    return float(np.max(scores))
