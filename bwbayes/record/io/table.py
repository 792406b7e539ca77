"""The columns of a file that count: time, voltage and displacement, as they stand in it."""

from __future__ import annotations

import warnings
from collections.abc import Collection, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bwbayes.arrays import FloatArray
from bwbayes.errors import InputError, InputWarning, one_line
from bwbayes.record.io.columns import COMMON_NAMES, QUANTITIES, Naming, choose, is_own, power_of
from bwbayes.record.io.series import Source, real_numbers

__all__ = ["AT_EVERY_SAMPLE", "FileColumn", "FileTable", "converted", "scaled", "table_of"]

AT_EVERY_SAMPLE = "give one at every sample (only a displacement may be missing: nan)"

_LATEST = 1e12  # s
_LARGEST = 1e9  # V or um: beyond it a unit is wrong, whatever the actuator


@dataclass(frozen=True)
class FileColumn:
    """One column as it stands in a file: its name, values, and unit; a minus turns the sign."""

    name: str
    values: NDArray[Any]
    unit: str


@dataclass(frozen=True)
class FileTable:
    """The columns of a file by quantity ("time", "voltage", "displacement", "truth").

    `notes` holds what the file says in words: `voltage_is`, `origin`, `interval_s`. `first_line`
    is the line of the first sample in a text file. `naming` finds the same columns again.
    """

    path: Path
    columns: Mapping[str, FileColumn]
    notes: Mapping[str, str] = field(default_factory=dict)
    first_line: int | None = None
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


def table_of(source: Source, naming: Naming, needed: Collection[str] = QUANTITIES) -> FileTable:
    """Return the columns of a file that are time, voltage, displacement and truth.

    Raises
    ------
    InputError
        A column or unit that is needed and not known, or values that are not real numbers.
    """
    chosen = choose(source, naming, needed)
    columns: dict[str, FileColumn] = {}
    for quantity, (series, unit) in chosen.items():
        where = f"{source.path}: {series.name}"
        values = real_numbers(series, where)
        if values.shape != (series.size,):
            raise InputError(f"{where}: damaged or cut off; write it again")
        columns[quantity] = FileColumn(series.name, values, unit)
    if "time" not in columns:
        interval = source.interval if naming.fs is None else 1 / naming.fs
        size = max((column.values.size for column in columns.values()), default=0)
        assert interval is not None
        time = source.start + interval * np.arange(size)
        columns["time"] = FileColumn(COMMON_NAMES["time"], time, "s")
    names = {q: column.name for q, column in columns.items()}
    others = [s.name for s in source.series if s.name not in names.values()]
    if others and source.first_line is not None:
        shown = ", ".join(others[:10]) + (", ..." if len(others) > 10 else "")
        remark = f"{source.path}:{max(source.first_line - 1, 1)}: ignored columns: {shown}"
        warnings.warn(one_line(remark), InputWarning, stacklevel=4)
    foreign = {q: name for q, name in names.items() if q in QUANTITIES and not is_own(name, q)}
    group = next(iter(chosen.values()))[0].group
    notes = {**source.notes.get("", {}), **source.notes.get(group, {})}
    used = Naming({**foreign, **naming.columns}, naming.units, naming.fs)
    return FileTable(source.path, columns, notes, source.first_line, used)


def converted(table: FileTable, quantity: str) -> FloatArray:
    """Return a column in the package's unit after refusing what is not finite or absurdly large."""
    column = table.columns[quantity]
    with np.errstate(all="ignore"):
        values = scaled(np.asarray(column.values, dtype=np.float64), column.unit, quantity)
        refused = ~(np.abs(values) <= (_LATEST if quantity == "time" else _LARGEST))
    if quantity == "displacement":
        refused &= ~np.isnan(values)
    if refused.any():
        sample = int(np.argmax(refused))
        raw = column.values[sample]
        if np.isfinite(raw):
            problem = f"{raw:g} is absurdly large; check the unit in the column's name"
        else:
            fact = "no number (empty or nan)" if np.isnan(raw) else f"{raw} is not a finite number"
            problem = f"{fact}; {AT_EVERY_SAMPLE}"
        raise table.error(problem, quantity, sample)
    return values


def scaled(values: FloatArray, unit: str, quantity: str) -> FloatArray:
    """Return values in the package's unit; a minus before theirs turns the sign."""
    power = power_of(unit.removeprefix("-"), quantity)
    assert power is not None
    # Dividing by 1e3 rounds once, multiplying by the inexact 1e-3 would round twice.
    scaled = values * 10.0**power if power >= 0 else values / 10.0**-power
    return -scaled if unit.startswith("-") else scaled
