"""Formats of numbers and symbols: numbers as exactly as they are known, in plain characters."""

from __future__ import annotations

import math
import re
import unicodedata
from collections.abc import Iterator, Mapping
from typing import Any

from markupsafe import Markup

from bwbayes.inference.parameters import Parameter
from bwbayes.prediction.scores import Scores
from bwbayes.report.report import Kind

# Kind of banner for the outcome of a validation or of a record of a campaign; "bad" for others.
STATUS_KINDS: Mapping[str, Kind] = {
    "passed": "good",
    "inconclusive": "note",
    "validation inconclusive": "note",
}


def symbol(parameter: Parameter) -> Markup:
    r"""Return a parameter's LaTeX label as HTML, or its name if that is impossible.

    Greek letters, one subscript and ``\mathrm`` are understood.
    """

    def greek(command: re.Match[str]) -> str:
        size = "CAPITAL" if command[1][0].isupper() else "SMALL"
        try:
            return unicodedata.lookup(f"GREEK {size} LETTER {command[1].upper()}")
        except KeyError:
            return command[0]

    text = re.sub(r"\\mathrm\{(\w*)\}", r"\1", parameter.label)
    text = re.sub(r"\\([A-Za-z]+)", greek, text)
    match = re.fullmatch(r"([^\\{}_^$]+)(?:_(?:\{([^\\{}_^$]+)\}|(\w+)))?", text)
    if match is None:
        return Markup("<i>{}</i>").format(parameter.name)
    base, *below = match.groups("")
    subscript = Markup("<sub>{}</sub>").format("".join(below)) if any(below) else ""
    return Markup("<i>{}</i>").format(base) + subscript


def unit_text(unit: str) -> str:
    """Return a unit for people: um as µm, nothing for a pure number."""
    return "" if unit == "-" else re.sub(r"\bum\b", "µm", unit)


def label_with_unit(name: str, unit: str) -> str:
    """Return a name with its unit in brackets, if it has one."""
    return f"{name} ({unit_text(unit)})" if unit_text(unit) else name


def digits(value: float, sd: float) -> str:
    """Write a value as exactly as its standard deviation with two digits is written.

    ``digits(0.69712, 0.0061234)`` is ``0.6971``. A value far from one gets a power of ten.
    """
    if not (math.isfinite(value) and math.isfinite(sd) and sd > 0):
        return f"{value:.6g}"
    exponent = int(f"{sd:.1e}".partition("e")[2]) - 1
    if exponent < -7 or exponent > 3:
        leading = int(f"{value:e}".partition("e")[2]) if value else exponent
        return f"{value:.{max(leading - exponent, 0)}e}"
    # Adding zero takes the sign from a negative zero.
    return f"{round(value, -exponent) + 0.0:.{max(-exponent, 0)}f}"


def with_error(value: float, sd: float) -> str:
    """Write a value and its standard error, both to two digits of the error."""
    return f"{digits(value, sd)} ± {digits(sd, sd)}"


def length_text(um: float) -> str:
    """Write a length or an error, um, with three significant digits, also of nanometers."""
    return f"{digits(um, abs(um) / 10)} µm"


def mark(status: str) -> Markup:
    """Write an outcome: on green if it passed, amber if inconclusive, red otherwise."""
    return Markup('<span class="mark {}">{}</span>').format(STATUS_KINDS.get(status, "bad"), status)


def coverage_text(scores: Scores, kind: str, level: int) -> str:
    """Write a band's coverage with its standard error; nothing if it is not known."""
    share, error = scores.coverage[kind], scores.coverage_error[kind]
    if share is None:
        return ""
    text = f"{100 * share[level]:.1f}"
    return f"{text}%" if error is None else f"{text} ± {100 * error[level]:.1f}%"


def error_text(scores: Scores) -> str:
    """Write the NRMSE, also relative to the training range if that differs from the record's."""
    text, full = f"{100 * scores.nrmse:.2f}%", scores.nrmse_full
    # Ranges count as different if they differ by more than this part.
    if full is None or abs(full - scores.nrmse) <= 0.05 * scores.nrmse:
        return text
    return f"{text} ({100 * full:.2f}% of the training range)"


def circumstances(numbers: Mapping[str, Any]) -> Iterator[tuple[str, str]]:
    """Yield the facts of the run in the summary besides its results."""
    if "seed" in numbers:
        yield "seed", str(numbers["seed"])
    if isinstance(wall := numbers.get("wall_s"), int | float):
        yield "wall time", f"{wall:.0f} s"
    if "data_sha256" in numbers:
        yield "data, SHA-256", str(numbers["data_sha256"])
    if isinstance(versions := numbers.get("versions"), Mapping):
        yield "versions", ", ".join(f"{name} {version}" for name, version in versions.items())
