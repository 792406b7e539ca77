"""The chain file is whole at every moment: killed, read while written, or damaged on the disk."""

from __future__ import annotations

import itertools
import multiprocessing
import os
import signal
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

from bwbayes.errors import InputError
from bwbayes.inference.chain import PHASES, Chain, Phase
from bwbayes.inference.chainfile import ChainFile
from bwbayes.inference.ensemble import RANDOM_STATE_WORDS, Block, EnsembleState
from bwbayes.inference.pointfit import PointFit
from bwbayes.inference.proposals import COMPONENTS, StudentMixture, StudentProposal

ENSEMBLES, WALKERS, FREE, STEPS = 4, 16, 8, 50
ATTRIBUTES: dict[str, str | int] = {
    "config": '[record]\nfile = "µm.csv"\n',
    "data_sha256": "94fd",
    "versions": '{"numpy": "2.0"}',
    "platform": "Linux",
    "seed": 7,
}
# What a writer does, in order, and where it may be interrupted.
PLAN: tuple[tuple[Phase, int], ...] = (("pilot", 2), ("tuning", 2), ("sampling", 10))

# Processes that start in milliseconds, from one that has all imported already.
FORKS = multiprocessing.get_context("forkserver")
FORKS.set_forkserver_preload([__name__])


def state(generator: np.random.Generator) -> EnsembleState:
    words = generator.integers(2**32, size=RANDOM_STATE_WORDS, dtype=np.uint32)
    coordinates = generator.standard_normal((WALKERS, FREE))
    return EnsembleState(coordinates, generator.standard_normal(WALKERS), words)


def blocks(phase: Phase, number: int) -> list[Block]:
    """Make up the block of every ensemble: always the same one."""
    generator = np.random.default_rng([PHASES.index(phase), number])
    made = []
    for _ in range(ENSEMBLES):
        end = state(generator)
        coordinates = generator.standard_normal((STEPS, WALKERS, FREE))
        density = generator.standard_normal((STEPS, WALKERS))
        coordinates[-1], density[-1] = end.coordinates, end.log_density
        made.append(Block(coordinates, density, generator.integers(STEPS, size=WALKERS), end))
    return made


def proposal(phase: Phase) -> StudentMixture:
    generator = np.random.default_rng(PHASES.index(phase))
    factors = np.tril(generator.standard_normal((COMPONENTS, FREE, FREE)))
    centres = generator.standard_normal((COMPONENTS, FREE))
    parts = tuple(StudentProposal(*pair) for pair in zip(centres, factors, strict=True))
    return StudentMixture(generator.dirichlet(np.ones(COMPONENTS)), parts)


def new(path: Path, blocks_before: int = 0) -> ChainFile:
    generator = np.random.default_rng(0)
    mode = generator.standard_normal(FREE)
    point = PointFit(mode, np.eye(FREE), -3.5, np.stack([mode, -mode]), 4 * np.eye(FREE))
    chain = Chain([state(generator) for _ in range(ENSEMBLES)])
    for number in range(blocks_before):
        chain.append("pilot", blocks("pilot", number))
    return ChainFile.create(path, chain, point, STEPS, ATTRIBUTES)


def finish(chain: Chain) -> None:
    """Do what is left of the plan, as a sampling does."""
    for phase, count in PLAN:
        if phase != "pilot" and not chain.blocks(phase):
            chain.freeze(phase, proposal(phase))
        while chain.blocks(phase) < count:
            chain.append(phase, blocks(phase, chain.blocks(phase)))


