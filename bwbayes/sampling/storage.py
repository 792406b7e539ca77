"""The chain on disk: a folder of NumPy files that grows by one file a block.

A file gets its name only when it is written, so that a process killed at any moment loses the block
in hand and nothing else. The files are of NumPy's own format, whose members carry checksums: of a
chain that a disk has damaged, what comes before the damage is used. This module alone knows them:

    start.npz                        starts of the ensembles, the point fit, the pilot's proposal,
                                     and what was run, as JSON
    PHASE-proposal.npz               weights, centers, factors and bend of a phase's proposal
    PHASE-0000.npz, PHASE-0001.npz   a block each: coordinates (steps, ensembles, walkers, free),
                                     log_density, accepted, moves, random_state
    set-aside.npz                    how many blocks of the sampling were set aside, and the
                                     proposal that was fitted to them
"""

from __future__ import annotations

import json
import shutil
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import fields
from itertools import count
from pathlib import Path
from typing import Any

import numpy as np

from bwbayes.errors import InputError, InputWarning, one_line
from bwbayes.inference.map_estimate import PointFit
from bwbayes.sampling.chain import PHASES, Block, Chain, EnsembleState, Phase
from bwbayes.sampling.curvature import QuadraticMap
from bwbayes.sampling.earlier import read_earlier
from bwbayes.sampling.proposals import StudentMixture

__all__ = ["ChainFile"]

FORMAT = 3

Arrays = Mapping[str, Any]


class ChainFile(Chain):
    """A chain that is written to files as it grows.

    Open one with :meth:`create` or :meth:`resume`. One process may write it; that is for the caller
    to see to (a run locks its folder). Readers need no permission: see :meth:`read`.
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

    @classmethod
    def create(
        cls,
        path: Path,
        chain: Chain,
        point: PointFit,
        block: int,
        attributes: Mapping[str, str | int],
    ) -> ChainFile:
        """Write a chain without blocks yet, to be of ``block`` steps, as a new folder.

        Raises
        ------
        InputError
            There is no room for it.
        """
        draft = path.with_suffix(".partial")
        created = cls(draft, point, chain.starts, block, attributes)
        text = {"format": FORMAT, "block": block, "attributes": created._attributes}
        shutil.rmtree(draft, ignore_errors=True)
        try:
            draft.mkdir()
            created._write(
                "start",
                {"text": json.dumps(text)}
                | {f"point_{field.name}": getattr(point, field.name) for field in fields(point)}
                | {name: np.stack([getattr(s, name) for s in chain.starts]) for name in _STATE}
                | _arrays_of(chain.proposals["pilot"]),
            )
            draft.rename(path)
        except OSError as error:
            raise _not_written(path, error) from None
        finally:
            shutil.rmtree(draft, ignore_errors=True)
        created.path, created.proposals = path, chain.proposals
        return created

    @classmethod
    def read(cls, path: Path) -> ChainFile:
        """Read a chain, finished, interrupted or being written.

        Raises
        ------
        InputError
            It is missing, or damaged where it says what it is.

        Warns
        -----
        InputWarning
            It is damaged further on; the blocks before that are read.
        """
        earlier = path.with_suffix(".h5")
        if not path.exists() and not earlier.exists():
            raise InputError(f"{path}: the chain does not exist; run again")
        chain: ChainFile | None = None
        try:
            if path.exists():
                chain = cls._begun(path)
                chain._read_blocks()
            else:
                read, point, block, attributes = read_earlier(earlier)
                chain = cls(path, point, read.starts, block, attributes)
                vars(chain).update(vars(read))
        except Exception as error:  # a damaged file fails in whatever way its reader stumbles
            damage = one_line(str(error)) or type(error).__name__
            if chain is None:
                raise InputError(
                    f"{path}: the chain cannot be read ({damage}); run again"
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
        """Read a chain to go on with, from the last block that counts.

        ``check`` is given the attributes first, and may refuse them: the files then stay as they
        are. What comes after a damage is deleted.

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
        if not path.exists():
            return chain._written_anew()
        for phase in PHASES:
            n_blocks = len(chain.history(phase))
            for file in path.glob(f"{phase}-[0-9]*"):
                if file.suffix != ".npz" or int(file.stem.rpartition("-")[2]) >= n_blocks:
                    file.unlink()
        if not chain.set_aside:
            (path / "set-aside.npz").unlink(missing_ok=True)
        return chain

    def _written_anew(self) -> ChainFile:
        """Write what was read of an earlier version's file as a folder."""
        draft = self.path.with_suffix(".earlier")
        shutil.rmtree(draft, ignore_errors=True)
        written = self.create(draft, self, self.point, self.block, self._attributes)
        for phase in PHASES[1:]:
            written.freeze(phase, self.proposals[phase])
        for phase in PHASES:
            for blocks in self.history(phase):
                written.append(phase, blocks)
        if self.set_aside:
            written.fall_back(self.set_aside, self.refit)
        draft.rename(self.path)
        written.path = self.path
        return written

    def attributes(self) -> dict[str, str | int]:
        """Return what was run: config, versions, platform, seed, hash of the data."""
        return dict(self._attributes)

    def append(self, phase: Phase, blocks: Sequence[Block]) -> None:
        """Add the next block of every ensemble; when this returns it is on the disk.

        Raises
        ------
        InputError
            There is no room for it; the chain is whole without it.
        """
        arrays = {
            "coordinates": np.stack([b.coordinates for b in blocks], axis=1),
            "log_density": np.stack([b.log_density for b in blocks], axis=1),
            "accepted": np.stack([b.accepted for b in blocks]),
            "moves": np.stack([b.moves for b in blocks]),
            "random_state": np.stack([b.end.random_state for b in blocks]),
        }
        self._write(_block_name(phase, len(self.history(phase))), arrays)
        super().append(phase, blocks)

    def freeze(self, phase: Phase, proposal: StudentMixture | None) -> None:
        """Fix the proposal of a phase, on the disk too."""
        if proposal is not None:
            self._write(f"{phase}-proposal", _arrays_of(proposal))
        super().freeze(phase, proposal)

    def fall_back(self, blocks: int, refit: StudentMixture | None = None) -> None:
        """Set the first blocks of the sampling aside, on the disk too."""
        self._write("set-aside", {"blocks": blocks} | _arrays_of(refit))
        super().fall_back(blocks, refit)

    def _write(self, name: str, arrays: Arrays) -> None:
        """Write a file, whole or not at all."""
        draft = self.path / f"{name}.partial"
        try:
            with draft.open("wb") as file:
                np.savez(file, allow_pickle=False, **arrays)
            draft.replace(self.path / f"{name}.npz")
        except OSError as error:
            draft.unlink(missing_ok=True)
            raise _not_written(self.path, error) from None

    def _arrays(self, name: str) -> Arrays | None:
        """Read a file; None if there is none."""
        path = self.path / f"{name}.npz"
        return _load(path) if path.exists() else None

    @classmethod
    def _begun(cls, path: Path) -> ChainFile:
        """Return the chain of a folder without its blocks."""
        arrays = _load(path / "start.npz")
        text = json.loads(str(arrays["text"]))
        if text["format"] != FORMAT:
            raise ValueError(f"its format is {text['format']}, this version reads {FORMAT}")
        point = {field.name: arrays[f"point_{field.name}"] for field in fields(PointFit)}
        point["log_density"] = float(point["log_density"])
        states = zip(*(arrays[name] for name in _STATE), strict=True)
        starts = [EnsembleState(*state) for state in states]
        begun = cls(path, PointFit(**point), starts, text["block"], text["attributes"])
        begun.proposals["pilot"] = _proposal_of(arrays)
        return begun

    def _read_blocks(self) -> None:
        """Read what is there, in its order; the set aside last, since it is of blocks."""
        for phase in PHASES:
            if (arrays := self._arrays(f"{phase}-proposal")) is not None:
                Chain.freeze(self, phase, _proposal_of(arrays))
            for number in count():
                if (arrays := self._arrays(_block_name(phase, number))) is None:
                    break
                Chain.append(self, phase, _blocks_of(arrays))
        aside = self._arrays("set-aside")
        # Blocks are lost from the end: then all that are left count again.
        if aside is not None and aside["blocks"] <= len(self.history("sampling")):
            Chain.fall_back(self, int(aside["blocks"]), _proposal_of(aside))


