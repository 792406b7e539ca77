"""What was measured, as rows: printed as tables, written as JSON."""

from __future__ import annotations

import datetime
import json
import os
import platform
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

from rich.console import Console
from rich.table import Table as Grid

from bwbayes.app.running.fingerprint import versions

Cell = str | float | bool | None


@dataclass(frozen=True)
class Table:
    """Rows with the same columns, under a title; the ``note`` says how they were measured."""

    name: str
    title: str
    note: str
    rows: Sequence[dict[str, Cell]]


def machine() -> dict[str, object]:
    """Say where and when, and how busy the machine is with other things."""
    return {
        "time": datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
        "platform": platform.platform(),
        "processor": _processor(),
        "cores": os.cpu_count(),
        "load": os.getloadavg() if hasattr(os, "getloadavg") else None,
        "versions": versions("numba"),
    }


def printed(table: Table, console: Console) -> None:
    """Print a table, numbers to three figures."""
    grid = Grid(title=table.title, caption=table.note, title_justify="left", min_width=60)
    for place, column in enumerate(table.rows[0]):
        grid.add_column(column, justify="right" if place else "left")
    for row in table.rows:
        grid.add_row(*map(_shown, row.values()))
    console.print(grid)


def written(tables: Sequence[Table], about: dict[str, object], path: Path) -> None:
    """Write all tables as JSON."""
    content = about | {table.name: asdict(table) for table in tables}
    path.write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")


def _shown(cell: Cell) -> str:
    match cell:
        case None:
            return "-"
        case bool():
            return "yes" if cell else "no"
        case int() | float():
            return f"{cell:.0f}" if abs(cell) >= 100 else f"{cell:.3g}"
    return cell


def _processor() -> str:
    """Return the processor's name; Linux alone tells it in a file."""
    path = Path("/proc/cpuinfo")
    lines = path.read_text(encoding="utf-8").splitlines() if path.is_file() else []
    names = [line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.processor()
