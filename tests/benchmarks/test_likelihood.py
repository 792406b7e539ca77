"""What a sample of a model costs, under pytest-benchmark (the package says how)."""

# mypy: allow-untyped-calls
# pytest-benchmark has types, but not for all of its methods.

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from pytest_benchmark.fixture import BenchmarkFixture

from bwbayes.inference.noise import NOISES
from bwbayes.inference.posterior import Posterior
from bwbayes.model.boucwen import hysteresis
from bwbayes.model.registry import DYNAMICS
from tests.benchmarks.cases import BATCHES, ENGINES, LENGTHS, MODELS, variant
from tests.benchmarks.likelihood import Call, likelihood_of, shape_of
from tests.benchmarks.stock import hysteresis_loop

each_engine = pytest.mark.parametrize("engine", ENGINES)


def measure(benchmark: BenchmarkFixture, call: Call, work: int) -> None:
    """Measure a call that works on so many samples times models."""
    assert np.isfinite(np.asarray(benchmark(call))).all()
    if benchmark.stats:  # none if benchmarks are disabled
        benchmark.extra_info["ns per sample and model"] = 1e9 * benchmark.stats.stats.min / work


@pytest.mark.benchmark(group="batch")
@pytest.mark.parametrize("count", BATCHES)
@each_engine
def test_batch(benchmark: BenchmarkFixture, paper: Posterior, engine: str, count: int) -> None:
    measure(benchmark, likelihood_of(paper, engine, count), count * paper.only.voltage.size)


@pytest.mark.benchmark(group="batch")
def test_batch_of_the_stock_path(benchmark: BenchmarkFixture, paper: Posterior) -> None:
    measure(benchmark, likelihood_of(paper, "stock"), MODELS * paper.only.voltage.size)


@pytest.mark.benchmark(group="model")
@pytest.mark.parametrize("noise", NOISES)
@pytest.mark.parametrize("dynamics", DYNAMICS)
@each_engine
def test_model(
    benchmark: BenchmarkFixture,
    paper: Posterior,
    engine: str,
    dynamics: str,
    noise: str,
) -> None:
    call = likelihood_of(variant(paper, dynamics, noise), engine)
    measure(benchmark, call, MODELS * paper.only.voltage.size)


@pytest.mark.benchmark(group="length")
@pytest.mark.parametrize("samples", LENGTHS)
@each_engine
def test_length(benchmark: BenchmarkFixture, paper: Posterior, engine: str, samples: int) -> None:
    longer = variant(paper, "second-order", "discrepancy", samples)
    measure(benchmark, likelihood_of(longer, engine), MODELS * samples)


@pytest.mark.benchmark(group="hysteresis")
@pytest.mark.parametrize("function", [hysteresis, hysteresis_loop])
def test_hysteresis(benchmark: BenchmarkFixture, paper: Posterior, function: Call) -> None:
    shape = shape_of(paper)
    work = MODELS * paper.only.voltage.size
    measure(benchmark, lambda: function(paper.only.voltage, **shape), work)  # type: ignore[call-arg]


@pytest.mark.benchmark(group="threads")
@pytest.mark.parametrize("threads", [1, 2])
def test_two_batches(benchmark: BenchmarkFixture, paper: Posterior, threads: int) -> None:
    call = likelihood_of(paper, "numba")
    with ThreadPoolExecutor(threads) as pool:

        def both() -> list[object]:
            return [future.result() for future in [pool.submit(call), pool.submit(call)]]

        measure(benchmark, both, 2 * MODELS * paper.only.voltage.size)
