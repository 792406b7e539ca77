"""Recognition of the quantity of a file's series by its name, unit and numbers.

Units are those of the SI with any prefix, some others, and multiples of them: a multiple of a unit
is a sensor's sensitivity. The user is asked for the others, all at once and with a guess. Some
programs write a column of times for each channel: in the series' group of the file or, in a text,
in the last column of times before it. Where the times of voltage and displacement differ, each gets
a clock.
"""

from __future__ import annotations

import math
import re
import warnings
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING
from unicodedata import normalize

import numpy as np

from bwbayes.arrays import FloatArray
from bwbayes.errors import ColumnsError, InputError, InputWarning, one_line
from bwbayes.record.io.series import Clock, Series, Source

if TYPE_CHECKING:
    from bwbayes.record.io.columns import Naming

QUANTITIES = ("time", "voltage", "displacement")
COMMON_UNITS = {
    "time": ("s", "ms", "us"),
    "voltage": ("V", "mV", "kV"),
    "displacement": ("um", "nm", "mm", "m"),
}
# The powers of ten of units' prefixes.
_PREFIXES = {"": 0, "p": -12, "n": -9, "u": -6, "µ": -6, "μ": -6, "m": -3, "c": -2, "k": 3, "M": 6}
# Other units, in lower case, in s or um.
_OTHERS = {
    "time": {
        **dict.fromkeys(("min", "mins", "minute", "minutes"), 60.0),
        **dict.fromkeys(("h", "hr", "hrs", "hour", "hours"), 3600.0),
        **dict.fromkeys(("d", "day", "days"), 86_400.0),
    },
    "displacement": {
        **dict.fromkeys(("\u00e5", "angstrom", "angstroms"), 1e-4),
        **dict.fromkeys(("mil", "mils", "thou"), 25.4),
        **dict.fromkeys(("in", "inch", "inches"), 25_400.0),
    },
}
# Other words in the place of a unit, in lower case.
_FOREIGN = (
    *("%", "-", "1", "#", "a.u.", "count", "counts", "digit", "digits", "lsb", "bit", "bits"),
    *("sequence", "sample", "samples", "index", "no", "no.", "n/a", "hz", "khz", "db", "g"),
    *("a", "ma", "ua", "µa", "w", "mw", "ohm", "ω", "c", "nc", "uc", "µc", "nf", "uf", "µf"),
    *("°c", "degc", "k", "°f", "n", "mn", "un", "µn", "kn", "pa", "kpa", "mpa", "bar", "mbar"),
    *("°", "deg", "rad", "mrad", "urad", "µrad", "m/s", "mm/s", "um/s", "µm/s", "um/v", "nm/v"),
)


def unit_scale(unit: str, quantity: str) -> tuple[float, int] | None:
    """Return the factor and the power of ten from a unit to s, V or um; None if it is unknown."""
    if (power := power_of(unit, quantity)) is not None:
        return 1.0, power
    # In lower case, the Angstrom sign is the letter.
    factor = _OTHERS.get(quantity, {}).get(unit.lower())
    return None if factor is None else (factor, 0)


def is_other_unit(text: str) -> bool:
    """Tell whether a text is a unit of another quantity, or means that there is no unit."""
    return text.lower().replace("\u03bc", "\u00b5") in _FOREIGN


def is_time_form(text: str) -> bool:
    """Tell whether a text is a format of times of day, in place of a unit."""
    return re.fullmatch("h+:m+(:s+)?([.,]f+)?", text.lower()) is not None


def power_of(unit: str, quantity: str) -> int | None:
    """Return the power of ten from a unit to s, V or um; None if it is unknown."""
    # Remove what voltmeters and potentiostats add; some alphabets have a unit in one character.
    unit = re.sub("(?<=V) ?(?:DC|dc|vs\\.? .*)$", "", normalize("NFKC", unit))
    base_names = "(secs?|seconds?)|(volts?)|(met(?:er|re)s?)|(microns?)"
    written = re.fullmatch(f"(pico|nano|micro|milli|kilo|)(?:{base_names})", unit, re.IGNORECASE)
    if written:
        prefix, *bases = written.groups()
        base = "sVm"[[*map(bool, bases[:3])].index(True)] if not bases[3] else "um"
        unit = {"micro": "u", "kilo": "k"}.get(prefix.lower(), prefix[:1].lower()) + base
    base, shift = {"time": ("s", 0), "voltage": ("V", 0)}.get(quantity, ("m", 6))
    if not unit.endswith(base) or unit.removesuffix(base) not in _PREFIXES:
        return None
    return _PREFIXES[unit.removesuffix(base)] + shift


