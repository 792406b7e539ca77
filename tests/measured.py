"""The figures of the slow tests and benchmarks from when they last ran in full.

They are kept in ``measured.json``, and the figures that both README files quote are compared with
them, so that none is quoted from memory. An expression names some of them: how they are reduced,
what they are multiplied by, and their paths, ``"extent 100 study/cover*|other study/cover"``.
"""

import json
import re
from collections.abc import Callable, Iterator, Mapping
from fnmatch import fnmatchcase
from pathlib import Path
from tempfile import gettempdir
from typing import Any

from filelock import FileLock

PATH = Path(__file__).with_suffix(".json")
NUMBER = re.compile(r"(?<![\w.-])-?\d[\d,]*(?:\.\d+)?(?:e-?\d+)?")

REDUCE: dict[str, Callable[[list[float]], list[float]]] = {
    "": list,
    "min": lambda values: [min(values)],
    "max": lambda values: [max(values)],
    "sum": lambda values: [sum(values)],
    "count": lambda values: [len(values)],
    "extent": lambda values: [min(values), max(values)],
    "worst": lambda values: [max(map(abs, values))],
}


def measured() -> dict[str, Any]:
    figures: dict[str, Any] = json.loads(PATH.read_text(encoding="utf-8"))
    return figures


def keep(promise: str, figures: Mapping[str, Any]) -> None:
    """Store the figures of a promise in place of older ones; a line for each promise."""
    # Studies may run side by side.
    with FileLock(Path(gettempdir()) / "bwbayes-measured.lock"):
        every = sorted((measured() | {promise: figures}).items())
        lines = (f"{json.dumps(name)}: {json.dumps(one, sort_keys=True)}" for name, one in every)
        PATH.write_text("{\n" + ",\n".join(lines) + "\n}\n", encoding="utf-8")


def figures(*expressions: str) -> list[float]:
    return [value for expression in expressions for value in _figures(expression)]


def _figures(expression: str) -> list[float]:
    found = re.fullmatch(rf"(?:({'|'.join(filter(None, REDUCE))}) )?(?:(\d+) )?(.*)", expression)
    assert found is not None
    how, factor, patterns = found.groups()
    values = [
        value * int(factor or 1)
        for pattern in patterns.split("|")
        for path, value in LEAVES.items()
        if fnmatchcase(path, pattern)
    ]
    assert values or how == "sum", expression
    return REDUCE[how or ""](values)


def _leaves(figure: Any, path: str) -> Iterator[tuple[str, float]]:
    """Yield the numbers of a figure by their paths; "5 of 9" is two, "#path" a list's length."""
    if isinstance(figure, str):
        counts = re.fullmatch(r"(\d+) of (\d+)", figure)
        figure = [int(count) for count in counts.groups()] if counts else []
    if isinstance(figure, int | float):
        yield path, figure
        return
    yield f"#{path}", len(figure)
    items = figure.items() if isinstance(figure, dict) else enumerate(figure)
    for key, value in items:
        yield from _leaves(value, f"{path}/{key}")


# As they are when this is loaded.
LEAVES = {
    path: value for name, figure in measured().items() for path, value in _leaves(figure, name)
}


def numbers(text: str) -> list[str]:
    return [number.rstrip(",") for number in NUMBER.findall(text)]


def quotes(text: str, value: float) -> bool:
    """Tell whether a number is a value, as precisely as it is printed."""
    if "e" in text:
        return f"{value:.0e}" == text
    return f"{value:,.{len(text.partition('.')[2])}f}" == text


def assert_quotes(text: str, *expressions: str) -> None:
    """Assert that a text's numbers are those of expressions, in their order, and no others."""
    printed, expected = numbers(text), figures(*expressions)
    assert len(printed) == len(expected), (text, expected)
    for number, value in zip(printed, expected, strict=True):
        assert quotes(number, value), (text, expected)
