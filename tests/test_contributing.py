"""What CONTRIBUTING shows is run as it stands there."""

from __future__ import annotations

import re
from dataclasses import dataclass, replace
from pathlib import Path

import emcee
import numpy as np
import pytest

import bwbayes
from bwbayes.inference.compiled.walk import walk
from bwbayes.inference.noise import (
    DISCREPANCY_SD,
    DISCREPANCY_TIME,
    SENSOR_SD,
    DiscrepancyNoise,
)
from bwbayes.inference.state_space import Noise
from bwbayes.model.inverse import inverse
from bwbayes.model.operator import Span
from bwbayes.model.spec import Extent, ModelSpec
from bwbayes.record.true_values import true_values
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


def test_a_stage_of_ones_own_is_in_the_chain(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """By its import path: both engines have it, and a command undoes it."""
    head = (
        "import numpy as np\n"
        "from bwbayes.model.declaration import Declaration, lognormal\n"
        "from bwbayes.model.stage import Stage\n\n\n"
    )
    (tmp_path / "my_stage.py").write_text(head + example("my_stage.py"), encoding="utf-8")
    monkeypatch.syspath_prepend(tmp_path)
    spec = ModelSpec(stages=("backlash", "my_stage:SoftMount"))
    made = spec.actuator(1e-3, "first", Extent(Span(-50.0, 50.0), 1e-3, 1.0))
    assert made.parameters[-2:] == ("softness", "offset")
    values = true_values(made, {"d": 1.0, "alpha": 0.3, "beta": 0.05, "gamma": 0.02, "offset": 1.0})
    values |= {"exponent": 1.0, "initial": 0.0, "lag": 1e-3, "softness": 300.0}
    theta = np.array([[*values.values()]] * 2)
    voltage = 50 * np.sin(np.arange(400) / 30)
    displacement = made.displacement(theta, voltage, from_rest=True)
    compiled = walk(made, theta, voltage, from_rest=True)(voltage.size)
    np.testing.assert_allclose(compiled, displacement, rtol=0, atol=1e-10)
    hard = replace(made, stages=made.stages[:1])
    before = hard.displacement(np.delete(theta, -2, axis=1), voltage, from_rest=True) - 1.0
    soft = 1.0 + before / (1 + np.abs(before) / 300.0)
    np.testing.assert_allclose(displacement, soft, rtol=0, atol=1e-10)
    command = inverse(made, theta[:1], displacement[:1], from_rest=True)
    again = made.displacement(theta[:1], command[0], from_rest=True)
    np.testing.assert_allclose(again, displacement[:1], rtol=0, atol=1e-8)


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
