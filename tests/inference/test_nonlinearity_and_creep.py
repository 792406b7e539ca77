"""Gain and creep in the likelihood: a dense Gaussian, both engines, slow starts, old equations."""

from dataclasses import replace
from typing import Any, cast

import numpy as np
import pytest

from bwbayes.arrays import FloatArray
from bwbayes.inference.engine import Engine
from bwbayes.inference.likelihood import Likelihood
from bwbayes.model.declaration import Values
from bwbayes.model.inputs import Hold, Span
from bwbayes.model.linear import Creep, creep_times
from bwbayes.model.nonlinearity import PolynomialNonlinearity
from tests.inference.test_likelihood import assert_dense, moving, responses

REFERENCE = Span(-90.0, 80.0)
NONLINEARITY = PolynomialNonlinearity(reference=REFERENCE)
CREEP = Creep((0.1, 1.0, 10.0), reference=REFERENCE)
GROWING = replace(CREEP, growing=True)

PARTS: dict[str, dict[str, Any]] = {
    "nonlinearity": {"nonlinearity": NONLINEARITY},
    "creep": {"creep": CREEP},
    "growing": {"creep": GROWING},
    "both": {"nonlinearity": NONLINEARITY, "creep": GROWING},
}


WAYS: list[tuple[str, Hold]] = [("none", "zero"), ("lag", "first"), ("second-order", "first")]


@pytest.mark.parametrize("engine", ["numpy", "numba"])
@pytest.mark.parametrize("parts", PARTS)
@pytest.mark.parametrize(("dynamics", "hold"), WAYS)
def test_the_unknown_start_is_integrated_out(
    engine: str, parts: str, dynamics: str, hold: Hold
) -> None:
    fixed = {"mass": 300.0, "damping": 3000.0, "stiffness": 4.1e5}
    posterior = moving("discrepancy", dynamics, fixed, hold=hold, missing=0.1, parts=PARTS[parts])
    for offset in (0.0, 3.0):
        likelihood = replace(posterior.likelihood, engine=cast(Engine, engine), offset_sd=offset)
        theta = posterior.prior.theta(posterior.prior.draw(np.random.default_rng(5), 3))
        assert_dense(likelihood, theta)


@pytest.mark.parametrize("engine", ["numpy", "numba"])
def test_a_start_is_integrated_out_however_alike_its_responses_and_small_the_noise(
    engine: str,
) -> None:
    """Noise of a few nanometers, an offset, and lags that hardly move in two seconds."""
    noise = {"sensor_sd": 0.002, "discrepancy_sd": 0.006}
    slow = Creep((0.1, 1.0, 10.0, 100.0, 1000.0), reference=REFERENCE)
    posterior = moving("discrepancy", "lag", noise, parts={"creep": slow})
    likelihood = replace(posterior.likelihood, engine=cast(Engine, engine), offset_sd=3.0)
    theta = posterior.prior.theta(posterior.prior.draw(np.random.default_rng(5), 1))
    model = likelihood.table.actuator(theta)
    rested = likelihood.actuator.displacement(model, likelihood.voltage)[0]
    displacement = likelihood.displacement.copy()
    displacement[likelihood.readings.rows] = rested + likelihood.start_sd(theta)[0] @ responses(
        likelihood, theta[0]
    )
    assert_dense(replace(likelihood, displacement=displacement), theta)


@pytest.mark.parametrize("parts", PARTS)
@pytest.mark.parametrize("offset", [0.0, 3.0])
@pytest.mark.parametrize(("noise", "missing"), [("white", 0.0), ("discrepancy", 0.01)])
def test_engines_agree_along_records_that_are_long_for_the_filter(
    parts: str, offset: float, noise: str, missing: float
) -> None:
    """Most of the record passes the short form, in which slow responses are only followed."""
    posterior = moving(noise, "lag", missing=missing, parts=PARTS[parts])
    repeated = 12
    posterior = posterior.altered(
        voltage=np.tile(posterior.single_record.voltage, repeated),
        displacement=np.tile(posterior.single_record.displacement, repeated),
        training=(slice(0, 200 * repeated),),
    )
    theta = posterior.prior.theta(posterior.prior.draw(np.random.default_rng(5), 40))
    likelihood = replace(posterior.likelihood, offset_sd=offset)
    one, other = (
        replace(likelihood, engine="numpy").start(theta),
        replace(likelihood, engine="numba").start(theta),
    )
    size = 200 * repeated + np.abs(one.log_density)
    assert np.max(np.abs(one.log_density - other.log_density) / size) < 1e-10
    sd = posterior.likelihood.start_sd(theta)
    if sd.size and not offset:
        assert np.max(np.abs(one.mean - other.mean) / np.max(sd, axis=1)[:, np.newaxis]) < 1e-6


def test_creep_that_grows_is_as_strong_as_stated_at_the_largest_voltage() -> None:
    posterior = moving("white", "none", {"offset": 0.0}, parts={"creep": GROWING})
    names = posterior.single_record.actuator.parameters
    value = {"d": 1.0, "alpha": 1e-12, "beta": 0.02, "exponent": 1.0, "creep_1": 0.05}
    voltage = np.concatenate([[0.0], np.full(3000, 90.0)])
    for growth in (0.0, 0.5):
        theta = [[(value | {"creep_growth": growth}).get(name, 0.0) for name in names]]
        x = posterior.single_record.actuator.displacement(theta, voltage)[0]
        assert x[-1] == pytest.approx(90 * (1 + 0.05 * (1 + growth)), rel=1e-9)


@pytest.mark.parametrize(
    ("interval", "duration", "times"),
    [
        (1e-3, 10.0, [0.01, 0.1, 1.0, 10.0]),
        (0.02, 30.0, [1.0, 10.0]),
        (1.0, 2.0, [10.0]),
        (1e-6, 3600.0, [0.001, 0.01, 0.1, 1.0, 10.0, 100.0, 1000.0, 10000.0]),
    ],
)
def test_times_are_powers_of_ten_from_samples_to_records(
    interval: float, duration: float, times: list[float]
) -> None:
    assert times == pytest.approx(creep_times(interval, duration))


def unevenness(likelihood: Likelihood, theta: FloatArray) -> float:
    """Return how unlike a parabola the log density is along strengths about zero.

    By how much its second difference varies, of the mean: 1, and it is twice as curved somewhere
    as elsewhere, in the range of published strengths.
    """
    strengths = np.linspace(-0.004, 0.004, 10)  # none is zero, which stands for no creep
    along = np.repeat(theta, strengths.size, axis=0)
    for name in CREEP.names:
        along = likelihood.table.replaced(along, name, strengths)
    bends = np.diff(likelihood.log_density(along), 2)
    return float(np.ptp(bends) / np.abs(np.mean(bends)))


def own_strength(creep: Creep, column: Values) -> FloatArray:
    return np.abs(np.stack([column[name] for name in creep.names], axis=1))


@pytest.mark.parametrize("seed", range(4))
def test_a_strength_next_to_zero_is_no_known_start(
    seed: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With a start as large as its own strength alone, the planted defect, there is a ridge."""
    posterior = moving("white", "none", parts=PARTS["creep"])
    likelihood = posterior.likelihood
    theta = posterior.prior.theta(posterior.prior.draw(np.random.default_rng(seed), 1))
    assert unevenness(likelihood, theta) < 0.5
    monkeypatch.setattr(Creep, "reach", own_strength)
    assert unevenness(likelihood, theta) > 1.0
