"""Chains of earlier versions, one HDF5 file each: they are read, and go on as today's.

    /start, /pilot, /tuning, /sampling   coordinates, log_density, accepted, moves, random_state
    /proposal/PHASE                      weights, centres, factors, bend; zeros where unused
    /point                               the point fit
    /committed                           blocks of each phase; proposals of each phase (0 or 1);
                                         blocks that were set aside, and fitted again to

Small datasets stand twice in their first axis.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from bwbayes.inference.map_estimate import PointFit
from bwbayes.sampling.chain import PHASES, Block, Chain, EnsembleState
from bwbayes.sampling.curvature import QuadraticMap
from bwbayes.sampling.proposals import StudentMixture

__all__ = ["read_earlier"]


def read_earlier(path: Path) -> tuple[Chain, PointFit, int, Mapping[str, str | int]]:
    """Read a chain, its point fit, the steps of a block, and what was run.

    Raises
    ------
    OSError, LookupError, ValueError
        The file is damaged, or no chain.
    """
    # By an open file: HDF5 itself waits for the writer of one that was killed.
    with path.open("rb") as content, h5py.File(content, "r") as file:
        attributes = {n: v if isinstance(v, str) else int(v) for n, v in file.attrs.items()}
        del attributes["format"]
        values = {field.name: file["point"][field.name][0] for field in fields(PointFit)}
        point = PointFit(**values | {"log_density": float(values["log_density"])})
        names = ("coordinates", "log_density", "random_state")
        starts = zip(*(file["start"][name][0] for name in names), strict=True)
        chain = Chain([EnsembleState(*start) for start in starts])
        block = int(file["pilot"]["coordinates"].chunks[0])
        committed = file["committed"][0].tolist()
        for column, phase in enumerate(PHASES):
            if committed[len(PHASES) + column]:
                chain.freeze(phase, _proposal(file["proposal"][phase]))
            for number in range(committed[column]):
                chain.append(phase, _blocks(file[phase], number, block))
        set_aside = committed[2 * len(PHASES)]
    if set_aside:
        aside = Chain(chain.starts)
        for blocks in chain.history("sampling")[:set_aside]:
            aside.append("sampling", blocks)
        draws, density = aside.coordinates("sampling"), aside.log_density("sampling")
        again = set_aside in committed[2 * len(PHASES) + 1 :]
        refit = StudentMixture.fitted(draws.reshape(-1, draws.shape[-1]), density.ravel())
        chain.fall_back(set_aside, refit if again else None)
    return chain, point, block, attributes


def _proposal(group: Any) -> StudentMixture:
    weights, bend = group["weights"][0], group["bend"][0]
    used = weights > 0
    center, factor, bends = np.split(bend, [1, 1 + bend.shape[1]])
    curved = QuadraticMap(center[0], factor, bends) if bend.any() else None
    return StudentMixture(
        weights[used], group["centres"][0][used], group["factors"][0][used], curved
    )


def _blocks(group: Any, number: int, block: int) -> list[Block]:
    """Read one block of every ensemble."""
    steps = slice(number * block, (number + 1) * block)
    coordinates, log_density = group["coordinates"][steps], group["log_density"][steps]
    rows = zip(
        group["accepted"][number], group["moves"][number], group["random_state"][number],
        strict=True,
    )  # fmt: skip
    return [
        Block(
            coordinates[:, e],
            log_density[:, e],
            accepted,
            moves,
            EnsembleState(coordinates[-1, e], log_density[-1, e], state),
        )
        for e, (accepted, moves, state) in enumerate(rows)
    ]
