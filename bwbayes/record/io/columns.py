"""Which columns of a file hold time, voltage and displacement, and in which units.

Every reader turns its file into series of numbers; :func:`choose` takes those that are meant. The
package's own names carry quantity and unit (``voltage_mV``); other names are recognized by their
word (``t [ms]``, ``pos``), or else by their unit, where they can mean nothing else; a
:class:`Naming` settles the rest. What is still open is one :class:`ColumnsError`: all of it, with
the series that there are.
"""

from __future__ import annotations

import re
import warnings
from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from bwbayes.arrays import FloatArray
from bwbayes.errors import ColumnsError, InputError, InputWarning, one_line
from bwbayes.record.io.series import Series, Source, real_numbers

__all__ = [
    "COMMON_NAMES",
    "QUANTITIES",
    "Naming",
    "choose",
    "is_own",
    "power_of",
    "unit_in",
]

QUANTITIES = ("time", "voltage", "displacement")
COMMON_NAMES = {
    "time": "time_s",
    "voltage": "voltage_V",
    "displacement": "displacement_um",
    "truth": "truth_um",
}

# Units: a prefix's power of ten and a base unit, and the power that leads from it to s, V or um.
_PREFIXES = {"": 0, "p": -12, "n": -9, "u": -6, "µ": -6, "μ": -6, "m": -3, "c": -2, "k": 3, "M": 6}
_BASES = {"time": ("s", 0), "voltage": ("V", 0), "displacement": ("m", 6), "truth": ("m", 6)}
# A rate to correct, Hz.
_COMMON_FS = 1000.0
_COMMON_UNITS = {
    "time": ("s", "ms", "us"),
    "voltage": ("V", "mV", "kV"),
    "displacement": ("um", "nm", "mm", "m"),
}
# Units that are written out.
_WRITTEN_PREFIXES = {"": "", "pico": "p", "nano": "n", "micro": "u", "milli": "m", "kilo": "k"}
_WRITTEN_UNITS = {
    **dict.fromkeys(("sec", "secs", "second", "seconds"), "s"),
    **dict.fromkeys(("volt", "volts"), "V"),
    **dict.fromkeys(("meter", "meters", "metre", "metres"), "m"),
}

# What other people call the quantities, in lower case and without a unit.
WORDS = {
    "time": ("t", "time", "timestamp", "sec", "seconds", "zeit", "x_value", "elapsed time"),
    "voltage": ("u", "v", "volt", "volts", "voltage", "drive", "command", "input", "spannung"),
    "displacement": (
        *("x", "y", "z", "pos", "position", "disp", "displacement", "stroke", "deflection"),
        *("sensor", "output", "weg", "auslenkung"),
    ),
}

# Series that a message lists, and that are looked at for it.
_MOST_LISTED, _MOST_LOADED = 12, 40


@dataclass(frozen=True)
class Naming:
    """Which columns of a file hold the quantities, and in which units.

    Parameters
    ----------
    columns
        The column of a quantity, "time", "voltage" or "displacement": its name, the end of its
        path, or its number, counted from 1. The others are recognized.
    units
        The unit of a quantity, where the file does not state it or states another. A minus before
        it turns the sign: ``"-um"`` is a displacement that the sensor counts backwards.
    fs
        The sampling rate, Hz, in place of a time column.

    Raises
    ------
    InputError
        A quantity that does not exist, a unit that it cannot have, one column for two quantities,
        or a rate that is none.
    """

    columns: Mapping[str, str] = field(default_factory=dict)
    units: Mapping[str, str] = field(default_factory=dict)
    fs: float | None = None

    def __post_init__(self) -> None:
        for key, table in (("columns", self.columns), ("units", self.units)):
            for quantity in table:
                if quantity not in QUANTITIES:
                    allowed = ", ".join(QUANTITIES)
                    raise InputError(f"{key}: no quantity {quantity!r}; write {allowed}")
        for quantity, unit in self.units.items():
            if power_of(unit.removeprefix("-"), quantity) is None:
                allowed = ", ".join(_COMMON_UNITS[quantity])
                raise InputError(
                    f"units: {quantity} in {unit!r} is unknown; write {allowed}, or with another "
                    "SI prefix"
                )
        if self.units.get("time", "").startswith("-"):
            raise InputError("units: time does not run backwards; remove the minus")
        if len(set(self.columns.values())) < len(self.columns):
            raise InputError("columns: two quantities have the same column; give each its own")
        if self.fs is not None and not 0 < self.fs < np.inf:
            raise InputError(f"fs: {self.fs:g} Hz is no sampling rate; give a number above 0")
        if self.fs is not None and "time" in self.columns:
            raise InputError("fs: takes the place of the time column; give one of the two")


def power_of(unit: str, quantity: str) -> int | None:
    """Return the power of ten that leads from a unit to s, V or um; None if it is none."""
    base, shift = _BASES[quantity]
    for written, prefix in _WRITTEN_PREFIXES.items():
        base_name = unit.lower().removeprefix(written)
        if unit.lower().startswith(written) and base_name in _WRITTEN_UNITS:
            unit = prefix + _WRITTEN_UNITS[base_name]
            break
    if unit.lower() in ("micron", "microns"):
        unit = "um"
    if not unit.endswith(base) or unit.removesuffix(base) not in _PREFIXES:
        return None
    return _PREFIXES[unit.removesuffix(base)] + shift