def arrays(chain: ChainFile) -> dict[str, Any]:
    """Return all that a chain holds, by name."""
    held: dict[str, Any] = {"point density": np.array(chain.point.log_density)}
    for name in ("mode", "covariance", "optima", "prior_covariance"):
        held[f"point {name}"] = getattr(chain.point, name)
    for phase in PHASES:
        held[f"{phase} blocks"] = np.array(chain.blocks(phase))
        if chain.blocks(phase):
            for name in ("coordinates", "log_density", "accepted"):
                held[f"{phase} {name}"] = getattr(chain, name)(phase)
        for number in range(chain.blocks(phase)):
            ends = [block.end.random_state for block in chain.block_of(phase, number)]
            held[f"{phase} {number} random states"] = np.stack(ends)
        mixture = chain.proposals[phase]
        if mixture is not None:
            held[f"{phase} weights"] = mixture.weights
            held[f"{phase} centres"] = np.stack([c.centre for c in mixture.components])
            held[f"{phase} factors"] = np.stack([c.factor for c in mixture.components])
    for kind, states in (("start", chain.starts), ("end", chain.ends)):
        for name in ("coordinates", "log_density", "random_state"):
            held[f"{kind} {name}"] = np.stack([getattr(one, name) for one in states])
    return held


def assert_same(expected: dict[str, Any], got: dict[str, Any]) -> None:
    assert expected.keys() == got.keys()
    for name, value in expected.items():
        np.testing.assert_array_equal(value, got[name], err_msg=name)


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the file of a run that was never interrupted."""
    path = tmp_path_factory.mktemp("whole") / "chain.h5"
    with new(path) as chain:
        finish(chain)
    return path


@pytest.fixture(scope="module")
def expected(whole: Path) -> dict[str, Any]:
    return arrays(ChainFile.read(whole))


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


def committed(path: Path) -> list[int]:
    if not path.exists():
        return [0] * len(PHASES)
    chain = ChainFile.read(path)
    return [chain.blocks(phase) for phase in PHASES]


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
        wanted = told.value + generator.integers(2)
        process.start()
        while told.value < wanted and process.is_alive():
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


# Damage


def assert_one_line(error: pytest.ExceptionInfo[InputError], path: Path) -> None:
    assert "\n" not in str(error.value)
    assert str(error.value).startswith(f"{path}: ")


def test_missing_file_is_said(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="does not exist") as error:
        ChainFile.read(tmp_path / "chain.h5")
    assert_one_line(error, tmp_path / "chain.h5")


@pytest.mark.parametrize("content", [b"", b"no chain", b"\x89HDF\r\n\x1a\n" + bytes(600)])
def test_other_file_is_refused(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "chain.h5"
    path.write_bytes(content)
    with pytest.raises(InputError, match="cannot be read") as error:
        ChainFile.read(path)
    assert_one_line(error, path)


def test_hdf5_file_that_is_no_chain_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "chain.h5"
    with h5py.File(path, "w") as file:
        file["voltage"] = np.zeros(3)
    with pytest.raises(InputError, match="cannot be read") as error:
        ChainFile.read(path)
    assert_one_line(error, path)


def test_chain_of_another_format_is_refused(whole: Path, tmp_path: Path) -> None:
    path = tmp_path / "chain.h5"
    path.write_bytes(whole.read_bytes())
    with h5py.File(path, "r+") as file:
        file.attrs["format"] = 99
    with pytest.raises(InputError, match="format is 99"):
        ChainFile.read(path)


@pytest.mark.parametrize("kept", [0.999, 0.9, 0.5, 0.1, 0.01])
def test_cut_file_is_refused(whole: Path, tmp_path: Path, kept: float) -> None:
    path, content = tmp_path / "chain.h5", whole.read_bytes()
    path.write_bytes(content[: int(kept * len(content))])
    with pytest.raises(InputError) as error:
        ChainFile.read(path)
    assert_one_line(error, path)


def test_flipped_bit_is_noticed_or_harmless(
    whole: Path, tmp_path: Path, expected: dict[str, Any]
) -> None:
    """A bit in each of many places, most of them where the numbers are few and all matter."""
    content = whole.read_bytes()
    generator = np.random.default_rng(5)
    head = min(60_000, len(content))
    places = [*generator.integers(head, size=150), *generator.integers(len(content), size=30)]
    refused = 0
    path = tmp_path / "chain.h5"
    for place in places:
        damaged = bytearray(content)
        damaged[place] ^= 1 << int(generator.integers(8))
        path.write_bytes(damaged)
        try:
            found = arrays(ChainFile.read(path))
        except InputError:
            refused += 1
            continue
        assert_same(expected, found)
    assert refused > len(places) / 10
