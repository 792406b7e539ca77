"""What a replicate costs, under pytest-benchmark (the package says how)."""

# mypy: allow-untyped-calls
# pytest-benchmark has types, but not for all of its methods.

from __future__ import annotations

import pytest
from pytest_benchmark.fixture import BenchmarkFixture

from tests.benchmarks.cases import ROOT
from tests.benchmarks.replicates import seconds


@pytest.mark.benchmark(group="replicate")
def test_replicates(benchmark: BenchmarkFixture) -> None:
    costs = benchmark.pedantic(seconds, args=(ROOT, 1, 4), rounds=1)
    assert len(costs) == 3
