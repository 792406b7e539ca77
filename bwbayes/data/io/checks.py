"""From the columns of a file to a record that can be trusted.

Every reader turns its file into a :class:`Table`: columns as they stand in the file, and their
units. :func:`checked` converts the units and checks what all formats share:
lengths, finite numbers, a uniform time grid, a voltage and a displacement that move. A displacement
may be missing here and there (nan), and so may whole samples where the voltage is a command, which
is held. A problem is one line, ``file:line: column: problem; what to do``; files without lines name
the sample, counted from 0.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, TypedDict, get_args

import numpy as np
from numpy.typing import NDArray

from bwbayes.arrays import FloatArray, IntArray
from bwbayes.data.io.columns import COMMON_NAMES, Naming, missing
from bwbayes.errors import InputError, InputWarning

__all__ = [
    "AT_EVERY_SAMPLE",
    "MAXIMUM_SAMPLES",
    "MINIMUM_SAMPLES",
    "Checked",
    "Column",
    "Table",
    "VoltageIs",
    "checked",
    "checked_reference",
    "named_table",
    "require_voltage_is",
]

VoltageIs = Literal["command", "output"]
"""What a voltage column is: the command that a DAC holds, or the amplifier's output."""

MINIMUM_SAMPLES = 10
MAXIMUM_SAMPLES = 10**8

_SHORTEST = 1e-12  # s
_LATEST = 1e12  # s
_LARGEST = 1e9  # V or um: beyond it a unit is wrong, whatever the actuator
_SMALLEST = 1e-9  # V or um: a range below it is none
AT_EVERY_SAMPLE = "give one at every sample (only a displacement may be missing: nan)"


@dataclass(frozen=True)
class Column:
    """One column as it stands in a file: its name, values, power of ten, and sign (1 or -1)."""

    name: str
    values: NDArray[Any]
    power: int
    sign: int = 1


@dataclass(frozen=True)
class Table:
    """The columns of a file by quantity ("time", "voltage", "displacement", "truth").

    `notes` holds what the file says in words: `voltage_is`, `origin`, `interval_s`. `first_line`
    is the line of the first sample in a text file. `names` are all names that the file has, and
    `naming` says which of them are the columns.
    """

    path: Path
    columns: Mapping[str, Column]
    notes: Mapping[str, str] = field(default_factory=dict)
    first_line: int | None = None
    names: tuple[str, ...] = ()
    naming: Naming = field(default_factory=Naming)

    def error(self, problem: str, quantity: str = "", sample: int | None = None) -> InputError:
        """Return the error ``file:line: column: problem``; sample and quantity may be left out."""
        where = str(self.path)
        if sample is not None and self.first_line is not None:
            where += f":{self.first_line + sample}"
        elif sample is not None:
            where += f":sample {sample}"
        if quantity in self.columns:
            where += f": {self.columns[quantity].name}"
        elif quantity:
            where += f": {COMMON_NAMES[quantity]}"
        return InputError(f"{where}: {problem}")


class Checked(TypedDict):
    """What a record is made of, in the package's units and with their checks behind them."""

    voltage: FloatArray
    displacement: FloatArray | None
    interval: float
    start: float
    voltage_is: VoltageIs
    origin: str
    truth: FloatArray | None


def require_voltage_is(text: str) -> VoltageIs:
    """Return `text` if it says what a voltage column is, else raise an `InputError`."""
    for known in get_args(VoltageIs):
        if text == known:
            return known  # type: ignore[no-any-return]
    raise InputError(f"voltage_is: {text!r} is unknown; write 'command' or 'output'")


