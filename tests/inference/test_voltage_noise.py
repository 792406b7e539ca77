"""What an estimated voltage leaves unsure of the parameters, against fits along other estimates."""

from dataclasses import replace

import numpy as np
import pytest

from bwbayes.inference import map_estimate as pointfit, voltage_noise
from bwbayes.inference.voltage_noise import path_covariance, widen_draws
from bwbayes.record.voltage_path import estimate_path
from tests.inference.problems import decaying_sine, short_posterior


def test_newton_steps_are_what_fits_along_other_paths_move(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(voltage_noise, "COPIES", 4)
    rng = np.random.default_rng(2)
    posterior = short_posterior(samples=1500, noise="white")
    path = estimate_path(decaying_sine(1500) + 0.3 * rng.standard_normal(1500))
    assert path.noise_sd == pytest.approx(0.3, rel=0.1)
    posterior = posterior.altered(voltage=path.voltage)
    point = pointfit.fit(posterior, rng)
    covariance = path_covariance(posterior, {"record": path}, point, np.random.default_rng(1))
    again = np.random.default_rng(1)
    moved = np.stack(
        [
            pointfit.fit(posterior.altered(voltage=path.redrawn(again)), rng).mode - point.mode
            for _ in range(4)
        ]
    )
    physical = [name in posterior.table.physical for name in posterior.names]
    expected = np.sqrt(np.mean(moved**2, axis=0))[physical]
    found = np.sqrt(np.diag(covariance))
    np.testing.assert_allclose(found[physical], expected, rtol=0.2)
    assert not found[np.logical_not(physical)].any()
    # A path without noise is known.
    known = {"record": replace(path, noise_sd=0.0)}
    assert not path_covariance(posterior, known, point, again).any()


def test_draws_are_as_much_wider_as_is_said() -> None:
    rng = np.random.default_rng(0)
    square = rng.standard_normal((2, 3, 3))
    covariance, more = square @ np.swapaxes(square, 1, 2)
    draws = rng.multivariate_normal(np.ones(3), covariance, size=(50, 4, 500))
    wide = widen_draws(draws, covariance, more)
    flat = wide.reshape(-1, 3)
    np.testing.assert_allclose(flat.mean(axis=0), draws.mean(axis=(0, 1, 2)))
    np.testing.assert_allclose(np.cov(flat.T), covariance + more, rtol=0.05, atol=0.05)
    np.testing.assert_allclose(widen_draws(draws, covariance, 0 * more), draws)
