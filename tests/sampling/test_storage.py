"""The chain's files keep what was written, whenever its writer dies and whatever a disk loses."""

import errno
import shutil
import time
from collections.abc import Callable
from pathlib import Path
from threading import Thread
from typing import Any

import emcee
import numpy as np
import pytest

from bwbayes.errors import InputError, InputWarning
from bwbayes.sampling.chain import PHASES, ChainFile
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


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    chain = new(tmp_path_factory.mktemp("whole") / "chain")
    finish(chain)
    return chain.path


def files_of(path: Path) -> list[Path]:
    names = ["start"]
    for phase, count in PLAN:
        names += [f"{phase}-proposal"] if phase != "pilot" else []
        names += [f"{phase}-{number:04d}" for number in range(count)]
    files = [path / f"{name}.npz" for name in names]
    assert sorted(files) == sorted(path.iterdir())
    return files


def test_what_is_read_is_what_was_written(tmp_path: Path) -> None:
    chain = new(tmp_path / "chain")
    finish(chain)
    read = ChainFile.read(chain.path)
    assert [count for _, count in PLAN] == [read.blocks(phase) for phase in PHASES]
    assert_same(arrays(chain), arrays(read))
    np.testing.assert_array_equal(proposal("tuning").weights, arrays(read)["tuning weights"])
    assert read.attributes() == ATTRIBUTES == ChainFile.resume(chain.path).attributes()


def test_blocks_that_were_set_aside_stay_so_and_are_kept(tmp_path: Path) -> None:
    """With the proposal that was fitted to them; without the last blocks all count again."""
    chain = new(tmp_path / "chain")
    chain.freeze("sampling", proposal("sampling"))
    for number, refit in enumerate((proposal("tuning"), proposal("sampling"), None)):
        chain.append("sampling", blocks("sampling", number))
        chain.fall_back(number + 1, refit)
        read = ChainFile.resume(chain.path)
        assert (number + 1, 0) == (read.set_aside, read.blocks("sampling"))
        assert_same(arrays(chain), arrays(read))
        assert (refit is None) == (read.proposal_in_use("sampling") is None)
    chain.append("sampling", blocks("sampling", 3))
    read = ChainFile.read(chain.path)
    assert (1, 4) == (read.blocks("sampling"), len(read.history("sampling")))
    (chain.path / "sampling-0002.npz").unlink()
    assert (0, 2) == (
        ChainFile.read(chain.path).set_aside,
        ChainFile.read(chain.path).blocks("sampling"),
    )


def test_stopped_at_any_moment_it_loses_nothing(whole: Path, tmp_path: Path) -> None:
    """A writer only ever adds to a draft, which then gets its name: all such states, 60 of them."""
    files, expected = files_of(whole), arrays(ChainFile.read(whole))
    states = 0
    for number, file in enumerate(files[1:], start=1):
        content = file.read_bytes()
        for length in (None, 0, 100, len(content)):
            path = tmp_path / f"{number}-{length}"
            path.mkdir()
            for before in files[:number]:
                shutil.copyfile(before, path / before.name)
            if length is not None:
                (path / file.name).with_suffix(".partial").write_bytes(content[:length])
            chain = ChainFile.resume(path)
            safe = sum("-0" in before.name for before in files[:number])
            assert safe == sum(chain.blocks(phase) for phase in PHASES)
            finish(chain)
            assert_same(expected, arrays(ChainFile.read(path)))
            files_of(path)
            states += 1
    assert states >= 60


def test_a_chain_that_was_not_created_to_its_end_is_created_again(tmp_path: Path) -> None:
    (tmp_path / "chain.partial").mkdir()
    (tmp_path / "chain.partial/start.partial").write_bytes(b"PK")
    chain = new(tmp_path / "chain")
    assert [chain.path] == list(tmp_path.iterdir())


def flipped(content: bytes, source: np.random.Generator) -> bytes:
    damaged = bytearray(content)
    damaged[int(source.integers(len(content)))] ^= 1 << int(source.integers(8))
    return bytes(damaged)


DAMAGES: dict[str, Callable[[bytes, np.random.Generator], bytes]] = {
    "a bit": flipped,
    "its end": lambda content, source: content[: int(source.integers(len(content)))],
    "all zeros": lambda content, _: bytes(len(content)),
}


@pytest.mark.filterwarnings("error::bwbayes.InputWarning")  # whatever the others are
@pytest.mark.parametrize("kind", DAMAGES)
def test_what_comes_before_a_damage_is_used_and_resuming_makes_the_rest_again(
    whole: Path, tmp_path: Path, kind: str
) -> None:
    """With 20 damages each; a bit may lie where it does not matter. Either way it says so."""
    source, files = np.random.default_rng(1), files_of(whole)
    expected, harmless = arrays(ChainFile.read(whole)), 0
    for trial in range(20):
        path = tmp_path / f"{trial}"
        shutil.copytree(whole, path)
        file = path / files[int(source.integers(1, len(files)))].name
        file.write_bytes(DAMAGES[kind](file.read_bytes(), source))
        try:
            chain = ChainFile.read(path)
            harmless += 1
        except InputWarning:
            with pytest.warns(InputWarning, match="damaged .*; the .* resuming makes the others"):
                chain = ChainFile.resume(path)
            before = files[: [f.name for f in files].index(file.name)]
            n_whole = sum(len(chain.history(phase)) for phase in PHASES)
            assert n_whole == sum("-0" in name.name for name in before)
        finish(chain)
        assert_same(expected, arrays(ChainFile.read(path)))
    assert harmless < 5


