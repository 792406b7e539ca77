"""The numbers of a summary are those of the draws."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scipy.signal import lfilter

from bwbayes.arrays import FloatArray
from bwbayes.report.result import summary
from bwbayes.sampling.diagnostics import check
from tests.app import example


def parameters(draws: FloatArray) -> dict[str, dict[str, float]]:
    """Return the summary's parameters of a run of these draws (steps, ensembles, walkers, 4)."""
    steps, ensembles, walkers, _ = draws.shape
    accepted = np.full((steps // 50, ensembles, walkers), 20)
    run = example.run(values=draws)
    outcome = replace(run.outcome, check=check(draws, accepted, 50))
    table: Any = summary(replace(run, outcome=outcome))["parameters"]
    return dict(table)


def test_intervals_leave_two_and_a_half_percent_on_either_side() -> None:
    """Draws at k/4000, shuffled, have known quantiles."""
    generator = np.random.default_rng(1)
    even = np.stack([generator.permutation(4000) for _ in range(4)], axis=1) / 4000
    for row in parameters(even.reshape(100, 4, 10, 4)).values():
        assert 0.025 == pytest.approx(row["lower_95"], abs=1e-3)
        assert 0.5 == pytest.approx(row["median"], abs=1e-3)
        assert 0.975 == pytest.approx(row["upper_95"], abs=1e-3)
        assert 0.5 == pytest.approx(row["mean"], abs=1e-3)
        assert 12**-0.5 == pytest.approx(row["sd"], abs=1e-3)


def test_the_means_error_is_that_of_a_known_process() -> None:
    """The mean of N draws of AR(1) series has the sd s √((1 + φ)/((1 − φ) N)); within a fifth."""
    kept, shape = 0.5, (600, 4, 16, 4)
    shocks = np.random.default_rng(2).standard_normal(shape)
    shocks[1:] *= np.sqrt(1 - kept**2)
    draws = 7.0 + 3.0 * lfilter([1.0], [1.0, -kept], shocks, axis=0)
    expected = 3.0 * np.sqrt((1 + kept) / (1 - kept) / (600 * 4 * 16))
    for row in parameters(draws).values():
        assert expected == pytest.approx(row["mcse_mean"], rel=0.2)
