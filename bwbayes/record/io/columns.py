"""Which series of a file are time, voltage and displacement, and in which units.

The package's own names carry quantity and unit (``voltage_mV``); other names are recognized by
their word (``t [ms]``, ``pos``), or else by their unit, where they can mean nothing else; a
:class:`Naming` settles the rest. What is still open is one :class:`ColumnsError`: all of it, with
the series that there are and a guess.
"""

from __future__ import annotations

import operator
import re
import warnings
from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bwbayes.arrays import FloatArray, IntArray
from bwbayes.errors import ColumnsError, InputError, InputWarning, one_line
from bwbayes.record.io.series import Clock, Series, Source
from bwbayes.record.io.units import (
    COMMON_UNITS,
    QUANTITIES,
    epoch_unit,
    rates_by_unit,
    scale_of,
    unit_in,
    unit_in_brackets,
    unit_scale,
)

# In the names of displacements that are asked for, not measured.
_DEMANDS = "target|set.?point|command|demand|reference|desired|nominal|soll|consigne"
# What other people call the quantities, in lower case and without a unit.
_WORDS = {
    "time": (
        *("t", "time", "timestamp", "sec", "seconds", "elapsed time", "x_value"),
        *("unix", "unix_time", "unix time", "unix_timestamp", "unix timestamp", "posix_time"),
        *("epoch", "epoch_time", "epoch time"),
        *("zeit", "temps"),
    ),
    "voltage": (
        *("u", "v", "volt", "volts", "voltage", "drive", "command", "input"),
        *("spannung", "tension"),
    ),
    "displacement": (
        *("x", "y", "z", "pos", "position", "disp", "displacement", "stroke", "deflection"),
        *("sensor", "output", "weg", "auslenkung", "déplacement"),
    ),
}


@dataclass(frozen=True)
class Naming:
    """Which columns of a file hold the quantities, and in which units.

    Parameters
    ----------
    columns
        The column of a quantity, "time", "voltage" or "displacement": its name, the end of its
        path, or its number, counted from 1. The others are recognized.
    units
        The unit of a quantity, where the file does not state it or states another. A number before
        it is what 1 in the column stands for, as the sensor's sensitivity: ``"0.35 um"`` for volts
        of 0.35 um each. A minus turns the sign: ``"-um"`` is a displacement counted backwards.
    fs
        The sampling rate, Hz, in place of a time column.
    table
        Of a file with several tables the one that counts: its number, from 1 on, or its title.

    Raises
    ------
    InputError
        A quantity that does not exist, a unit that it cannot have, one column for two quantities,
        or a rate that is none.
    """

    columns: Mapping[str, str | int] = field(default_factory=dict)
    units: Mapping[str, str] = field(default_factory=dict)
    fs: float | None = None
    table: int | str | None = None

    def __post_init__(self) -> None:
        for key, table in (("columns", self.columns), ("units", self.units)):
            for quantity in table:
                if quantity not in QUANTITIES:
                    allowed = ", ".join(QUANTITIES)
                    raise InputError(f"{key}: no quantity {quantity!r}; write {allowed}")
        for quantity, unit in self.units.items():
            if (scale := scale_of(unit, quantity)) is None:
                allowed = ", ".join(COMMON_UNITS[quantity])
                raise InputError(
                    f"units: {quantity} in {unit!r} is unknown; write {allowed}, with another SI "
                    f"prefix, or a number of them, as '0.35 {COMMON_UNITS[quantity][0]}'"
                )
            if quantity == "time" and scale[0] < 0:
                raise InputError("units: time does not run backwards; remove the minus")
        for quantity, column in self.columns.items():
            if not isinstance(column, str) and (
                isinstance(column, bool) or not hasattr(column, "__index__")
            ):
                raise InputError(f"columns: {quantity}: {column!r} is no name and no number")
        columns = {
            q: c if isinstance(c, str) else operator.index(c) for q, c in self.columns.items()
        }
        object.__setattr__(self, "columns", columns)
        if len(set(self.columns.values())) < len(self.columns):
            raise InputError("columns: two quantities have the same column; give each its own")
        if self.fs is not None and not 0 < self.fs < np.inf:
            raise InputError(f"fs: {self.fs:g} Hz is no sampling rate; give a number above 0")
        if self.fs is not None and "time" in self.columns:
            raise InputError("fs: takes the place of the time column; give one of the two")


