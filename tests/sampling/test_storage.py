"""The chain file keeps what was written, what was set aside, and what was said of the run."""

from __future__ import annotations

from pathlib import Path

import h5py
import numpy as np

from bwbayes.sampling.chain import PHASES
from bwbayes.sampling.storage import REFITTED, ChainFile
from tests.sampling.chains import (
    ATTRIBUTES,
    PLAN,
    arrays,
    assert_same,
    blocks,
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
