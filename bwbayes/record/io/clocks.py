"""Alignment of columns that have different clocks, by their times instead of their row numbers.

LabVIEW's files state for each channel when it starts and how often it is sampled. The times of a
record are the voltage's, as its whole path counts; displacement readings go to the nearest of them.
"""

from __future__ import annotations

import warnings
from dataclasses import replace

import numpy as np

from bwbayes.errors import InputWarning
from bwbayes.record.io.columns import ColumnTable
from bwbayes.record.io.grid import Grid


def align_clocks(table: ColumnTable) -> ColumnTable:
    """Return a table whose displacement readings are at the times of its voltage.

    Both are cut to the time that they have in common. Readings a whole number of samples away are
    moved exactly, and others along their slope (:meth:`Grid.filled`) by up to half an interval. A
    faster displacement keeps the readings nearest to the voltage's times; a slower one has no
    reading between. Clocks that differ replace a time column, and a user's rate replaces them.

    Raises
    ------
    InputError
        They have no time in common.

    Warns
    -----
    InputWarning
        If the clocks or lengths differ.
    """
    voltage, displacement = (table.columns.get(q) for q in ("voltage", "displacement"))
    if not (voltage and displacement) or table.naming.fs:
        return table
    if not (voltage.clock and displacement.clock):
        return table
    interval, delay = voltage.clock.interval, displacement.clock.delay(voltage.clock)
    # Times of the readings and the places of the nearest voltages, in samples of the voltage.
    ratio = displacement.clock.interval / interval
    times = delay / interval + ratio * np.arange(displacement.values.size, dtype=np.float64)
    samples = np.arange(voltage.values.size)
    if times.size == samples.size and np.abs(times - samples).max() <= 0.01:
        return table
    # Slightly more than a half, so that rounding decides nothing halfway between two.
    half = 0.5 + 1e-6
    readings = np.floor((samples - delay / interval) / ratio + half).astype(np.int64)
    away = times[readings.clip(0, times.size - 1)] - samples
    is_near = (readings >= 0) & (readings < times.size) & (away > half - 1) & (away <= half)
    samples, readings, away = samples[is_near], readings[is_near], away[is_near]
    facts = [f"starts {abs(delay):.6g} s {'after' if delay > 0 else 'before'} {voltage.name!r}"]
    if not samples.size:
        problem = f"{facts[0]}, and they have no time in common"
        advice = "choose channels that were recorded together, or give `fs=HZ` if these were"
        raise table.error(f"{problem}; {advice}", "displacement")
    first, last = int(samples[0]), int(samples[-1])
    is_moved = np.abs(away).max() > 0.01
    grid = Grid(
        voltage.clock.start + first * interval,
        interval,
        positions=samples - first,
        sources=readings,
        elapsed=interval * (times - first) if is_moved else None,
    )
    facts = facts if abs(delay) > 0.01 * interval else []
    if abs(ratio - 1) * times.size > 0.01:
        facts.append(
            f"has a reading every {displacement.clock.interval:.6g} s, "
            f"{voltage.name!r} a value every {interval:.6g} s"
        )
    if is_moved:
        facts.append(f"is moved by up to {np.abs(away).max() * interval:.2g} s along its slope")
    facts.append(f"both are cut to their common {(last - first + 1) * interval:.6g} s")
    remark = str(table.error(", ".join(facts), "displacement"))
    warnings.warn(remark, InputWarning, stacklevel=4)
    clock = voltage.clock._replace(start=grid.start)
    rows = slice(first, last + 1)
    columns = {
        "voltage": replace(voltage, values=voltage.values[rows], clock=clock),
        "displacement": replace(
            displacement, values=grid.filled(displacement.values.astype(np.float64)), clock=clock
        ),
    }
    return replace(table, columns=columns, rows=np.arange(first, last + 1))