@dataclass(frozen=True)
class FileColumn:
    """One column as it stands in a file; its unit may be a number of units, and negative."""

    name: str
    values: NDArray[Any]
    unit: str
    clock: Clock | None = None

    def scaled(self, values: FloatArray, quantity: str) -> FloatArray:
        """Return values in this column's unit in the package's."""
        factor, power = scale_of(self.unit, quantity) or (1.0, 0)
        # Dividing by 1e3 rounds once, multiplying by the inexact 1e-3 would round twice.
        return factor * (values * 10.0**power if power >= 0 else values / 10.0**-power)


@dataclass(frozen=True)
class ColumnTable:
    """The columns of a file by quantity ("time", "voltage", "displacement", "truth").

    ``notes`` is what the file says in words. ``naming`` finds the same columns again; the times
    are those of its rate, or of the source, where there is no column of them. ``rows`` are the
    samples of the file that are in it, if not all.
    """

    source: Source
    columns: Mapping[str, FileColumn]
    notes: Mapping[str, str]
    naming: Naming
    rows: IntArray | None = None

    def error(self, problem: str, quantity: str = "", sample: int | None = None) -> InputError:
        """Return the error ``file:line: column: problem``; sample and quantity may be left out."""
        where, lines = str(self.source.path), self.source.lines
        if sample is not None:
            sample = sample if self.rows is None else int(self.rows[sample])
            where += f":{lines[sample]}" if lines else f":sample {sample}"
        if quantity:
            name = self.columns[quantity].name if quantity in self.columns else quantity
            where += f": {name}"
        return InputError(f"{where}: {problem}")

    def only(self, rows: IntArray) -> ColumnTable:
        """Return the table of some of its rows."""
        columns = {q: replace(c, values=c.values[rows]) for q, c in self.columns.items()}
        return replace(self, columns=columns, rows=rows if self.rows is None else self.rows[rows])


def select(source: Source, naming: Naming, needed: Collection[str] = QUANTITIES) -> ColumnTable:
    """Return the columns of a file that are time, voltage, displacement and truth.

    Raises
    ------
    ColumnsError
        A column that is needed and not known, or one whose unit is not.
    InputError
        A column that is named and not there, or whose values are not real numbers.

    Warns
    -----
    InputWarning
        If a column is recognized by nothing but its unit, or columns of a text are ignored.
    """
    chosen = {q: series_named(source, name, q) for q, name in naming.columns.items()}
    by_unit = _recognize(source, chosen, naming)
    timed = [series for quantity, series in chosen.items() if quantity != "time"] or source.series
    has_rate = naming.fs is not None or all(series.clock for series in timed)
    missing = [q for q in needed if q not in chosen and not (q == "time" and has_rate)]
    units = {q: naming.units.get(q) or _unit_of(s.label, s.unit, q) for q, s in chosen.items()}
    if "time" in units:
        units["time"] = units["time"] or epoch_unit(chosen["time"].label, _finite(chosen["time"]))
    for series in (chosen[q] for q in chosen if "V" in naming.units.get(q, "") and q != "voltage"):
        if (stated := _unit_of(series.label, series.unit, "voltage")) not in (None, "V"):
            advice = f"say how many um is 1 {stated}, as '0.35 um'"
            raise InputError(f"{source.path}: {series.name}: in {stated}, not in V; {advice}")
    unknown = [q for q in QUANTITIES if q in chosen and units[q] is None]
    if missing or unknown:
        raise _columns_error(source, naming, chosen, missing, unknown)
    path = source.path
    if by_unit:
        reasons = ", ".join(f"{quantity} is {chosen[quantity].name!r}" for quantity in by_unit)
        _warn(f"{path}: taken by its unit: {reasons}; if not, say `columns`")
    columns = {
        quantity: FileColumn(
            chosen[quantity].name,
            chosen[quantity].numbers(path, readings=quantity == "displacement"),
            unit,
            chosen[quantity].clock,
        )
        for quantity, unit in units.items()
        if unit
    }
    names = {q: column.name for q, column in columns.items()}
    others = [s.name for s in source.series if s.name not in names.values()]
    if others and source.lines:
        shown = ", ".join(others[:10]) + ", ..." * (len(others) > 10)
        _warn(f"{path}:{max(source.lines[0] - 1, 1)}: ignored columns: {shown}")
    foreign = {
        q: name for q, name in names.items() if q in QUANTITIES and _likeness(name, "", q) != 0
    }
    used = Naming({**foreign, **naming.columns}, naming.units, naming.fs, naming.table)
    group = next(iter(chosen.values())).group
    notes = {**source.notes.get("", {}), **source.notes.get(group, {})}
    return ColumnTable(source, columns, notes, used)


