"""The chain on disk: appended block by block, whole at every moment.

An HDF5 file in single-writer mode, whose datasets all exist from the start: a block is written and
flushed, then the number of blocks that count, and only what is counted is ever read. A process
killed in between loses the block in hand and nothing else. All numbers carry checksums. Going on
from such a file first copies what counts into a fresh one. This module alone knows the layout:

    /start, /pilot, /tuning, /sampling   coordinates, log_density, accepted, random_state
    /proposal/PHASE                      weights, centres, factors of that phase's proposal
    /point                               the point fit
    /committed                           blocks of each phase; proposals of each phase (0 or 1)

and what was run (config, versions, seed, hash of the data) as the file's attributes.
"""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from bwbayes.errors import InputError
from bwbayes.inference.chain import PHASES, Chain, Phase
from bwbayes.inference.ensemble import RANDOM_STATE_WORDS, Block, EnsembleState
from bwbayes.inference.pointfit import PointFit
from bwbayes.inference.proposals import COMPONENTS, StudentMixture, StudentProposal

__all__ = ["ChainFile"]

FORMAT = 1


class ChainFile(Chain):
    """A chain that is written to a file as it grows. Use it as a context manager.

    Open one with :meth:`create` or :meth:`resume`. One process may write a file; that is for the
    caller to see to (a run locks its folder). Readers need no permission: see :meth:`read`.
    """

    def __init__(
        self, path: Path, point: PointFit, starts: Sequence[EnsembleState], block: int
    ) -> None:
        super().__init__(starts)
        self.path, self.point, self.block = path, point, block
        self._file: Any = None

    @classmethod
    def create(
        cls,
        path: Path,
        chain: Chain,
        point: PointFit,
        block: int,
        attributes: Mapping[str, str | int],
    ) -> ChainFile:
        """Write a chain, blocks of ``block`` steps or none yet, as a new file and open it."""
        made = cls(path, point, chain.starts, block)
        temporary = path.with_suffix(".partial")
        with h5py.File(temporary, "w", libver="latest") as file:
            _lay_out(file, point, chain.starts, block)
            file.attrs["format"] = FORMAT
            for name, value in attributes.items():
                file.attrs[name] = value
        _replace(temporary, path)
        made._open()
        for phase in PHASES:
            made.freeze(phase, chain.proposals[phase])
            for number in range(chain.blocks(phase)):
                made.append(phase, chain.block_of(phase, number))
        return made

    @classmethod
    def read(cls, path: Path) -> ChainFile:
        """Read a chain, finished, interrupted or being written; it cannot be extended.

        Raises
        ------
        InputError
            The file is missing, not a chain, or damaged before the last block that counts.
        """
        try:
            with _reading(path) as file:
                return cls._load(path, file)
        except (OSError, KeyError, ValueError, RuntimeError) as error:
            why = "does not exist" if not path.exists() else f"cannot be read ({error})"
            raise InputError(f"{path}: the chain {why}; run again") from None

    @classmethod
    def resume(cls, path: Path) -> ChainFile:
        """Read a chain and open it to go on, from the last block that counts.

        Raises
        ------
        InputError
            As :meth:`read`.
        """
        old = cls.read(path)
        fresh = path.with_suffix(".fresh")
        made = cls.create(fresh, old, old.point, old.block, old.attributes())
        # The name changes under the open file: it is the same file all along.
        _replace(fresh, path)
        made.path = path
        return made

    def attributes(self) -> dict[str, str | int]:
        """Return what was run: config, versions, platform, seed, hash of the data."""
        with _reading(self.path) as file:
            return {
                name: value if isinstance(value, str) else int(value)
                for name, value in file.attrs.items()
                if name != "format"
            }

    def append(self, phase: Phase, blocks: Sequence[Block]) -> None:
        """Add the next block of every ensemble; when this returns it is in the file."""
        number = self.blocks(phase)
        group = self._file[phase]
        steps = slice(number * self.block, (number + 1) * self.block)
        _put(group["coordinates"], steps, np.stack([b.coordinates for b in blocks], axis=1))
        _put(group["log_density"], steps, np.stack([b.log_density for b in blocks], axis=1))
        one = slice(number, number + 1)
        _put(group["accepted"], one, np.stack([b.accepted for b in blocks])[np.newaxis])
        states = np.stack([b.end.random_state for b in blocks])
        _put(group["random_state"], one, states[np.newaxis])
        self._commit(PHASES.index(phase), number + 1)
        super().append(phase, blocks)

    def freeze(self, phase: Phase, proposal: StudentMixture | None) -> None:
        """Fix the proposal of a phase, in the file too."""
        if proposal is not None:
            group = self._file[f"proposal/{phase}"]
            group["weights"][:] = proposal.weights
            group["centres"][:] = np.stack([c.centre for c in proposal.components])
            group["factors"][:] = np.stack([c.factor for c in proposal.components])
            self._commit(len(PHASES) + PHASES.index(phase), 1)
        super().freeze(phase, proposal)

    def close(self) -> None:
        """Close the file."""
        if self._file is not None:
            self._file.close()
            self._file = None

    def __enter__(self) -> ChainFile:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _open(self) -> None:
        self._file = h5py.File(self.path, "r+", libver="latest", locking=False)
        self._file.swmr_mode = True

    def _commit(self, place: int, count: int) -> None:
        """Let ``count`` count, once everything before has reached the file."""
        self._file.flush()
        self._file["committed"][place] = count
        self._file.flush()

    @classmethod
    def _load(cls, path: Path, file: Any) -> ChainFile:
        if file.attrs["format"] != FORMAT:
            raise ValueError(f"its format is {file.attrs['format']}, this version reads {FORMAT}")
        # Read before anything that it counts: a dataset that is open already may have grown since.
        committed = file["committed"][:]
        point = PointFit(
            **{name: file["point"][name][()] for name in _POINT[:-1]},
            log_density=float(file["point"]["log_density"][0]),
        )
        start = file["start"]
        states = zip(start["coordinates"], start["log_density"], start["random_state"], strict=True)
        block = int(file["pilot"]["coordinates"].chunks[0])
        loaded = cls(path, point, [EnsembleState(*state) for state in states], block)
        for place, phase in enumerate(PHASES):
            if committed[len(PHASES) + place]:
                loaded.proposals[phase] = _proposal(file[f"proposal/{phase}"])
            for number in range(committed[place]):
                Chain.append(loaded, phase, _blocks(file[phase], number, block))
        return loaded


