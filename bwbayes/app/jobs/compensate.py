"""The voltage for a displacement, and its predicted error: ``fit.compensate()``.

Its files are the command as a record, ``command.csv``, which a signal generator can play; the
numbers, ``compensation.json``; everything along time, ``compensation.csv``; and a page with
pictures, ``compensation.html``.
"""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from bwbayes.app.jobs.at_work import command_limits
from bwbayes.app.problem.problem import generator
from bwbayes.control.compensation import compensate as compensated
from bwbayes.control.predicted import Choice, Compensation
from bwbayes.control.references import SHAPES, Reference, shaped
from bwbayes.data.io.formats import read_reference
from bwbayes.diagnosis.extrapolation import beyond_training
from bwbayes.errors import InputError, suggestion
from bwbayes.model.inverse.limits import Limits
from bwbayes.model.linear import parse_hold
from bwbayes.results.prediction import thinned

if TYPE_CHECKING:
    from bwbayes.app.fit.fitted import Fit

__all__ = ["compensate", "reference_of"]


def compensate(
    fit: Fit,
    reference: Any,
    *,
    command: Choice = "mean",
    hold: str = "zoh",
    from_rest: bool = False,
    voltage: tuple[float, float] | None = None,
    slew: float | None = None,
    current: float | None = None,
    capacitance: float | None = None,
    nearest: bool = False,
    limit: float | None = None,
    interval: float | None = None,
    smoothed: float | None = None,
    amplitude: float | None = None,
    frequency: float | None = None,
    middle: float | None = None,
    periods: float | None = None,
    levels: int | None = None,
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
    command
        ``"mean"``, the inverse of the mean model; or ``"expected"``, the voltage whose squared
        error, expected over the draws, is least.
    hold
        What the command does between samples: ``"zoh"``, it is held, as a DAC does (zero-order
        hold); ``"foh"``, it goes in straight lines (first-order hold), as the output of a generator
        that interpolates does. It need not be that of the record.
    from_rest
        The actuator starts demagnetized; otherwise it has waited at zero volts, in a state of its
        hysteresis that nothing tells.
    voltage, slew, current, capacitance
        Limits of the amplifier: lowest and highest voltage, V, by default zero and those of all
        records fitted; its fastest change, V/s, and the largest current, A, into the actuator's
        capacitance, F, by default any.
    nearest
        Give the nearest command where the limits do not allow for the one that is asked for.
    limit
        Of the error, um: the probability that it is kept is given.
    interval, smoothed
        Sampling interval, s, by default that of the record, and SD of a smoothing, s; a file has an
        interval of its own.
    amplitude, frequency, middle, periods, levels
        Of a shape: um and Hz, which it needs; um (default: 0); how many periods or lines (default:
        3), and steps of a staircase from the middle to either end (default: 5).

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
    problem, flat = fit.problem, fit.flat_draws
    span = command_limits(problem, voltage)
    fastest = math.inf if slew is None else slew
    limits = Limits(span.low, span.high, fastest, current, capacitance)
    alone = next(iter(problem.posterior.each(flat)))
    desired = reference_of(
        reference,
        problem.record.interval,
        interval=interval,
        smoothed=smoothed,
        amplitude=amplitude,
        frequency=frequency,
        middle=middle,
        periods=periods,
        levels=levels,
    )
    seed = problem.config.seed
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


def reference_of(requested: Any, default: float, **options: Any) -> Reference:
    """Return a reference: one that is made already, a shape, a file's, or displacements.

    Parameters
    ----------
    requested
        A reference; the name of a shape; a file; or displacements (samples,), um.
    default
        Sampling interval, s, where neither the file nor ``options`` say it.
    options
        ``interval``, ``smoothed`` and those of :func:`~bwbayes.control.references.shaped`; what is
        None is not given.

    Raises
    ------
    InputError
        It is none of these or cannot be used, or options that it cannot have.
    """
    options = {name: value for name, value in options.items() if value is not None}
    shapes = ", ".join(SHAPES)
    if isinstance(requested, str) and requested in SHAPES:
        for name, unit in (("amplitude", "um"), ("frequency", "Hz")):
            if name not in options:
                raise InputError(f"{requested}: has no {name}; give it, in {unit}")
        return shaped(requested, **{"interval": default, **options})
    kind, allowed = "displacements take", {"smoothed", "interval"}
    if isinstance(requested, Reference):
        kind, allowed = "one that is made already takes", set()
    elif isinstance(requested, str | Path):
        kind, allowed = "a file takes", {"smoothed"}
    for name in options:
        if name not in allowed:
            raise InputError(f"reference: {kind} no {name}; leave it out, or give one of {shapes}")
    if isinstance(requested, Reference):
        return requested
    smoothed = options.get("smoothed", 0.0)
    if isinstance(requested, str | Path):
        path = Path(requested)
        if isinstance(requested, str) and not path.suffix and not path.exists():
            raise InputError(
                f"reference: {requested!r} is neither a shape nor a file; "
                f"{suggestion(requested, SHAPES)}"
            )
        values, interval = read_reference(path)
        return Reference(values, interval, path.stem, smoothed)
    try:
        values = np.asarray(requested, dtype=np.float64)
    except (TypeError, ValueError):
        values = np.empty(())
    if values.ndim == 0:
        raise InputError(
            f"reference: {type(requested).__name__} is none; give one of {shapes}, a file, or "
            "displacements in um"
        )
    return Reference(values, options.get("interval", default), smoothed=smoothed)
