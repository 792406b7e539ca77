"""Input and output of a specimen: by default a voltage in V and a displacement in um.

The package computes in the units of the record, whatever they are, and its words are written once,
for voltage and displacement in V and um. :class:`Quantities` say them in a record's own words where
text leaves the package: on the screen, in pages, figures and files, in notes and errors.
"""

from __future__ import annotations

import re
import warnings
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Self

from bwbayes.errors import ColumnsError, InputError, InputWarning


@dataclass(frozen=True)
class Quantity:
    """A quantity: its name in a sentence, and its unit."""

    name: str
    unit: str

    @classmethod
    def of(cls, text: str, key: str) -> Self:
        """Return the quantity that a text such as ``"H (A/m)"`` names.

        Raises
        ------
        InputError
            The text is not a name with a unit in brackets.
        """
        match = re.fullmatch(r"\s*([^\[\]()]+?)\s*[(\[]\s*([^\[\]()]+?)\s*[)\]]\s*", text)
        # Nothing that would be code in a page, a config or the exported C.
        is_plain = text.isprintable() and not re.search(r"[<>&\"`{}\\,]|\*/|/\*", text)
        if match is None or not is_plain:
            raise InputError(f"{key}: {text!r} is no name with a unit; write it as 'H (A/m)'")
        return cls(match[1], match[2])

    def __str__(self) -> str:
        return f"{self.name} ({self.unit})"


VOLTAGE = Quantity("voltage", "V")
DISPLACEMENT = Quantity("displacement", "um")
TIME = Quantity("time", "s")


# The words of the package's texts that depend on the quantities. A word in a path, an option or an
# identifier is none of them; a V may be of a person's name.
_WORDS = re.compile(
    r"(?<![\w./='\"\\-])(?P<word>[Vv]oltages?|[Dd]isplacements?)(?![\w/]|[.=-]\w)"
    r"|(?P<zero>\bzero volts?\b)|(?P<slope>\bpiezoelectric coefficient\b)"
    r"|(?P<time>\btime \(s\)|\(s\)|(?<=\d )s\b(?! *[=(])|/√Hz\b|/s\b|\bHz\b|^s$)"
    r"|(?P<before>/?)(?<![\w.\\])(?<![A-Z]\. )"
    r"(?P<unit>um|µm|V|volts?|micrometers?)(?!\w)(?P<after>\^?)"
)
# Words for a time where samples are the clock.
_SAMPLES = {
    "time (s)": "sample",
    "(s)": "(samples)",
    "s": "samples",
    "/√Hz": " √sample",
    "/s": "/sample",
    "Hz": "per sample",
}