def named_table(
    path: Path,
    names: tuple[str, ...],
    naming: Naming,
    size: Callable[[str], int],
    load: Callable[[str], Any],
    notes: Mapping[str, str],
) -> Table:
    """Return the columns among the named arrays of a binary file; other arrays are passed over.

    `naming` says which arrays are meant, and what it leaves open is recognised. `size` gives the
    number of values of an array before `load` reads it, so that a damaged file cannot ask for all
    memory.
    """
    columns: dict[str, Column] = {}
    try:
        naming = naming.completed(names)
    except ValueError as error:
        raise InputError(f"{path}: {error}") from None
    for name in names:
        try:
            quantity, power, sign = naming.of(name)
        except ValueError as error:
            if name in naming.columns.values():
                raise InputError(f"{path}: {name}: {error}") from None
            continue
        if quantity in columns:
            problem = f"{name}: {quantity} is also in {columns[quantity].name}; remove one"
            raise InputError(f"{path}: {problem}")
        if size(name) > MAXIMUM_SAMPLES:
            raise InputError(f"{path}: {name}: {size(name)} values; give at most {MAXIMUM_SAMPLES}")
        columns[quantity] = Column(name, _real_vector(path, name, load(name)), power, sign)
    return Table(path, columns, notes, names=names, naming=naming)


def _real_vector(path: Path, name: str, values: Any) -> NDArray[Any]:
    array = np.asarray(values)
    if array.dtype.kind not in "iuf":
        kinds = {"c": "complex numbers", "b": "logical values"}
        problem = kinds.get(array.dtype.kind, "text or another type that is not a number")
        raise InputError(f"{path}: {name}: holds {problem}; store real numbers")
    if array.size != max(array.shape, default=1):
        raise InputError(f"{path}: {name}: shape {array.shape} is not a vector; store one row")
    return array.ravel()


def checked(
    table: Table, *, voltage_is: VoltageIs | None = None, need_displacement: bool = True
) -> Checked:
    """Return what a table's record is made of, after all checks that do not depend on the format.

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
    needed = ["time", "voltage"] + ["displacement"] * need_displacement
    _check_lengths(table, needed)
    try:
        kind = voltage_is or require_voltage_is(table.notes.get("voltage_is", "output"))
    except InputError as error:
        raise table.error(str(error)) from error
    start, interval, rows = _time_grid(table, held=kind == "command")
    values = {name: _converted(table, name) for name in table.columns if name != "time"}
    samples = values["voltage"].size
    if samples < MINIMUM_SAMPLES:
        raise table.error(f"too short, samples: {samples}; give at least {MINIMUM_SAMPLES}")
    _check_moving(table, "voltage", values["voltage"])
    if not need_displacement and np.isnan(values.get("displacement", 0.0)).all():
        del values["displacement"]
    if "displacement" in values:
        _check_readings(table, values["displacement"])
    if rows is not None:
        values = {name: _filled(column, rows, name) for name, column in values.items()}
    origin = table.notes.get("origin") or table.path.name
    return Checked(
        voltage=values["voltage"],
        displacement=values.get("displacement"),
        interval=interval,
        start=start,
        voltage_is=kind,
        origin=origin,
        truth=values.get("truth"),
    )


def checked_reference(table: Table) -> tuple[FloatArray, float]:
    """Return a displacement that is asked for, (samples,), um, and its sampling interval, s.

    Raises
    ------
    InputError
        For the first problem, in one line.
    """
    _check_lengths(table, ("time", "displacement"))
    _, interval, _ = _time_grid(table, held=False)
    values = _converted(table, "displacement")
    if np.isnan(values).any():
        sample = int(np.argmax(np.isnan(values)))
        raise table.error("not a number; give one at every sample", "displacement", sample)
    return values, interval


def _check_lengths(table: Table, needed: Iterable[str]) -> None:
    for quantity in needed:
        if quantity not in table.columns:
            header = None if table.first_line is None else -1  # the line above the first sample
            used = [column.name for column in table.columns.values()]
            rest = [name for name in table.names if name not in used]
            raise table.error(missing(quantity, rest), sample=header)
    samples = table.columns["time"].values.size
    for quantity, column in table.columns.items():
        if column.values.size != samples:
            problem = f"{column.values.size} values where time has {samples}; store one per time"
            raise table.error(problem, quantity)
    if samples < 2:
        raise table.error(f"too short, samples: {samples}; give at least {MINIMUM_SAMPLES}")


def _converted(table: Table, quantity: str) -> FloatArray:
    """Return a column in the package's unit after refusing what is not finite or absurdly large."""
    column = table.columns[quantity]
    with np.errstate(all="ignore"):
        values = np.asarray(column.values, dtype=np.float64)
        values = column.sign * _scaled(values, column.power)
        refused = ~(np.abs(values) <= (_LATEST if quantity == "time" else _LARGEST))
    if quantity == "displacement":
        refused &= ~np.isnan(values)
    if refused.any():
        sample = int(np.argmax(refused))
        raw = column.values[sample]
        if np.isfinite(raw):
            problem = f"{raw:g} is absurdly large; check the unit in the column's name"
        else:
            problem = f"{raw} is not a finite number; {AT_EVERY_SAMPLE}"
        raise table.error(problem, quantity, sample)
    return values


