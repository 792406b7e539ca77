"""The chain on disk: appended block by block, whole at every moment.

An HDF5 file in single-writer mode, whose datasets all exist from the start: a block is written and
flushed, then the number of blocks that count, and only what is counted is ever read. A process
killed in between loses the block in hand and nothing else. All numbers carry checksums: of a file
that was cut or changed on the disk the blocks before the damage are read. Going on from a file
first copies what counts into a fresh one. This module alone knows the layout:

    /start, /pilot, /tuning, /sampling   coordinates, log_density, accepted, moves, random_state
    /proposal/PHASE                      weights, centers, factors of the proposals; bend
    /point                               the point fit
    /committed                           blocks of each phase; proposals of each phase (0 or 1);
                                         blocks of the sampling that were set aside, and those
                                         that the proposal in use was fitted to, which is
                                         fitted again when the sampling goes on

and what was run (config, versions, seed, hash of the data) as the file's attributes.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from hashlib import file_digest
from io import BytesIO
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from bwbayes.errors import InputError, InputWarning
from bwbayes.inference.pointfit import PointFit
from bwbayes.sampling.chain import (
    MOVES,
    PHASES,
    RANDOM_STATE_WORDS,
    Block,
    Chain,
    EnsembleState,
    Phase,
)
from bwbayes.sampling.curvature import QuadraticMap, rows_of
from bwbayes.sampling.hdf5 import DAMAGE, Image, either, name_finished, put, reserve
from bwbayes.sampling.proposals import COMPONENTS, StudentMixture, StudentProposal

__all__ = ["ChainFile"]

FORMAT = 2

# Where /committed says how many blocks were set aside, and how many a proposal was fitted to.
SET_ASIDE = 2 * len(PHASES)
REFITTED = SET_ASIDE + 1


class ChainFile(Chain):
    """A chain that is written to a file as it grows. Use it as a context manager.

    Open one with :meth:`create` or :meth:`resume`. One process may write a file; that is for the
    caller to see to (a run locks its folder). Readers need no permission: see :meth:`read`.
    """

    def __init__(
        self,
        path: Path,
        point: PointFit,
        starts: Sequence[EnsembleState],
        block: int,
        attributes: Mapping[str, str | int],
    ) -> None:
        super().__init__(starts)
        self.path, self.point, self.block = path, point, block
        self._attributes = dict(attributes)
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
        """Write a chain, blocks of ``block`` steps or none yet, as a new file and open it.

        Raises
        ------
        InputError
            There is no room for it.
        """
        opened = cls(path, point, chain.starts, block, attributes)
        temporary = path.with_suffix(".partial")
        # Laid out in memory: HDF5 does not survive a disk that is full.
        layout = BytesIO()
        with h5py.File(layout, "w", libver="latest") as file:
            _create_all(file, point, chain.starts, block)
            file.attrs["format"] = FORMAT
            for name, value in attributes.items():
                file.attrs[name] = value
        with _write_errors(path), opened._delete_on_failure(temporary):
            temporary.write_bytes(layout.getbuffer())
            name_finished(temporary, path)
        with opened._delete_on_failure(path):
            opened._file = h5py.File(path, "r+", libver="latest", locking=False)
            opened._file.swmr_mode = True
            for phase in PHASES:
                opened.freeze(phase, chain.proposals[phase])
                for blocks in chain.history(phase):
                    opened.append(phase, blocks)
            opened.refitted, opened.refit = chain.refitted, chain.refit
            if chain.set_aside:
                opened.fall_back(chain.set_aside)
        return opened

    @classmethod
    def read(cls, path: Path) -> ChainFile:
        """Read a chain, finished, interrupted or being written; it cannot be extended.

        Raises
        ------
        InputError
            The file is missing, not a chain, or damaged where it says what it is.

        Warns
        -----
        InputWarning
            It is damaged further on; the blocks before that are read.
        """
        before = None
        while True:
            try:
                chain, damage = cls._load(path)
                # One that was written while it was read may look damaged; at rest it does not.
                if not damage or before == (before := _digest(path)):
                    break
            except FileNotFoundError:
                raise InputError(f"{path}: the chain does not exist; run again") from None
            except OSError as error:
                raise InputError(f"{path}: {error.strerror}; make it readable") from None
        if chain is None:
            raise InputError(f"{path}: the chain cannot be read ({damage}); run again")
        if damage:
            n_blocks = sum(len(chain.history(phase)) for phase in PHASES)
            warnings.warn(
                f"{path}: damaged ({damage}); the {n_blocks} whole blocks before that are used, "
                "and resuming makes the others again",
                InputWarning,
                stacklevel=2,
            )
        return chain

    @classmethod
    def resume(
        cls, path: Path, check: Callable[[Mapping[str, str | int]], None] | None = None
    ) -> ChainFile:
        """Read a chain and open it to go on, from the last block that counts.

        ``check`` is given the attributes first, and may refuse them: the file then stays as it is.

        Raises
        ------
        InputError
            As :meth:`read`, or there is no room for the copy that it makes.

        Warns
        -----
        InputWarning
            As :meth:`read`.
        """
        old = cls.read(path)
        if check is not None:
            check(old.attributes())
        fresh = path.with_suffix(".fresh")
        opened = cls.create(fresh, old, old.point, old.block, old.attributes())
        # The name changes under the open file: it is the same file all along.
        name_finished(fresh, path)
        opened.path = path
        return opened

    def attributes(self) -> dict[str, str | int]:
        """Return what was run: config, versions, platform, seed, hash of the data."""
        return dict(self._attributes)

    def append(self, phase: Phase, blocks: Sequence[Block]) -> None:
        """Add the next block of every ensemble; when this returns it is in the file.

        Raises
        ------
        InputError
            There is no room for it; the file is whole without it.
        """
        unused = len(MOVES) - len(blocks[0].moves)
        rows: dict[str, NDArray[Any]] = {
            "coordinates": np.stack([b.coordinates for b in blocks], axis=1),
            "log_density": np.stack([b.log_density for b in blocks], axis=1),
            "accepted": np.stack([b.accepted for b in blocks])[np.newaxis],
            "moves": np.stack([np.pad(b.moves, [(0, unused), (0, 0)]) for b in blocks])[np.newaxis],
            "random_state": np.stack([b.end.random_state for b in blocks])[np.newaxis],
        }
        with _write_errors(self.path):
            reserve(self._file, sum(values.nbytes for values in rows.values()))
        number = len(self.history(phase))
        for name, values in rows.items():
            put(self._file[phase][name], number * len(values), values)
        self._commit(PHASES.index(phase), number + 1)
        super().append(phase, blocks)

    def freeze(self, phase: Phase, proposal: StudentMixture | None) -> None:
        """Fix the proposal of a phase, in the file too."""
        if proposal is not None:
            self._write(phase, proposal)
            self._commit(len(PHASES) + PHASES.index(phase), 1)
        super().freeze(phase, proposal)

    def fall_back(self, blocks: int, refit: StudentMixture | None = None) -> None:
        """Set the first blocks of the sampling aside, in the file too."""
        super().fall_back(blocks, refit)
        self._commit(slice(SET_ASIDE, REFITTED + 1), [self.set_aside, self.refitted])

    def close(self) -> None:
        """Close the file."""
        if self._file is not None:
            self._file.close()
            self._file = None

    def __enter__(self) -> ChainFile:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _write(self, name: str, proposal: StudentMixture) -> None:
        group = self._file[f"proposal/{name}"]
        count = len(proposal.components)
        if count > group["weights"].shape[1]:
            raise InputError(
                f"{self.path}: begun by an earlier version, whose files have no room for the "
                f"{count} components of today's proposals; start a new run"
            )
        group["weights"][:] = 0.0
        group["weights"][:, :count] = proposal.weights
        group["centres"][:, :count] = np.stack([c.center for c in proposal.components])
        group["factors"][:, :count] = np.stack([c.factor for c in proposal.components])
        group["bend"][:] = 0.0 if proposal.bend is None else proposal.bend.numbers

    @contextmanager
    def _delete_on_failure(self, path: Path) -> Iterator[None]:
        """Leave nothing of a file that could not be written to its end."""
        try:
            yield
        except BaseException:
            self.close()
            path.unlink(missing_ok=True)
            raise

    def _commit(self, column: int | slice, count: int | list[int]) -> None:
        """Let ``count`` count, once everything before has reached the file."""
        self._file.flush()
        self._file["committed"][:, column] = count
        self._file.flush()

    @classmethod
    def _load(cls, path: Path) -> tuple[ChainFile | None, str]:
        """Return what can be read of a file, and what is wrong with the rest, if anything."""
        loaded, damage, set_aside, refitted = None, "", 0, 0
        with Image(path) as image:
            try:
                with h5py.File(image, "r") as file:
                    loaded = cls._read_header(path, file)
                    committed = either(file["committed"])
                    # Files of versions that fitted none say nothing of it.
                    set_aside, refitted = [*committed[SET_ASIDE:].tolist(), 0][:2]
                    for column, phase in enumerate(PHASES):
                        if committed[len(PHASES) + column]:
                            loaded.proposals[phase] = _proposal(file[f"proposal/{phase}"])
                        for number in range(committed[column]):
                            Chain.append(loaded, phase, _blocks(file[phase], number, loaded.block))
            except DAMAGE as error:
                damage = " ".join(str(error.args[-1] if error.args else error).split())
        if loaded is not None:
            n_blocks = len(loaded.history("sampling"))
            # Blocks are lost from the end: then all that are left count again.
            if set_aside <= n_blocks:
                loaded.set_aside, loaded.refitted = set_aside, refitted
        return loaded, damage

    @classmethod
    def _read_header(cls, path: Path, file: Any) -> ChainFile:
        """Return the chain of a file without its blocks."""
        attributes = {n: v if isinstance(v, str) else int(v) for n, v in file.attrs.items()}
        number = attributes.pop("format")
        if number != FORMAT:
            raise ValueError(f"its format is {number}, this version reads {FORMAT}")
        point = PointFit(
            **{name: either(file["point"][name]) for name in _POINT[:-1]},
            log_density=float(either(file["point"]["log_density"])),
        )
        parts = [either(file["start"][n]) for n in ("coordinates", "log_density", "random_state")]
        block = int(file["pilot"]["coordinates"].chunks[0])
        return cls(
            path, point, [EnsembleState(*s) for s in zip(*parts, strict=True)], block, attributes
        )


def _digest(path: Path) -> bytes:
    with path.open("rb") as file:
        return file_digest(file, "sha256").digest()


_POINT = ("mode", "covariance", "optima", "prior_covariance", "log_density")


def _create_all(file: Any, point: PointFit, starts: Sequence[EnsembleState], block: int) -> None:
    """Create every dataset, so that none has to be later."""
    ensembles = len(starts)
    walkers, free = starts[0].coordinates.shape
    layout: dict[str, Any] = {f"point/{name}": getattr(point, name) for name in _POINT}
    for name in ("coordinates", "log_density", "random_state"):
        layout[f"start/{name}"] = np.stack([getattr(s, name) for s in starts])
    for name in PHASES:
        layout[f"proposal/{name}/weights"] = np.zeros(COMPONENTS)
        layout[f"proposal/{name}/centres"] = np.zeros((COMPONENTS, free))
        layout[f"proposal/{name}/factors"] = np.zeros((COMPONENTS, free, free))
        layout[f"proposal/{name}/bend"] = np.zeros((rows_of(free), free))
    layout["committed"] = np.zeros(REFITTED + 1, dtype=np.int64)
    for name, values in layout.items():
        # Twice, since nothing else could stand in for it; only chunks carry checksums.
        data = np.stack([values, values])
        file.create_dataset(name, data=data, chunks=(1, *np.shape(values)), fletcher32=True)
    shapes: dict[str, tuple[tuple[int, ...], Any]] = {
        "coordinates": ((block, ensembles, walkers, free), np.float64),
        "log_density": ((block, ensembles, walkers), np.float64),
        "accepted": ((1, ensembles, walkers), np.int64),
        "moves": ((1, ensembles, len(MOVES), 2), np.int64),
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


def _proposal(group: Any) -> StudentMixture:
    """Read a frozen proposal."""
    weights = either(group["weights"])
    used = weights > 0
    pairs = zip(either(group["centres"])[used], either(group["factors"])[used], strict=True)
    parts = tuple(StudentProposal(*pair) for pair in pairs)
    # Older files have none.
    bend = QuadraticMap.of(either(group["bend"])) if "bend" in group else None
    return StudentMixture(weights[used], parts, bend)


def _blocks(group: Any, number: int, block: int) -> list[Block]:
    """Read one block of every ensemble."""
    steps = slice(number * block, (number + 1) * block)
    coordinates, log_density = group["coordinates"][steps], group["log_density"][steps]
    accepted, states = group["accepted"][number], group["random_state"][number]
    moves = group["moves"][number]
    # Where a disk lost what it was given there are zeros, which pass the checksum.
    if not all(values.any() for values in (coordinates, log_density, states)):
        raise ValueError("a block is empty")
    return [
        Block(
            coordinates[:, e],
            log_density[:, e],
            accepted[e],
            moves[e],
            EnsembleState(coordinates[-1, e], log_density[-1, e], states[e]),
        )
        for e in range(len(states))
    ]


@contextmanager
def _write_errors(path: Path) -> Iterator[None]:
    """Say in one line that a chain cannot be written."""
    try:
        yield
    except OSError as error:
        raise InputError(
            f"{path}: cannot be written ({error.strerror}); no block of the chain is lost: fix "
            "that, then resume the run"
        ) from None
