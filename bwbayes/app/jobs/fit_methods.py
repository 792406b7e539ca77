"""Methods of a fit: jobs that warn, their voltage limits and scratch folders.

Python warns of the remarks that the command line prints.
"""

from __future__ import annotations

import math
import shutil
import sys
import warnings
import weakref
from collections.abc import Callable, Iterable, Mapping
from functools import wraps
from inspect import signature
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Concatenate

import numpy as np
from rich.console import Console

from bwbayes.app.fit.fitted import Run
from bwbayes.diagnosis.extrapolation import covariate_range
from bwbayes.errors import InputError, InputWarning, suggestion
from bwbayes.inference.study import Study
from bwbayes.model.inputs import Limits, Span
from bwbayes.report.report import Shown


def fit_method[**P, R](
    job: Callable[Concatenate[Run, P], R],
) -> Callable[Concatenate[Run, P], R]:
    """Make a job the method of a fit: it needs convergence, and warns as a command prints.

    It warns of a failed validation, the run's unless its product has one of its own, and of the
    product's notes.
    """
    options = [*signature(job).parameters][1:]
    earlier = {"own_offset": "estimate_offset", "lead_in_from": "lead_in_start"}

    @wraps(job)
    def method(fit: Run, /, *args: P.args, **kwargs: P.kwargs) -> R:
        for name in kwargs:
            if name not in options:
                hint = suggestion(name, options, earlier)
                raise InputError(f"{job.__name__}: {name} is unknown; {hint}")
        fit.require_converged()
        say = fit.quantities.say
        with fit.quantities.spoken():
            product = job(fit, *args, **kwargs)
        if isinstance(product, Shown):
            product.said_in(fit.quantities)
        if getattr(product, "standing", fit.standing) is fit.standing:
            warn(map(say, fit.standing.messages), 3)
        warn(map(say, getattr(product, "notes", getattr(product, "remarks", ()))), 3)
        return product

    return method


def fitted_voltages(study: Study) -> Span:
    """Return the lowest and the highest voltage that were fitted, V."""
    fitted = [edge for record in study.records.values() for edge in record.range_voltage]
    return Span(min(fitted), max(fitted))


def amplifier_limits(
    study: Study,
    voltage: tuple[float, float] | None,
    slew: float | None = None,
    current: float | None = None,
    capacitance: float | None = None,
    *,
    beyond_training: bool = False,
) -> Limits:
    """Return an amplifier's limits; its voltages are by default those fitted, and 0 V.

    Raises InputError: they are not two voltages, the lower one first; they go beyond those fitted
    and 0 V, which has to be allowed; a limit that is not positive, a current without a capacitance.
    """
    fitted = fitted_voltages(study)
    trained = Span(min(fitted.low, 0.0), max(fitted.high, 0.0))
    low, high = voltage or trained
    if not (np.isfinite([low, high]).all() and low < high):
        raise InputError(f"voltage: {low:g} to {high:g} V; give two voltages, the lower one first")
    slack = 0.02 * (trained.high - trained.low)  # a sensor's noise, as in beyond_training
    if not beyond_training and (low < trained.low - slack or high > trained.high + slack):
        raise InputError(
            f"voltage: {low:g} to {high:g} V goes beyond the {trained.low:g} to {trained.high:g} V "
            "that were fitted, where nothing is known of the error; give voltages within these, or "
            "allow it with beyond_training (--beyond-training)"
        )
    return Limits(low, high, math.inf if slew is None else slew, current, capacitance)


def conditions_at(
    study: Study, at: Mapping[str, str | float] | None, *, beyond_training: bool = False
) -> dict[str, float]:
    """Return the constant values of the covariates that a model follows, by name.

    Raises InputError: one is missing, unknown or no number, or goes beyond those fitted, which has
    to be allowed.
    """
    stages, given, conditions = study.posterior.datasets[0].actuator.stages, dict(at or {}), {}
    for name in sorted({name for stage in stages for name in stage.sees} - {"time", "voltage"}):
        if name not in given:
            raise InputError(
                f"{name}: the model follows it, and it is not given; give its constant value in at "
                f"(--at {name}=VALUE)"
            )
        try:
            value = float(given.pop(name))
        except ValueError:
            value = math.nan
        trained = covariate_range(study.posterior, name)
        slack = 0.02 * (trained.high - trained.low)
        if not math.isfinite(value):
            raise InputError(f"at: {name} is not a finite number; give one")
        if not beyond_training and not trained.low - slack <= value <= trained.high + slack:
            raise InputError(
                f"at: {name} {value:g} is beyond the {trained.low:g} to {trained.high:g} that were "
                "fitted, where nothing is known of the error; give a value within these, or allow "
                "it with beyond_training (--beyond-training)"
            )
        conditions[name] = value
    for name in given:
        raise InputError(f"at: the model does not follow {name}; leave it out")
    return conditions


def folder_or_scratch(
    folder: str | Path | None, name: str
) -> tuple[Path, TemporaryDirectory[str] | None]:
    """Return a user's folder, or without one a temporary one and what keeps it there."""
    if folder is not None:
        return Path(folder), None
    # Its own clean-up warns where it is not asked for.
    scratch = TemporaryDirectory(prefix="bwbayes-", delete=False)
    weakref.finalize(scratch, shutil.rmtree, scratch.name, ignore_errors=True)
    return Path(scratch.name) / name, scratch


def console_of(progress: bool) -> Console:
    """Return where progress goes: the terminal's own lines, and in a notebook plain ones."""
    if Console(quiet=True).is_jupyter:
        return Console(file=sys.stdout, force_jupyter=False, quiet=not progress)
    return Console(stderr=True, quiet=not progress)


def warn(lines: Iterable[str], level: int) -> None:
    """Warn of each line; the caller of the function that calls this is level 3."""
    for line in lines:
        warnings.warn(line, InputWarning, stacklevel=level)
