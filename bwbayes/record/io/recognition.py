"""Recognition of the quantity of a file's series by its name, unit and numbers."""

from __future__ import annotations

import re
import warnings
from collections import Counter
from collections.abc import Mapping, Sequence

import numpy as np

from bwbayes.arrays import FloatArray
from bwbayes.errors import InputError, InputWarning
from bwbayes.record.io.series import Series, Source
from bwbayes.record.io.units import QUANTITIES, factor_in, unit_in, unit_in_brackets, unit_scale

# Words in the names of displacements that are commanded, not measured.
_DEMANDS = "target|set.?point|command|demand|reference|desired|nominal|soll|consigne"
# Common names of the quantities, in lower case and without a unit.
WORDS = {
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


def likeness(label: str, unit: str, quantity: str) -> int | None:
    """Tell if a name means a quantity: 0 as the package's own, 1 by its word, 2 by its unit."""
    word, _, ending = label.strip(" _").rpartition("_")
    if word.lower() == quantity and unit_scale(ending, quantity):
        return 0
    if quantity == "truth" or likeness(label, "", "truth") == 0:
        return None
    stated = {q: unit_of(label, unit, q) for q in QUANTITIES}
    if any(stated.values()) and stated[quantity] is None:
        return None
    if bare_name(label, quantity).lower() in WORDS[quantity] or word.lower() == quantity:
        return 1
    return 2 if stated[quantity] else None


def bare_name(label: str, quantity: str) -> str:
    """Return a name without the unit of the quantity at its end."""
    unit = unit_in(label, quantity)
    # A minus before brackets is part of the name, as in V- [V].
    between = r"(?:[\s_/.]|\s-)*[\[(]\s*|[\s_/.-]+"
    return (
        re.sub(rf"(?:{between}){re.escape(unit)}[\])\s_]*$", "", label).strip() if unit else label
    )


def is_demand(series: Series) -> bool:
    """Tell whether a series is, by its name, a commanded displacement, not a measured one."""
    return re.search(_DEMANDS, series.label.lower()) is not None


def rises(series: Series) -> bool:
    """Tell whether a series is of numbers that rise with each sample, as times do."""
    steps = np.diff(finite(series))
    return steps.size == series.size - 1 and bool((steps > 0).all())


def counts_samples(series: Series) -> bool:
    """Tell whether a series only numbers the samples."""
    steps = np.diff(finite(series))
    return bool(steps.size) and bool((steps == 1).all())


def foreign_unit(series: Series, quantity: str) -> str:
    """Return the unit that a file states for a series, if the quantity cannot have it, or ""."""
    stated = series.unit or unit_in_brackets(series.label) or factor_in(series.label)
    others = [unit for q in QUANTITIES if (unit := unit_of(series.label, series.unit, q))]
    # A number in brackets is the index of a matrix's column.
    stated = "" if stated.isdecimal() else stated
    return "" if unit_of(series.label, series.unit, quantity) else next(iter(others), stated)


def beside(candidates: list[Series], chosen: Mapping[str, Series]) -> list[Series]:
    """Keep the series in the group of the first chosen one, and of its length, if there are any."""
    first = next(iter(chosen.values()), None)
    for key in ("group", "size") if first else ():
        alike = [s for s in candidates if getattr(s, key) == getattr(first, key)]
        candidates = alike or candidates
    return candidates


def unit_of(label: str, unit: str, quantity: str) -> str | None:
    """Return the unit that a file states for a series, if it is unambiguous and the quantity's."""
    named = unit_in(label, quantity)
    scale = unit_scale(unit, quantity)
    if factor_in(label) or (named and scale and unit_scale(named, quantity) != scale):
        return None
    return unit if scale else named


def finite(series: Series) -> FloatArray:
    """Return the finite numbers of a series; none if cells are neither numbers nor words."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", InputWarning)
            values = series.numbers("", readings=True).astype(np.float64)
    except InputError:
        return np.empty(0)
    return values[np.isfinite(values)] + 0.0


def ranges_of(series: Sequence[Series]) -> dict[str, tuple[float, float]]:
    """Return the least and the largest number of each of the first forty series with numbers."""
    values = {s.name: finite(s) for s in series[:40]}
    return {name: (v.min(), v.max()) for name, v in values.items() if v.size}


def listed(series: Sequence[Series], ranges: Mapping[str, tuple[float, float]]) -> str:
    """List series of equal length with their ranges, the most usual length first."""
    numbers = [s for s in series if s.name in ranges]
    listed = []
    for size, _ in Counter(s.size for s in numbers).most_common():
        names = [s.name for s in numbers if s.size == size]
        texts = [f"{name!r} ({_span(*ranges[name])})" for name in names[:12]]
        listed.append(f"{size} values each: {', '.join(texts)}{', ...' * (len(names) > 12)}")
    return f"There are {'; '.join(listed)}" if listed else "There are no series of numbers"


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
        matches = [s for s in source.series if name == bare_name(s.label, quantity)]
    if not matches and word.isdecimal():
        matches = list(source.series[int(word) - 1 : int(word)]) if int(word) else []
    if len(matches) == 1:
        return matches[0]
    problem = "several columns" if matches else "no column"
    raise InputError(
        f"{source.path}: {problem} {name!r} for the {quantity}; choose another. "
        f"{listed(matches or source.series, ranges_of(matches or source.series))}"
    )


def _span(low: float, high: float) -> str:
    """Write a range with enough digits to distinguish its ends, if they differ."""
    digits = 4
    while low != high and float(f"{low:.{digits}g}") == float(f"{high:.{digits}g}"):
        digits += 1
    # Two more digits show how long a record is, not only that its ends differ.
    digits += 2 * (digits > 4)
    return f"{low:.{digits}g} to {high:.{digits}g}"
