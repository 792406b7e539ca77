"""Configs and records as accident and malice would write them.

:func:`case` makes one from its number alone, so that any of them can be made again: a config and
the record that it names, one of the two spoilt. Records are spoilt by the line, by the cell, by
the byte, and are made again from arrays that belong in no record; configs by the value, by the key,
by the line and by the byte.
"""

from __future__ import annotations

import json
import tomllib
from collections.abc import Callable
from copy import deepcopy
from dataclasses import dataclass
from typing import Any

import numpy as np

from tests.app.odd_files import chosen, few, made, odd_arrays
from tests.app.oddities import (
    CONFIGS,
    GOOD,
    ODD_CELLS,
    ODD_KEYS,
    ODD_LINES,
    ODD_NAMES,
    ODD_NOTES,
    ODD_VALUES,
    QUICK,
)

__all__ = ["KINDS", "Case", "case"]

Generator = np.random.Generator
Lines = list[str]


@dataclass(frozen=True)
class Case:
    """A config and the record beside it; ``kind`` says which of the two was spoilt, and how."""

    kind: str
    config: bytes
    record: str
    data: bytes


def case(seed: int, number: int) -> Case:
    """Make the case of that number, always the same."""
    generator = np.random.default_rng([seed, number])
    good = "\n".join([*GOOD, ""]).encode()
    kind = list(KINDS)[number % len(KINDS)]
    if kind.startswith("config"):
        config = KINDS[kind](CONFIGS[generator.integers(len(CONFIGS))].encode(), generator)
        return Case(kind, config, "record.csv", good)
    suffix = kind.split()[-1]
    data = KINDS[kind](made()[suffix], generator)
    name = f"record.{suffix.split('-')[0]}"
    return Case(kind, QUICK.replace("record.csv", name).encode(), name, data)


# Bytes


def spoilt_bytes(good: bytes, generator: Generator) -> bytes:
    """Flip, change, drop, double, move, insert or blank bytes or stretches, or cut the end."""
    data = bytearray(good)
    if generator.random() < 0.02:
        return generator.bytes(int(generator.integers(0, 3000)))
    for _ in range(few(generator)):
        at = int(generator.integers(0, max(len(data), 1)))
        end = at + int(generator.choice([1, 1, 1, 4, 8, 100, 600]))
        match int(generator.integers(0, 9)):
            case 0 | 1 if data:
                data[at] ^= 1 << int(generator.integers(8))
            case 2:
                data[at:end] = generator.bytes(end - at)
            case 3:
                del data[at:end]
            case 4:
                data[at:at] = data[at:end]
            case 5:
                data[at:at] = generator.bytes(end - at)
            case 6:
                data[at:end] = chosen(generator, (b"\0", b"\xff", b"\x7f")) * (end - at)
            case 7 if generator.random() < 0.3:
                del data[at:]
            case 8:
                to = int(generator.integers(0, max(len(data), 1)))
                data[to : to + end - at] = data[at:end]
    return bytes(data)


# Lines of text


def spoilt_lines(good: bytes, generator: Generator) -> bytes:
    """Spoil a text record by its lines, cells, columns and separators."""
    lines = good.decode().split("\n")[:-1]
    for _ in range(few(generator)):
        lines = chosen(generator, (_moved_lines, _odd_cell, _odd_cell, _odd_columns, _odd_form))(
            lines, generator
        )
    end = chosen(generator, ("\n", "\n", "\r\n", "\r", "\n\n", ""))
    text = end.join(lines) + end
    encoding = chosen(generator, ("utf-8",) * 8 + ("utf-16", "utf-8-sig"))
    data: bytes = text.encode(encoding)
    return data


def _moved_lines(lines: Lines, generator: Generator) -> Lines:
    at, to = sorted(generator.integers(0, len(lines) + 1, 2).tolist())
    match int(generator.integers(0, 5)):
        case 0:
            return lines[:at] + lines[to:] or [""]
        case 1:
            return lines[:to] + lines[at:]
        case 2:
            return lines[:at] + lines[at:to][::-1] + lines[to:]
        case 3:
            return [*lines[:at], chosen(generator, ("", " ", "#", "a")), *lines[at:]]
    return lines[:at] or [""]


def _odd_cell(lines: Lines, generator: Generator) -> Lines:
    at = int(generator.integers(len(lines)))
    cells = lines[at].split(",")
    odd = ODD_NAMES if "time" in lines[at] else ODD_CELLS
    cells[int(generator.integers(len(cells)))] = chosen(generator, odd)
    return [*lines[:at], ",".join(cells), *lines[at + 1 :]]