def unit_in(name: str, quantity: str) -> str | None:
    """Return the unit at the end of a column's name, if it is one of the quantity.

    In brackets or after a blank, a slash or an underscore: ``t [ms]``, ``pos (nm)``, ``U / mV``.
    """
    ending = re.search(r"(?:\[([^]]*)\]|\(([^)]*)\)|[\s_/.-]([^][()\s_/.-]+))\s*$", name)
    if ending is None:
        return None
    unit = next(group for group in ending.groups() if group is not None).strip()
    return unit if power_of(unit, quantity) is not None else None


def choose(
    source: Source, naming: Naming, needed: Collection[str] = QUANTITIES
) -> dict[str, tuple[Series, str]]:
    """Return the series of each quantity, and its unit.

    Raises
    ------
    ColumnsError
        A column that is needed and not known, or one whose unit is not.
    InputError
        A column that is named and not there.

    Warns
    -----
    InputWarning
        If a column is recognized by nothing but its unit.
    """
    chosen = {q: _named(source, name, q) for q, name in naming.columns.items()}
    clocked = naming.fs is not None or source.interval is not None
    settled = {*chosen, *(["time"] if naming.fs is not None else [])}
    long = [s for s in source.series if s.size > 1] or source.series
    by_unit = []
    for rank in (_by_own_name, _by_word, _by_unit):
        for quantity in (*QUANTITIES, "truth"):
            chosen_names = [series.name for series in chosen.values()]
            fitting = [s for s in long if s.name not in chosen_names and rank(s, quantity)]
            if quantity in settled or not fitting:
                continue
            settled.add(quantity)
            fitting = _alike(fitting, chosen)
            if len(fitting) == 1:  # several leave it open, whatever their units are
                chosen[quantity] = fitting[0]
                # Of seconds there is no doubt.
                by_unit += [quantity] if rank is _by_unit and quantity != "time" else []
    columns = [q for q in needed if q not in chosen and not (q == "time" and clocked)]
    units = {q: _unit(s, q, naming) for q, s in chosen.items()}
    unknown = [q for q in QUANTITIES if q in chosen and units[q] is None]
    if columns or unknown:
        raise _open(source, naming, chosen, columns, unknown)
    if by_unit:
        reasons = ", ".join(f"{quantity} is {chosen[quantity].name!r}" for quantity in by_unit)
        remark = f"{source.path}: taken by its unit: {reasons}; if not, say `columns`"
        warnings.warn(one_line(remark), InputWarning, stacklevel=3)
    return {quantity: (chosen[quantity], unit) for quantity, unit in units.items() if unit}


def _named(source: Source, name: str, quantity: str) -> Series:
    """Return the series that a naming means."""
    exact = [s for s in source.series if s.name == name.strip()]
    ending = [s for s in source.series if s.label == name.strip()]
    for matches in (exact, ending):
        if len(matches) == 1:
            return matches[0]
    number = int(name) if name.strip().isdecimal() else 0
    if 1 <= number <= len(source.series) and not exact and not ending:
        return source.series[number - 1]
    problem = "several columns" if exact or ending else "no column"
    raise InputError(
        f"{source.path}: {problem} {name!r} for the {quantity}; choose one of "
        f"{_listed(exact or ending or source.series)}"
    )


def is_own(name: str, quantity: str) -> bool:
    """Tell whether a name is the package's own for a quantity, as ``voltage_mV`` is."""
    word, _, unit = name.strip().rpartition("_")
    return word.lower() == quantity and power_of(unit, quantity) is not None


def _by_own_name(series: Series, quantity: str) -> bool:
    return is_own(series.label, quantity)


def _by_word(series: Series, quantity: str) -> bool:
    """Tell whether a series is called as a quantity is, and has no other quantity's unit."""
    if quantity == "truth" or _is_truth(series):
        return False
    name = series.label.strip()
    units = {q: _stated(series, q) for q in QUANTITIES}
    if any(units.values()) and units[quantity] is None:
        return False
    unit = unit_in(name, quantity)
    bare = name if unit is None else re.sub(rf"[\s_/.\-\[(]*{re.escape(unit)}[\])\s]*$", "", name)
    return bare.strip().lower() in WORDS[quantity] or name.lower().rpartition("_")[0] == quantity


def _by_unit(series: Series, quantity: str) -> bool:
    """Tell whether a series has a unit of a quantity."""
    return not _is_truth(series) and quantity != "truth" and _stated(series, quantity) is not None


def _is_truth(series: Series) -> bool:
    return is_own(series.label, "truth")


def _stated(series: Series, quantity: str) -> str | None:
    """Return the unit that a file states for a series, if it is one of the quantity."""
    if series.unit and power_of(series.unit, quantity) is not None:
        return series.unit
    return unit_in(series.label, quantity)


