"""From the columns of a file to a record that can be trusted.

:func:`checked` converts the units of a file's columns and checks what all formats share: lengths,
finite numbers, a uniform time grid, a voltage and a displacement that move. A displacement may be
missing here and there (nan), and so may whole samples where the voltage is a command, which is
held. A problem is one line, ``file:line: column: problem; what to do``; files without lines name
the sample, counted from 0.
"""

from __future__ import annotations

from typing import Any, Literal, get_args

import numpy as np

from bwbayes.arrays import FloatArray, IntArray
from bwbayes.errors import InputError
from bwbayes.record.io.grid import time_grid
from bwbayes.record.io.table import FileTable, converted

__all__ = [
    "MINIMUM_SAMPLES",
    "VoltageIs",
    "checked",
    "checked_reference",
    "require_voltage_is",
]

VoltageIs = Literal["command", "output"]
"""What a voltage column is: the command that a DAC holds, or the amplifier's output."""

MINIMUM_SAMPLES = 10


def require_voltage_is(text: str) -> VoltageIs:
    """Return `text` if it says what a voltage column is, else raise an `InputError`."""
    for kind in get_args(VoltageIs):
        if text == kind:
            return kind  # type: ignore[no-any-return]
    raise InputError(f"voltage_is: {text!r} is unknown; write 'command' or 'output'")


def checked(
    table: FileTable, *, voltage_is: VoltageIs | None = None, need_displacement: bool = True
) -> dict[str, Any]:
    """Return a record's arguments, after all checks that do not depend on the format.

    Parameters
    ----------
    voltage_is : "command", "output" or None
        Overrides what the file says; None leaves it to the file, and "output" if it says nothing.
    need_displacement : bool
        False also accepts a planned voltage without a displacement column.

    Raises
    ------
    InputError
        For the first problem, in one line.

    Warns
    -----
    InputWarning
        If samples are missing in which a command was held.
    """
    _check_lengths(table)
    try:
        kind = voltage_is or require_voltage_is(table.notes.get("voltage_is", "output"))
    except InputError as error:
        raise table.error(str(error)) from error
    grid = time_grid(table, held=kind == "command")
    values = {name: converted(table, name) for name in table.columns if name != "time"}
    samples = values["voltage"].size
    if samples < MINIMUM_SAMPLES:
        raise table.error(f"too short, samples: {samples}; give at least {MINIMUM_SAMPLES}")
    _check_moving(table, "voltage", values["voltage"])
    if not need_displacement and np.isnan(values.get("displacement", 0.0)).all():
        del values["displacement"]
    if "displacement" in values:
        read = values["displacement"][~np.isnan(values["displacement"])]
        if read.size < MINIMUM_SAMPLES:
            problem = f"too few readings: {read.size}; give at least {MINIMUM_SAMPLES}"
            raise table.error(problem, "displacement")
        _check_moving(table, "displacement", read)
    if grid.places is not None:
        values = {name: _filled(column, grid.places, name) for name, column in values.items()}
    return {
        "displacement": None,
        **values,
        "interval": grid.interval,
        "start": grid.start,
        "voltage_is": kind,
        "origin": table.notes.get("origin") or table.path.name,
        "time_offset": grid.time_offset + float(table.notes.get("time_offset_s", 0.0)),
    }


def checked_reference(table: FileTable) -> tuple[FloatArray, float]:
    """Return a displacement that is asked for, (samples,), um, and its sampling interval, s.

    Raises
    ------
    InputError
        For the first problem, in one line.
    """
    _check_lengths(table)
    interval = time_grid(table, held=False).interval
    values = converted(table, "displacement")
    if np.isnan(values).any():
        sample = int(np.argmax(np.isnan(values)))
        raise table.error("not a number; give one at every sample", "displacement", sample)
    return values, interval


def _check_lengths(table: FileTable) -> None:
    samples = table.columns["time"].values.size
    for quantity, column in table.columns.items():
        if column.values.size != samples:
            problem = f"{column.values.size} values where time has {samples}; store one per time"
            raise table.error(problem, quantity)
    if samples < 2:
        raise table.error(f"too short, samples: {samples}; give at least {MINIMUM_SAMPLES}")


def _filled(values: FloatArray, places: IntArray, quantity: str) -> FloatArray:
    """Return a column on the whole grid: the voltage held in the gaps, all else missing there."""
    if quantity == "voltage":
        return np.repeat(values, np.diff(places, append=places[-1] + 1))
    full = np.full(int(places[-1]) + 1, np.nan)
    full[places] = values
    return full


def _check_moving(table: FileTable, quantity: str, values: FloatArray) -> None:
    extent = float(np.ptp(values))
    if extent == 0:
        problem = f"constant at {values[0]:g}; give a record in which it moves"
        raise table.error(problem, quantity)
    if extent < 1e-9:  # V or um
        problem = f"moves by {extent:.3g} at most, which is absurdly little; check the unit"
        raise table.error(problem, quantity)
