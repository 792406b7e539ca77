"""How long a start takes, under pytest-benchmark (the package says how)."""

from __future__ import annotations

import pytest
from pytest_benchmark.fixture import BenchmarkFixture

from tests.benchmarks.startup import STARTS, started


@pytest.mark.benchmark(group="start-up", warmup=True, warmup_iterations=1)
@pytest.mark.parametrize("name", STARTS)
def test_start(benchmark: BenchmarkFixture, name: str) -> None:
    benchmark(started(STARTS[name]))
