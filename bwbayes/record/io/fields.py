"""From the columns of a file to a record that can be trusted: units, lengths, numbers, gaps.

What all formats share is checked here: lengths, finite numbers, a voltage and a displacement that
move. A displacement may be missing here and there (nan), and so may whole samples where the voltage
is known: a command is held, and an output is on the line between its neighbors where no extremum
can be hidden there. A problem is one line, ``file:line: column: problem; what to do``;
files without lines name the sample, counted from 0.
"""

from __future__ import annotations

import warnings
from typing import Any, Literal, get_args

import numpy as np

from bwbayes.arrays import FloatArray
from bwbayes.errors import InputError, InputWarning
from bwbayes.record.io.columns import ColumnTable
from bwbayes.record.io.grid import Grid, clock, require_plausible, time_grid

VoltageIs = Literal["command", "output"]
"""What a voltage column is: the command that a DAC holds, or the amplifier's output."""

_MINIMUM_SAMPLES = 10


def require_voltage_is(text: str) -> VoltageIs:
    """Return `text` if it says what a voltage column is, else raise an `InputError`."""
    for kind in get_args(VoltageIs):
        if text == kind:
            return kind  # type: ignore[no-any-return]
    raise InputError(f"voltage_is: {text!r} is unknown; write 'command' or 'output'")


def record_fields(
    table: ColumnTable, voltage_is: VoltageIs | None = None, need_displacement: bool = True
) -> dict[str, Any]:
    """Return a record's arguments, after all checks that do not depend on the format.

    ``voltage_is`` overrides what the file says; a file that says nothing means "output". Without
    the need of a displacement, one that is missing everywhere is a planned voltage.

    Raises
    ------
    InputError
        For the first problem, in one line.

    Warns
    -----
    InputWarning
        If samples are missing, or times scatter.
    """
    _check_lengths(table)
    try:
        kind = voltage_is or require_voltage_is(table.notes.get("voltage_is", "output"))
    except InputError as error:
        raise table.error(str(error)) from error
    table, grid = _grid(table)
    values = {name: _converted(table, name) for name in table.columns if name != "time"}
    if values["voltage"].size < _MINIMUM_SAMPLES:
        raise table.error(
            f"too short, samples: {values['voltage'].size}; give at least {_MINIMUM_SAMPLES}"
        )
    _check_moving(table, "voltage", values["voltage"])
    if not need_displacement and np.isnan(values.get("displacement", 0.0)).all():
        del values["displacement"]
    if "displacement" in values:
        readings = values["displacement"][~np.isnan(values["displacement"])]
        if readings.size < _MINIMUM_SAMPLES:
            problem = f"too few readings: {readings.size}; give at least {_MINIMUM_SAMPLES}"
            raise table.error(problem, "displacement")
        _check_moving(table, "displacement", readings)
    held = kind == "command"
    return {
        "displacement": None,
        **{name: grid.filled(column) for name, column in values.items()},
        "voltage": _without_gaps(table, grid, "voltage", values["voltage"], held),
        "interval": grid.interval,
        "start": grid.start,
        "voltage_is": kind,
        "origin": table.notes.get("origin") or table.source.path.name,
        "time_offset": grid.time_offset + float(table.notes.get("time_offset_s", 0.0)),
    }


def reference_fields(table: ColumnTable) -> tuple[FloatArray, float]:
    """Return a displacement that is asked for, (samples,), um, and its sampling interval, s.

    Raises
    ------
    InputError
        For the first problem, in one line.
    """
    _check_lengths(table)
    table, grid = _grid(table)
    values = _converted(table, "displacement")
    if np.isnan(values).any():
        sample = int(np.argmax(np.isnan(values)))
        raise table.error("not a number; give one at every sample", "displacement", sample)
    return _without_gaps(table, grid, "displacement", values, held=False), grid.interval


def _check_lengths(table: ColumnTable) -> None:
    (first, *_), others = table.columns, table.columns.items()
    samples = table.columns[first].values.size
    for quantity, column in others:
        if column.values.size != samples:
            problem = f"{column.values.size} values where {first} has {samples}"
            raise table.error(f"{problem}; store one per sample", quantity)
    if samples < 2:
        raise table.error(f"too short, samples: {samples}; give at least {_MINIMUM_SAMPLES}")


