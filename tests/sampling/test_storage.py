"""The chain file is whole at every moment: killed, read while written, or damaged on the disk."""

from __future__ import annotations

import itertools
import os
import signal
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

from bwbayes.sampling.chain import PHASES
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


def test_what_is_read_is_what_was_written(tmp_path: Path) -> None:
    with new(tmp_path / "chain.h5") as chain:
        finish(chain)
        memory = arrays(chain)
    read = ChainFile.read(tmp_path / "chain.h5")
    assert [count for _, count in PLAN] == [read.blocks(phase) for phase in PHASES]
    assert_same(memory, arrays(read))
    np.testing.assert_array_equal(proposal("tuning").weights, memory["tuning weights"])


def test_attributes_say_what_was_run_and_survive_going_on(whole: Path, tmp_path: Path) -> None:
    assert ChainFile.read(whole).attributes() == ATTRIBUTES
    copy = tmp_path / "chain.h5"
    copy.write_bytes(whole.read_bytes())
    with ChainFile.resume(copy) as chain:
        assert chain.attributes() == ATTRIBUTES
    assert ChainFile.read(copy).attributes() == ATTRIBUTES


def test_how_many_blocks_a_proposal_was_fitted_to_is_kept(tmp_path: Path) -> None:
    """Through a file that goes on; without the last blocks all count again."""
    path = tmp_path / "chain.h5"
    with new(path) as chain:
        chain.freeze("sampling", proposal("sampling"))
        chain.append("sampling", blocks("sampling", 0))
        chain.fall_back(1, proposal("tuning"))
        assert_same_proposal(proposal("tuning"), chain.proposal_in_use("sampling"))
    for made in (1, 2):
        with ChainFile.resume(path) as chain:
            assert (made, made) == (chain.refitted, chain.set_aside)
            chain.append("sampling", blocks("sampling", made))
            chain.fall_back(made + 1, proposal("tuning") if made == 1 else None)
    read = ChainFile.read(path)
    assert (2, 3) == (read.refitted, read.set_aside)
    assert read.proposal_in_use("sampling") is None
    with h5py.File(path, "r+") as file:
        file["committed"][:, PHASES.index("sampling")] = 2
    read = ChainFile.read(path)
    assert (0, 0) == (read.refitted, read.set_aside)


def test_a_file_that_knows_of_no_other_proposal_is_read(tmp_path: Path) -> None:
    path = tmp_path / "chain.h5"
    with new(path) as chain:
        chain.freeze("sampling", proposal("sampling"))
        chain.append("sampling", blocks("sampling", 0))
        chain.fall_back(1)
    with h5py.File(path, "r+") as file:
        shorter = file["committed"][:, :REFITTED]
        del file["committed"]
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
    assert_same(expected, arrays(ChainFile.read(path)))
    with ChainFile.resume(path) as resumed:
        resumed.append("sampling", blocks("sampling", 4))
        longer = arrays(resumed)
    read = ChainFile.read(path)
    assert_same(longer, arrays(read))
    assert (2, 3, 5) == (read.set_aside, read.blocks("sampling"), len(read.history("sampling")))
    assert read.proposals["sampling"] is not None
    assert read.proposal_in_use("sampling") is None


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
@pytest.mark.parametrize("first", [0, 3, 20, 44, 48, 53, 60, 71, 120])
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
