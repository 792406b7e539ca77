"""Stopped before any single write of three consecutive saves, a chain loses nothing.

The file is copied at each of these moments, and every copy must hold all blocks that were said to
be safe, and go on from there to the same bits. A block of HDF5 is some twenty writes. The
reader that reads as fast as it can, while another process writes as fast as it can, is here too.
"""

from __future__ import annotations

import platform
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from bwbayes.sampling.chain import PHASES, Block, EnsembleState, Phase
from bwbayes.sampling.storage import ChainFile
from tests.forks import FORKS
from tests.inference.traced import WRITES, stopped_before_every_write
from tests.sampling.chains import arrays, assert_same, blocks, committed, new, proposal

# Three saves, one of which has a proposal frozen before it.
SAVES: tuple[tuple[Phase, int], ...] = (("pilot", 1), ("pilot", 2), ("tuning", 1))


def save(path: Path, told: Any) -> None:
    """Go on with a chain, or start it, to the end of the three saves."""
    with ChainFile.resume(path) if path.exists() else new(path) as chain:
        for phase, count in SAVES:
            if chain.blocks(phase) < count:
                if phase == "tuning":
                    chain.freeze(phase, proposal(phase))
                chain.append(phase, blocks(phase, chain.blocks(phase)))
                told.value += 1


def trace(folder: Path, told: Any, status: Any) -> None:
    """Save three blocks, and copy the folder before every write of it."""
    path = folder / "run" / "chain.h5"
    moments = 0

    def look(name: str) -> None:
        nonlocal moments
        shutil.copytree(path.parent, folder / f"{moments:04d}-{told.value}-{name}")
        moments += 1

    status.value = stopped_before_every_write(lambda: save(path, told), look)


@pytest.mark.skipif(
    platform.system() != "Linux" or platform.machine() not in WRITES,
    reason="knows the system calls of Linux alone",
)
@pytest.mark.parametrize("new_chain", [True, False], ids=["new", "resumed"])
def test_stopped_before_any_write_it_loses_nothing(tmp_path: Path, new_chain: bool) -> None:
    run = tmp_path / "run"
    run.mkdir()
    if not new_chain:
        new(run / "chain.h5").close()
    told, status = FORKS.Value("i", 0, lock=False), FORKS.Value("i", 1, lock=False)
    process = FORKS.Process(target=trace, args=(tmp_path, told, status))
    process.start()
    process.join()
    if status.value == -1:
        pytest.skip("no process may be traced here")
    assert (0, 0) == (process.exitcode, status.value)
    expected = arrays(ChainFile.read(run / "chain.h5"))
    moments = sorted(path for path in tmp_path.iterdir() if path != run)
    assert len(moments) > 60
    seen = set()
    for moment in moments:
        path, safe = moment / "chain.h5", int(moment.name.split("-")[1])
        before = sum(committed(path))
        assert safe <= before <= safe + 1, moment.name
        seen.add(before)
        save(path, FORKS.Value("i", 0, lock=False))
        assert_same(expected, arrays(ChainFile.read(path)))
        shutil.rmtree(moment)
    assert {0, 1, 2, 3} == seen


# Blocks of one step, as fast as they come.
SHORT = 200


def short(number: int) -> list[Block]:
    """Return a block of one step that bears its number."""
    made = []
    for block in blocks("pilot", 0):
        coordinates = np.full_like(block.coordinates[:1], number + 1)
        density = block.log_density[:1]
        end = EnsembleState(coordinates[-1], density[-1], block.end.random_state)
        made.append(Block(coordinates, density, block.accepted, block.moves, end))
    return made


def write_short(path: Path, told: Any) -> None:
    with ChainFile.resume(path) as chain:
        for number in range(SHORT):
            chain.append("sampling", short(number))
            told.value = number + 1


def test_reader_meets_whole_blocks_alone_while_another_process_writes(tmp_path: Path) -> None:
    """Every reading is consistent, and as new as the last block that was said to be safe."""
    path = tmp_path / "chain.h5"
    new(path, steps=1).close()
    told = FORKS.Value("i", 0, lock=False)
    process = FORKS.Process(target=write_short, args=(path, told))
    process.start()
    readings = 0
    while process.is_alive():
        safe = told.value
        chain = ChainFile.read(path)
        counts = [chain.blocks(phase) for phase in PHASES]
        assert [0, 0] == counts[:2]
        assert safe <= counts[2]
        for number in range(counts[2]):
            for block in chain.block_of("sampling", number):
                assert {number + 1} == set(block.coordinates.ravel().tolist())
        readings += 1
    assert 0 == process.exitcode
    assert SHORT == ChainFile.read(path).blocks("sampling")
    assert readings > 5
