"""The chain of a sampling: the steps of every ensemble, block by block.

A :class:`Chain` keeps it in memory; a :class:`ChainFile` writes it to files as well. The blocks of
the pilot and the tuning are kept apart from those that count, and so are blocks of the sampling
whose proposal turned out not to cover the posterior.

On disk a chain is a folder of NumPy files that grows by one file a block. A file gets its name only
when it is written, so that a process killed at any moment loses the current block and nothing else.
The files are of NumPy's own format, whose members carry checksums: if a disk has damaged a chain,
the part before the damage is used. This module alone uses the files:

    start.npz                        starts of the ensembles, the point fit, the pilot's proposal,
                                     and what was run, as JSON
    PHASE-proposal.npz               weights, centers, factors and maps of a phase's proposal
    PHASE-0000.npz, PHASE-0001.npz   a block each: coordinates (steps, ensembles, walkers, free),
                                     log_density, accepted, moves, random_state
    set-aside.npz                    how many blocks of the sampling were set aside, and the
                                     proposal that was fitted to them

Beside the folder stands ``chain.h5``: the draws that count so far, in emcee's format, with a group
for each ensemble. ``emcee.backends.HDFBackend("chain.h5", name="ensemble_1")`` opens it, during a
run and after it. It is rewritten at each check of the chain, and nothing in the package reads it.
"""

from __future__ import annotations

import json
import shutil
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields
from functools import partial
from itertools import count
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import NDArray

from bwbayes.arrays import FloatArray, IntArray
from bwbayes.errors import InputError, InputWarning, one_line
from bwbayes.inference.map_estimate import MAPEstimate
from bwbayes.sampling.proposals import StudentMixture
from bwbayes.shown import brief

if TYPE_CHECKING:
    from bwbayes.inference.posterior import Posterior

# Largest number of draws of all walkers in checks and reports; longer chains are thinned by powers
# of two. Chains get that long because their steps are highly correlated.
MOST_DRAWS = 2**19

Phase = Literal["pilot", "tuning", "sampling"]
PHASES: tuple[Phase, ...] = ("pilot", "tuning", "sampling")


# A generator's state in emcee's form: kind, 624 words, position, flag and value of a kept normal.
RandomState = tuple[str, NDArray[np.uint32], int, int, float]


def unpack_random_state(words: NDArray[np.uint32]) -> RandomState:
    """Return the state of a generator that :func:`pack_random_state` has packed."""
    normal = float(np.ascontiguousarray(words[626:628]).view(np.float64)[0])
    return "MT19937", words[:624], int(words[624]), int(words[625]), normal


def pack_random_state(state: RandomState) -> NDArray[np.uint32]:
    """Return a generator's state, (628,): 624 words, position, flag and value of a kept normal."""
    _, words, position, has_normal, normal = state
    position_and_flag = np.array([position, has_normal], dtype=np.uint32)
    return np.concatenate([words, position_and_flag, np.array([normal]).view(np.uint32)])


@dataclass(frozen=True)
class EnsembleState:
    """State of an ensemble.

    ``coordinates`` (walkers, free), ``log_density`` (walkers,) and ``random_state`` (628,), the
    words of emcee's generator.
    """

    __repr__ = brief

    coordinates: FloatArray
    log_density: FloatArray
    random_state: NDArray[np.uint32]


@dataclass(frozen=True)
class Block:
    """A block of steps of an ensemble.

    ``coordinates`` (steps, walkers, free), ``log_density`` (steps, walkers), the number of
    ``accepted`` moves (walkers,), ``moves`` with the numbers of proposals to a walker and of
    acceptances by the move's name, and the ``end`` state, from which the ensemble goes on.
    """

    coordinates: FloatArray
    log_density: FloatArray
    accepted: IntArray
    moves: Mapping[str, tuple[int, int]]
    end: EnsembleState


