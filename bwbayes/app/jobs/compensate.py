"""The voltage for a displacement, and its predicted error: ``fit.compensate()``.

Its files are the command as a record, ``command.csv``, which a signal generator can play; the
numbers, ``compensation.json``; everything along time, ``compensation.csv``; and a page with
pictures, ``compensation.html``.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from bwbayes.app.jobs.at_work import command_limits
from bwbayes.app.problem.records import generator
from bwbayes.control.compensation import compensate as compensated
from bwbayes.control.predicted import Compensation
from bwbayes.control.references import SHAPES, Reference, shaped
from bwbayes.diagnosis.extrapolation import beyond_training
from bwbayes.errors import InputError, suggestion
from bwbayes.model.limits import Limits
from bwbayes.model.linear import parse_hold
from bwbayes.prediction.prediction import thinned
from bwbayes.record.io.formats import read_reference

if TYPE_CHECKING:
    from bwbayes.app.fit.fitted import Fit


def compensate(
    fit: Fit,
    reference: Any,
    *,
    amplitude: float | None = None,
    frequency: float | None = None,
    middle: float | None = None,
    periods: float | None = None,
    levels: int | None = None,
    interval: float | None = None,
    smoothed: float | None = None,
    command: Literal["mean", "expected"] = "mean",
    hold: str = "zoh",
    limit: float | None = None,
    from_rest: bool = False,
    voltage: tuple[float, float] | None = None,
    slew: float | None = None,
    current: float | None = None,
    capacitance: float | None = None,
    nearest: bool = False,
) -> Compensation:
    """Return the voltage for a displacement, and its predicted error.

    ``fit.compensate("triangle", amplitude=30, frequency=1)`` is what
    ``bwbayes compensate FOLDER triangle --amplitude 30 --frequency 1`` writes.

    Parameters
    ----------
    fit
        What is built on; of several records the first, and a thousand of the draws.
    reference
        What the displacement is to be: one of the shapes ``"sine"``, ``"triangle"``,
        ``"staircase"`` and ``"raster"``; a file with time and displacement; displacements
        (samples,), um; or the ``reference`` of an earlier command. 0 um is where the actuator
        stands at zero volts as the command begins: there a command begins too, and a reference
        that begins elsewhere gets a way from there before it.
    amplitude
        Amplitude of the shape, um.
    frequency
        Frequency of the shape, or of a raster's lines, Hz.
    middle
        Middle of the shape, um; default: 0.
    periods
        Periods, or lines; default: 3.
    levels
        Steps of a staircase from the middle to either end; default: 5.
    interval
        Sampling interval of a shape, s; default: the record's.
    smoothed
        Smooths the reference, s (SD); default: a shape's 0.01 periods.
    command
        Inverse of the mean model, or least expected squared error over the draws.
    hold
        Voltage between samples: held, as a DAC does (zoh), or straight lines (foh). It need not be
        that of the record.
    limit
        Limit of the error, um; says how probably it is kept.
    from_rest
        The actuator starts demagnetized. Otherwise it has waited at zero volts, in a state of its
        hysteresis that nothing tells.
    voltage
        Lowest and highest voltage of the amplifier, V; default: what was fitted, and 0 V.
    slew
        Its fastest change of the voltage, V/s.
    current
        Its largest current, A; with the capacitance.
    capacitance
        The actuator's capacitance, F.
    nearest
        If limits are exceeded, return the nearest feasible command.

    Raises
    ------
    NotConvergedError
        The sampling has not converged.
    InputError
        A reference that cannot be used or reached.

    Warns
    -----
    InputWarning
        A reference that was smoothed or led to, a command beyond what was fitted.
    """
    problem, seed = fit.problem, fit.problem.config.seed
    span = command_limits(problem, voltage)
    limits = Limits(span.low, span.high, math.inf if slew is None else slew, current, capacitance)
    shape = {"amplitude": amplitude, "frequency": frequency, "middle": middle, "periods": periods}
    options = shape | {"levels": levels, "interval": interval, "smoothed": smoothed}
    options = {name: value for name, value in options.items() if value is not None}
    desired = _reference(reference, problem.record.interval, options)
    alone = next(iter(problem.posterior.each(fit.flat_draws)))
    compensation = compensated(
        alone.posterior,
        thinned(alone.draws, generator(seed, "draws")),
        desired,
        generator(seed, f"compensate {desired.name}"),
        command=command,
        hold=parse_hold(hold),
        from_rest=from_rest,
        limits=limits,
        nearest=nearest,
        limit=limit,
    )
    extrapolations = beyond_training(alone.posterior, compensation.voltage, desired.interval)
    remarks = (*compensation.remarks, *(finding.note for finding in extrapolations))
    return replace(compensation, remarks=remarks, standing=fit.standing)


def _reference(requested: Any, interval: float, options: Mapping[str, Any]) -> Reference:
    """Return a reference: one that is made already, a shape, a file's, or displacements.

    ``interval`` is that of samples where nothing says it, s. Refused are options that it cannot
    have.
    """
    shapes = ", ".join(SHAPES)
    if isinstance(requested, str) and requested in SHAPES:
        for name, unit in (("amplitude", "um"), ("frequency", "Hz")):
            if name not in options:
                raise InputError(f"{requested}: has no {name}; give it, in {unit}")
        return shaped(requested, **{"interval": interval, **options})
    is_file, is_made = isinstance(requested, str | Path), isinstance(requested, Reference)
    kind, allowed = "displacements take", {"smoothed", "interval"}
    if is_made or is_file:
        kind = "one that is made already takes" if is_made else "a file takes"
        allowed = {"smoothed"} if is_file else set()
    for name in options.keys() - allowed:
        raise InputError(f"reference: {kind} no {name}; leave it out, or give one of {shapes}")
    if isinstance(requested, Reference):
        return requested
    smoothed = options.get("smoothed", 0.0)
    if is_file:
        path = Path(requested)
        if isinstance(requested, str) and not path.suffix and not path.exists():
            hint = suggestion(requested, SHAPES)
            raise InputError(f"reference: {requested!r} is neither a shape nor a file; {hint}")
        values, interval = read_reference(path)
        return Reference(values, interval, path.stem, smoothed)
    try:
        values = np.asarray(requested, dtype=np.float64)
    except (TypeError, ValueError):
        values = np.empty(())
    if values.ndim == 0:
        given = type(requested).__name__
        raise InputError(
            f"reference: {given} is none; give one of {shapes}, a file, or displacements in um"
        )
    return Reference(values, options.get("interval", interval), smoothed=smoothed)
