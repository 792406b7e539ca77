"""Text of an object at a prompt: its fields, or the head of its text, never a flood.

A class shows its fields by ``__repr__ = brief`` in its body. One that has a text of its own for
``print`` shows the beginning of it: ``return head(str(self))``.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any

import numpy as np

# A repr has at most so many lines and characters.
MOST_LINES, LONGEST = 12, 1200

# Characters of a line, and of a value in it.
WIDTH, VALUE = 96, 70


def brief(instance: object) -> str:
    """Return class and fields of an object, on one line or one each; long values by their size."""
    name, parts = type(instance).__name__, [f"{n}={_value(v)}" for n, v in _fields(instance)]
    line = f"{name}({', '.join(parts)})"
    if len(line) <= WIDTH:
        return line
    room = MOST_LINES - 2
    if len(parts) > room:
        parts = [*parts[: room - 1], f"... {len(parts) - room + 1} more"]
    return "\n".join(
        [f"{name}(", *(f"    {field_line[: WIDTH - 5]}," for field_line in parts), ")"]
    )


def rounded(value: float, digits: int = 3) -> str:
    """Return a number with so many digits, without an exponent below a million: 13,600."""
    text = f"{value:.{digits}g}"
    return f"{float(text):,.0f}" if "e+0" in text and abs(value) < 1e6 else text


def head(text: str) -> str:
    """Return the beginning of a text, with what is left out counted."""
    lines = text.splitlines()
    if len(lines) <= MOST_LINES and len(text) <= LONGEST:
        return text
    shown: list[str] = []
    for line in (raw.rstrip()[: 2 * WIDTH] for raw in lines[: MOST_LINES - 1]):
        if len("\n".join([*shown, line])) > LONGEST - WIDTH:
            break
        shown.append(line)
    return "\n".join([*shown, f"... {len(lines) - len(shown)} more lines: print it to see them"])


def _fields(instance: object) -> Iterator[tuple[str, Any]]:
    """Yield names and values of an object's fields."""
    names: Iterable[str] = vars(instance)
    if is_dataclass(instance):
        names = [field.name for field in fields(instance) if field.repr]
    for name in names:
        if not name.startswith("_"):
            yield name, getattr(instance, name)


def _value(value: Any, *, nested: bool = True) -> str:
    """Return a value in a few words; of what is in it, if it is ``nested``."""
    if isinstance(value, np.ndarray):
        text = f"array {value.shape}"
        if value.size <= 4:
            text = repr(value.tolist())
        elif value.dtype.kind in "iuf" and np.isfinite(value).any():
            finite = value[np.isfinite(value)]
            text += f" from {finite.min():.4g} to {finite.max():.4g}"
        return _cut_text(text)
    if isinstance(value, Mapping):
        items = (f"{key!r}: {_value(item, nested=False)}" for key, item in value.items())
        return _join_items("{", items, len(value), "}")
    if isinstance(value, list | tuple | set | frozenset):
        return _join_items("[", (_value(item, nested=False) for item in value), len(value), "]")
    if nested and is_dataclass(value) and not isinstance(value, type):
        parts = [f"{name}={_value(item, nested=False)}" for name, item in _fields(value)]
        line = f"{type(value).__name__}({', '.join(parts)})"
        return line if len(line) <= VALUE else f"{type(value).__name__}(...)"
    plain = value.item() if isinstance(value, np.generic) else value
    # These show themselves shortly.
    if plain is None or isinstance(
        plain, bool | int | float | complex | str | bytes | slice | Path
    ):
        return f"{plain:.6g}" if isinstance(plain, float) else _cut_text(repr(plain))
    return str(getattr(value, "__name__", f"{type(value).__name__}(...)"))


def _join_items(opening: str, items: Iterator[str], count: int, closing: str) -> str:
    """Return the first items of a collection, as many as there is room for, and how many more."""
    shown: list[str] = []
    for item in items:
        if sum(map(len, shown)) + 2 * len(shown) + len(item) > VALUE:
            break
        shown.append(item)
    more = [f"... {count - len(shown)} more"] if len(shown) < count else []
    return f"{opening}{', '.join([*shown, *more])}{closing}"


def _cut_text(text: str) -> str:
    return text if len(text) <= VALUE else f"{text[: VALUE - 3]}..."
