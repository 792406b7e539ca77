"""One constant amplitude does not identify the model, decaying amplitudes do, and the user hears.

At the test stand's 1000 Hz, with the damping free. The remaining sd depends on the record and the
mode alone, so the mode is put at the truth.
"""

from typing import Literal

import numpy as np
import pytest

from bwbayes.arrays import FloatArray
from bwbayes.diagnosis.identifiability import (
    InformationGain,
    information_gain,
    spectrum,
    undetermined_directions,
)
from bwbayes.inference.map_estimate import MAPEstimate
from bwbayes.inference.posterior import Posterior
from bwbayes.model.declaration import Distribution
from bwbayes.record.teststand import VirtualTestStand
from bwbayes.record.waveforms import Waveform, signal, sine
from tests.inference.linear import Linear
from tests.inference.problems import (
    TRUE_NOISE,
    posterior_of,
    posterior_of_record,
    short_posterior,
    truth,
)

FIXED = {"mass": 0.00134, "stiffness": 4.1e5, "initial": 0.0}

Discrepancy = Literal["none", "process", "structural"]


def measured(
    drive: Waveform, discrepancy: Discrepancy = "process", seed: int = 1, rate: float = 1000.0
) -> Posterior:
    record = VirtualTestStand(discrepancy, rate).run(drive, np.random.default_rng(seed))
    return posterior_of_record(record, FIXED)


def at_truth(posterior: Posterior) -> MAPEstimate:
    columns = [posterior.prior.names.index(name) for name in posterior.names]
    mode = posterior.prior.unconstrain(truth(posterior)[:, columns])[0]
    unit = np.eye(mode.size)
    return MAPEstimate(mode, unit, 0.0, mode[np.newaxis], unit)


def sines(amplitude: float, frequency: float, periods: float = 10.0) -> Waveform:
    return Waveform(sine(amplitude, frequency), periods / frequency)


@pytest.mark.parametrize(
    ("amplitude", "frequency", "discrepancy"),
    [(100.0, 1.0, "none"), (50.0, 0.5, "process"), (100.0, 0.5, "structural")],
)
def test_one_sine_leaves_a_combination_with_gamma_open(
    amplitude: float, frequency: float, discrepancy: Discrepancy
) -> None:
    posterior = measured(sines(amplitude, frequency), discrepancy)
    (finding,) = undetermined_directions(posterior, at_truth(posterior))
    assert finding.text.startswith("gamma")
    assert "% of the effective prior's SD remains if the model is off by 1%" in finding.text
    assert "(next alpha" in finding.text
    assert finding.fix == "vary the amplitude: let it decay to a tenth over ten periods"


def test_small_steady_sine_does_not_tell_alpha_from_beta() -> None:
    """It shows d - alpha and alpha beta: both may grow while beta falls."""
    fixed = {"gamma": 0.0, "initial": 0.0, "mass": 0.00134, "stiffness": 4.1e5}
    record = measured(sines(10.0, 1.0, 3.0), rate=250.0).single_record
    small = posterior_of(record.voltage, record.displacement, record.actuator, "discrepancy", fixed)
    (finding,) = undetermined_directions(small, at_truth(small))
    assert finding.text.startswith("alpha with d against beta: ")
    assert finding.fix == "drive over more than 20 V peak to peak, if the actuator allows it"


@pytest.mark.parametrize("discrepancy", ["none", "structural"])
def test_decaying_amplitudes_leave_nothing_open(discrepancy: Discrepancy) -> None:
    posterior = measured(signal("identification"), discrepancy)
    assert [] == [*undetermined_directions(posterior, at_truth(posterior))]


