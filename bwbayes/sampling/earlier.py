"""Chains of earlier versions, one HDF5 file each: they are read as the files of today's folder.

    /start, /pilot, /tuning, /sampling   coordinates, log_density, accepted, moves, random_state
    /proposal/PHASE                      weights, centres, factors, bend; zeros where unused
    /point                               the point fit
    /committed                           blocks of each phase; proposals of each phase (0 or 1);
                                         blocks that were set aside, and fitted again to

Small datasets stand twice in their first axis.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import h5py
import numpy as np

from bwbayes.sampling.chain import PHASES
from bwbayes.sampling.curvature import QuadraticMap
from bwbayes.sampling.proposals import StudentMixture


def read_earlier(path: Path) -> dict[str, dict[str, Any]]:
    """Read a chain as the arrays of each file of :mod:`bwbayes.sampling.storage`, by name.

    That of the start has ``block`` and ``attributes`` instead of a text.

    Raises
    ------
    OSError, LookupError, ValueError
        The file is damaged, or no chain.
    """
    # By an open file: HDF5 itself waits for the writer of one that was killed.
    with path.open("rb") as content, h5py.File(content, "r") as file:
        attributes = {n: v if isinstance(v, str) else int(v) for n, v in file.attrs.items()}
        del attributes["format"]
        block = int(file["pilot"]["coordinates"].chunks[0])
        start = {"block": block, "attributes": attributes}
        start |= {f"point_{name}": values[0] for name, values in file["point"].items()}
        start |= {name: values[0] for name, values in file["start"].items()}
        files: dict[str, dict[str, Any]] = {"start": start}
        committed = file["committed"][0].tolist()
        for column, phase in enumerate(PHASES):
            if committed[len(PHASES) + column]:
                name = "start" if phase == "pilot" else f"{phase}-proposal"
                mixture = _mixture(file["proposal"][phase]).arrays()
                files[name] = files.get(name, {}) | mixture
            group = file[phase]
            for number in range(committed[column]):
                steps = slice(number * block, (number + 1) * block)
                arrays = {name: group[name][steps] for name in ("coordinates", "log_density")}
                arrays |= {n: group[n][number] for n in ("accepted", "moves", "random_state")}
                files[f"{phase}-{number:04d}"] = arrays
        set_aside, *fitted_to = committed[2 * len(PHASES) :]
    if set_aside:
        aside = [files[f"sampling-{number:04d}"] for number in range(set_aside)]
        draws, density = (
            np.concatenate([arrays[name] for arrays in aside])
            for name in ("coordinates", "log_density")
        )
        refit = StudentMixture.fitted(draws.reshape(-1, draws.shape[-1]), density.ravel())
        again = refit.arrays() if set_aside in fitted_to else {}
        files["set-aside"] = {"blocks": set_aside} | again
    return files


def _mixture(group: Any) -> StudentMixture:
    weights, bend = group["weights"][0], group["bend"][0]
    used = weights > 0
    center, factor, bends = np.split(bend, [1, 1 + bend.shape[1]])
    maps = (QuadraticMap(center[0], factor, bends),) if bend.any() else ()
    centers, factors = (group[name][0][used] for name in ("centres", "factors"))
    return StudentMixture(weights[used], centers, factors, maps, freedom=6.0)
