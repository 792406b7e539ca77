"""The same seed gives the same bits: threads or processes, one or two, straight or in five pieces.

So it does however many ensembles are moved together. The pieces end in the middle of a block, each
in another phase or place, and each goes on from the file alone, as a run does that was interrupted.
"""

from collections.abc import Iterator
from concurrent.futures import Executor, ProcessPoolExecutor, ThreadPoolExecutor
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from bwbayes.sampling.chain import PHASES, ChainFile, Phase
from bwbayes.sampling.diagnostics import ConvergenceDiagnostics, SamplingResult
from bwbayes.sampling.plan import SamplingPlan
from bwbayes.sampling.sampler import init_chain, sample
from tests.forks import FORKS
from tests.sampling.chains import arrays, assert_same
from tests.sampling.targets import gaussian

POSTERIOR, POINT = gaussian(2)
PLAN = SamplingPlan(
    ess=200, walkers=8, block=10, min_pilot_steps=40, max_pilot_steps=200, max_steps=500
)
PIECES = 5


class StoppedError(Exception):
    """Somebody stopped the run."""


class Stopper:
    """Watches a sampling, and stops it when so many blocks of single ensembles are done."""

    def __init__(self, blocks: int) -> None:
        self.left = blocks

    def __call__(self, _: Phase, result: ConvergenceDiagnostics | None) -> None:
        """Hear of a block, or of a check."""
        if result is None:
            self.left -= 1
            if self.left == 0:
                raise StoppedError


def begin(path: Path, seed: int = 1) -> None:
    chain = init_chain(POSTERIOR, POINT, PLAN, np.random.default_rng(seed))
    ChainFile.create(path, chain, POINT, PLAN.block, {})


def go_on(path: Path, executor: Executor, blocks: int = 0, per_task: int = 1) -> SamplingResult:
    plan = replace(PLAN, ensembles_per_task=per_task)
    return sample(POSTERIOR, plan, ChainFile.resume(path), executor, Stopper(blocks))


@pytest.fixture(scope="module")
def expected(tmp_path_factory: pytest.TempPathFactory) -> tuple[dict[str, Any], SamplingResult]:
    path = tmp_path_factory.mktemp("straight") / "chain"
    begin(path)
    with ThreadPoolExecutor(1) as executor:
        outcome = go_on(path, executor)
    return arrays(ChainFile.read(path)), outcome


@pytest.fixture(scope="module", params=["2 threads", "2 processes"])
def executor(request: pytest.FixtureRequest) -> Iterator[Executor]:
    pool: Executor = ThreadPoolExecutor(2)
    if "process" in request.param:
        pool = ProcessPoolExecutor(2, mp_context=FORKS)
    with pool:
        yield pool


def assert_same_end(
    path: Path, outcome: SamplingResult, expected: tuple[dict[str, Any], SamplingResult]
) -> None:
    assert_same(expected[0], arrays(ChainFile.read(path)))
    assert (expected[1].converged, expected[1].stop_reason) == (
        outcome.converged,
        outcome.stop_reason,
    )
    for name in ("rhat", "ess_bulk", "ess_tail", "autocorrelation", "acceptance", "stuck"):
        np.testing.assert_array_equal(
            getattr(expected[1].check, name), getattr(outcome.check, name)
        )


@pytest.mark.parametrize("per_task", [1, 3])
def test_straight(
    tmp_path: Path,
    executor: Executor,
    expected: tuple[dict[str, Any], SamplingResult],
    per_task: int,
) -> None:
    begin(tmp_path / "chain")
    outcome = go_on(tmp_path / "chain", executor, per_task=per_task)
    assert_same_end(tmp_path / "chain", outcome, expected)


def test_in_five_pieces(
    tmp_path: Path, executor: Executor, expected: tuple[dict[str, Any], SamplingResult]
) -> None:
    path = tmp_path / "chain"
    begin(path)
    total = sum(int(expected[0][f"{phase} blocks"]) for phase in PHASES)
    piece = total // PIECES
    for number in range(1, PIECES):
        with suppress(StoppedError):
            go_on(path, executor, 4 * piece + 2, per_task=number)
        done = ChainFile.read(path)
        assert number * piece == sum(done.blocks(phase) for phase in PHASES)
    assert_same_end(path, go_on(path, executor), expected)