def _scaled(values: FloatArray, power: int) -> FloatArray:
    # Dividing by 1e3 rounds once, multiplying by the inexact 1e-3 would round twice.
    return values * 10.0**power if power >= 0 else values / 10.0**-power


def _time_grid(table: Table, held: bool) -> tuple[float, float, IntArray | None]:
    """Return start and interval in s of the time column after checking that it is uniform.

    With `held` samples may be missing; then the places (samples,) on the whole grid come third.
    """
    column = table.columns["time"]
    time = _converted(table, "time")
    steps = np.diff(time)
    if (steps <= 0).any():
        sample = int(np.argmax(steps <= 0))
        before, after = time[sample], time[sample + 1]
        if after == before:
            problem = f"{after:.9g} s is repeated; remove one of the two samples"
        else:
            problem = f"time goes back from {before:.9g} s to {after:.9g} s; sort the samples"
        raise table.error(problem, "time", sample + 1)
    usual = float(np.median(steps))
    if usual < _SHORTEST:
        problem = f"steps of {usual:.3g} s are absurdly small; check the unit"
        raise table.error(problem, "time")
    places = np.arange(time.size)
    gaps = steps > 1.5 * usual
    if held and gaps.any():
        # The mean of the other steps, as the rounding of the times goes to nothing in it.
        counts = np.maximum(np.rint(steps / steps[~gaps].mean()), 1.0)
        if counts.sum() >= MAXIMUM_SAMPLES:
            sample = int(np.argmax(steps))
            problem = f"gap of {steps[sample]:.6g} s makes the record too long; cut it there"
            raise table.error(problem, "time", sample + 1)
        places = np.concatenate([[0], np.cumsum(counts.astype(np.int64))])
    interval = float((time[-1] - time[0]) / places[-1])
    tolerance = _time_tolerance(time, interval, column)
    deviation = np.abs(time - (time[0] + interval * places))
    if not (deviation <= tolerance).all():
        raise _uneven(table, time, steps, deviation, held)
    interval = _declared_interval(table, interval, tolerance / int(places[-1]))
    if places[-1] < time.size:
        return float(time[0]), interval, None
    sample = int(np.argmax(gaps)) + 1
    lost = int(places[-1]) + 1 - time.size
    count = int(np.count_nonzero(gaps))
    remark = f"{lost} samples are missing, from here on in {count} gap{'s' * (count > 1)}"
    error = table.error(f"{remark}; the commanded voltage is taken as held there", "time", sample)
    warnings.warn(str(error), InputWarning, stacklevel=4)
    return float(time[0]), interval, places


