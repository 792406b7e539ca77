"""A run that is there, opened as a fit: its files are read, and nothing is worked out."""

from __future__ import annotations

from pathlib import Path

from bwbayes.app.fit.fitted import Fit
from bwbayes.app.running.fingerprint import require_its_own
from bwbayes.app.running.folder import RunFolder
from bwbayes.errors import InputError
from bwbayes.sampling.storage import ChainFile

__all__ = ["converged", "finished"]


def finished(folder: RunFolder) -> Fit:
    """Return the fit that a run's folder holds, as far as its chain goes.

    Raises
    ------
    InputError
        The chain is missing, damaged or still in its pilot.
    """
    problem = folder.problem()
    chain = ChainFile.read(folder.chain)
    require_its_own(folder.chain, problem, chain.attributes())
    if chain.blocks("sampling") == 0:
        raise InputError(f"{folder.path}: no draws yet; resume with {folder.resuming}")
    return Fit(problem, chain, folder, folder.numbers().get("wall_s", 0.0))


def converged(path: Path) -> Fit:
    """Return the fit in a folder, if it is finished and has converged.

    Raises
    ------
    NotConvergedError
        The sampling has not converged.
    InputError
        No such run, or it is not finished.
    """
    folder = RunFolder.open(path)
    fit = finished(folder)
    fit.require_converged()
    return fit.knowing(standing=folder.standing())