def _odd_columns(lines: Lines, generator: Generator) -> Lines:
    """Swap, double, drop, scale or blank columns, in all lines or from one line on."""
    since = chosen(generator, (0, 0, int(generator.integers(len(lines)))))
    order = chosen(generator, ((1, 0, 2), (2, 1, 0), (0, 1), (0, 1, 1), (0, 1, 2, 2), (0,), (1, 2)))
    tail = chosen(generator, ("", "", "", "e9", "e-9", "e300", ","))

    def changed(line: str) -> str:
        cells = line.split(",")
        if len(cells) != 3 or line.startswith("#"):
            return line
        return ",".join(cells[i] for i in order) + ("" if "_" in line else tail)

    return lines[:since] + [changed(line) for line in lines[since:]]


def _odd_form(lines: Lines, generator: Generator) -> Lines:
    match int(generator.integers(0, 5)):
        case 0:
            return [chosen(generator, ODD_NOTES), *lines]
        case 1:
            old, new = chosen(
                generator, ((",", ";"), (".", ","), (",", "\t"), (",", " , "), (",", ""))
            )
            return [line.replace(old, new) for line in lines]
        case 2:
            at = int(generator.integers(len(lines)))
            return [*lines[:at], lines[at] + "," + "1," * 30_000, *lines[at + 1 :]]
        case 3:
            return [line + chosen(generator, (" ", "\t", "\0", "#", "x")) for line in lines]
    return lines * int(generator.integers(2, 4))


# Configs


def spoilt_values(good: bytes, generator: Generator) -> bytes:
    """Set a few keys of a config to odd values, remove some, put new ones in, rename others."""
    table = tomllib.loads(good.decode())
    for _ in range(few(generator)):
        at = _somewhere(table, generator)
        old = chosen(generator, [*at]) if at else "a"
        match int(generator.integers(0, 8)):
            case 6 | 7 if isinstance(at.get(old), int | float) and abs(at[old]) < 1e300:
                at[old] *= chosen(generator, (0.5, 2.0, 3, -1, 1e3, 1e-3, 1 + 1e-9))
            case 0:
                at.pop(old, None)
            case 1:
                at[chosen(generator, ODD_KEYS)] = at.pop(old, None) or 1
            case 2:
                at[chosen(generator, ODD_KEYS)] = deepcopy(chosen(generator, ODD_VALUES))
            case _:
                at[old] = deepcopy(chosen(generator, ODD_VALUES))
    return toml(table).encode()


def _somewhere(table: dict[str, Any], generator: Generator) -> dict[str, Any]:
    inner = [value for value in table.values() if isinstance(value, dict)]
    if not inner or generator.random() < 0.25:
        return table
    return _somewhere(chosen(generator, inner), generator)


def toml(table: dict[str, Any]) -> str:
    """Write a table as TOML, without a library that could refuse it."""
    return "".join(f"{_quoted(key)} = {_inline(value)}\n" for key, value in table.items())


def _inline(value: Any) -> str:
    if isinstance(value, dict):
        return "{" + ", ".join(f"{_quoted(k)} = {_inline(v)}" for k, v in value.items()) + "}"
    if isinstance(value, list):
        return "[" + ", ".join(map(_inline, value)) + "]"
    if isinstance(value, str):
        return _quoted(value)
    if isinstance(value, bool):
        return str(value).lower()
    # Hexadecimal, because Python writes and reads decimals of limited length alone.
    return hex(value) if isinstance(value, int) and value > 10**300 else repr(value)


def _quoted(text: str) -> str:
    return json.dumps(text, ensure_ascii=False).replace("\x7f", "\\u007f")


def spoilt_config_lines(good: bytes, generator: Generator) -> bytes:
    """Move, double, drop and insert lines of a config."""
    lines = good.decode().split("\n")
    for _ in range(few(generator)):
        at = int(generator.integers(len(lines) + 1))
        if generator.random() < 0.5:
            lines = [*lines[:at], chosen(generator, ODD_LINES), *lines[at:]]
        else:
            lines = _moved_lines(lines, generator)
    return "\n".join(lines).encode("utf-8", errors="surrogatepass")


KINDS: dict[str, Callable[[bytes, Generator], bytes]] = {
    "lines of csv": spoilt_lines,
    "config's values": spoilt_values,
    "bytes of h5": spoilt_bytes,
    "lines of csv ": spoilt_lines,
    "config's lines": spoilt_config_lines,
    "bytes of mat": spoilt_bytes,
    "arrays of h5": odd_arrays("h5"),
    "config's bytes": spoilt_bytes,
    "bytes of h5-other": spoilt_bytes,
    "bytes of csv": spoilt_bytes,
    "arrays of mat": odd_arrays("mat"),
    "bytes of mat-7.3": spoilt_bytes,
    "config's values ": spoilt_values,
    "bytes of mat-other": spoilt_bytes,
    "arrays of mat-7.3": odd_arrays("mat-7.3"),
}
