"""What CONTRIBUTING shows is run as it stands there."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

import emcee
import numpy as np
import pytest

import bwbayes
from bwbayes.inference.noise import (
    DISCREPANCY_SD,
    DISCREPANCY_TIME,
    SENSOR_SD,
    DiscrepancyNoise,
)
from bwbayes.inference.state_space import Noise
from bwbayes.sampling.moves import IndependenceMove
from tests.app import small

TEXT = (Path(__file__).resolve().parents[1] / "CONTRIBUTING.md").read_text(encoding="utf-8")


def example(name: str) -> str:
    """Return the code of an example."""
    found = re.search(rf"<!-- example: {name} -->\n```python\n(.*?)```", TEXT, re.DOTALL)
    assert found is not None
    return found[1]


def test_the_noise_is_the_gaussian_that_it_says_it_is() -> None:
    """Alone and with another one, against the dense covariance."""
    names = (dataclass, Noise, np, SENSOR_SD, DISCREPANCY_SD, DISCREPANCY_TIME)
    known = dict(
        zip(
            ("dataclass", "Noise", "np", "SENSOR_SD", "DISCREPANCY_SD", "DISCREPANCY_TIME"),
            names,
            strict=True,
        )
    )
    exec(example("my_noise.py"), known)
    swinging = known["Swinging"](0.05)  # type: ignore[operator]
    time = 0.05 * np.abs(np.subtract.outer(np.arange(60), np.arange(60)))
    covariance = 4 * np.exp(-time / 0.3) * np.cos(time / 0.3) + 0.01 * np.eye(60)
    residual = np.random.default_rng(1).standard_normal(60)

    def dense(covariance: np.ndarray) -> float:
        inverse, volume = np.linalg.inv(covariance), np.linalg.slogdet(covariance)[1]
        return float(-0.5 * (residual @ inverse @ residual + volume + 60 * np.log(2 * np.pi)))

    theta = np.array([[0.1, 2.0, 0.3]])
    (density,) = swinging.log_density(theta, residual[np.newaxis])
    assert density == pytest.approx(dense(covariance), abs=1e-8)
    both, more = swinging + DiscrepancyNoise(0.05), np.array([[0.1, 2.0, 0.3, 0.5, 1.0]])
    (density,) = both.log_density(more, residual[np.newaxis])
    assert density == pytest.approx(dense(covariance + 0.25 * np.exp(-time)), abs=1e-8)


def test_a_sampler_of_ones_own_goes_on_where_a_run_ended(
    tmp_path_factory: pytest.TempPathFactory,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    (tmp_path / "results").mkdir()
    (tmp_path / "results/my").symlink_to(small.finished(tmp_path_factory))
    monkeypatch.chdir(tmp_path)
    known = {"bwbayes": bwbayes, "emcee": emcee, "IndependenceMove": IndependenceMove}
    exec(example("sampler"), known)
    sampler, end = known["sampler"], known["end"]
    fit = bwbayes.open_run("results/my")
    np.testing.assert_array_equal(end.coords, fit.chain.ends[0].coordinates)
    assert (20, *end.coords.shape) == sampler.get_chain().shape
    assert 0.1 < np.mean(sampler.acceptance_fraction)
