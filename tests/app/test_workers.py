"""Workers keep their linear algebra to one thread, wherever they run."""

from __future__ import annotations

import numpy as np
import pytest
from threadpoolctl import threadpool_info

from bwbayes.app.workers import executor, one_thread
from bwbayes.inference.engine import Engine


def linear_algebra_threads() -> set[int]:
    """Return how many threads the linear algebra libraries of this process use."""
    np.linalg.solve(np.eye(2), np.eye(2))
    return {found["num_threads"] for found in threadpool_info() if found["user_api"] == "blas"}


@pytest.mark.parametrize("engine", ["numpy", "numba"])
@pytest.mark.parametrize("workers", [1, 2])
def test_workers_use_one_thread_for_linear_algebra(workers: int, engine: Engine) -> None:
    with one_thread(), executor(workers, engine) as pool:
        found = [pool.submit(linear_algebra_threads) for _ in range(2 * workers)]
        assert [{1}] * len(found) == [future.result() for future in found]