def _reading(path: Path) -> Any:
    """Open a file to read it, also while it is written.

    HDF5's own locks stay off here as in the writer: readers need none, the writer's is its
    folder's, and a process may not open a file with and without them.
    """
    # A file whose writer has not closed it is marked so, and opens in this mode only. For others
    # it must be off: it waits for a writer to mend what is damaged, which may be for ever.
    with path.open("rb") as file:
        marked = file.read(12)[11:] == b"\5"
    return h5py.File(path, "r", libver="latest", swmr=marked, locking=False)


_POINT = ("mode", "covariance", "optima", "prior_covariance", "log_density")


def _lay_out(file: Any, point: PointFit, starts: Sequence[EnsembleState], block: int) -> None:
    """Create every dataset, so that none has to be later."""
    ensembles = len(starts)
    walkers, free = starts[0].coordinates.shape
    whole: dict[str, Any] = {f"point/{name}": getattr(point, name) for name in _POINT}
    for name in ("coordinates", "log_density", "random_state"):
        whole[f"start/{name}"] = np.stack([getattr(s, name) for s in starts])
    for phase in PHASES:
        whole[f"proposal/{phase}/weights"] = np.zeros(COMPONENTS)
        whole[f"proposal/{phase}/centres"] = np.zeros((COMPONENTS, free))
        whole[f"proposal/{phase}/factors"] = np.zeros((COMPONENTS, free, free))
    whole["committed"] = np.zeros(2 * len(PHASES), dtype=np.int64)
    for name, values in whole.items():
        data = np.atleast_1d(values)
        # Only chunks carry checksums.
        file.create_dataset(name, data=data, chunks=data.shape, fletcher32=True)
    shapes: dict[str, tuple[tuple[int, ...], Any]] = {
        "coordinates": ((block, ensembles, walkers, free), np.float64),
        "log_density": ((block, ensembles, walkers), np.float64),
        "accepted": ((1, ensembles, walkers), np.int64),
        "random_state": ((1, ensembles, RANDOM_STATE_WORDS), np.uint32),
    }
    for phase in PHASES:
        for name, (shape, dtype) in shapes.items():
            file.create_dataset(
                f"{phase}/{name}",
                shape=(0, *shape[1:]),
                maxshape=(None, *shape[1:]),
                chunks=shape,
                dtype=dtype,
                fletcher32=True,
            )


def _put(dataset: Any, rows: slice, values: NDArray[Any]) -> None:
    dataset.resize(rows.stop, axis=0)
    dataset[rows] = values


def _proposal(group: Any) -> StudentMixture:
    """Read a frozen proposal."""
    pairs = zip(group["centres"][:], group["factors"][:], strict=True)
    return StudentMixture(group["weights"][:], tuple(StudentProposal(*pair) for pair in pairs))


def _blocks(group: Any, number: int, block: int) -> list[Block]:
    """Read one block of every ensemble."""
    steps = slice(number * block, (number + 1) * block)
    coordinates, log_density = group["coordinates"][steps], group["log_density"][steps]
    accepted, states = group["accepted"][number], group["random_state"][number]
    return [
        Block(
            coordinates[:, e],
            log_density[:, e],
            accepted[e],
            EnsembleState(coordinates[-1, e], log_density[-1, e], states[e]),
        )
        for e in range(len(states))
    ]


def _replace(temporary: Path, path: Path) -> None:
    """Give a finished file its name, in one step, after it has reached the disk."""
    with temporary.open("rb") as file:
        os.fsync(file.fileno())
    temporary.replace(path)
