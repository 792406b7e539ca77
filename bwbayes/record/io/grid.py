"""From the columns of a file to a record that can be trusted: units, a uniform time grid, checks.

What all formats share is checked here: lengths, finite numbers, times that are uniform as far as
their digits can tell, a voltage and a displacement that move. A displacement may be missing here
and there (nan), and so may whole samples where the voltage is a command, which is held. A problem
is one line, ``file:line: column: problem; what to do``; files without lines name the sample,
counted from 0. Time stamps of a clock count from the first of them.
"""

from __future__ import annotations

import math
import warnings
from typing import Any, Literal, NamedTuple, get_args

import numpy as np

from bwbayes.arrays import FloatArray, IntArray
from bwbayes.errors import InputError, InputWarning
from bwbayes.record.io.columns import ColumnTable
from bwbayes.record.io.series import MAXIMUM_SAMPLES

VoltageIs = Literal["command", "output"]
"""What a voltage column is: the command that a DAC holds, or the amplifier's output."""

_MINIMUM_SAMPLES = 10


class _Grid(NamedTuple):
    """The times of a record, s, what a clock adds to them, and where the samples are on the grid.

    ``positions`` (samples,) are given where some samples are missing.
    """

    start: float
    interval: float
    time_offset: float = 0.0
    positions: IntArray | None = None


def require_voltage_is(text: str) -> VoltageIs:
    """Return `text` if it says what a voltage column is, else raise an `InputError`."""
    for kind in get_args(VoltageIs):
        if text == kind:
            return kind  # type: ignore[no-any-return]
    raise InputError(f"voltage_is: {text!r} is unknown; write 'command' or 'output'")


def decimals_of(interval: float) -> int:
    """Return how many decimals tell the times of neighboring samples apart."""
    return max(0, -math.floor(math.log10(interval))) if interval > 0 else 9