def _warn(remark: str) -> None:
    warnings.warn(one_line(remark), InputWarning, stacklevel=5)


def series_named(source: Source, name: str | int, quantity: str) -> Series:
    """Return the series that a naming means: by its path, the end of its path, or its number.

    Raises
    ------
    InputError
        There is none, or several.
    """
    word = str(name).strip()
    exact = [s for s in source.series if s.name == word and name == str(name)]
    matches = exact or [s for s in source.series if s.label == word and name == str(name)]
    if not matches:  # without its unit, which a reader may have appended
        matches = [s for s in source.series if name == _bare(s.label, quantity)]
    if not matches and word.isdecimal():
        matches = list(source.series[int(word) - 1 : int(word)]) if int(word) else []
    if len(matches) == 1:
        return matches[0]
    problem = "several columns" if matches else "no column"
    raise InputError(
        f"{source.path}: {problem} {name!r} for the {quantity}; choose another. "
        f"{_listed(matches or source.series, _ranges(matches or source.series))}"
    )


def _recognize(source: Source, chosen: dict[str, Series], naming: Naming) -> list[str]:
    """Add the series that can be meant by one quantity alone; return those known by their unit."""
    settled = {*chosen, *(["time"] if naming.fs is not None else [])}
    long = [s for s in source.series if s.size > 1] or source.series
    by_unit = []
    for likeness in range(3):
        for quantity in (*QUANTITIES, "truth"):
            names = [series.name for series in chosen.values()]
            candidates = [
                s
                for s in long
                if s.name not in names
                and _likeness(s.label, s.unit, quantity) == likeness
                # Neither what counts the samples, nor what is asked for, nor an empty column.
                and not (likeness and quantity != "time" and _counts_samples(s))
                and not (likeness == 2 and quantity == "displacement" and _is_demand(s))
                and not (quantity == "time" and s.clock and not _finite(s).size)
            ]
            if quantity in settled or not candidates:
                continue
            settled.add(quantity)
            candidates = _beside(candidates, chosen)
            if len(candidates) == 1:  # several leave it open, whatever their units are
                chosen[quantity] = candidates[0]
                if likeness == 2 and quantity != "time":  # of seconds there is no doubt
                    by_unit.append(quantity)
    return by_unit


def _likeness(label: str, unit: str, quantity: str) -> int | None:
    """Tell if a name means a quantity: 0 as the package's own, 1 by its word, 2 by its unit."""
    word, _, ending = label.strip(" _").rpartition("_")
    if word.lower() == quantity and unit_scale(ending, quantity):
        return 0
    if quantity == "truth" or _likeness(label, "", "truth") == 0:
        return None
    stated = {q: _unit_of(label, unit, q) for q in QUANTITIES}
    if any(stated.values()) and stated[quantity] is None:
        return None
    if _bare(label, quantity).lower() in _WORDS[quantity] or word.lower() == quantity:
        return 1
    return 2 if stated[quantity] else None


