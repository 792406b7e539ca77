"""The chain file is whole at every moment: killed, read while written, or damaged on the disk."""

from __future__ import annotations

import itertools
import os
import signal
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

from bwbayes.sampling.chain import PHASES, Phase
from bwbayes.sampling.ensemble import Block
from bwbayes.sampling.storage import REFITTED, ChainFile
from tests.forks import FORKS
from tests.sampling.chains import (
    ATTRIBUTES,
    ENSEMBLES,
    PLAN,
    arrays,
    assert_same,
    blocks,
    committed,
    finish,
    new,
    proposal,
)
from tests.sampling.samplings import assert_same_proposal


def test_what_is_read_is_what_was_written(whole: Path, expected: dict[str, Any]) -> None:
    chain = ChainFile.read(whole)
    assert [count for _, count in PLAN] == [chain.blocks(phase) for phase in PHASES]
    for phase, count in PLAN:
        for number in range(count):
            for mine, yours in zip(
                blocks(phase, number), chain.block_of(phase, number), strict=True
            ):
                np.testing.assert_array_equal(mine.coordinates, yours.coordinates)
                np.testing.assert_array_equal(mine.log_density, yours.log_density)
                np.testing.assert_array_equal(mine.accepted, yours.accepted)
                np.testing.assert_array_equal(mine.end.random_state, yours.end.random_state)
    np.testing.assert_array_equal(proposal("tuning").weights, expected["tuning weights"])
    assert chain.proposals["pilot"] is None


def test_attributes_say_what_was_run_and_survive_going_on(whole: Path, tmp_path: Path) -> None:
    assert ChainFile.read(whole).attributes() == ATTRIBUTES
    copy = tmp_path / "chain.h5"
    copy.write_bytes(whole.read_bytes())
    with ChainFile.resume(copy) as chain:
        assert chain.attributes() == ATTRIBUTES
    assert ChainFile.read(copy).attributes() == ATTRIBUTES


def test_chain_that_has_blocks_already_is_written_with_them(tmp_path: Path) -> None:
    with new(tmp_path / "chain.h5", blocks_before=2) as chain:
        assert chain.blocks("pilot") == 2
        finish(chain)
        memory = arrays(chain)
    assert_same(memory, arrays(ChainFile.read(tmp_path / "chain.h5")))


def test_a_second_proposal_is_kept_in_use_and_after_it(tmp_path: Path) -> None:
    """Through a file that goes on; without the last blocks it is in use again."""
    path = tmp_path / "chain.h5"
    second = proposal("tuning")
    with new(path) as chain:
        chain.freeze("sampling", proposal("sampling"))
        chain.append("sampling", blocks("sampling", 0))
        chain.fall_back(1, second)
    with ChainFile.resume(path) as chain:
        assert_same_proposal(second, chain.proposal_in_use("sampling"))
        chain.append("sampling", blocks("sampling", 1))
        chain.fall_back(2)
    with ChainFile.resume(path) as chain:
        assert (1, 2) == (chain.refitted, chain.set_aside)
        assert chain.proposal_in_use("sampling") is None
        assert_same_proposal(second, chain.second)
    with h5py.File(path, "r+") as file:
        file["committed"][:, PHASES.index("sampling")] = 1
    assert_same_proposal(second, ChainFile.read(path).proposal_in_use("sampling"))


def test_a_file_that_knows_no_second_proposal_is_read(tmp_path: Path) -> None:
    path = tmp_path / "chain.h5"
    with new(path) as chain:
        chain.freeze("sampling", proposal("sampling"))
        chain.append("sampling", blocks("sampling", 0))
        chain.fall_back(1)
    with h5py.File(path, "r+") as file:
        shorter = file["committed"][:, :REFITTED]
        del file["committed"], file["proposal/second"]
        file.create_dataset("committed", data=shorter, chunks=(1, REFITTED), fletcher32=True)
    read = ChainFile.read(path)
    assert (1, 0) == (read.set_aside, read.refitted)
    assert read.proposal_in_use("sampling") is None


def test_blocks_that_were_set_aside_stay_so_and_are_kept(tmp_path: Path) -> None:
    path = tmp_path / "chain.h5"
    with new(path) as chain:
        chain.freeze("sampling", proposal("sampling"))
        for number in range(3):
            chain.append("sampling", blocks("sampling", number))
        chain.fall_back(2)
        chain.append("sampling", blocks("sampling", 3))
        expected = arrays(chain)
    read = ChainFile.read(path)
    with ChainFile.resume(path) as resumed:
        resumed.append("sampling", blocks("sampling", 4))
    longer = ChainFile.read(path)
    assert_same(expected, arrays(read))
    assert (2, 2, 4) == (read.set_aside, read.blocks("sampling"), len(read.history("sampling")))
    assert (2, 3, 5) == (
        longer.set_aside,
        longer.blocks("sampling"),
        len(longer.history("sampling")),
    )
    assert longer.proposals["sampling"] is not None
    assert longer.proposal_in_use("sampling") is None
    for number in range(5):
        for mine, yours in zip(
            blocks("sampling", number), longer.history("sampling")[number], strict=True
        ):
            np.testing.assert_array_equal(mine.coordinates, yours.coordinates)
            np.testing.assert_array_equal(mine.moves, yours.moves)