def clock(time: float, interval: float) -> str:
    """Return a time, s, with the decimals that tell samples an interval, s, apart."""
    return f"{round(float(time), decimals_of(interval)):.15g}"


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
        If samples are missing in which a command was held.
    """
    _check_lengths(table)
    try:
        kind = voltage_is or require_voltage_is(table.notes.get("voltage_is", "output"))
    except InputError as error:
        raise table.error(str(error)) from error
    grid = _grid(table, held=kind == "command")
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
    if grid.positions is not None:
        values = {name: _filled(v, grid.positions, name) for name, v in values.items()}
    return {
        "displacement": None,
        **values,
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
    interval = _grid(table, held=False).interval
    values = _converted(table, "displacement")
    if np.isnan(values).any():
        sample = int(np.argmax(np.isnan(values)))
        raise table.error("not a number; give one at every sample", "displacement", sample)
    return values, interval


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
            problem = f"{fact}; give one at every sample (only a displacement may be missing: nan)"
        raise table.error(problem, quantity, sample)
    return values


def _filled(values: FloatArray, positions: IntArray, quantity: str) -> FloatArray:
    """Return a column on the whole grid: the voltage held in the gaps, all else missing there."""
    if quantity == "voltage":
        return np.repeat(values, np.diff(positions, append=positions[-1] + 1))
    full = np.full(int(positions[-1]) + 1, np.nan)
    full[positions] = values
    return full


def _grid(table: ColumnTable, held: bool) -> _Grid:
    """Return the grid of the times after checking that they are uniform.

    With `held` samples may be missing; then their positions on the whole grid are given.
    """
    if "time" not in table.columns:
        fs, interval = table.naming.fs, table.source.interval
        return _Grid(table.source.start, 1 / fs if fs else interval or 0.0)
    column, stamps = table.columns["time"], _converted(table, "time")
    is_float = column.values.dtype.kind == "f"
    raw = column.values if is_float else column.values.astype(np.int64)
    # From the first one on, which loses no digits of a clock's times. No measurement counts from
    # its beginning for 1e6 s: what does is a clock, whose first time is left out of the record's.
    elapsed = column.scaled((raw - raw[0]).astype(np.float64), "time")
    start = float(stamps[0])
    offset = start if abs(start) > 1e6 else 0.0
    steps = np.diff(elapsed)
    typical = float(np.median(steps))
    if (steps <= 0).any():
        sample = int(np.argmax(steps <= 0)) + 1
        digits = decimals_of(float(np.median(np.abs(steps))))
        before, after = (f"{t + start - offset:.{digits}f} s" for t in elapsed[sample - 1 :][:2])
        problem = f"{after} is repeated; remove one of the two samples"
        if elapsed[sample] < elapsed[sample - 1]:
            problem = f"time goes back from {before} to {after}; sort them"
        raise table.error(problem, "time", sample)
    if typical < 1e-12:
        problem = f"steps of {typical:.3g} s are absurdly small; check the unit"
        raise table.error(problem, "time")
    gaps = steps > 1.5 * typical
    positions = np.arange(elapsed.size)
    if held and gaps.any():
        # The mean of the other steps, as the rounding of the times goes to nothing in it.
        counts = np.maximum(np.rint(steps / steps[~gaps].mean()), 1.0)
        if counts.sum() >= MAXIMUM_SAMPLES:
            sample = int(np.argmax(steps))
            problem = f"gap of {steps[sample]:.6g} s makes the record too long; cut it there"
            raise table.error(problem, "time", sample + 1)
        positions = np.concatenate([[0], np.cumsum(counts.astype(np.int64))])
    interval = float(elapsed[-1] / positions[-1])
    # What a number of the time column may be rounded off in memory, s.
    rounding = float(np.abs(stamps).max() * np.finfo(column.values.dtype).eps) if is_float else 0.0
    tolerance = _tolerance(stamps, interval, rounding)
    deviation = np.abs(elapsed - interval * positions)
    if not (deviation <= tolerance).all():
        raise _uneven(table, elapsed + (start - offset), tolerance, deviation, held)
    interval = _exact_interval(table, interval, tolerance, rounding, int(positions[-1]))
    if positions[-1] < elapsed.size:
        return _Grid(start - offset, interval, offset)
    lost, count = int(positions[-1]) + 1 - elapsed.size, int(np.count_nonzero(gaps))
    remark = f"{lost} samples are missing, from here on in {count} gap{'s' * (count > 1)}"
    error = table.error(
        f"{remark}; the commanded voltage is taken as held there", "time", int(np.argmax(gaps)) + 1
    )
    warnings.warn(str(error), InputWarning, stacklevel=4)
    return _Grid(start - offset, interval, offset, positions)


def _tolerance(stamps: FloatArray, interval: float, rounding: float) -> float:
    """Return how far a time may be off the grid: 1 % of the interval, or what printing rounds off.

    Rounding moves a time and the grid's ends by half a unit of the last decimal each. A whole
    unit is already an uneven sample, and 0.4 intervals keep a missing sample apart from rounding.
    """
    printed = 0.0
    for digits in range(3):
        unit = 10.0 ** (math.floor(math.log10(interval)) - digits)
        counts = stamps / unit
        if np.all(np.abs(counts - np.rint(counts)) <= 1e-6 + 1e-15 * np.abs(counts)):
            printed = 0.999 * unit
            break
    return max(0.01 * interval, min(max(printed, rounding), 0.4 * interval))


def _uneven(
    table: ColumnTable, time: FloatArray, tolerance: float, deviation: FloatArray, held: bool
) -> InputError:
    """Return the error that says where the times leave the grid, and by how much."""
    steps = np.diff(time)
    typical = float(np.median(steps))
    is_off = np.abs(steps - typical) > tolerance
    if not is_off.any():
        sample = int(np.argmax(deviation))
        problem = f"irregular sampling: {deviation[sample]:.3g} s off the uniform grid"
        return table.error(f"{problem}; resample it or print more decimals", "time", sample)
    sample = int(np.argmax(is_off)) + 1
    step, before = float(steps[sample - 1]), clock(time[sample - 1], typical)
    problem = f"irregular sampling: {step:.6g} s after the sample before, {typical:.6g} s elsewhere"
    advice = "resample it on a uniform grid"
    if step > 1.5 * typical and held:
        problem = f"gap of {step:.6g} s is not a whole number of intervals of {typical:.6g} s"
        advice = "resample it or cut the record"
    elif step > 1.5 * typical:
        missing = round(step / typical) - 1
        problem = f"gap of {step:.6g} s after {before} s, about {missing} missing"
        advice = (
            "give the voltage there (the displacement may be nan), say voltage_is = "
            '"command" if it was held, or cut the record'
        )
    return table.error(f"{problem}; {advice}", "time", sample)


def _exact_interval(
    table: ColumnTable, measured: float, tolerance: float, rounding: float, steps: int
) -> float:
    """Return the interval that the file declares, if its times agree, or else the roundest one."""
    text = table.notes.get("interval_s")
    if text is None:
        # The digits after these are the rounding of the times.
        unsure = max(2 * rounding / steps, 5e-13 * measured)
        rounded = [float(f"{measured:.{digits}g}") for digits in range(1, 13)]
        return next((value for value in rounded if abs(value - measured) <= unsure), rounded[-1])
    try:
        declared = float(text)
    except ValueError:
        declared = math.nan
    if not (declared > 0 and abs(declared - measured) <= tolerance / steps):
        problem = f"interval_s {text!r} contradicts the time column, {measured:.9g} s"
        raise table.error(f"{problem}; remove or correct it")
    return declared