_STATE = ("coordinates", "log_density", "random_state")
_MIXTURE = ("weights", "centers", "factors", "freedom")
_BEND = fields(QuadraticMap)


def _load(path: Path) -> Arrays:
    with path.open("rb") as file, np.load(file, allow_pickle=False) as arrays:
        return dict(arrays)


def _block_name(phase: Phase, number: int) -> str:
    return f"{phase}-{number:04d}"


def _blocks_of(arrays: Arrays) -> list[Block]:
    """Return one block of every ensemble."""
    coordinates, log_density = arrays["coordinates"], arrays["log_density"]
    return [
        Block(
            coordinates[:, e],
            log_density[:, e],
            arrays["accepted"][e],
            arrays["moves"][e],
            EnsembleState(coordinates[-1, e], log_density[-1, e], state),
        )
        for e, state in enumerate(arrays["random_state"])
    ]


def _arrays_of(proposal: StudentMixture | None) -> dict[str, Any]:
    """Return the arrays that a proposal is made of; none of none."""
    if proposal is None:
        return {}
    arrays = {name: getattr(proposal, name) for name in _MIXTURE}
    if proposal.bend is not None:
        arrays |= {f"bend_{field.name}": getattr(proposal.bend, field.name) for field in _BEND}
    return arrays


def _proposal_of(arrays: Arrays) -> StudentMixture | None:
    """Return the proposal that is made of arrays, if any."""
    if "weights" not in arrays:
        return None
    bend = None
    if "bend_bends" in arrays:
        bend = QuadraticMap(**{field.name: arrays[f"bend_{field.name}"] for field in _BEND})
    return StudentMixture(**{name: arrays[name] for name in _MIXTURE}, bend=bend)


def _not_written(path: Path, error: OSError) -> InputError:
    return InputError(
        f"{path}: cannot be written ({error.strerror}); no block of the chain is lost: fix that, "
        "then resume the run"
    )