def test_chain_without_blocks_goes_on_from_its_starts(
    tmp_path: Path, expected: dict[str, Any]
) -> None:
    path = tmp_path / "chain.h5"
    new(path).close()
    with ChainFile.resume(path) as chain:
        assert dict.fromkeys(PHASES, 0) == {p: chain.blocks(p) for p in PHASES}
        finish(chain)
    assert_same(expected, arrays(ChainFile.read(path)))


def test_reader_sees_each_block_as_soon_as_it_is_written(tmp_path: Path) -> None:
    path = tmp_path / "chain.h5"
    with new(path) as writer:
        for phase, count in PLAN:
            for number in range(count):
                writer.append(phase, blocks(phase, number))
                reader = ChainFile.read(path)
                assert number + 1 == reader.blocks(phase)
                np.testing.assert_array_equal(writer.coordinates(phase), reader.coordinates(phase))


def test_reader_in_another_process_sees_whole_blocks_alone(tmp_path: Path) -> None:
    path = tmp_path / "chain.h5"
    new(path).close()
    process = FORKS.Process(target=write, args=(path,))
    process.start()
    seen = set()
    while process.is_alive():
        chain = ChainFile.read(path)
        counts = [chain.blocks(phase) for phase in PHASES]
        seen.add(sum(counts))
        for phase, count in zip(PHASES, counts, strict=True):
            for number in range(count):
                for mine, yours in zip(
                    blocks(phase, number), chain.block_of(phase, number), strict=True
                ):
                    np.testing.assert_array_equal(mine.coordinates, yours.coordinates)
    assert process.exitcode == 0
    assert seen <= set(range(sum(count for _, count in PLAN) + 1))


def test_uncommitted_block_is_never_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "chain.h5"
    with new(path) as writer:
        writer.append("pilot", blocks("pilot", 0))
        monkeypatch.setattr(ChainFile, "_commit", lambda *_: None)
        writer.append("pilot", blocks("pilot", 1))
        assert 1 == ChainFile.read(path).blocks("pilot")


# Killing


def mortal(method: Callable[..., Any], moment: Callable[[], None]) -> Callable[..., Any]:
    """Make a method one of whose two ends may be its process's last moment."""

    def wrapped(*args: Any, **kwargs: Any) -> Any:
        moment()
        result = method(*args, **kwargs)
        moment()
        return result

    return wrapped


def write(path: Path, last_moment: int | None = None) -> None:
    """Finish the chain, or die before or after one of the calls that change its file."""
    moments = itertools.count()

    def moment() -> None:
        if next(moments) == last_moment:
            os.kill(os.getpid(), signal.SIGKILL)

    for owner, name in (
        (h5py.Dataset, "__setitem__"),
        (h5py.Dataset, "resize"),
        (h5py.File, "flush"),
        (h5py.File, "close"),
        (Path, "replace"),
    ):
        setattr(owner, name, mortal(getattr(owner, name), moment))
    with ChainFile.resume(path) if path.exists() else new(path) as chain:
        finish(chain)


def written(path: Path, last_moment: int | None = None) -> int | None:
    process = FORKS.Process(target=write, args=(path, last_moment))
    process.start()
    process.join()
    return process.exitcode


# Some fall into the start, most into a block, its count, or the copy with which a run goes on.
@pytest.mark.parametrize("first", [0, 1, 3, 7, 20, 31, 44, 47, 48, 50, 53, 57, 60, 64, 71, 90, 120])
def test_killed_anywhere_it_goes_on_to_the_same_bits(
    first: int, tmp_path: Path, expected: dict[str, Any]
) -> None:
    """Killed twice, the second time when it has gone on: copying, or in a later block."""
    path = tmp_path / "chain.h5"
    assert written(path, first) == -signal.SIGKILL
    before = len(ChainFile.read(path).ends) if path.exists() else 0
    assert before in (0, ENSEMBLES)
    counts = committed(path)
    assert written(path, 5 + first // 2) == -signal.SIGKILL
    assert all(now >= then for now, then in zip(committed(path), counts, strict=True))
    assert written(path) == 0
    assert_same(expected, arrays(ChainFile.read(path)))


def write_and_tell(path: Path, told: Any) -> None:
    """Finish the chain block by block, and tell of each that should now be safe."""
    with ChainFile.resume(path) if path.exists() else new(path) as chain:
        original = chain.append

        def append(phase: Phase, made: list[Block]) -> None:
            original(phase, made)
            told.value += 1

        chain.append = append  # type: ignore[method-assign,assignment]
        finish(chain)


def test_killed_at_any_time_no_block_that_was_told_of_is_lost(
    tmp_path: Path, expected: dict[str, Any]
) -> None:
    path = tmp_path / "chain.h5"
    told = FORKS.Value("i", 0, lock=False)
    generator = np.random.default_rng(1)
    unfinished = 0
    for _ in range(20):
        process = FORKS.Process(target=write_and_tell, args=(path, told))
        required = told.value + generator.integers(2)
        process.start()
        while told.value < required and process.is_alive():
            time.sleep(1e-3)
        time.sleep(generator.uniform(0, 0.01))
        process.kill()
        process.join()
        blocks_there = sum(committed(path))
        assert told.value <= blocks_there
        told.value = blocks_there
        unfinished += 0 < blocks_there < sum(count for _, count in PLAN)
    assert unfinished > 0
    assert written(path) == 0
    assert_same(expected, arrays(ChainFile.read(path)))
