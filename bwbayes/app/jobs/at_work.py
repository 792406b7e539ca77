"""A finished run to be put to work: its draws, its validation, and the voltages it may use."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np

from bwbayes.app.problem.problem import Problem
from bwbayes.app.running.folder import RunFolder
from bwbayes.app.running.run import finished, going_on
from bwbayes.arrays import FloatArray
from bwbayes.errors import InputError, NotConvergedError
from bwbayes.model.operator import Span
from bwbayes.results.standing import Standing
from bwbayes.sampling.sampler import draws

__all__ = ["RunDraws", "command_limits", "drawn", "limits_of", "refuse_existing"]


class RunDraws(NamedTuple):
    """What a run that has converged gives to whatever builds on it.

    ``problem`` is what was fitted; ``flat`` its draws, (draws, free), parameters in their own
    units; ``standing`` how its validation came out, which goes along.
    """

    problem: Problem
    flat: FloatArray
    standing: Standing = Standing()


def drawn(path: Path) -> RunDraws:
    """Return what the run in a folder gives.

    Raises
    ------
    NotConvergedError
        The sampling has not converged.
    InputError
        No such run.
    """
    folder = RunFolder.open(path)
    problem, chain, outcome = finished(folder)
    if not outcome.converged:
        raise NotConvergedError(
            f"{path}: {outcome.stop_reason}; go on with `{going_on(path, problem)}`"
        )
    flat = draws(problem.posterior, chain).reshape(-1, len(problem.posterior.names))
    return RunDraws(problem, flat, folder.standing())


def limits_of(problem: Problem, given: tuple[float, float] | None) -> Span:
    """Return the voltages that may be used: those given, or those of all that was fitted, V.

    Raises
    ------
    InputError
        They are not two voltages, the lower one first.
    """
    ranges = np.array([record.range_voltage for record in problem.records.values()])
    low, high = given or (float(ranges[:, 0].min()), float(ranges[:, 1].max()))
    if not (np.isfinite([low, high]).all() and low < high):
        raise InputError(f"voltage: {low:g} to {high:g} V; give two voltages, the lower one first")
    return Span(low, high)


def command_limits(problem: Problem, given: tuple[float, float] | None) -> Span:
    """Return the voltages that a command may use: those given, or zero and all fitted ones, V.

    Errors are those of :func:`limits_of`.
    """
    low, high = limits_of(problem, given)
    return Span(low, high) if given else Span(min(low, 0.0), max(high, 0.0))


def refuse_existing(files: list[Path], overwrite: bool) -> None:
    """Refuse to replace a file, unless that is asked for.

    Raises
    ------
    InputError
        One of them exists.
    """
    for target in files:
        if target.exists() and not overwrite:
            raise InputError(f"{target}: exists; choose another folder, or give `overwrite=True`")
