"""A finished run to be put to work: its problem, its draws, and the voltages that it may use."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from bwbayes.app.problem.problem import Problem
from bwbayes.app.running.folder import RunFolder
from bwbayes.app.running.run import finished, going_on
from bwbayes.arrays import FloatArray
from bwbayes.errors import InputError, NotConvergedError
from bwbayes.model.operator import Span
from bwbayes.sampling.sampler import draws

__all__ = ["command_limits", "drawn", "limits_of", "refuse_existing"]


def drawn(path: Path) -> tuple[Problem, FloatArray]:
    """Return the problem of the run in a folder, and its draws (draws, free).

    Raises
    ------
    NotConvergedError
        The sampling has not converged.
    InputError
        No such run.
    """
    problem, chain, outcome = finished(RunFolder.open(path))
    if not outcome.converged:
        raise NotConvergedError(
            f"{path}: not converged: {outcome.stop_reason}; go on with `{going_on(path, problem)}`"
        )
    return problem, draws(problem.posterior, chain).reshape(-1, len(problem.posterior.names))


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