def _bare(label: str, quantity: str) -> str:
    """Return a name without the unit of the quantity at its end."""
    unit = unit_in(label, quantity)
    return (
        re.sub(rf"[\s_/.\-\[(]*{re.escape(unit)}[\])\s_]*$", "", label).strip() if unit else label
    )


def _is_demand(series: Series) -> bool:
    """Tell whether a name is that of a displacement that is asked for, not measured."""
    return re.search(_DEMANDS, series.label.lower()) is not None


def _counts_samples(series: Series) -> bool:
    """Tell whether a series only numbers the samples."""
    steps = np.diff(_finite(series))
    return bool(steps.size) and bool((steps == 1).all())


def _foreign_unit(series: Series, quantity: str) -> str:
    """Return the unit that a file states for a series, if it is none of the quantity."""
    stated = series.unit or unit_in_brackets(series.label) or ""
    others = [unit for q in QUANTITIES if (unit := _unit_of(series.label, series.unit, q))]
    return "" if _unit_of(series.label, series.unit, quantity) else next(iter(others), stated)


def _beside(candidates: list[Series], chosen: Mapping[str, Series]) -> list[Series]:
    """Keep the series that stand beside those that are chosen, and are as long, if any do."""
    first = next(iter(chosen.values()), None)
    for key in ("group", "size") if first else ():
        alike = [s for s in candidates if getattr(s, key) == getattr(first, key)]
        candidates = alike or candidates
    return candidates


def _unit_of(label: str, unit: str, quantity: str) -> str | None:
    """Return the unit that a file states for a series, if it is one of the quantity."""
    return unit if unit_scale(unit, quantity) else unit_in(label, quantity)


def _guess(label: str, quantity: str) -> str:
    """Return the unit that stands anywhere in a name, as in ``ms_since_midnight``, or the usual."""
    words = (word for word in re.split(r"[\W_]+", label) if unit_scale(word, quantity))
    return next(words, COMMON_UNITS[quantity][0])


