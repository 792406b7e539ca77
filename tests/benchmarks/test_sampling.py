"""What a step and a whole run cost, under pytest-benchmark (the package says how)."""

# mypy: allow-untyped-calls
# pytest-benchmark has types, but not for all of its methods.

from __future__ import annotations

import pytest
from pytest_benchmark.fixture import BenchmarkFixture

from bwbayes.inference.engine import Engine
from tests.benchmarks.cases import ENGINES, on_engine, problem
from tests.benchmarks.effective import MOVES, Run, from_posterior, our_run, step


@pytest.mark.benchmark(group="step")
@pytest.mark.parametrize("move", MOVES)
@pytest.mark.parametrize("engine", [*ENGINES, "stock"])
def test_step(benchmark: BenchmarkFixture, finished: Run, engine: str, move: str) -> None:
    (state, _) = from_posterior(finished)
    call = step(on_engine(finished.problem.posterior, engine), move, state)
    block = benchmark(call)
    assert (1, *state.coordinates.shape) == block.coordinates.shape


@pytest.mark.benchmark(group="run")
@pytest.mark.parametrize("engine", ENGINES)
def test_run(benchmark: BenchmarkFixture, finished: Run, engine: Engine) -> None:
    target = finished.problem.plan.ess
    run: Run = benchmark.pedantic(our_run, args=(problem(engine, target),), rounds=1)
    assert run.outcome.converged
    assert run.ess >= target
    if benchmark.stats:  # none if benchmarks are disabled
        benchmark.extra_info["effective draws/s"] = run.ess / benchmark.stats.stats.min
