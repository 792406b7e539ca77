"""Small posteriors to test with: short records of the ring bender."""

from collections.abc import Iterable, Iterator, Mapping

import numpy as np

from bwbayes.arrays import FloatArray
from bwbayes.inference.defaults import ranges_of
from bwbayes.inference.likelihood import Likelihood
from bwbayes.inference.noise import noise_model
from bwbayes.inference.parameters import JointPrior, Parameter, ParameterTable
from bwbayes.inference.posterior import Posterior
from bwbayes.inference.study import Study
from bwbayes.model.actuator import Actuator
from bwbayes.model.declaration import Context, Declaration, Distribution, Ranges
from bwbayes.model.inputs import Hold, Inputs
from bwbayes.model.spec import ModelSpec, StageSpec
from bwbayes.record.record import Record
from bwbayes.record.teststand import TABLE_1
from tests.declared import NAMES, context, declared, joint, parameter
from tests.stand import process

INTERVAL = 0.01

TRUE_NOISE = {"sensor_sd": 0.3, "discrepancy_sd": 0.8, "discrepancy_time": 0.2}
TRUE_LAG = 0.02


def decaying_sine(samples: int, periods: float = 4.0, amplitude: float = 100.0) -> FloatArray:
    """Return a voltage (samples,) from rest whose amplitude decays to a tenth."""
    part = np.arange(samples) / samples
    voltage: FloatArray = -amplitude * np.sin(2 * np.pi * periods * part) * (1 - 0.9 * part)
    return voltage


def truth(posterior: Posterior) -> FloatArray:
    """Return the θ (1, parameters) that the simulated records come from."""
    known = {**{n: TABLE_1.get(n, 0.0) for n in NAMES}, **TRUE_NOISE, "lag": TRUE_LAG}
    return np.array([[known[name] for name in posterior.prior.names]])


def ring_bender(actuator: Actuator, noise: str, voltage: FloatArray, seed: int) -> FloatArray:
    """Simulate the displacement (samples,) of the paper's ring bender, um."""
    generator = np.random.default_rng(seed)
    theta = [TRUE_LAG if n == "lag" else TABLE_1[n] for n in actuator.parameters]
    clean = actuator.displacement(np.array([theta]), voltage)[0]
    reading: FloatArray = clean + TRUE_NOISE["sensor_sd"] * generator.standard_normal(voltage.size)
    if noise == "white":
        return reading
    step = actuator.interval / TRUE_NOISE["discrepancy_time"]
    return reading + TRUE_NOISE["discrepancy_sd"] * process(voltage.size, step, generator)


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
    model = noise_model(noise, actuator.interval)
    fixed = {"initial": 0.0} if fixed is None else fixed
    inputs = Inputs(voltage, interval=actuator.interval)
    ranges = ranges_of(inputs, displacement)
    known = context(ranges, fixed.get("exponent", 1.0), 4.1e5)
    parameters = parameters_of(ParameterTable(actuator, model).declarations, known, fixed, priors)
    prior = JointPrior(parameters, actuator.hysteresis.holds)
    windows = training or (slice(0, voltage.size),)
    one = Likelihood(inputs, displacement, windows, actuator, model, from_rest)
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
    actuator = Actuator(dynamics, "first", INTERVAL)
    voltage = decaying_sine(samples)
    displacement = ring_bender(actuator, noise, voltage, seed)
    return posterior_of(
        voltage, displacement, actuator, noise, fixed, training=training, priors=priors
    )


def study_of(*datasets: Likelihood, noise: str = "discrepancy") -> Study:
    """Return the study of such records with default priors, of an actuator without dynamics."""
    spec = ModelSpec((StageSpec("hysteresis", "bouc-wen"),), "first", noise=noise)
    records = {
        one.name: Record(one.voltage, one.displacement, interval=one.inputs.interval)
        for one in datasets
    }
    return Study(spec, records, {one.name: one.training for one in datasets})


def posterior_of_record(record: Record, fixed: Mapping[str, float]) -> Posterior:
    """Return the posterior of a record from the virtual test stand, with default priors."""
    assert record.displacement is not None
    hold: Hold = "zero" if record.voltage_is == "command" else "first"
    actuator = Actuator("second-order", hold, record.interval)
    return posterior_of(record.voltage, record.displacement, actuator, "discrepancy", fixed)


def single(
    name: str, prior: Distribution, lower: float = -np.inf, upper: float = np.inf
) -> JointPrior:
    return joint([parameter(name, prior, lower, upper)])