def _filled(values: FloatArray, places: IntArray, quantity: str) -> FloatArray:
    """Return a column on the whole grid: the voltage held in the gaps, all else missing there."""
    whole = np.full(int(places[-1]) + 1, np.nan)
    whole[places] = values
    if quantity == "voltage":
        whole = np.repeat(values, np.diff(places, append=places[-1] + 1))
    return whole


def _time_tolerance(time: FloatArray, interval: float, column: Column) -> float:
    """Return how far a time may be off the grid: 1 % of the interval, or what printing rounds off.

    Rounding moves a time and the grid's ends by half a unit of the last decimal each. A whole
    unit is already an uneven sample, and 0.4 intervals keep a missing sample apart from rounding.
    """
    largest = float(np.abs(time).max())
    rounded = 0.0
    digits = math.floor(math.log10(interval))
    for unit in (10.0**digits, 10.0 ** (digits - 1), 10.0 ** (digits - 2)):
        counts = time / unit
        if np.all(np.abs(counts - np.rint(counts)) <= 1e-6 + 1e-15 * np.abs(counts)):
            rounded = 0.999 * unit
            break
    if column.values.dtype.kind == "f":
        rounded = max(rounded, largest * float(np.finfo(column.values.dtype).eps))
    return max(0.01 * interval, min(rounded, 0.4 * interval))


def _uneven(
    table: Table, time: FloatArray, steps: FloatArray, deviation: FloatArray, held: bool
) -> InputError:
    """Return the error that says where the times leave the grid, and by how much."""
    usual = float(np.median(steps))
    off = np.abs(steps - usual) > _time_tolerance(time, usual, table.columns["time"])
    if not off.any():
        sample = int(np.argmax(deviation))
        problem = f"irregular sampling: {deviation[sample]:.3g} s off the uniform grid"
        return table.error(f"{problem}; resample it or print more decimals", "time", sample)
    sample = int(np.argmax(off)) + 1
    step, before = float(steps[sample - 1]), float(time[sample - 1])
    if step > 1.5 * usual:
        if held:
            problem = f"gap of {step:.6g} s is not a whole number of intervals of {usual:.6g} s"
            return table.error(f"{problem}; resample it or cut the record", "time", sample)
        missing = round(step / usual) - 1
        problem = f"gap of {step:.6g} s after {before:.9g} s, about {missing} missing"
        advice = 'give the voltage there (the displacement may be nan), say voltage_is = "command"'
        return table.error(f"{problem}; {advice} if it was held, or cut the record", "time", sample)
    problem = f"irregular sampling: {step:.6g} s after the sample before, {usual:.6g} s elsewhere"
    return table.error(f"{problem}; resample it on a uniform grid", "time", sample)


def _declared_interval(table: Table, measured: float, tolerance: float) -> float:
    """Return the interval that the file declares, to the last bit, if its times agree with it."""
    text = table.notes.get("interval_s")
    if text is None:
        return float(f"{measured:.12g}")  # the digits after these are the rounding of the times
    try:
        declared = float(text)
    except ValueError:
        declared = math.nan
    if not (declared > 0 and abs(declared - measured) <= tolerance):
        problem = f"interval_s {text!r} contradicts the time column, {measured:.9g} s"
        raise table.error(f"{problem}; remove or correct it")
    return declared


def _check_moving(table: Table, quantity: str, values: FloatArray) -> None:
    extent = float(np.ptp(values))
    if extent == 0:
        problem = f"constant at {values[0]:g}; give a record in which it moves"
        raise table.error(problem, quantity)
    if extent < _SMALLEST:
        problem = f"moves by {extent:.3g} at most, which is absurdly little; check the unit"
        raise table.error(problem, quantity)


def _check_readings(table: Table, displacement: FloatArray) -> None:
    read = displacement[~np.isnan(displacement)]
    if read.size < MINIMUM_SAMPLES:
        problem = f"too few readings: {read.size}; give at least {MINIMUM_SAMPLES}"
        raise table.error(problem, "displacement")
    _check_moving(table, "displacement", read)
