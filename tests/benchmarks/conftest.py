"""What benchmarks share: the paper's record, and a run of ours on it."""

from __future__ import annotations

import pytest

from bwbayes.inference.posterior import Posterior
from tests.benchmarks.cases import problem
from tests.benchmarks.effective import Run, our_run


@pytest.fixture(scope="session")
def paper() -> Posterior:
    """Return the posterior of the paper's record, on the compiled engine."""
    return problem("numba").posterior


@pytest.fixture(scope="session")
def finished() -> Run:
    """Return a converged run of ours on the compiled engine."""
    return our_run(problem("numba"))
