"""Calls timed in turns, and what was measured as rows: printed as tables, written as JSON."""

from __future__ import annotations

import datetime
import json
import os
import platform
import time
from collections.abc import Callable, Hashable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import NamedTuple

from rich.console import Console
from rich.table import Table as Grid

from bwbayes.app.running.fingerprint import versions

Cell = str | float | bool | None


class Cost(NamedTuple):
    """Seconds on the clock, and seconds of all cores together, child processes included."""

    wall: float
    cpu: float


def timed(call: Callable[[], object]) -> Cost:
    """Return what one call costs."""
    wall, cpu = time.perf_counter(), _cpu()
    call()
    return Cost(time.perf_counter() - wall, _cpu() - cpu)


def interleaved[Name: Hashable](
    contestants: Mapping[Name, Callable[[], object]], rounds: int
) -> dict[Name, Cost]:
    """Return the least cost of each contestant's call, over rounds in which all take a turn.

    So noise hits all alike; a turn lasts 50 ms at least, in which cheap calls are repeated.
    """
    result: dict[Name, list[Cost]] = {name: [] for name in contestants}
    for _ in range(rounds):
        for name, call in contestants.items():
            end = time.perf_counter() + 0.05
            result[name].append(timed(call))
            while time.perf_counter() < end:
                result[name].append(timed(call))
    return {name: Cost(*map(min, zip(*costs, strict=True))) for name, costs in result.items()}


def _cpu() -> float:
    # The finer clock knows this process alone; children count once they have ended.
    times = os.times()
    return time.process_time() + times.children_user + times.children_system


@dataclass(frozen=True)
class Table:
    """Rows with the same columns, under a title; the ``note`` says how they were measured."""

    name: str
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
    match cell:
        case None:
            return "-"
        case bool():
            return "yes" if cell else "no"
        case int() | float():
            return f"{cell:.0f}" if abs(cell) >= 100 else f"{cell:.3g}"
    return cell


def machine() -> dict[str, object]:
    """Say where and when, and how busy the machine is with other things."""
    return {
        "time": datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
        "platform": platform.platform(),
        "cores": os.cpu_count(),
        "load": os.getloadavg() if hasattr(os, "getloadavg") else None,
        "versions": versions("numba"),
    }


def write(tables: Sequence[Table], about: Mapping[str, object], path: Path) -> None:
    """Write all tables as JSON."""
    content = {**about, **{table.name: asdict(table) for table in tables}}
    path.write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")
