"""Units of columns: SI units with any prefix, some others, and multiples of them.

A multiple of a unit is a sensor's sensitivity.
"""

from __future__ import annotations

import math
import re
from unicodedata import normalize

from bwbayes.arrays import FloatArray

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
# A power of ten, a ratio, or a factor of ten, hundred or the like: "10^-6", "1:20", "x10", "/100".
_FACTOR = re.compile(
    r"(?<![\w.])(?:10\s*\^|10[\u207b\u207a\u2070\u00b9\u00b2\u00b3\u2074-\u2079]|10?[eE][-+]?\d)"
    r"|(?<![\d.:])1:\d+(?![\d:])|(?:(?<!\w)[xX*]|[\u00d7\u00b7/*])\s*10+(?!\d|\s*[\w.])"
)
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
    return unit if unit_scale(unit, quantity) else None


def factor_in(name: str) -> str:
    """Return a factor in a column's name, which may belong to its unit or its numbers, or "".

    Names such as ``x / 10⁻⁶ m``, ``U x10 (V)`` or ``monitor 1:100 [V]`` do not tell what 1 in the
    column stands for.
    """
    factor = _FACTOR.search(name)
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


def rates_by_unit(samples: int, extent: float) -> str:
    """State the sampling rate and the duration in each unit; a wrong one shows nowhere else.

    ``extent`` is the difference of the last and the first time.
    """
    durations = {u: extent * 10.0 ** (power_of(u, "time") or 0) for u in COMMON_UNITS["time"]}
    rates = [f"{(samples - 1) / t:.6g} Hz for {t:.6g} s in {u}" for u, t in durations.items()]
    return ", ".join(rates)
