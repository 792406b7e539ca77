"""Lines that instruments write above the numbers of a text: notes, units, rate, settings."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path

from bwbayes.record.io.series import RATES, Clock, Source
from bwbayes.record.io.units import QUANTITIES, unit_in


def stated_above(lines: Sequence[str]) -> tuple[dict[str, str], dict[str, list[str]]]:
    """Return the notes in the lines above a header, and the values they list for each channel."""
    notes: dict[str, str] = {}
    preamble: dict[str, list[str]] = {}
    for line in lines:
        key, sign, value, *_ = [*re.split(r"([:=,;\t])", line, maxsplit=1), "", ""]
        key = re.sub(r"\W+", "_", re.sub(r"\(.*", "", key)).strip("_").lower()
        if line.startswith("#") and sign in ("=", ":"):
            notes["voltage_is" if key == "voltage" else key] = value.strip()
        elif sign:
            preamble[key] = [cell.strip(' "') for cell in value.split(sign)]
    return notes | {key: cells[0] for key, cells in preamble.items() if key in RATES}, preamble


def clock_above(
    notes: Mapping[str, str], preamble: Mapping[str, list[str]], n_samples: int
) -> Clock | None:
    """Return the clock of a stated rate, if the stated number of samples is right, or None."""
    rate = Source(Path(), (), {"": notes}).stated_rate()
    is_confirmed = preamble.get("record_length", [""])[0] == str(n_samples)
    return Clock(1 / rate) if rate and is_confirmed else None


def with_units(
    names: Sequence[str], units: Sequence[str], preamble: Mapping[str, list[str]]
) -> list[str]:
    """Return the columns' units, with those that an oscilloscope's preamble states for channels.

    The time stands before the channels, if there is one column more than units. A name that stands
    twice gets a number behind its unit; the unit without that number is returned.
    """
    units = [
        unit or next((u for q in QUANTITIES if (u := unit_in(name, q))), "")
        if names.count(name) > 1
        else unit
        for name, unit in zip(names, units, strict=True)
    ]
    channels = [unit for unit in preamble.get("vertical_units", []) if unit]
    time = preamble.get("horizontal_units", [""])[:1]
    stated = [*(time if len(channels) == len(units) - 1 else []), *channels]
    if not channels or len(stated) != len(units):
        return units
    return [unit or other for unit, other in zip(units, stated, strict=True)]


def settings_in(names: Sequence[str], units: Sequence[str]) -> tuple[Clock | None, dict[str, str]]:
    """Return the clock that an oscilloscope writes into the header, or None, and all settings.

    A setting is a number below its name, ``Increment``, or behind it, ``tInc = 1e-6``.
    """
    settings = {}
    for name, unit in zip(names, units, strict=True):
        key, _, value = name.partition("=")
        with suppress(ValueError):
            text = (value or unit).strip().removesuffix("s")
            settings[key.strip().lower()] = repr(float(text))
    rate = Source(Path(), (), {"": settings}).stated_rate()
    start = float(settings.get("start", settings.get("t0", "0")))
    return Clock(1 / rate, start) if rate else None, settings
