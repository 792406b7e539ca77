"""A fit that has converged put to work, and the voltages it may use."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from functools import wraps
from inspect import signature
from typing import TYPE_CHECKING, Any, Concatenate

import numpy as np

from bwbayes.app.fit.surroundings import warn
from bwbayes.errors import InputError, suggestion
from bwbayes.model.operator import Span

if TYPE_CHECKING:
    from bwbayes.app.fit.fitted import Fit
    from bwbayes.app.problem.problem import Problem

__all__ = ["at_work", "command_limits", "limits_of"]


def at_work[**P, R](
    job: Callable[Concatenate[Fit, P], R],
    *,
    carried: bool = True,
    after: Callable[[Any], Iterable[str]] = lambda product: getattr(product, "remarks", ()),
) -> Callable[Concatenate[Fit, P], R]:
    """Make a job the method of a fit: it needs convergence, and warns as a command prints.

    Of what the run's bands do not hold if that is ``carried``, and of what its product says.
    """
    options = [*signature(job).parameters][1:]

    @wraps(job)
    def method(fit: Fit, /, *args: P.args, **kwargs: P.kwargs) -> R:
        for name in kwargs:
            if name not in options:
                raise InputError(f"{job.__name__}: {name} is unknown; {suggestion(name, options)}")
        fit.require_converged()
        warn(fit.standing.said if carried else (), 3)
        product = job(fit, *args, **kwargs)
        warn(after(product), 3)
        return product

    return method


def limits_of(problem: Problem, limits: tuple[float, float] | None) -> Span:
    """Return the voltages that may be used: those given, or those of all that was fitted, V.

    Raises
    ------
    InputError
        They are not two voltages, the lower one first.
    """
    ranges = [record.range_voltage for record in problem.records.values()]
    low, high = limits or (min(low for low, _ in ranges), max(high for _, high in ranges))
    if not (np.isfinite([low, high]).all() and low < high):
        raise InputError(f"voltage: {low:g} to {high:g} V; give two voltages, the lower one first")
    return Span(low, high)


def command_limits(problem: Problem, limits: tuple[float, float] | None) -> Span:
    """Return the voltages of a command: those given, or zero and all fitted ones, V."""
    low, high = limits_of(problem, limits)
    return Span(low, high) if limits else Span(min(low, 0.0), max(high, 0.0))