class Chain:
    """Blocks of all ensembles, in three phases.

    Parameters
    ----------
    starts
        The state that each ensemble starts from.

    Attributes
    ----------
    proposals
        The proposal that was fitted for each phase, if any.
    set_aside
        Blocks at the beginning of the sampling that do not count, because their proposal turned
        out not to cover the posterior.
    refit
        The proposal that was then fitted to them, if any.
    """

    __repr__ = brief

    def __init__(self, starts: Sequence[EnsembleState]) -> None:
        self.starts = tuple(starts)
        self.proposals: dict[Phase, StudentMixture | None] = dict.fromkeys(PHASES)
        self.set_aside = 0
        self.refit: StudentMixture | None = None
        self._blocks: dict[Phase, list[tuple[Block, ...]]] = {phase: [] for phase in PHASES}

    def freeze(self, phase: Phase, proposal: StudentMixture | None) -> None:
        """Fix the proposal of a phase, before its first block."""
        self.proposals[phase] = proposal

    def fall_back(self, blocks: int, refit: StudentMixture | None = None) -> None:
        """Set the first blocks of the sampling aside: they count no longer.

        The sampling goes on with a proposal fitted to them, or without any.
        """
        self.set_aside, self.refit = blocks, refit

    def proposal_in_use(self, phase: Phase) -> StudentMixture | None:
        """Return the proposal that a phase goes on with."""
        return self.refit if phase == "sampling" and self.set_aside else self.proposals[phase]

    def append(self, phase: Phase, blocks: Sequence[Block]) -> None:
        """Add the next block of every ensemble."""
        self._blocks[phase].append(tuple(blocks))

    def publish(self) -> None:
        """Let others read the draws that count so far; a chain in memory does nothing."""

    def blocks(self, phase: Phase) -> int:
        """Return the number of blocks of each ensemble, without those that were set aside."""
        return len(self._counting(phase))

    def history(self, phase: Phase) -> tuple[tuple[Block, ...], ...]:
        """Return all blocks of a phase, those that were set aside first."""
        return tuple(self._blocks[phase])

    def steps(self, phase: Phase) -> int:
        """Return the number of steps of each ensemble."""
        return sum(len(blocks[0].coordinates) for blocks in self._counting(phase))

    @property
    def ends(self) -> tuple[EnsembleState, ...]:
        """The state that each ensemble goes on from."""
        done = [blocks for phase in PHASES for blocks in self._blocks[phase]]
        return tuple(block.end for block in done[-1]) if done else self.starts

    def draws(self, phase: Phase, blocks: int | None = None) -> int:
        """Return the number of draws of all walkers, in the first ``blocks`` blocks or in all."""
        return sum(b.log_density.size for row in self._counting(phase)[:blocks] for b in row)

    def coordinates(self, phase: Phase, thin: int = 1, blocks: int | None = None) -> FloatArray:
        """Return unconstrained draws (steps, ensembles, walkers, free), every ``thin``-th step.

        The draws are those of the first ``blocks`` blocks that count, or of all.
        """
        return self._join(phase, "coordinates", thin, blocks)

    def log_density(self, phase: Phase, thin: int = 1, blocks: int | None = None) -> FloatArray:
        """Return the log density (steps, ensembles, walkers), nats, of :meth:`coordinates`."""
        return self._join(phase, "log_density", thin, blocks)

    def accepted(self, phase: Phase) -> IntArray:
        """Return the accepted moves of each block, (blocks, ensembles, walkers)."""
        return np.array([[block.accepted for block in blocks] for blocks in self._counting(phase)])

    def moves(self, phase: Phase) -> dict[str, tuple[int, int]]:
        """Return the numbers of proposals to a walker and of acceptances by kind of move.

        Kinds that were never proposed are left out.
        """
        totals: dict[str, tuple[int, int]] = {}
        for blocks in self._counting(phase):
            for block in blocks:
                for name, (proposed, accepted) in block.moves.items():
                    before = totals.get(name, (0, 0))
                    totals[name] = before[0] + proposed, before[1] + accepted
        return {name: counts for name, counts in totals.items() if counts[0]}

    def _counting(self, phase: Phase) -> list[tuple[Block, ...]]:
        """Return the blocks that count."""
        return self._blocks[phase][self.set_aside if phase == "sampling" else 0 :]

    def _join(self, phase: Phase, name: str, thin: int, count: int | None) -> FloatArray:
        parts, done = [], 0
        for blocks in self._counting(phase)[:count]:
            arrays = [getattr(block, name) for block in blocks]
            first = -(done + 1) % thin  # take steps, counted from one, that thin divides
            parts.append(np.stack([values[first::thin] for values in arrays], axis=1))
            done += len(arrays[0])
        return np.concatenate(parts)