@pytest.mark.parametrize("content", [b"", b"no chain", b"PK\3\4" + bytes(600)])
def test_another_file_in_place_of_the_start_is_refused(
    whole: Path, tmp_path: Path, content: bytes
) -> None:
    path = tmp_path / "chain"
    with pytest.raises(InputError, match=f"^{path}: the chain does not exist; resume the run$"):
        ChainFile.read(path)
    shutil.copytree(whole, path)
    (path / "start.npz").write_bytes(content)
    with pytest.raises(InputError, match=f"^{path}: the chain cannot be read .*; delete it "):
        ChainFile.read(path)


def test_a_full_disk_is_told_in_one_line_and_the_chain_goes_on_when_there_is_room(
    whole: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def savez(file: Any, **_: Any) -> None:
        file.write(b"PK")
        raise OSError(errno.ENOSPC, "No space left on device")

    path = tmp_path / "chain"
    says = rf"{path}\S*: cannot be written \(No space left on device\); no block of the chain is "
    with monkeypatch.context() as patch:
        patch.setattr(np, "savez", savez)
        with pytest.raises(InputError, match=says):
            new(path)
    assert [] == list(tmp_path.iterdir())
    chain = new(path)
    chain.append("pilot", blocks("pilot", 0))
    with monkeypatch.context() as patch:
        patch.setattr(np, "savez", savez)
        with pytest.raises(InputError, match=says):
            chain.append("pilot", blocks("pilot", 1))
    assert 1 == ChainFile.read(path).blocks("pilot")
    assert not list(path.glob("*.partial"))
    finish(ChainFile.resume(path))
    assert_same(arrays(ChainFile.read(whole)), arrays(ChainFile.read(path)))


def test_a_reader_meets_whole_blocks_alone_while_another_writes(tmp_path: Path) -> None:
    """Every reading is consistent, and as new as the last block that was said to be safe."""
    chain = new(tmp_path / "chain")

    def write() -> None:
        for _ in range(40):
            chain.append("sampling", blocks("pilot", 0))
            time.sleep(0.02)

    writer = Thread(target=write)
    writer.start()
    counts = [0]
    while writer.is_alive():
        safe = chain.blocks("sampling")
        counts.append(ChainFile.read(chain.path).blocks("sampling"))
        assert counts[-1] >= max(safe, counts[-2])
    writer.join()
    assert ChainFile.read(chain.path).blocks("sampling") == 40
    assert len(set(counts)) > 2


def test_emcee_opens_each_ensemble_during_a_run_and_after_it_and_goes_on(tmp_path: Path) -> None:
    """It reads the draws that count so far; its own sampler continues from there."""
    chain = new(tmp_path / "chain")
    finish(chain)
    chain.fall_back(1)  # of the sampling, which counts no longer
    chain.publish()
    file = tmp_path / "chain.h5"
    coordinates = chain.coordinates("sampling")
    for number, end in enumerate(chain.ends):
        backend = emcee.backends.HDFBackend(str(file), name=f"ensemble_{number + 1}")
        np.testing.assert_array_equal(backend.get_chain(), coordinates[:, number])
        np.testing.assert_array_equal(
            backend.get_log_prob(), chain.log_density("sampling")[:, number]
        )
        np.testing.assert_array_equal(
            backend.accepted, np.sum(chain.accepted("sampling")[:, number], axis=0)
        )
        last = backend.get_last_sample()
        np.testing.assert_array_equal(last.random_state[1], end.random_state[:624])
        walkers, free = last.coords.shape
        sampler = emcee.EnsembleSampler(
            walkers, free, lambda x: -0.5 * np.sum(x**2, axis=1), vectorize=True, backend=backend
        )
        sampler.run_mcmc(last, 3, skip_initial_state_check=True)
        assert backend.iteration == len(coordinates) + 3
    # The next check writes it anew; the chain itself is not read from it.
    chain.publish()
    assert emcee.backends.HDFBackend(str(file), name="ensemble_1").iteration == len(coordinates)
    assert [chain.path, file] == sorted(tmp_path.iterdir())


@pytest.mark.parametrize("length", [0, 100, 2000])
def test_a_backend_that_is_cut_off_costs_nothing(tmp_path: Path, length: int) -> None:
    """It becomes ``chain.h5`` only when it is whole, and the chain does without it."""
    chain = new(tmp_path / "chain")
    finish(chain)
    chain.publish()
    whole = (tmp_path / "chain.h5").read_bytes()
    (tmp_path / "chain.h5.partial").write_bytes(whole[:length])
    assert emcee.backends.HDFBackend(str(tmp_path / "chain.h5"), name="ensemble_1").initialized
    resumed = ChainFile.resume(tmp_path / "chain")
    assert_same(arrays(chain), arrays(resumed))
    resumed.publish()
    assert [chain.path, tmp_path / "chain.h5"] == sorted(tmp_path.iterdir())
