"""The package's steps as Python users call them: what the command line prints becomes a warning.

Each function does what its namesake does, and warns (:class:`~bwbayes.errors.InputWarning`) where
the command line would print a remark: of a record, of a prediction beyond what was fitted, or of
bands that do not hold. The values are the same; whoever silences the warnings loses nothing else.
"""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from bwbayes.app import problem
from bwbayes.app.config import Config
from bwbayes.app.problem import Problem
from bwbayes.arrays import FloatArray
from bwbayes.data.record import Record
from bwbayes.errors import InputWarning
from bwbayes.inference.posterior import Posterior
from bwbayes.results import prediction
from bwbayes.results.bands import Bands
from bwbayes.results.extrapolation import beyond_training
from bwbayes.results.prediction import Start
from bwbayes.results.verdict import Background, assess

__all__ = ["predict_record", "predict_windows", "resolve"]


def resolve(config: Config, folder: Path) -> Problem:
    """Make a problem of a config whose files are relative to ``folder``.

    Raises
    ------
    InputError
        Anything in the config or the records that cannot be used.

    Warns
    -----
    InputWarning
        Each of the problem's remarks.
    """
    made = problem.resolve(config, folder)
    for remark in made.remarks:
        warnings.warn(remark, InputWarning, stacklevel=2)
    return made


def predict_windows(
    posterior: Posterior,
    draws: FloatArray,
    record: Record,
    windows: Mapping[str, slice],
    generator: np.random.Generator,
) -> list[Bands]:
    """Predict windows of the training record: one simulation, one offset.

    Parameters
    ----------
    posterior
        The posterior that was sampled.
    draws
        (draws, free), parameters in their own units.
    record
        The training record, whole.
    windows
        Slices of its samples, by name.
    generator
        Draws the state of the dynamics at the record's start, where that is unknown.

    Warns
    -----
    InputWarning
        Bands that do not hold: which, by how much, the likeliest cause and what helps.
    """
    made = prediction.predict_windows(posterior, draws, record, windows, generator)
    for bands in made:
        _judge(bands, posterior, draws)
    return made


def predict_record(
    posterior: Posterior,
    draws: FloatArray,
    record: Record,
    start: Start,
    generator: np.random.Generator,
    name: str = "prediction",
    window: tuple[float, float] | None = None,
) -> Bands:
    """Predict another record, or a planned voltage without a measurement.

    Parameters
    ----------
    posterior, draws
        As in :func:`predict_windows`.
    record
        The other record, at any sampling interval.
    start
        What is known of its start.
    generator
        Draws what is not known of it.
    name
        The bands' name.
    window
        Start and stop in s of the part that is judged; by default all of it.

    Raises
    ------
    InputError
        A lead-in or window that is none of the record's.

    Warns
    -----
    InputWarning
        A drive beyond what was fitted; bands that do not hold, with the likeliest cause.
    """
    made = prediction.predict_record(posterior, draws, record, start, generator, name, window)
    far = beyond_training(posterior, record.voltage, record.interval)
    for remark in far:
        warnings.warn(f"{name}: {remark}", InputWarning, stacklevel=2)
    _judge(made, posterior, draws, far)
    return made


def _judge(
    bands: Bands, posterior: Posterior, draws: FloatArray, beyond: Sequence[str] = ()
) -> None:
    verdict = assess(bands, Background.of(posterior, draws), beyond=beyond)
    if verdict is not None and verdict.holds is False:
        warnings.warn(verdict.line, InputWarning, stacklevel=3)