def thinning(draws: int, limit: int | None = None) -> int:
    """Return the thinning of so many draws: a power of two.

    At most ``limit`` draws remain, ``MOST_DRAWS`` by default.
    """
    thin = 1
    while draws > (limit or MOST_DRAWS) * thin:
        thin *= 2
    return thin


def draws(
    posterior: Posterior,
    chain: Chain,
    phase: Phase = "sampling",
    covariances: tuple[FloatArray, FloatArray] | None = None,
) -> FloatArray:
    """Return a chain's draws in their own units, (steps, ensembles, walkers, free).

    Long chains are thinned by powers of two, to ``MOST_DRAWS`` draws at most. With ``covariances``
    (free, free), of the posterior and a larger one, the draws are widened, see
    :func:`~bwbayes.inference.map_estimate.widen_draws`; a draw that the prior would exclude then
    stays as sampled.
    """
    coordinates = chain.coordinates(phase, thinning(chain.draws(phase)))
    if covariances is not None:
        from bwbayes.inference.map_estimate import widen_draws  # noqa: PLC0415  # slow to load

        wide = widen_draws(coordinates, *covariances)
        _, log_prior = posterior.prior.constrain(wide.reshape(-1, wide.shape[-1]))
        possible = np.isfinite(log_prior).reshape(*wide.shape[:-1], 1)
        coordinates = np.where(possible, wide, coordinates)
    return constrain_steps(posterior, coordinates)


def log_densities(chain: Chain, phase: Phase = "sampling") -> FloatArray:
    """Return the log density of :func:`draws`, (steps, ensembles, walkers), nats."""
    return chain.log_density(phase, thinning(chain.draws(phase)))


def constrain_steps(posterior: Posterior, coordinates: FloatArray) -> FloatArray:
    """Return coordinates (steps, ensembles, walkers, free) in their own units."""
    flat, _ = posterior.prior.constrain(coordinates.reshape(-1, coordinates.shape[-1]))
    return flat.reshape(coordinates.shape)


FORMAT = 5

Arrays = Mapping[str, Any]


