"""What the columns of a file are: their quantities and units, from their names or as one is told.

The package's own names carry quantity and unit, ``voltage_mV`` for instance. A :class:`Naming`
says which columns of a file with other names are meant, and in which units; where it says none,
the unit is read from the name itself, as in ``t [ms]``, ``pos (nm)`` or ``U_mV``, and a column that
can be nothing else is recognised by its name: :meth:`Naming.completed`.
"""

from __future__ import annotations

import contextlib
import difflib
import re
import warnings
from collections.abc import Collection, Mapping
from dataclasses import dataclass, field

from bwbayes.errors import InputError, InputWarning, one_line

__all__ = ["COMMON_NAMES", "UNITS", "Naming", "missing", "recognised", "say_guesses", "unit_in"]

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

    def completed(self, names: Collection[str]) -> Naming:
        """Return this naming with what it leaves open recognised among a file's columns.

        The columns that are named here and the package's own names come first.

        Raises
        ------
        ValueError
            With the text ``problem; what to do``: a column that is named and missing, or one that
            is recognised and has no unit, or none that is known.
        """
        self.require_in(names)
        known = dict(self.columns)
        for name in names:
            with contextlib.suppress(ValueError):
                known.setdefault(self.of(name)[0], name)
        rest = [name for name in names if name not in known.values()]
        more = {q: name for q, name in recognised(rest).items() if q not in known}
        for name in rest:
            quantity, _, unit = name.strip().lower().rpartition("_")
            if quantity in WORDS and quantity not in {*known, *more}:
                written = ", ".join(UNITS[quantity])
                raise ValueError(f"{name}: unknown unit {unit!r}; write one of {written}")
        for quantity, name in more.items():
            if quantity not in self.units and unit_in(name, quantity) is None:
                raise ValueError(f"{name}: {_no_unit(quantity)}")
        return Naming({**self.columns, **more}, self.units) if more else self

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
            raise ValueError(_no_unit(quantity))
        return UNITS[quantity][unit.removeprefix("-")], -1 if unit.startswith("-") else 1


def _no_unit(quantity: str) -> str:
    example = f'units = {{ {quantity} = "{next(iter(UNITS[quantity]))}" }}'
    return (
        f"no unit of the {quantity} in its name; write it there, or say {example} "
        f"(bwbayes init: --unit {quantity}={next(iter(UNITS[quantity]))})"
    )


def missing(quantity: str, rest: Collection[str]) -> str:
    """Return what to do about a quantity that no column has; ``rest`` are the file's others."""
    if not rest:
        return f"{COMMON_NAMES[quantity]}: missing; add it"
    near = difflib.get_close_matches(COMMON_NAMES[quantity], rest, 1)
    name = near[0] if near else "..."
    return (
        f"which column is the {quantity}? There are {_listed(rest)}; "
        f'say columns = {{ {quantity} = "{name}" }} (bwbayes init: --column {quantity}={name})'
    )


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


def say_guesses(where: str, given: Naming, used: Naming) -> None:
    """Warn of columns that were recognised by nothing but their units."""
    more = {q: name for q, name in used.columns.items() if q not in given.columns}
    guesses = [f"{q} is {name!r}" for q, name in more.items() if _word(name) not in WORDS[q]]
    if guesses:
        remark = f"{where}: taken by its unit: {', '.join(guesses)}; if not, say `columns`"
        warnings.warn(one_line(remark), InputWarning, stacklevel=3)


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
    if known is not None and unit in known:
        return quantity.lower(), known[unit]
    if bare in units:
        return bare, 0
    raise ValueError("not one of the package's own names; say it under `columns`")


def _listed(names: Collection[str]) -> str:
    shown = list(names)[:10]
    return ", ".join(map(repr, shown)) + (", ..." if len(names) > 10 else "")
