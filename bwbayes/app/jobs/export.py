"""The posterior's mean model for a controller, as JSON and as C: ``fit.export()``.

Two files come of it: ``model.json`` has the parts, all coefficients with units, and the linear part
as matrices; ``actuator.c`` is the model and its inverse, one sample a call. In both 0 um is where
the demagnetized actuator stands at zero volts.
"""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from bwbayes.app.jobs.at_work import command_limits
from bwbayes.control.exported import Exported, exported
from bwbayes.errors import InputError
from bwbayes.model.actuator import Actuator
from bwbayes.model.linear import Hold, parse_hold
from bwbayes.report.outputs import refuse_existing

if TYPE_CHECKING:
    from bwbayes.app.fit.fitted import Fit

FILES = ("model.json", "actuator.c")


def export(
    fit: Fit,
    folder: str | Path,
    *,
    voltage: tuple[float, float] | None = None,
    rate: float | None = None,
    hold: str = "zoh",
    overwrite: bool = False,
) -> Exported:
    """Write the posterior's mean model for a controller: ``model.json`` and ``actuator.c``.

    0 um is where the demagnetized actuator stands at zero volts. What is returned has the
    ``linear`` part as a discrete ``scipy.signal`` system.

    Parameters
    ----------
    fit
        What is built on; of several records the first, as what belongs to a record matters little
        to a controller.
    folder
        Where the files go.
    voltage
        Lowest and highest voltage of the inverse, V; default: what was fitted, and 0 V.
    rate
        The controller's samples a second; default: the record's.
    hold
        Voltage between samples: held, as a DAC does (zoh), or straight lines (foh). The latter is
        for a model beside a measured voltage; neither need be that of the record.
    overwrite
        Replace existing files.

    Raises
    ------
    NotConvergedError
        The sampling has not converged.
    InputError
        A hysteresis that has no step of bounded time, options that make no sense, or files that
        exist or cannot be written.
    """
    problem, posterior = fit.problem, fit.problem.posterior
    dataset, theta = posterior.datasets[0], posterior.prior.theta(fit.flat_draws)
    theta = dataset.table.actuator(posterior.table.of(theta, dataset.name))
    actuator = at_rate(dataset.actuator, rate, parse_hold(hold))
    sds = dict(zip(actuator.parameters, theta.std(axis=0).tolist(), strict=True))
    name = problem.config.name or problem.record.origin
    model = exported(name, actuator, theta.mean(axis=0), command_limits(problem, voltage), sds)
    model = replace(model, standing=fit.standing)
    numbers, code = (Path(folder) / name for name in FILES)
    refuse_existing([numbers, code], overwrite=overwrite)
    try:
        numbers.parent.mkdir(parents=True, exist_ok=True)
        text = json.dumps(model.numbers(), indent=2, allow_nan=False)
        numbers.write_text(f"{text}\n", encoding="utf-8")
        code.write_text(model.c_code(), encoding="ascii")
    except OSError as error:
        raise InputError(f"{folder}: {error.strerror}; choose another folder") from None
    return model


def at_rate(actuator: Actuator, rate: float | None, hold: Hold) -> Actuator:
    """Return an actuator at a controller's pace: samples a second up to 10 MHz, with this hold.

    Raises InputError: a rate that is not above zero, or is too high.
    """
    if rate is not None and not 0 < rate <= 1e7:
        raise InputError(f"rate: {rate:g} Hz; give a number above 0 and up to {1e7:g}")
    interval = actuator.interval if rate is None else 1 / rate
    return replace(actuator, interval=interval, hold=hold)
