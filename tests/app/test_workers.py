"""Workers keep their linear algebra to one thread, wherever they run."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from threadpoolctl import threadpool_info

from bwbayes.app.running.workers import executor, one_thread
from bwbayes.inference.engine import Engine
from tests.inference.problems import short_posterior, truth


def linear_algebra_threads() -> set[int]:
    """Return how many threads the linear algebra libraries of this process use."""
    np.linalg.solve(np.eye(2), np.eye(2))
    return {
        outcome["num_threads"] for outcome in threadpool_info() if outcome["user_api"] == "blas"
    }


@pytest.mark.parametrize("engine", ["numpy", "numba"])
@pytest.mark.parametrize("workers", [1, 2])
def test_workers_use_one_thread_for_linear_algebra(workers: int, engine: Engine) -> None:
    with one_thread(), executor(workers, engine) as pool:
        outcome = [pool.submit(linear_algebra_threads) for _ in range(2 * workers)]
        assert [{1}] * len(outcome) == [future.result() for future in outcome]


@pytest.mark.parametrize("engine", ["numpy", "numba"])
def test_a_model_reaches_the_workers_with_all_that_its_parts_declare(engine: Engine) -> None:
    posterior = replace(short_posterior(samples=40), engine=engine)
    theta = truth(posterior)
    with one_thread(), executor(2, engine) as pool:
        density = pool.submit(posterior.log_likelihood, theta).result()
    np.testing.assert_array_equal(posterior.log_likelihood(theta), density)
