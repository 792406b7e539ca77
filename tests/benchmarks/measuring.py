"""Calls timed in turns, and what was measured as rows of a table."""

import os
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

from rich.console import Console
from rich.table import Table as Grid

ROOT = Path(__file__).resolve().parents[2]

Call = Callable[[], object]
Cell = str | float | None


class Cost(NamedTuple):
    """Seconds on the clock, and seconds of all cores together, child processes included."""

    wall: float
    cpu: float


def timed(call: Call) -> Cost:
    wall, cpu = time.perf_counter(), cpu_time()
    call()
    return Cost(time.perf_counter() - wall, cpu_time() - cpu)


def cpu_time() -> float:
    """Return the CPU time (s) of this process and of the children that have ended."""
    # The finer clock knows this process alone.
    times = os.times()
    return time.process_time() + times.children_user + times.children_system


def interleaved(contestants: Mapping[str, Call], rounds: int) -> dict[str, Cost]:
    """Return the least cost of each contestant's call, over rounds in which all take a turn.

    So noise hits all alike; a turn lasts 50 ms at least, in which cheap calls are repeated.
    """
    result: dict[str, list[Cost]] = {name: [] for name in contestants}
    for _ in range(rounds):
        for name, call in contestants.items():
            end = time.perf_counter() + 0.05
            result[name].append(timed(call))
            while time.perf_counter() < end:
                result[name].append(timed(call))
    return {name: Cost(*map(min, zip(*costs, strict=True))) for name, costs in result.items()}


@dataclass(frozen=True)
class Table:
    """Rows with the same columns, under a title; the ``note`` says how they were measured."""

    title: str
    note: str
    rows: Sequence[dict[str, Cell]]

    def number(self, column: str, row: int = 0) -> float:
        """Return a cell that is a number."""
        cell = self.rows[row][column]
        assert isinstance(cell, int | float)
        return float(cell)

    def show(self, console: Console) -> None:
        """Print it, numbers to three figures."""
        grid = Grid(title=self.title, caption=self.note, title_justify="left", min_width=60)
        for number, column in enumerate(self.rows[0]):
            grid.add_column(column, justify="right" if number else "left")
        for row in self.rows:
            grid.add_row(*map(_shown, row.values()))
        console.print(grid)


def _shown(cell: Cell) -> str:
    if isinstance(cell, int | float):
        return f"{cell:.0f}" if abs(cell) >= 100 else f"{cell:.3g}"
    return "-" if cell is None else cell
