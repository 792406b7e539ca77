"""Questions about a file's columns and units, asked all at once, with a guess of the answers."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

from bwbayes.errors import ColumnsError, InputError
from bwbayes.record.io.recognition import (
    WORDS,
    beside,
    counts_samples,
    finite,
    foreign_unit,
    is_demand,
    listed,
    ranges_of,
    rises,
    unit_of,
)
from bwbayes.record.io.series import Series, Source
from bwbayes.record.io.units import COMMON_UNITS, power_of, rates_by_unit, unit_scale

if TYPE_CHECKING:
    from bwbayes.record.io.columns import Naming


def columns_error(
    source: Source,
    naming: Naming,
    chosen: Mapping[str, Series],
    missing: Sequence[str],
    unknown: Sequence[str],
) -> InputError:
    """Return the error that lists all unknown columns and units, with a guess for each."""
    where = str(source.path)
    if source.lines and source.lines[0] > 1:
        where += f":{source.lines[0] - 1}"
    if all(series.size == 1 for series in source.series):
        return InputError(
            f"{where}: no column has more than one number; give a row for each sample"
        )
    ranges = ranges_of(source.series)
    if not ranges:
        return InputError(f"{where}: no column holds only numbers; export it as CSV")
    candidates = _candidates(source, chosen, ranges)
    clock = chosen["time"] if "time" in unknown else None
    clocks = [s for s in candidates if s.size > 1 and rises(s)]
    timeless = "time" in missing and not clocks
    missing = [q for q in missing if not (q == "time" and timeless)]
    columns, units = dict(naming.columns), naming.stated_units
    proposed = {q: chosen[q] for q in unknown}  # those whose unit is open
    for quantity in missing:
        pool = clocks if quantity == "time" else sorted(candidates, key=rises)
        if quantity == "displacement":
            pool = sorted(pool, key=is_demand)
        words = [word for word in WORDS[quantity] if len(word) > 3]
        alike = [s for s in pool if any(word in s.label.lower() for word in words)]
        in_unit = [s for s in pool if unit_of(s.label, s.unit, quantity)]
        in_unit = in_unit or [s for s in pool if unit_scale(s.label, quantity)]
        pool = in_unit or alike or pool
        if not pool:
            continue
        columns[quantity] = pool[0].name.removeprefix("column ")  # without a name by its number
        candidates = [s for s in candidates if s is not pool[0]]
        if unit_of(pool[0].label, pool[0].unit, quantity) is None:
            clock = pool[0] if quantity == "time" else clock
            proposed[quantity] = pool[0]
    sensitivities = _guess_units(proposed, units)
    unknown = [q for q in unknown if units[q] == _guess(chosen[q].label, q)]
    listing = listed(source.series, ranges)
    lost = [q for q in missing if q not in columns]
    if lost:
        other = ", or say in which file it is, `displacement_file=FILE`"
        advice = f"add it{other * (lost == ['displacement'])}"
        return InputError(
            f"{where}: no column for the {' and the '.join(lost)}; {advice}. {listing}"
        )
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
    fs = source.stated_rate() or "HZ" if timeless else naming.fs
    return ColumnsError(problem, columns, units, fs=fs)


def _candidates(
    source: Source, chosen: Mapping[str, Series], ranges: Mapping[str, tuple[float, float]]
) -> list[Series]:
    """Return the series that a missing quantity may be: as long as those chosen, and moving.

    Series that number the samples are left out, and so are settings beside the first numbers.
    """
    others = [s for s in source.series if s.name not in {c.name for c in chosen.values()}]
    if chosen:
        others = [s for s in others if s.size in {c.size for c in chosen.values()}]
    moving = [s for s in others if s.name in ranges and len(set(ranges[s.name])) == 2]
    moving = [s for s in moving if 2 * finite(s).size > s.size] or moving
    return [
        s
        for s in beside(moving or others, chosen)
        if unit_of(s.label, s.unit, "time") or not counts_samples(s)
    ]


def _guess_units(proposed: Mapping[str, Series], units: dict[str, str]) -> list[str]:
    """Add a guess of the units that are open; return questions for those that a file states."""
    questions = []
    for quantity, series in proposed.items():
        guess = _guess(series.label, quantity)
        foreign = foreign_unit(series, quantity)
        if foreign and quantity not in units:  # for instance volts of a sensor
            questions.append(f"how many {guess} is 1 {foreign} of {series.name!r}")
            guess = f"? {guess}"
        units.setdefault(quantity, guess)
    return questions


def _guess(label: str, quantity: str) -> str:
    """Return the unit anywhere in a name, as in ``ms_since_midnight``, or the usual unit."""
    *words, last = re.split(r"[\W_]+", label)
    # Only at the end of a name is "in" or "min" an inch or a minute instead of a word.
    units = [word for word in words if power_of(word, quantity) is not None]
    units += [last] if unit_scale(last, quantity) else []
    return units[0] if units else COMMON_UNITS[quantity][0]