def _columns_error(
    source: Source,
    naming: Naming,
    chosen: Mapping[str, Series],
    missing: Sequence[str],
    unknown: Sequence[str],
) -> InputError:
    """Return the error that names all that is open, and guesses it."""
    where = str(source.path)
    if source.lines and source.lines[0] > 1:
        where += f":{source.lines[0] - 1}"
    if all(series.size == 1 for series in source.series):
        return InputError(
            f"{where}: no column has more than one number; give a row for each sample"
        )
    ranges = _ranges(source.series)
    if not ranges:
        return InputError(f"{where}: no column holds only numbers; export it as CSV")
    others = [s for s in source.series if s.name not in {c.name for c in chosen.values()}]
    if chosen:
        others = [s for s in others if s.size in {c.size for c in chosen.values()}]
    moving = [s for s in others if s.name in ranges and len(set(ranges[s.name])) == 2]
    candidates = _beside(moving or others, chosen)
    clock = chosen["time"] if "time" in unknown else None
    steps = {s.name: np.diff(_finite(s)) for s in candidates if s.name in ranges}
    # But for those that number the samples.
    candidates = [
        s for s in candidates if _unit_of(s.label, s.unit, "time") or not _counts_samples(s)
    ]
    clocks = [
        s
        for s in candidates
        if s.name in steps and steps[s.name].size == s.size - 1 and (steps[s.name] > 0).all()
    ]
    timeless = "time" in missing and not clocks
    missing = [q for q in missing if not (q == "time" and timeless)]
    columns, units = dict(naming.columns), dict(naming.units)
    proposed = {q: chosen[q] for q in unknown}  # those whose unit is open
    for quantity in missing:
        pool = clocks if quantity == "time" else candidates
        if quantity == "displacement":
            pool = sorted(pool, key=_is_demand)
        words = [word for word in _WORDS[quantity] if len(word) > 3]
        alike = [s for s in pool if any(word in s.label.lower() for word in words)]
        pool = [s for s in pool if _unit_of(s.label, s.unit, quantity)] or alike or pool
        if not pool:
            continue
        columns[quantity] = pool[0].name.removeprefix("column ")  # without a name by its number
        candidates = [s for s in candidates if s is not pool[0]]
        if _unit_of(pool[0].label, pool[0].unit, quantity) is None:
            clock = pool[0] if quantity == "time" else clock
            proposed[quantity] = pool[0]
    sensitivities = _guess_units(proposed, units)
    unknown = [q for q in unknown if units[q] == _guess(chosen[q].label, q)]
    listing = _listed(source.series, ranges)
    lost = [q for q in missing if q not in columns]
    if lost:
        return InputError(f"{where}: no column for the {' and the '.join(lost)}; add it. {listing}")
    questions = [f"which column is the {', which the '.join(missing)}"] if missing else []
    if unknown:
        names = ", which ".join(f"{chosen[q].name!r} ({q})" for q in unknown)
        questions.append(f"which unit has {names}")
    questions += sensitivities
    if timeless:
        questions.append(
            "what is the sampling rate, Hz (no column can be the time; with any other rate "
            "dynamics, creep and correlation times mean nothing)"
        )
    extent = float(np.ptp(ranges[clock.name])) if clock and clock.name in ranges else 0.0
    rates = f"{clock.name!r} is {rates_by_unit(clock.size, extent)}. " if clock and extent else ""
    problem = f"{where}: {', and '.join(questions)}? {rates}{listing}"
    fs = source.stated_rate(1000.0) if timeless else naming.fs
    return ColumnsError(problem, columns, units, fs=fs)


def _guess_units(proposed: Mapping[str, Series], units: dict[str, str]) -> list[str]:
    """Add a guess of the units that are open; return questions for those that a file states."""
    questions = []
    for quantity, series in proposed.items():
        guess = _guess(series.label, quantity)
        foreign = _foreign_unit(series, quantity)
        if foreign and quantity not in units:  # as of a sensor's volts
            questions.append(f"how many {guess} is 1 {foreign} of {series.name!r}")
            guess = f"1 {guess}"
        units.setdefault(quantity, guess)
    return questions


def _finite(series: Series) -> FloatArray:
    """Return the finite numbers of a series; none of one that has something else but words."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", InputWarning)
            values = series.numbers("", readings=True).astype(np.float64)
    except InputError:
        return np.empty(0)
    return values[np.isfinite(values)] + 0.0


def _ranges(series: Sequence[Series]) -> dict[str, tuple[float, float]]:
    """Return the least and the largest number of each series of numbers, of the first forty."""
    values = {s.name: _finite(s) for s in series[:40]}
    return {name: (v.min(), v.max()) for name, v in values.items() if v.size}


def _listed(series: Sequence[Series], ranges: Mapping[str, tuple[float, float]]) -> str:
    """List series of equal length with their ranges, the most usual length first."""
    numbers = [s for s in series if s.name in ranges]
    listed = []
    for size, _ in Counter(s.size for s in numbers).most_common():
        names = [s.name for s in numbers if s.size == size]
        texts = [f"{name!r} ({_span(*ranges[name])})" for name in names[:12]]
        listed.append(f"{size} values each: {', '.join(texts)}{', ...' * (len(names) > 12)}")
    return f"There are {'; '.join(listed)}" if listed else "There are no series of numbers"


def _span(low: float, high: float) -> str:
    """Write a range with digits that tell its ends apart, if they differ."""
    digits = 4
    while low != high and float(f"{low:.{digits}g}") == float(f"{high:.{digits}g}"):
        digits += 1
    # Two more: how long a record is, not only that it has a length.
    digits += 2 * (digits > 4)
    return f"{low:.{digits}g} to {high:.{digits}g}"