def _unit(series: Series, quantity: str, naming: Naming) -> str | None:
    return naming.units.get(quantity) or _stated(series, quantity)


def _alike(candidates: list[Series], chosen: Mapping[str, Series]) -> list[Series]:
    """Keep the series that stand beside those that are chosen, and are as long, if any do."""
    for key in ("group", "size"):
        values = [getattr(series, key) for series in chosen.values() if series.name]
        fitting = [s for s in candidates if values and getattr(s, key) == values[0]]
        candidates = fitting or candidates
    return candidates


def _open(
    source: Source,
    naming: Naming,
    chosen: Mapping[str, Series],
    columns: Sequence[str],
    unknown: Sequence[str],
) -> ColumnsError:
    """Return the error that names all that is open, and guesses it."""
    where = str(source.path)
    if source.first_line is not None and source.first_line > 1:
        where += f":{source.first_line - 1}"
    if all(series.size == 1 for series in source.series):
        raise InputError(f"{where}: no column has more than one number; give a row for each sample")
    if np.isnan([_extent(series) for series in source.series[:_MOST_LOADED]]).all():
        raise InputError(f"{where}: no column holds only numbers; export it as CSV")
    chosen_names = [series.name for series in chosen.values()]
    sizes = {series.size for series in chosen.values()}
    candidates = [
        s for s in source.series if s.name not in chosen_names and s.size in (sizes or {s.size})
    ]
    moving = [s for s in candidates[:_MOST_LOADED] if np.ptp(_extent(s)) > 0]
    candidates = _alike(moving or candidates, chosen)
    guess_columns, guess_units = dict(naming.columns), dict(naming.units)
    clocks = [s for s in candidates[:_MOST_LOADED] if _rises(s)]
    timeless = "time" in columns and not clocks
    if timeless:
        columns = [quantity for quantity in columns if quantity != "time"]
    for quantity in unknown:
        guess_units[quantity] = _COMMON_UNITS[quantity][0]
    for quantity in columns:
        pool = clocks if quantity == "time" else candidates
        fitting = [s for s in pool if _stated(s, quantity)] or pool
        if fitting:
            # One without a name goes by its number.
            guess_columns[quantity] = fitting[0].name.removeprefix("column ")
            candidates = [s for s in candidates if s.name != fitting[0].name]
        if not fitting or _unit(fitting[0], quantity, naming) is None:
            guess_units.setdefault(quantity, _COMMON_UNITS[quantity][0])
    lost = [q for q in columns if q not in guess_columns]
    listing = _listed(source.series)
    if lost:
        raise InputError(f"{where}: no column for the {' and the '.join(lost)}; add it. {listing}")
    questions = [f"which column is the {', which the '.join(columns)}"] if columns else []
    if unknown:
        questions.append(
            f"which unit has {', which '.join(f'{chosen[q].name!r} ({q})' for q in unknown)}"
        )
    if timeless:
        questions.append("what is the sampling rate, Hz (no column can be the time)")
    problem = f"{where}: {', and '.join(questions)}? {listing}"
    return ColumnsError(problem, guess_columns, guess_units, fs=_COMMON_FS if timeless else None)


def _listed(series: Sequence[Series]) -> str:
    """List series of equal length with their ranges, the most usual length first."""
    extents = {s.name: _extent(s) for s in series[:_MOST_LOADED]}
    numbers = [s for s in series if np.isfinite(extents.get(s.name, (np.nan,))).all()]
    parts = []
    for size, _ in Counter(s.size for s in numbers).most_common():
        group = [s for s in numbers if s.size == size]
        ranges = [(s.name, *extents[s.name]) for s in group[:_MOST_LISTED]]
        texts = [f"{name!r} ({_span(low, high)})" for name, low, high in ranges]
        more = ", ..." if len(group) > _MOST_LISTED else ""
        parts.append(f"{size} values each: {', '.join(texts)}{more}")
    return f"There are {'; '.join(parts)}" if parts else "There are no series of numbers"


def _span(low: float, high: float) -> str:
    """Write a range with digits that tell its ends apart, if they differ."""
    digits = 4
    while low != high and float(f"{low:.{digits}g}") == float(f"{high:.{digits}g}"):
        digits += 1
    # Two more: how long a record is, not only that it has a length.
    digits += 2 * (digits > 4)
    return f"{low:.{digits}g} to {high:.{digits}g}"


def _rises(series: Series) -> bool:
    """Tell whether a series may be the time."""
    values = _finite(series)
    return values.size == series.size and bool(np.all(np.diff(values) > 0))


def _extent(series: Series) -> tuple[float, float]:
    """Return the least and the largest number of a series; nan if it has none."""
    values = _finite(series)
    return (values.min(), values.max()) if values.size else (np.nan, np.nan)


def _finite(series: Series) -> FloatArray:
    """Return the finite numbers of a series; none of one that has something else."""
    try:
        values = real_numbers(series, series.name).astype(np.float64)
    except InputError:
        return np.empty(0)
    return values[np.isfinite(values)] + 0.0
