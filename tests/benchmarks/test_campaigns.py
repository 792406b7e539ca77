"""What a campaign of short records costs, under pytest-benchmark (the package says how)."""

# mypy: allow-untyped-calls
# pytest-benchmark has types, but not for all of its methods.

from __future__ import annotations

from pathlib import Path

import pytest
from pytest_benchmark.fixture import BenchmarkFixture

from tests.benchmarks.campaigns import campaign_of


@pytest.mark.benchmark(group="campaign")
def test_campaign(benchmark: BenchmarkFixture, tmp_path: Path) -> None:
    figures = benchmark.pedantic(campaign_of, args=(4, tmp_path), rounds=1)
    assert figures["refused"] == 0
