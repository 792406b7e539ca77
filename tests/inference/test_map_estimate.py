"""The point fit stands on the mode, knows the curvature there, and sees all modes."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.optimize import least_squares
from scipy.signal import lfilter

from bwbayes.app.config.config import parse
from bwbayes.arrays import FloatArray
from bwbayes.inference.least_squares import LeastSquares
from bwbayes.inference.map_estimate import MAPEstimate, fit, mode_weights
from bwbayes.inference.posterior import Posterior
from tests.diagnosis.plants import bench
from tests.diagnosis.test_fixes import CONFIG, put
from tests.diagnosis.test_validation_end_to_end import made
from tests.inference.problems import short_posterior
from tests.prediction.runs import study_of

CASES = ("white", "discrepancy", "lag")


def case(name: str) -> Posterior:
    if name == "lag":
        return short_posterior("discrepancy", 400, "lag", {}, seed=3)
    return short_posterior("white" if name == "white" else "discrepancy", 300, seed=2)


@pytest.fixture(scope="module")
def fits() -> dict[str, tuple[Posterior, MAPEstimate]]:
    return {name: (case(name), fit(case(name), np.random.default_rng(1))) for name in CASES}


Fits = dict[str, tuple[Posterior, MAPEstimate]]


@pytest.mark.parametrize("steps", [False, True])
def test_least_squares_side_by_side_come_as_low_as_scipys(steps: bool) -> None:
    """From each of four prior draws, good starts or bad ones, to the optimum that scipy finds."""
    posterior = case("lag")
    prior = posterior.prior
    draws = prior.unconstrain(prior.draw(np.random.default_rng(4), 100))
    center, spread = np.median(draws, axis=0), np.std(draws, axis=0)
    study = LeastSquares(posterior, center, spread, steps=steps)
    starts = draws[:4]

    def residuals(physical: FloatArray) -> FloatArray:
        place = center.copy()
        place[study.physical] = physical
        residual: FloatArray = study.residuals(place[np.newaxis])[0]
        return residual

    lowest = [
        2 * least_squares(residuals, start, x_scale=spread[study.physical], jac="3-point").cost
        for start in starts[:, study.physical]
    ]
    costs = study.costs(study.optima(starts))
    assert np.min(costs) <= np.min(lowest) * (1 + 1e-6)
    # One may end in another valley.
    assert np.sum(costs <= np.array(lowest) * (1 + 1e-3)) >= 3


@pytest.mark.parametrize("name", CASES)
def test_the_gradient_at_the_mode_vanishes(fits: Fits, name: str) -> None:
    """Less than 0.03 nats per posterior sd along each axis of the posterior."""
    posterior, point = fits[name]
    axes = np.linalg.cholesky(point.covariance).T
    step = 1e-3
    plus, minus = (posterior.log_density(point.mode + sign * step * axes) for sign in (1, -1))
    assert np.max(np.abs((plus - minus) / (2 * step))) < 0.03


@pytest.mark.parametrize("name", CASES)
def test_the_covariance_is_that_of_the_curvature(fits: Fits, name: str) -> None:
    """In units of the reported covariance a numerical Hessian is the identity."""
    posterior, point = fits[name]
    axes = np.linalg.cholesky(point.covariance).T
    size, step = point.mode.size, 0.03
    hessian = np.empty((size, size))
    for i in range(size):
        for j in range(size):
            corners = [
                point.mode + step * (a * axes[i] + b * axes[j])
                for a, b in ((1, 1), (1, -1), (-1, 1), (-1, -1))
            ]
            pp, pm, mp, mm = posterior.log_density(np.array(corners))
            hessian[i, j] = -(pp - pm - mp + mm) / (4 * step**2)
    np.testing.assert_allclose(np.eye(size), hessian, atol=0.15)


@pytest.mark.parametrize(("number", "least"), [(97, 0.05), (106, 0.3)])
def test_both_modes_of_a_record_of_one_amplitude_are_seen(
    tmp_path: Path, number: int, least: float
) -> None:
    """Whatever the seed. Of the second, least squares sees one optimum between the two."""
    study, _ = made((7, number), tmp_path)
    for seed in range(4):
        point = fit(study.posterior, np.random.default_rng(seed))
        free, _ = study.posterior.prior.constrain(point.optima)
        np.testing.assert_allclose([0.71, 0.95], np.sort(free[:, 0]), atol=0.02)
        assert least < min(mode_weights(study.posterior, point)[1])


def test_a_climb_along_which_hardly_anything_changes_comes_to_an_end(tmp_path: Path) -> None:
    """A record of the wrong sign, with a place where d and alpha are all but one parameter.

    Axes there are so unlike in length that nothing can be solved for.
    """
    put(bench("sign", (6, 25)).records, tmp_path)
    posterior = study_of(parse(CONFIG, "config"), tmp_path).posterior
    point = fit(posterior, np.random.default_rng((6, 25)))
    assert point.log_density == pytest.approx(np.max(posterior.log_density(point.optima)))


@pytest.mark.parametrize("seed", [1, 2])
def test_two_lags_in_a_row_have_a_mode_for_either_order(tmp_path: Path, seed: int) -> None:
    """A sensor of 12 ms behind an actuator of 4 to 10 ms: exchanged, they do the same nearly."""
    records = bench("good", (8, seed)).records
    keep = np.exp(-records[0].interval / 0.012)
    slow = [
        replace(
            record, displacement=lfilter([1 - keep], [1, -keep], np.asarray(record.displacement))
        )
        for record in records
    ]
    put(slow, tmp_path)
    config = CONFIG.replace("from_rest = true\n", "train = [[1.0, 9.0]]\n")
    config += '[model]\ndynamics = "lag"\nnoise = "discrepancy"\nstages = ["sensor-lag"]\n'
    posterior = study_of(parse(config, "config"), tmp_path).posterior
    point = fit(posterior, np.random.default_rng(seed))
    free, _ = posterior.prior.constrain(point.optima)
    lags = free[:, [posterior.names.index(name) for name in ("lag", "sensor_lag")]]
    np.testing.assert_allclose(lags[0].sum(), lags[1].sum(), rtol=0.05)
    assert np.prod(np.diff(lags[:2])) < 0
    assert min(mode_weights(posterior, point)[1]) > 0.1