@dataclass(frozen=True)
class Quantities:
    """Input and output of a record, and its clock: s, or samples where it has no time.

    Examples
    --------
    >>> quantities = Quantities.of("H (A/m)", "B (T)")
    >>> quantities.say("the displacement, 0.2 um, rises by 3 um/V")
    'the B, 0.2 T, rises by 3 T/(A/m)'
    """

    input: Quantity = VOLTAGE
    output: Quantity = DISPLACEMENT
    clock: Quantity = TIME

    @classmethod
    def of(cls, input: str | None, output: str | None, *, has_clock: bool = True) -> Self:
        """Return the quantities that texts such as ``"H (A/m)"`` name; None is the default.

        Raises
        ------
        InputError
            A text that is not a name with a unit in brackets; both have the same name.
        """
        made = cls(
            VOLTAGE if input is None else Quantity.of(input, "input"),
            DISPLACEMENT if output is None else Quantity.of(output, "output"),
            TIME if has_clock else Quantity("sample", "samples"),
        )
        if made.input.name.casefold() == made.output.name.casefold():
            raise InputError(f"output: {made.output.name!r} is the input; give each its own name")
        return made

    @property
    def has_clock(self) -> bool:
        """Whether the record has a time; without one it is taken as rate independent."""
        return self.clock == TIME

    @property
    def are_default(self) -> bool:
        """Whether they are a voltage in V and a displacement in um."""
        return (self.input, self.output) == (VOLTAGE, DISPLACEMENT)

    def of_key(self, key: str) -> Quantity:
        """Return the quantity that the package calls time, voltage or displacement."""
        return {"voltage": self.input, "displacement": self.output}.get(key, TIME)

    @cached_property
    def by_key(self) -> dict[str, str]:
        """The package's names of the quantities, by the other names that a user may give them."""
        names = {"input": "voltage", self.input.name.casefold(): "voltage"}
        return names | {"output": "displacement", self.output.name.casefold(): "displacement"}

    def say[Text: str](self, text: Text) -> Text:
        """Return a text of the package in these quantities."""
        if self == DEFAULT:
            return text
        # At once, as the input may be a displacement.
        return type(text)(_WORDS.sub(self._own, text))

    def _own(self, match: re.Match[str]) -> str:
        """Return what stands for a word, a unit or a time of the package."""
        if word := match["word"]:
            default = DISPLACEMENT if word[0] in "dD" else VOLTAGE
            quantity = self.output if default == DISPLACEMENT else self.input
            if quantity.name == default.name:
                return word
            several = " values" if len(quantity.name) <= 2 else "s"
            name = quantity.name + several * word.endswith("s")
            return name[0].upper() + name[1:] if word[0].isupper() else name
        if match["zero"] or match["slope"]:
            zero = match[0] if self.input == VOLTAGE else f"zero {self.input.name}"
            return zero if match["zero"] else "linear coefficient"
        if time := match["time"]:
            return time if self.has_clock else _SAMPLES.get(time, time)
        return self._unit(match)

    def _unit(self, match: re.Match[str]) -> str:
        """Return the unit that stands for one of the package, in brackets where that is needed."""
        before, token, after = match["before"] or "", match["unit"] or "", match["after"] or ""
        default = VOLTAGE if token in ("V", "volt", "volts") else DISPLACEMENT
        quantity = self.input if default == VOLTAGE else self.output
        if quantity.unit == default.unit:
            return match[0]
        is_compound = (before or after) and re.search(r"[^\w%°µμ]|\d$", quantity.unit)
        return (
            f"{before}({quantity.unit}){after}"
            if is_compound
            else f"{before}{quantity.unit}{after}"
        )

    def key(self, name: str) -> str:
        """Return a name such as ``rmse_um`` in these quantities: ``rmse_T``."""
        if self == DEFAULT:
            return name
        words = {"voltage": self.input.name, "displacement": self.output.name}
        words |= {"V": self.input.unit, "um": self.output.unit}
        if not self.has_clock:
            words |= {"s": self.clock.unit}
        return "_".join(words.get(word, word) for word in name.split("_"))

    def heading(self, name: str) -> str:
        """Return a column's name such as ``voltage_V`` in these quantities: ``H (A/m)``."""
        match = re.fullmatch(r"(\w+)_(V|um|s)", name)
        if self == DEFAULT or match is None or (match[2] == "s" and self.has_clock):
            return name
        if name == "time_s":
            return self.clock.name
        return f"{self.key(match[1])} ({self.key(match[2])})"

    def rendered(self, value: Any) -> Any:
        """Return numbers and texts of a file, nested by keys and in lists, in these quantities."""
        if self == DEFAULT:
            return value
        if isinstance(value, str):
            return self.say(value)
        if isinstance(value, Mapping):
            return {self.key(str(name)): self.rendered(item) for name, item in value.items()}
        return [self.rendered(item) for item in value] if isinstance(value, list | tuple) else value

    def asked(self, error: InputError) -> InputError:
        """Return an error that asks for columns by the names that nobody confuses."""
        if not isinstance(error, ColumnsError):
            return error
        roles = {"voltage": "input", "displacement": "output"}
        columns = {roles.get(q, q): column for q, column in error.guess["columns"].items()}
        own_units = {"voltage": self.input.unit, "displacement": self.output.unit}
        units = {roles.get(q, q): own_units.get(q, u) for q, u in error.guess["units"].items()}
        fs = error.fs if self.has_clock else None
        translated = ColumnsError(self.say(error.problem), columns, units, error.place, fs)
        translated.is_said = True
        return translated

    @contextmanager
    def spoken(self) -> Iterator[None]:
        """Say the errors and warnings of what is done within in these quantities."""
        if self == DEFAULT:
            yield
            return
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always", InputWarning)
            try:
                yield
            except InputError as error:
                if not error.is_said:
                    error.args, error.is_said = (self.say(str(error)),), True
                raise
            finally:
                notes = [w for w in caught if issubclass(w.category, InputWarning)]
                messages = [(self.say(str(w.message)), w.category) for w in notes]
        for text, category in messages:
            warnings.warn(text, category, stacklevel=4)


DEFAULT = Quantities()
