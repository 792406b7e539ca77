"""A chain that was cut or changed on the disk is recovered to its last whole block, and that said.

Of each file the test knows where the blocks are, so it knows which of them are whole. Also here is
what stops a chain from growing: a full disk.
"""

from __future__ import annotations

import os
import resource
import signal
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

from bwbayes.errors import InputError, InputWarning
from bwbayes.sampling.chain import PHASES
from bwbayes.sampling.storage import ChainFile
from tests.forks import FORKS
from tests.sampling.chains import (
    PLAN,
    arrays,
    assert_same,
    blocks,
    committed,
    finish,
    new,
)

BLOCKS = sum(count for _, count in PLAN)

Place = tuple[int, int]


def die_at_the_end(path: Path) -> None:
    finish(new(path))
    os.kill(os.getpid(), signal.SIGKILL)


@pytest.fixture(scope="module")
def killed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a whole file that its writer had no time to close."""
    path = tmp_path_factory.mktemp("killed") / "chain.h5"
    process = FORKS.Process(target=die_at_the_end, args=(path,))
    process.start()
    process.join()
    assert -signal.SIGKILL == process.exitcode
    return path


def chunks(path: Path) -> list[dict[str, Place]]:
    """Return for each block, in order, where its numbers are: first byte and the one after."""
    result = []
    with h5py.File(path, "r") as file:
        for phase, count in PLAN:
            for number in range(count):
                infos = {n: d.id.get_chunk_info(number) for n, d in file[phase].items()}
                result.append(
                    {n: (i.byte_offset, i.byte_offset + i.size) for n, i in infos.items()}
                )
    return result


def flipped(content: bytes, place: int, bit: int = 3) -> bytes:
    damaged = bytearray(content)
    damaged[place] ^= 1 << bit
    return bytes(damaged)


def read_damaged(path: Path) -> ChainFile:
    """Read a chain that must say in one line that it is damaged."""
    with pytest.warns(InputWarning) as said:
        chain = ChainFile.read(path)
    (text,) = [str(warning.message) for warning in said]
    kept = sum(len(chain.history(phase)) for phase in PHASES)
    assert "\n" not in text
    assert text.startswith(f"{path}: damaged (")
    assert text.endswith(
        f"); the {kept} whole blocks before that are used, and resuming makes the others again"
    )
    return chain


def kept_blocks(chain: ChainFile) -> int:
    """Count the blocks of a chain, each of which must be what was written."""
    kept = 0
    for phase, count in PLAN:
        here = chain.history(phase)
        for number, got in enumerate(here):
            for mine, yours in zip(blocks(phase, number), got, strict=True):
                for name in ("coordinates", "log_density", "accepted"):
                    np.testing.assert_array_equal(getattr(mine, name), getattr(yours, name))
                np.testing.assert_array_equal(mine.end.random_state, yours.end.random_state)
        kept += len(here)
        if len(here) < count:
            break
    assert kept == sum(len(chain.history(phase)) for phase in PHASES)
    return kept


# Cut


def test_cut_file_is_read_to_its_last_whole_block(whole: Path, tmp_path: Path) -> None:
    content, path = whole.read_bytes(), tmp_path / "chain.h5"
    ends = [max(end for _, end in places.values()) for places in chunks(whole)]
    first = min(start for start, _ in chunks(whole)[0].values())
    lengths = np.random.default_rng(1).integers(first, max(ends) - 1, size=20)
    for length in [*lengths, ends[4], ends[4] - 1, max(ends) - 1]:
        path.write_bytes(content[:length])
        before = [end <= length for end in ends]
        assert before.index(False) == kept_blocks(read_damaged(path)), length


@pytest.mark.parametrize("kept", [0.9, 0.3, 0.05])
def test_cut_file_goes_on_to_the_same_bits(
    whole: Path, tmp_path: Path, expected: dict[str, Any], kept: float
) -> None:
    content, path = whole.read_bytes(), tmp_path / "chain.h5"
    path.write_bytes(content[: int(kept * len(content))])
    with pytest.warns(InputWarning, match="damaged"):
        chain = ChainFile.resume(path)
    with chain:
        assert 0 <= sum(chain.blocks(phase) for phase in PHASES) < BLOCKS
        finish(chain)
    assert_same(expected, arrays(ChainFile.read(path)))


# Changed


@pytest.mark.parametrize("name", ["coordinates", "log_density", "accepted", "moves"])
def test_file_with_a_changed_block_is_read_up_to_there(
    whole: Path, tmp_path: Path, name: str
) -> None:
    content, path = whole.read_bytes(), tmp_path / "chain.h5"
    generator = np.random.default_rng(2)
    for number, places in enumerate(chunks(whole)):
        path.write_bytes(flipped(content, int(generator.integers(*places[name]))))
        assert number == kept_blocks(read_damaged(path))


def test_zeros_where_a_block_was_are_noticed(whole: Path, tmp_path: Path) -> None:
    """As a disk leaves them that lost power; they pass a checksum that is zero as well."""
    path = tmp_path / "chain.h5"
    for name in ("coordinates", "log_density", "random_state"):
        content = bytearray(whole.read_bytes())
        start, end = chunks(whole)[7][name]
        content[start:end] = bytes(end - start)
        path.write_bytes(content)
        assert 7 == kept_blocks(read_damaged(path))


def test_what_is_there_once_is_written_twice(
    whole: Path, tmp_path: Path, expected: dict[str, Any]
) -> None:
    """Starts, point fit, proposals and what counts survive a change in any one place."""
    content, path = whole.read_bytes(), tmp_path / "chain.h5"
    names = ["committed", "point/mode", "point/covariance", "start/coordinates"]
    names += ["start/random_state", "proposal/tuning/centres", "proposal/sampling/factors"]
    for name in names:
        with h5py.File(whole, "r") as file:
            infos = [file[name].id.get_chunk_info(i) for i in range(2)]
        for info in infos:
            path.write_bytes(flipped(content, info.byte_offset + info.size // 2))
            assert_same(expected, arrays(ChainFile.read(path)))


@pytest.mark.parametrize("closed", [True, False], ids=["closed", "killed"])
def test_change_anywhere_costs_no_block_before_it(
    whole: Path, killed: Path, tmp_path: Path, closed: bool
) -> None:
    """Most changes are where the numbers are few and all matter. None makes reading wait."""
    content, path = (whole if closed else killed).read_bytes(), tmp_path / "chain.h5"
    generator = np.random.default_rng(5)
    head = min(start for start, _ in chunks(whole)[0].values())
    places = [*generator.integers(head, size=60), *generator.integers(len(content), size=20)]
    outcomes = {"whole": 0, "recovered": 0, "refused": 0}
    for place in places:
        path.write_bytes(flipped(content, int(place), int(generator.integers(8))))
        try:
            chain = ChainFile.read(path)
        except InputWarning:
            outcomes["recovered"] += 1
            kept_blocks(read_damaged(path))
        except InputError:
            outcomes["refused"] += 1
            assert place < head
            assert_refused(path, "cannot be read")
        else:
            outcomes["whole"] += 1
            assert BLOCKS == kept_blocks(chain)
    assert outcomes["recovered"] >= 15
    assert outcomes["refused"] < 0.15 * len(places)


# Not a chain


def assert_refused(path: Path, why: str) -> None:
    with pytest.raises(InputError, match=why) as error:
        ChainFile.read(path)
    assert "\n" not in str(error.value)
    assert str(error.value).startswith(f"{path}: ")


@pytest.mark.parametrize("content", [b"", b"no chain", b"\x89HDF\r\n\x1a\n" + bytes(600)])
def test_other_file_is_refused(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "chain.h5"
    path.write_bytes(content)
    assert_refused(path, "cannot be read")


def test_chain_of_another_format_is_refused(whole: Path, tmp_path: Path) -> None:
    path = tmp_path / "chain.h5"
    path.write_bytes(whole.read_bytes())
    with h5py.File(path, "r+") as file:
        file.attrs["format"] = 99
    assert_refused(path, "format is 99")


# No room


def write_with_room_for(path: Path, size: int, told: Any) -> None:
    """Go on with a chain, or start it, as far as there is room; tell the error."""
    signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, size))
    try:
        with ChainFile.resume(path) if path.exists() else new(path) as chain:
            finish(chain)
    except InputError as error:
        told.put(str(error))


def error_with_room_for(path: Path, size: int) -> str:
    told = FORKS.Queue()
    process = FORKS.Process(target=write_with_room_for, args=(path, size, told))
    process.start()
    text: str = told.get(timeout=60)
    process.join()
    assert 0 == process.exitcode
    return text


def test_full_disk_is_told_in_one_line_and_the_chain_goes_on_when_there_is_room(
    tmp_path: Path, expected: dict[str, Any]
) -> None:
    path = tmp_path / "chain.h5"
    says = (
        ": cannot be written (File too large); no block of the chain is lost: fix that, then "
        "resume the run"
    )
    for size in (10_000, 50_000):  # not even the layout
        assert f"{path}{says}" == error_with_room_for(path, size)
        assert [] == list(tmp_path.iterdir())
    before = 0
    for size in (700_000, 1_500_000, 2_500_000):
        assert f"{path}{says}" == error_with_room_for(path, size)
        now = sum(committed(path))
        assert before < now < BLOCKS
        before = now
    content = path.read_bytes()
    assert error_with_room_for(path, 700_000).endswith(says)  # no room for its copy
    assert content == path.read_bytes()
    assert [path] == list(tmp_path.iterdir())
    with ChainFile.resume(path) as chain:
        finish(chain)
    assert_same(expected, arrays(ChainFile.read(path)))