class ChainFile(Chain):
    """A chain that is written to files as it grows.

    Open one with :meth:`create` or :meth:`resume`. Only one process may write it; the caller has to
    ensure that (a run locks its folder). Any process may read it: see :meth:`read`.
    """

    def __init__(
        self,
        path: Path,
        point: MAPEstimate,
        starts: Sequence[EnsembleState],
        block: int,
        attributes: Mapping[str, str | int],
    ) -> None:
        super().__init__(starts)
        self.path, self.point, self.block = path, point, block
        self._attributes = dict(attributes)

    @classmethod
    def create(
        cls,
        path: Path,
        chain: Chain,
        point: MAPEstimate,
        block: int,
        attributes: Mapping[str, str | int],
    ) -> ChainFile:
        """Write a chain without blocks yet, to be of ``block`` steps, as a new folder.

        Raises
        ------
        InputError
            There is no room for it.
        """
        created = cls(path, point, chain.starts, block, attributes)
        created.proposals = chain.proposals
        text = {"format": FORMAT, "block": block, "attributes": created._attributes}
        start = {"text": json.dumps(text)} | _arrays_of(chain.proposals["pilot"])
        start |= {f"point_{field.name}": getattr(point, field.name) for field in fields(point)}
        for name in (field.name for field in fields(EnsembleState)):
            start[name] = np.stack([getattr(state, name) for state in chain.starts])
        # The folder is there whole or not at all.
        draft = path.with_suffix(".partial")
        shutil.rmtree(draft, ignore_errors=True)
        try:
            draft.mkdir()
            _write(draft, "start", start)
            draft.rename(path)
        except OSError as error:
            raise _not_written(path, error) from None
        finally:
            shutil.rmtree(draft, ignore_errors=True)
        return created

    @classmethod
    def read(cls, path: Path) -> ChainFile:
        """Read a chain, finished, interrupted or being written.

        Raises
        ------
        InputError
            It is missing, or its description is damaged.

        Warns
        -----
        InputWarning
            It is damaged further on; the blocks before that are read.
        """
        if not path.exists():
            raise InputError(f"{path}: the chain does not exist; resume the run")
        chain: ChainFile | None = None
        try:
            load = partial(_load, path)
            chain = cls._read_start(path, load("start"))
            chain._read_blocks(load)
        except Exception as error:  # a damaged file may raise any exception
            damage = one_line(str(error)) or type(error).__name__
            if chain is None:
                raise InputError(
                    f"{path}: the chain cannot be read ({damage}); delete it and resume the run, "
                    "which samples anew"
                ) from None
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
        """Read a chain to resume it from the last block that counts.

        ``check`` is given the attributes first, and may refuse them: the files then stay as they
        are. Blocks after a damaged one are deleted.

        Raises
        ------
        InputError
            As :meth:`read`.

        Warns
        -----
        InputWarning
            As :meth:`read`.
        """
        chain = cls.read(path)
        if check is not None:
            check(chain.attributes())
        for phase in PHASES:
            n_blocks = len(chain.history(phase))
            for file in path.glob(f"{phase}-[0-9]*"):
                if file.suffix != ".npz" or int(file.stem.rpartition("-")[2]) >= n_blocks:
                    file.unlink()
        if not chain.set_aside:
            (path / "set-aside.npz").unlink(missing_ok=True)
        return chain

    def attributes(self) -> dict[str, str | int]:
        """Return the facts of the run: config, versions, platform, seed, hash of the data."""
        return dict(self._attributes)

    def append(self, phase: Phase, blocks: Sequence[Block]) -> None:
        """Add the next block of every ensemble; it is on the disk when this returns.

        Raises
        ------
        InputError
            There is no room for it; the chain is whole without it.
        """
        arrays = {
            "coordinates": np.stack([b.coordinates for b in blocks], axis=1),
            "log_density": np.stack([b.log_density for b in blocks], axis=1),
            "accepted": np.stack([b.accepted for b in blocks]),
            "moves": json.dumps([dict(b.moves) for b in blocks]),
            "random_state": np.stack([b.end.random_state for b in blocks]),
        }
        _write(self.path, _block_name(phase, len(self.history(phase))), arrays)
        super().append(phase, blocks)

    def freeze(self, phase: Phase, proposal: StudentMixture | None) -> None:
        """Fix the proposal of a phase, on the disk too."""
        if proposal is not None:
            _write(self.path, f"{phase}-proposal", _arrays_of(proposal))
        super().freeze(phase, proposal)

    def fall_back(self, blocks: int, refit: StudentMixture | None = None) -> None:
        """Set the first blocks of the sampling aside, on the disk too."""
        _write(self.path, "set-aside", {"blocks": blocks} | _arrays_of(refit))
        super().fall_back(blocks, refit)

    def publish(self) -> None:
        """Write the draws that count so far to ``chain.h5``, in the format of ``HDFBackend``.

        Raises
        ------
        InputError
            There is no room for it; the chain is whole without it.
        """
        import emcee  # noqa: PLC0415  # slow to load, as HDF5 is
        import h5py  # noqa: PLC0415

        file = self.path.with_suffix(".h5")
        draft = self.path.with_suffix(".h5.partial")
        coordinates, log_density = self.coordinates("sampling"), self.log_density("sampling")
        accepted = np.sum(self.accepted("sampling"), axis=0)
        try:
            with h5py.File(draft, "w") as opened:
                opened.attrs.update(self._attributes)
                for number, end in enumerate(self.ends):
                    steps, _, walkers, free = coordinates.shape
                    group = opened.create_group(f"ensemble_{number + 1}")
                    group.attrs.update(
                        version=emcee.__version__, nwalkers=walkers, ndim=free, has_blobs=False,
                        iteration=steps,
                    )  # fmt: skip
                    for row, element in enumerate(unpack_random_state(end.random_state)):
                        group.attrs[f"random_state_{row}"] = element
                    for name, series in (("chain", coordinates), ("log_prob", log_density)):
                        values = series[:, number]
                        # The data sets can grow: emcee's sampler may go on with them.
                        group.create_dataset(name, data=values, maxshape=(None, *values.shape[1:]))
                    group["accepted"] = accepted[number].astype(np.float64)
            draft.replace(file)
        except OSError as error:
            draft.unlink(missing_ok=True)
            raise _not_written(file, error) from None

    @classmethod
    def _read_start(cls, path: Path, arrays: Arrays | None) -> ChainFile:
        """Return the chain of a folder without its blocks."""
        if arrays is None:
            raise LookupError("it has no start")
        text = json.loads(str(arrays["text"]))
        if text["format"] != FORMAT:
            raise ValueError(f"its format is {text['format']}, this version reads {FORMAT}")
        point = {field.name: arrays[f"point_{field.name}"] for field in fields(MAPEstimate)}
        point["log_density"] = float(point["log_density"])
        states = zip(*(arrays[field.name] for field in fields(EnsembleState)), strict=True)
        starts = [EnsembleState(*state) for state in states]
        chain = cls(path, MAPEstimate(**point), starts, text["block"], text["attributes"])
        chain.proposals["pilot"] = StudentMixture.of_arrays(arrays)
        return chain

    def _read_blocks(self, load: Callable[[str], Arrays | None]) -> None:
        """Read the existing files in their order; the one about blocks set aside comes last."""
        for phase in PHASES:
            if (arrays := load(f"{phase}-proposal")) is not None:
                Chain.freeze(self, phase, StudentMixture.of_arrays(arrays))
            for number in count():
                if (arrays := load(_block_name(phase, number))) is None:
                    break
                coordinates, log_density = arrays["coordinates"], arrays["log_density"]
                moves = json.loads(str(arrays["moves"]))
                blocks = [
                    Block(
                        coordinates[:, e],
                        log_density[:, e],
                        arrays["accepted"][e],
                        {name: tuple(counts) for name, counts in moves[e].items()},
                        EnsembleState(coordinates[-1, e], log_density[-1, e], state),
                    )
                    for e, state in enumerate(arrays["random_state"])
                ]
                Chain.append(self, phase, blocks)
        aside = load("set-aside")
        # If blocks at the end are lost, all remaining ones count again.
        if aside is not None and aside["blocks"] <= len(self.history("sampling")):
            Chain.fall_back(self, int(aside["blocks"]), StudentMixture.of_arrays(aside))


def _load(folder: Path, name: str) -> Arrays | None:
    """Read a file; None if there is none."""
    path = folder / f"{name}.npz"
    if not path.exists():
        return None
    with path.open("rb") as file, np.load(file, allow_pickle=False) as arrays:
        return dict(arrays)


def _write(folder: Path, name: str, arrays: Arrays) -> None:
    """Write a file, whole or not at all."""
    draft = folder / f"{name}.partial"
    try:
        with draft.open("wb") as file:
            np.savez(file, **arrays)
        draft.replace(folder / f"{name}.npz")
    except OSError as error:
        draft.unlink(missing_ok=True)
        raise _not_written(folder, error) from None


def _block_name(phase: Phase, number: int) -> str:
    return f"{phase}-{number:04d}"


def _arrays_of(proposal: StudentMixture | None) -> dict[str, Any]:
    return {} if proposal is None else proposal.arrays()


def _not_written(path: Path, error: OSError) -> InputError:
    return InputError(
        f"{path}: cannot be written ({error.strerror}); no block of the chain is lost: fix that, "
        "then resume the run"
    )
