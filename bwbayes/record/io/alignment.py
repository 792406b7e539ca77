"""Alignment of columns from two files, or with two clocks: a record's voltage and displacement.

LabVIEW's files state for each channel when it starts and how often it is sampled. The times of a
record are the voltage's, as its whole path counts; displacement readings go to the nearest of them.
Two files have the same samples, with or without times, and one column each, or several of which one
is chosen as in any file.
"""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from bwbayes.errors import ColumnsError, InputError, InputWarning, path_text
from bwbayes.record.io.columns import ColumnTable, Naming, select
from bwbayes.record.io.grid import Grid
from bwbayes.record.io.recognition import likeness, rises
from bwbayes.record.io.series import Source
from bwbayes.record.io.units import QUANTITIES


def align_clocks(table: ColumnTable) -> ColumnTable:
    """Return a table whose displacement readings are at the times of its voltage.

    Both are cut to the time that they have in common. Readings a whole number of samples away are
    moved exactly, and others along their slope (:meth:`Grid.filled`) by up to half an interval. A
    faster displacement keeps the readings nearest to the voltage's times; a slower one has no
    reading between. Clocks that differ replace a time column, and a user's rate replaces them.

    Raises InputError: they have no time in common.
    Warns InputWarning: if the clocks or lengths differ.
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


def select_pair(sources: Mapping[str, Source], naming: Naming) -> ColumnTable:
    """Return the columns of two files, by "voltage" and "displacement", as one table.

    Raises ColumnsError: a column or unit of either file that is not known; all of both; InputError:
    as for one file; or the files differ in their numbers of samples or in their times.
    """
    tables: dict[str, ColumnTable] = {}
    errors: list[ColumnsError] = []
    for quantity in ("displacement", "voltage"):
        source = sources[quantity]
        own_naming = _own(source, naming, quantity)
        # The file with the voltage must have times, unless the other one has them.
        is_asked = quantity == "voltage" and not any("time" in t.columns for t in tables.values())
        may_have_times = len(source.series) > 1 and any(map(rises, source.series))
        needed = ["time"] * (is_asked or may_have_times) + [quantity]
        try:
            tables[quantity] = select(source, own_naming, needed)
        except ColumnsError as error:
            if quantity not in naming.columns:
                error.guess["columns"].pop(quantity if quantity in own_naming.columns else "", None)
            errors.insert(0, error)
    if errors:
        both = [error.guess for error in errors]
        guess = {
            key: {q: table[key][q] for q in QUANTITIES for table in both[::-1] if q in table[key]}
            for key in ("columns", "units")
        }
        rates = [error.fs for error in errors if error.fs is not None]
        problem = "; ".join(error.problem for error in errors)
        fs = rates[0] if rates else None
        raise ColumnsError(problem, guess["columns"], guess["units"], fs=fs)
    return _joined(tables["voltage"], tables["displacement"], naming)


def _own(source: Source, naming: Naming, quantity: str) -> Naming:
    """Return the naming for one file; its only column besides times holds the quantity."""
    columns = {q: c for q, c in naming.columns.items() if q in ("time", quantity)}
    if len(source.series) == 1:
        columns.pop("time", None)
    others = [s for s in source.series if likeness(s.label, s.unit, "time") is None]
    if quantity not in columns and len(others) == 1:
        columns[quantity] = others[0].name
    units = {q: unit for q, unit in naming.units.items() if q in ("time", quantity)}
    covariates = naming.covariates if quantity == "voltage" else ()
    return replace(
        naming, columns=columns, units=units, covariates=covariates, displacement_file=None
    )


def _joined(voltage: ColumnTable, displacement: ColumnTable, naming: Naming) -> ColumnTable:
    path, other = voltage.source.path, displacement.source.path
    reading = displacement.columns["displacement"]
    columns = {q: c for q, c in voltage.columns.items() if q not in ("displacement", "truth")}
    samples, readings = columns["voltage"].values.size, reading.values.size
    if samples != readings and reading.clock is None:
        raise InputError(
            f"{other}: {readings} displacements for {samples} voltages in {path}; give files of "
            "the same samples"
        )
    if "time" in displacement.columns:
        column = displacement.columns["time"]
        reading_times, times = (
            c.scaled(c.values, "time") for c in (column, columns.get("time", column))
        )
        apart = np.abs(reading_times - times) > 0.01 * np.ptp(reading_times) / reading_times.size
        if apart.any():
            sample = int(np.argmax(apart))
            raise InputError(
                f"{other}: {column.name}: sample {sample} is at {reading_times[sample]:.9g} s, "
                f"in {path} at {times[sample]:.9g} s; give both at the same times, or `fs=HZ` for "
                "the times"
            )
        columns["time"] = columns.get("time", column)
    columns["displacement"] = replace(reading, name=f"{other.name}: {reading.name}")
    used = {q: c for q, c in voltage.naming.columns.items() if q != "displacement"}
    if "displacement" in naming.columns:
        used["displacement"] = naming.columns["displacement"]
    alike = voltage.source.lines == displacement.source.lines
    return ColumnTable(
        replace(voltage.source, lines=voltage.source.lines if alike else ()),
        columns,
        {"origin": path_text(f"{path.name}, {other.name}"), **voltage.notes},
        replace(naming, columns=used, fs=voltage.naming.fs),
        quantities=voltage.quantities,
    )
