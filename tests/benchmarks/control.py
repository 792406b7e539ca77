"""What a step of an exported controller costs, forward and inverse."""

from __future__ import annotations

import tempfile
from functools import partial
from pathlib import Path

import numpy as np

from bwbayes.control.exported import exported
from tests.benchmarks.cases import Effort
from tests.benchmarks.tables import Cell, Table
from tests.benchmarks.timing import interleaved
from tests.control import cases
from tests.control.compiled import Compiled
from tests.programs import path

__all__ = ["controller"]

SAMPLES = 16_000


def controller(effort: Effort) -> Table:
    """Measure the C files of every actuator that has one."""
    rows: list[dict[str, Cell]] = []
    compiler = path("cc")
    for name in cases.ACTUATORS if compiler else ():
        assert compiler is not None
        actuator = cases.actuator(name, "zero")
        made = exported(name, actuator, cases.theta(actuator, 1, name)[0], cases.SPAN)
        with tempfile.TemporaryDirectory() as folder:
            compiled = Compiled(made, Path(folder), compiler)
            # Slow for the interval, as a controller sees it.
            voltage = 80 * np.sin(2 * np.pi * 1e-3 * np.arange(SAMPLES))
            displacement = compiled.run("forward", 0.0, voltage)
            costs = interleaved(
                {
                    "forward": partial(compiled.run, "forward", 0.0, voltage),
                    "inverse": partial(compiled.run, "inverse", 0.0, displacement),
                },
                effort.rounds,
            )
            rows.append(
                {
                    "model": name,
                    **{f"{one}, ns": 1e9 * cost.wall / SAMPLES for one, cost in costs.items()},
                    "state, bytes": compiled.bytes,
                }
            )
    rows = rows or [{"model": "no C compiler here"}]
    return Table("controller", "Controller", "ns a step of the exported C file, -O2", rows)