def scale_of(unit: str, quantity: str) -> tuple[float, int] | None:
    """Return the factor and the power of ten from a user's unit to s, V or um, or None.

    A number before it is what 1 in the column stands for, a minus turns the sign: ``-0.35 um``. A
    sensitivity may be written as in data sheets, ``0.35 um/V`` or ``2.9 V/um``, or with counts,
    digits or LSB. A voltage per V is refused: it may be an amplifier's gain or its monitor's.
    """
    if (plain := unit_scale(unit.strip(), quantity)) is not None:
        return plain
    number = r"(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?"
    reading = f"(?i:counts?|digits?|LSB{'|V' if quantity == 'displacement' else ''})"
    written = re.fullmatch(
        rf"(-?)({number}|)\s*(?:({reading})\s*/\s*(\S+)|(\S*?)(?:\s*/\s*{reading})?)", unit.strip()
    )
    scale = unit_scale(written[4] or written[5], quantity) if written else None
    if written is None or scale is None:
        return None
    factor = float(f"{written[1]}{written[2] or 1}")
    if not 0 < abs(factor) < math.inf:
        return None
    factor = scale[0] * (1 / factor if written[3] else factor)
    return (factor, scale[1]) if abs(factor) < math.inf else None


def unit_in(name: str, quantity: str) -> str | None:
    """Return the unit at the end of a column's name, if it is one of the quantity.

    It stands in brackets or after a blank, a slash or an underscore: ``t [ms]``, ``pos (nm)``,
    ``U / mV``; also ``pos_nm_``, as MATLAB writes brackets. Units other than those of the SI must
    stand in brackets or after a slash, as ``U_in`` is an input and ``x_min`` a minimum.
    """
    if (unit := unit_in_brackets(name)) is None:
        ending = re.search(r"([\s_/.-])([^][()\s_/.-]+)_?\s*$", name)
        unit = ending[2] if ending else ""
        is_marked = ending is not None and name[: ending.start(2)].rstrip().endswith("/")
        if power_of(unit, quantity) is None and not is_marked:
            return None
    # A header in capitals, as of a Fortran program, has units in capitals.
    if name.isupper() and quantity != "voltage" and unit_scale(unit.lower(), quantity):
        return unit.lower()
    return unit if unit_scale(unit, quantity) else None


def factor_in(name: str) -> str:
    """Return a factor in a column's name, which may belong to its unit or its numbers, or "".

    Names such as ``x / 10⁻⁶ m``, ``U x10 (V)`` or ``monitor 1:100 [V]`` do not tell what 1 in the
    column stands for.
    """
    # A power of ten, a ratio, or a factor of ten, hundred or the like: 10^-6, 1:20, x10, /100.
    factor = re.search(
        r"(?<![\w.])(?:10\s*\^|10[\u207b\u207a\u2070\u00b9\u00b2\u00b3\u2074-\u2079]|10?[eE][-+]?\d)"
        r"|(?<![\d.:])1:\d+(?![\d:])|(?:(?<!\w)[xX*]|[\u00d7\u00b7/*])\s*10+(?!\d|\s*[\w.])",
        name,
    )
    return factor[0].strip() if factor else ""


def unit_in_brackets(name: str) -> str | None:
    """Return the text in brackets at the end of a column's name, if it is not its number."""
    ending = re.search(r"(?:\[(?!\d+\])([^]]*)\]|\((?!column \d+\))([^)]*)\))\s*$", name)
    return next(group for group in ending.groups() if group is not None).strip() if ending else None


def epoch_unit(name: str, times: FloatArray) -> str | None:
    """Return the unit in which times (samples,) count from 1970, if the column's name says so.

    In this unit alone all times are between 1980 and 2200; None if there is no such unit.
    """
    if not times.size or not re.search("unix|epoch|posix", name.lower()):
        return None
    first, last = float(times.min()), float(times.max())
    powers = {"s": 0, "ms": 3, "us": 6, "ns": 9}
    dates = (u for u, p in powers.items() if 3.155e8 * 10**p < first <= last < 7.2e9 * 10**p)
    return next(dates, None)


def unit_at_rate(times: FloatArray, rate: float) -> str | None:
    """Return the unit in which times, (samples,), are sampled at a rate, Hz, or None.

    The rate is one that a file states, or 0. Rounded times may be off by 1%.
    """
    counts = float(np.ptp(times)) * rate / (times.size - 1) if times.size > 1 else 0.0
    powers = {u: power_of(u, "time") or 0 for u in COMMON_UNITS["time"]}
    return next((u for u, p in powers.items() if abs(counts * 10.0**p - 1) < 0.01), None)


def rates_by_unit(samples: int, extent: float) -> str:
    """State the sampling rate and the duration in each unit; a wrong one shows nowhere else.

    ``extent`` is the difference of the last and the first time.
    """
    durations = {u: extent * 10.0 ** (power_of(u, "time") or 0) for u in COMMON_UNITS["time"]}
    rates = [f"{(samples - 1) / t:.6g} Hz for {t:.6g} s in {u}" for u, t in durations.items()]
    return ", ".join(rates)


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
        re.sub(rf"(?i:(?:{between}){re.escape(unit)}[\])\s_]*$)", "", label).strip()
        if unit
        else label
    )


