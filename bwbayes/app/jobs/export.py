"""``bwbayes export``: the posterior's mean model for a controller, as JSON and as C.

Two files come of it: ``model.json`` has the parts, all coefficients with units, and the linear part
as matrices; ``actuator.c`` is the model and its inverse, one sample a call. In both 0 um is where
the demagnetized actuator stands at zero volts.
"""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

from bwbayes.app.jobs.at_work import RunDraws, command_limits, drawn, refuse_existing
from bwbayes.control.exported import Exported, exported
from bwbayes.errors import InputError
from bwbayes.model.actuator import Actuator
from bwbayes.model.linear import Hold, parse_hold

__all__ = ["at_rate", "export", "export_draws"]

# Fastest sampling of a controller, Hz.
LARGEST_RATE = 1e7


def export(path: Path, out: Path | None = None, **options: Any) -> tuple[Exported, list[Path]]:
    """Write the mean model of the run in a folder, by default to ``export`` in it.

    Options, errors and what is returned are as of :func:`export_draws`; a run that has not
    converged is refused.
    """
    return export_draws(drawn(path), out or path / "export", **options)


def export_draws(
    run: RunDraws,
    folder: Path,
    *,
    voltage: tuple[float, float] | None = None,
    rate: float | None = None,
    hold: str = "zoh",
    overwrite: bool = False,
) -> tuple[Exported, list[Path]]:
    """Write the mean model of draws for a controller; return it, and the files.

    Parameters
    ----------
    run
        What is built on.
    folder
        Where the files go.
    voltage
        Lowest and highest that the inverse may give, V; by default zero and those of all records
        fitted.
    rate
        The controller's samples a second; by default the record's.
    hold
        What the voltage does between samples, whatever it did in the record: ``"zoh"``, it is held,
        as a controller's DAC does (zero-order hold); ``"foh"``, it goes in straight lines, for a
        model beside a measured voltage (first-order hold).
    overwrite
        Whether files may be replaced.

    Raises
    ------
    InputError
        A hysteresis that has no step of bounded time, options that make no sense, or files that
        exist or cannot be written.
    """
    problem, flat, standing = run
    posterior = problem.posterior
    # Of several records the first: what belongs to a record matters little to a controller.
    one = posterior.datasets[0]
    theta = one.table.actuator(posterior.table.of(posterior.prior.theta(flat), one.name))
    actuator = at_rate(one.actuator, rate, parse_hold(hold))
    sds = dict(zip(actuator.parameters, theta.std(axis=0).tolist(), strict=True))
    name = problem.config.name or problem.record.origin
    made = exported(name, actuator, theta.mean(axis=0), command_limits(problem, voltage), sds)
    made = replace(made, standing=standing)
    return made, _written(made, folder, overwrite)


def at_rate(actuator: Actuator, rate: float | None, hold: Hold) -> Actuator:
    """Return an actuator at a controller's pace: so many samples a second, with this hold.

    Raises
    ------
    InputError
        A rate that is not above zero, or is too high.
    """
    if rate is not None and not 0 < rate <= LARGEST_RATE:
        raise InputError(f"rate: {rate:g} Hz; give a number above 0 and up to {LARGEST_RATE:g}")
    interval = actuator.interval if rate is None else 1 / rate
    return replace(actuator, interval=interval, hold=hold)


def _written(made: Exported, folder: Path, overwrite: bool) -> list[Path]:
    """Write the two files, and return them."""
    numbers, code = folder / "model.json", folder / "actuator.c"
    refuse_existing([numbers, code], overwrite)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        text = json.dumps(made.numbers(), indent=2, allow_nan=False)
        numbers.write_text(f"{text}\n", encoding="utf-8")
        code.write_text(made.c_code(), encoding="ascii")
    except OSError as error:
        raise InputError(f"{folder}: {error.strerror}; choose another folder") from None
    return [numbers, code]
