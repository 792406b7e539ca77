"""What the columns of a file are: their quantities and units, from their names or as one is told.

The package's own names carry quantity and unit, ``voltage_mV`` for instance. A :class:`Naming`
says which columns of a file with other names are meant, and in which units; where it says none,
the unit is read from the name itself, as in ``t [ms]``, ``pos (nm)`` or ``U_mV``.
"""

from __future__ import annotations

import difflib
import re
from collections.abc import Collection, Mapping
from dataclasses import dataclass, field

from bwbayes.errors import InputError

__all__ = ["COMMON_NAMES", "UNITS", "Naming", "recognised", "unit_in"]

# Powers of ten that lead from a column's unit to s, V and um. Both micro signs of Unicode count.
_TIME = {"s": 0, "ms": -3, "us": -6, "µs": -6, "μs": -6}
_VOLTAGE = {"V": 0, "mV": -3, "kV": 3, "uV": -6, "µV": -6, "μV": -6}
_LENGTH = {"um": 0, "µm": 0, "μm": 0, "nm": -3, "mm": 3, "m": 6}
UNITS = {"time": _TIME, "voltage": _VOLTAGE, "displacement": _LENGTH, "truth": _LENGTH}
COMMON_NAMES = {
    "time": "time_s",
    "voltage": "voltage_V",
    "displacement": "displacement_um",
    "truth": "truth_um",
}

# What other people call the quantities, in lower case and without a unit.
WORDS = {
    "time": ("t", "time", "timestamp", "sec", "seconds", "zeit"),
    "voltage": ("u", "v", "volt", "volts", "voltage", "drive", "command", "input", "spannung"),
    "displacement": (
        *("x", "y", "z", "pos", "position", "disp", "displacement", "stroke", "deflection"),
        *("sensor", "output", "weg", "auslenkung"),
    ),
}


@dataclass(frozen=True)
class Naming:
    """Which columns of a file hold the quantities, and in which units.

    Parameters
    ----------
    columns
        The name that a column has in the file by quantity, "time", "voltage" or "displacement";
        the others go by the package's own names.
    units
        The unit of a column by quantity, where its name does not say it or says another. A minus
        before it turns the sign: ``"-um"`` is a displacement that the sensor counts backwards.

    Raises
    ------
    InputError
        A quantity that does not exist, a unit that it cannot have, or one column for two
        quantities.
    """

    columns: Mapping[str, str] = field(default_factory=dict)
    units: Mapping[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        for key, table in (("columns", self.columns), ("units", self.units)):
            for quantity in table:
                if quantity not in WORDS:
                    known = ", ".join(WORDS)
                    raise InputError(f"{key}: no quantity {quantity!r}; write {known}")
        for quantity, unit in self.units.items():
            if unit.removeprefix("-") not in UNITS[quantity]:
                known = ", ".join(UNITS[quantity])
                raise InputError(f"units: {quantity} in {unit!r} is unknown; write one of {known}")
        if self.units.get("time", "").startswith("-"):
            raise InputError("units: time does not run backwards; remove the minus")
        if len(set(self.columns.values())) < len(self.columns):
            raise InputError("columns: two quantities have the same column; give each its own")

    def require_in(self, names: Collection[str]) -> None:
        """Refuse columns that a file with columns of these names does not have.

        Raises
        ------
        ValueError
            With the text ``problem; what to do``, which names the nearest column.
        """
        for quantity, name in self.columns.items():
            if name not in names:
                near = difflib.get_close_matches(name, names, 1, 0.4)
                hint = f"did you mean {near[0]!r}?" if near else f"there are {_listed(names)}"
                raise ValueError(f"no column {name!r} for the {quantity}; {hint}")

    def of(self, name: str) -> tuple[str, int, int]:
        """Return the quantity of a column of this name, its unit's power of ten, and its sign.

        Raises
        ------
        ValueError
            With the text ``problem; what to do`` if the column is none that counts.
        """
        for quantity, column in self.columns.items():
            if column == name.strip():
                return quantity, *self._unit(name, quantity)
        quantity, power = _own(name, self.units)
        if quantity in self.columns:
            raise ValueError(f"the {quantity} is in {self.columns[quantity]!r}; remove one")
        if quantity in self.units:
            return quantity, *self._unit(name, quantity)
        return quantity, power, 1

    def _unit(self, name: str, quantity: str) -> tuple[int, int]:
        """Return the power of ten and the sign of a column's unit."""
        unit = self.units.get(quantity) or unit_in(name, quantity)
        if unit is None:
            example = f'units = {{ {quantity} = "{next(iter(UNITS[quantity]))}" }}'
            raise ValueError(f"no unit in the name; say it: {example}")
        return UNITS[quantity][unit.removeprefix("-")], -1 if unit.startswith("-") else 1


def unit_in(name: str, quantity: str) -> str | None:
    """Return the unit at the end of a column's name, if it is one of the quantity.

    In brackets or after a blank, a slash or an underscore: ``t [ms]``, ``pos (nm)``, ``U / mV``.
    """
    ending = re.search(r"(?:\[([^]]*)\]|\(([^)]*)\)|[\s_/.-]([^][()\s_/.-]+))\s*$", name)
    if ending is None:
        return None
    unit = next(part for part in ending.groups() if part is not None).strip()
    return unit if unit in UNITS[quantity] else None


def recognised(names: Collection[str]) -> dict[str, str]:
    """Guess which of a file's columns hold time, voltage and displacement, by quantity.

    A column counts by the word before its unit, or else by its unit; a quantity that no column or
    more than one may be is left out.
    """
    by_word = {q: [n for n in names if _word(n) in words] for q, words in WORDS.items()}
    guessed = {q: some[0] for q, some in by_word.items() if len(some) == 1}
    for quantity in WORDS:
        rest = [n for n in names if n not in guessed.values()]
        some = [n for n in rest if unit_in(n, quantity)]
        if quantity not in guessed and not by_word[quantity] and len(some) == 1:
            guessed[quantity] = some[0]
    return guessed


def _word(name: str) -> str:
    """Return what a column's name says besides a unit, in lower case."""
    units = [unit_in(name, quantity) for quantity in WORDS]
    unit = next((unit for unit in units if unit), None)
    bare = name if unit is None else re.sub(rf"[\s_/.\-\[(]*{re.escape(unit)}[\])\s]*$", "", name)
    return bare.strip().lower()


def _own(name: str, units: Mapping[str, str]) -> tuple[str, int]:
    """Return quantity and power of ten of one of the package's own names."""
    quantity, _, unit = name.strip().rpartition("_")
    known = UNITS.get(quantity.lower())
    bare = name.strip().lower()
    if known is None and bare in UNITS:
        if bare in units:
            return bare, 0
        raise ValueError(f"no unit in the name; write {COMMON_NAMES[bare]}")
    if known is None:
        common = [COMMON_NAMES[key] for key in ("time", "voltage", "displacement")]
        near = difflib.get_close_matches(name.strip(), common, 1, 0.4)
        hint = f"did you mean {near[0]}?" if near else f"known are {', '.join(common)};"
        raise ValueError(f"unknown column; {hint} `columns` maps other names")
    if unit not in known:
        raise ValueError(f"unknown unit {unit!r}; write one of {', '.join(known)}")
    return quantity.lower(), known[unit]


def _listed(names: Collection[str]) -> str:
    shown = list(names)[:10]
    return ", ".join(map(repr, shown)) + (", ..." if len(names) > 10 else "")