@pytest.mark.parametrize("sigma", [0.003, 0.03])
def test_what_is_left_of_one_parameter_is_that_of_the_dense_matrix(sigma: float) -> None:
    """With d alone, whose slope is the voltage, and a discrepancy of a percent of the range.

    No stretch comes twice, so each counts; the discrepancy's time is half of a stretch.
    """
    known = {"alpha": 0.3575, "beta": 0.0272, "gamma": 0.0172, "initial": 0.0, "offset": 0.0}
    prior = {"d": Distribution("lognormal", {"median": 0.7, "sigma": sigma})}
    posterior = short_posterior("white", 400, fixed=known, priors=prior)
    voltage = posterior.single_record.voltage
    turns = 1 + np.count_nonzero(np.diff(np.sign(np.diff(voltage))))
    lags = np.abs(np.subtract.outer(np.arange(400), np.arange(400)))
    floor = 0.01 * np.ptp(posterior.single_record.displacement)
    covariance = floor**2 * np.exp(-lags / (200 / turns)) + TRUE_NOISE["sensor_sd"] ** 2 * np.eye(
        400
    )
    slope = 0.7 * sigma * voltage
    expected = (1 + slope @ np.linalg.solve(covariance, slope)) ** -0.5
    assert 0.1 < expected < 0.95
    left, _ = spectrum(posterior, at_truth(posterior))
    np.testing.assert_allclose(expected, left, rtol=0.03)


# A record's information is that of the closed form, and a prior that decides is named


def exact(model: Linear, spread: float = 1.0) -> FloatArray:
    """Draws (steps, ensembles, walkers, free) of the closed form, that many times as wide."""
    known = model.exact
    flat = known.mean + spread * (known.draw(6000, 1) - known.mean)
    return flat.reshape(1000, 2, 3, -1)


def of(posterior: Posterior, draws: FloatArray) -> InformationGain:
    flat = draws.reshape(-1, draws.shape[-1])
    density = posterior.log_density(posterior.prior.unconstrain(flat)).reshape(draws.shape[:-1])
    return information_gain(posterior.prior, draws, density, np.random.default_rng(2))


@pytest.fixture(scope="module")
def model() -> Linear:
    return Linear(("d", "alpha", "offset"), "white")


def test_the_contraction_is_that_of_the_variances(model: Linear) -> None:
    """Within 0.07: four errors of 4,000 draws of either."""
    expected = 1 - (model.exact.sd / model.sd) ** 2
    made, narrow = (of(model.posterior, exact(model, spread)) for spread in (1.0, 0.5))
    got = [made.parameters[name].contraction for name in model.posterior.names]
    np.testing.assert_allclose(got, expected, atol=0.07)
    # The twin: draws that are half as wide look as if the record had taught more.
    got = [narrow.parameters[name].contraction for name in model.posterior.names]
    assert np.max(np.abs(got - expected)) > 0.1


def test_the_worst_combination_is_the_closed_forms(model: Linear) -> None:
    """The largest eigenvalue of the whitened posterior covariance, and how it moves."""
    made = of(model.posterior, exact(model))
    values, vectors = np.linalg.eigh(model.exact.covariance / np.outer(model.sd, model.sd))
    worst, left_of_it = made.combinations[0]
    assert left_of_it == pytest.approx(np.sqrt(values[-1]), abs=0.04)
    assert worst.split()[0] == model.posterior.names[int(np.argmax(np.abs(vectors[:, -1])))]
    assert str(made.findings[-1]).startswith(f"determined worst: {worst}")


def test_a_parameter_that_the_readings_do_not_touch_is_its_priors(model: Linear) -> None:
    """Its contraction is nothing, and the prior decides."""
    draws, posterior = exact(model), model.posterior
    source = np.random.default_rng(3)
    draws[..., 2] = model.mean[2] + model.sd[2] * source.normal(size=draws.shape[:-1])
    # The likelihood of the others, at the best offset.
    flat = draws.reshape(-1, 3)
    fixed = flat.copy()
    fixed[:, 2] = model.exact.mean[2]
    density = posterior.log_likelihood(posterior.prior.theta(fixed))
    density += posterior.prior.constrain(posterior.prior.unconstrain(flat))[1]
    made = information_gain(
        posterior.prior, draws, density.reshape(draws.shape[:-1]), np.random.default_rng(2)
    )
    offset = made.parameters["offset"]
    assert abs(offset.contraction) < 0.1
    assert offset.prior_decides
    assert str(made.findings[0]).startswith("offset: the prior decides")
    assert not made.parameters["d"].prior_decides