def _check_moving(table: ColumnTable, quantity: str, values: FloatArray) -> None:
    extent = float(np.ptp(values))
    if extent == 0:
        problem = f"constant at {values[0]:g}; give a record in which it moves"
        raise table.error(problem, quantity)
    if extent < 1e-9:  # V or um
        problem = f"moves by {extent:.3g} at most, which is absurdly little; check the unit"
        raise table.error(problem, quantity)


def _converted(table: ColumnTable, quantity: str) -> FloatArray:
    """Return a column in the package's unit after refusing what is not finite or absurdly large."""
    column = table.columns[quantity]
    largest = 1e12 if quantity == "time" else 1e9  # s; V or um, whatever the actuator
    with np.errstate(all="ignore"):
        values = column.scaled(np.asarray(column.values, dtype=np.float64), quantity)
        refused = ~(np.abs(values) <= largest)
    if quantity == "displacement":
        refused &= ~np.isnan(values)
    if refused.any():
        sample = int(np.argmax(refused))
        raw = column.values[sample]
        problem = f"{raw:g} is absurdly large; check the unit in the column's name"
        if not np.isfinite(raw):
            fact = "no number (empty or nan)" if np.isnan(raw) else f"{raw} is not a finite number"
            problem = f"{fact}; give one, or leave the sample out (a displacement may be nan)"
        raise table.error(problem, quantity, sample)
    return values


def _grid(table: ColumnTable) -> tuple[ColumnTable, Grid]:
    if "time" in table.columns:
        return time_grid(table, _converted(table, "time"))
    interval = 1 / table.naming.fs if table.naming.fs else table.source.interval or 0.0
    require_plausible(table, interval, next(iter(table.columns.values())).values.size)
    return table, Grid(table.source.start, interval)


def _without_gaps(
    table: ColumnTable, grid: Grid, quantity: str, values: FloatArray, held: bool
) -> FloatArray:
    """Return a column at all times of the grid: held where samples are missing, or interpolated.

    Raises
    ------
    InputError
        It is interpolated, and the longest gap may hide an extremum: between others that are as
        far apart is a value beyond both, by more than 1% of the range.
    """
    positions, sources = grid.positions, grid.sources
    if positions is None or sources is None:
        return values
    values, steps = grid.filled(values)[positions], np.diff(positions)
    longest, samples = int(np.argmax(steps)), int(positions[-1]) + 1
    missing = int(steps[longest]) - 1
    if missing and not held:
        # Hysteresis depends on extrema alone: how far beyond both ends such a gap would hide one.
        ends = np.array([values[: -missing - 1], values[missing + 1 :]])
        lowest, highest = ends.min(axis=0), ends.max(axis=0)
        inside = [values[i : i + lowest.size] for i in {(missing + 1) // 2, missing // 2 + 1}]
        hidden = np.abs(inside - np.clip(inside, lowest, highest))
        if not (hidden.size and hidden.max() <= 0.01 * np.ptp(values)):
            since = clock(grid.start + positions[longest] * grid.interval, grid.interval)
            held_too = ""
            if quantity == "voltage":
                held_too = (
                    ' (the displacement may be nan), say voltage_is = "command" if it was held'
                )
            problem = f"gap of {steps[longest] * grid.interval:.6g} s after {since} s"
            advice = f"give the {quantity} there{held_too}, or cut the record"
            problem = f"{problem}, about {missing} missing; {advice}"
            raise table.error(problem, "time", int(sources[longest + 1]))
    if missing:
        kind = "held" if held else "interpolated"
        remark = f"{samples - values.size} samples are missing, from here on in "
        count = int(np.count_nonzero(steps > 1))
        remark += f"{count} gap{'s' * (count > 1)}; the {quantity} is {kind} there"
        where = int(sources[int(np.argmax(steps > 1)) + 1])
        warnings.warn(str(table.error(remark, "time", where)), InputWarning, stacklevel=5)
    if held:
        return np.repeat(values, np.append(steps, 1))
    return np.interp(np.arange(samples), positions, values)