def is_demand(series: Series) -> bool:
    """Tell whether a series is, by its name, a commanded displacement, not a measured one."""
    demands = "target|set.?point|command|demand|reference|desired|nominal|soll|consigne"
    return re.search(demands, series.label.lower()) is not None


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


def list_series(series: Sequence[Series], ranges: Mapping[str, tuple[float, float]]) -> str:
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

    Raises InputError: there is none, or several.
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
        f"{list_series(matches or source.series, ranges_of(matches or source.series))}"
    )


def _span(low: float, high: float) -> str:
    """Write a range with enough digits to distinguish its ends, if they differ."""
    digits = 4
    while low != high and float(f"{low:.{digits}g}") == float(f"{high:.{digits}g}"):
        digits += 1
    # Two more digits show how long a record is, not only that its ends differ.
    digits += 2 * (digits > 4)
    return f"{low:.{digits}g} to {high:.{digits}g}"


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
    listing = list_series(source.series, ranges)
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


def with_own_times(
    source: Source, chosen: Mapping[str, Series], naming: Naming
) -> dict[str, Series]:
    """Return the chosen series with times, or clocks where they have different times.

    Raises InputError: their times differ, and are not uniform.
    Warns InputWarning: their times differ, and one column of times is said to count for both.
    """
    read = {q: chosen[q] for q in ("voltage", "displacement") if q in chosen}
    own_times = {q: times for q, series in read.items() if (times := _beside(source, series))}
    seconds = {q: _seconds(times, naming) for q, times in own_times.items()}
    # Other functions handle one column of times for both, or one that cannot be understood.
    is_known = len({times.name for times in own_times.values()}) == 2
    is_known &= all(times.size > 1 for times in seconds.values())
    if naming.fs is not None or not is_known:
        return dict(chosen)
    first, last = seconds.values()
    interval = float(first[-1] - first[0]) / (first.size - 1)
    size = min(first.size, last.size)
    apart = float(np.abs(first[:size] - last[:size]).max())
    if first.size == last.size and apart <= 0.01 * interval:
        return {"time": own_times["voltage"], **chosen}
    names = [repr(times.name) for times in own_times.values()]
    differ = f"{source.path}: {names[1]}: not the times of {names[0]}, by up to {apart:.6g} s"
    if "time" in naming.columns:
        advice = "name no column of times to put each by its own"
        text = one_line(f"{differ}, but {chosen['time'].name!r} counts for both; {advice}")
        warnings.warn(text, InputWarning, stacklevel=5)
        return dict(chosen)
    clocked = {q: _with_clock(series, seconds[q]) for q, series in read.items()}
    if not all(series.clock for series in clocked.values()):
        advice = "write both at the same times, or name the column of times that counts for both"
        raise InputError(one_line(f"{differ}, and not uniform; {advice}"))
    return {**{q: s for q, s in chosen.items() if q != "time"}, **clocked}


def _beside(source: Source, series: Series) -> Series | None:
    """Return the times of one series; None if all series share their times or there are none."""
    times = [
        s
        for s in source.series
        if s.size == series.size and likeness(s.label, s.unit, "time") is not None
    ]
    if source.lines:
        before = source.series[: source.series.index(series)]
        return next((s for s in before[::-1] if s in times), None) if times[1:] else None
    group_times = [s for s in times if s.group == series.group != ""]
    return group_times[0] if len(group_times) == 1 else None


def _seconds(times: Series, naming: Naming) -> FloatArray:
    """Return times, s, up to their end; None if they do not rise or have no unit."""
    unit = naming.units.get("time") or unit_of(times.label, times.unit, "time")
    scale = scale_of(unit or "", "time")
    values = times.numbers("", readings=True).astype(np.float64)
    values = values[: values.size - int(np.argmax(np.isfinite(values[::-1])))]
    if scale is None or not (np.diff(values) > 0).all():
        return np.empty(0)
    factor, power = scale
    return np.asarray(factor * values * 10.0**power)


def _with_clock(series: Series, seconds: FloatArray) -> Series:
    """Return a series with the clock of its times, up to where they end, if they are uniform."""
    interval = float(seconds[-1] - seconds[0]) / (seconds.size - 1)
    uniform = seconds[0] + interval * np.arange(seconds.size)
    if np.abs(seconds - uniform).max() > 0.01 * interval:
        return series
    load_all, size = series.load_readings or series.load, seconds.size
    clock = Clock(interval, float(seconds[0]))
    return replace(
        series, size=size, load=lambda: load_all()[:size], load_readings=None, clock=clock
    )
