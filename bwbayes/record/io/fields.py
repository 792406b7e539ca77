"""Conversion of a file's columns to a checked record: clocks, units, lengths, finite numbers, gaps.

The checks here apply to all formats: lengths, finite numbers, a voltage and a displacement that
move. Single displacements may be missing (nan, or a number far from all others). Whole samples, or
their voltages alone, may be missing where the voltage can be inferred: a command is held, and an
output is interpolated if interpolation is right elsewhere. A problem is one line,
``file:line: column: problem; what to do``; files without lines name the sample, counted from 0.

Two files of a record have the same samples, with or without times, and one column each, or several
of which one is chosen as in any file. LabVIEW's files state for each channel when it starts and how
often it is sampled. The times of a record are the voltage's, as its whole path counts; displacement
readings go to the nearest of them.
"""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from bwbayes.arrays import FloatArray
from bwbayes.errors import ColumnsError, InputError, InputWarning, path_text
from bwbayes.model.inputs import VoltageIs, require_voltage_is
from bwbayes.record.instruments import Instruments
from bwbayes.record.io.columns import ColumnTable, Naming, select
from bwbayes.record.io.grid import Grid, clock, is_smooth, require_plausible, time_grid
from bwbayes.record.io.recognition import QUANTITIES, rises
from bwbayes.record.io.series import INSTRUMENT_NOTES, Clock, Source

_MINIMUM_SAMPLES = 10


def record_fields(
    table: ColumnTable, voltage_is: VoltageIs | None = None, need_displacement: bool = True
) -> dict[str, Any]:
    """Return a record's arguments, after all checks that do not depend on the format.

    ``voltage_is`` overrides what the file says; a file that says nothing means "output". Without
    the need of a displacement, one that is missing everywhere is a planned voltage.

    Raises InputError: for the first problem, in one line.
    Warns InputWarning: if samples are missing, or times scatter.
    """
    read_as = {
        "columns": {name: column.name for name, column in table.columns.items()},
        "all_columns": [series.name for series in table.source.series],
    }
    table = align_clocks(table)
    _check_lengths(table)
    table = _without_empty_ends(table)
    try:
        kind = voltage_is or require_voltage_is(table.notes.get("voltage_is", "output"))
    except InputError as error:
        raise table.error(str(error)) from error
    table, grid = _grid(table)
    is_missing = np.isnan(table.values["voltage"]) & ("time" in table.columns)
    is_missing[[0, -1] if grid.sources is None else grid.sources[[0, -1]]] = False
    if is_missing.any():
        rows = np.flatnonzero(~is_missing)
        table, grid = table.only(rows), grid.only(rows)
    if "displacement" in table.columns:
        table = _without_marks(table)
    values = {name: _convert_column(table, name) for name in table.columns if name != "time"}
    if values["voltage"].size < _MINIMUM_SAMPLES:
        raise table.error(
            f"too short, samples: {values['voltage'].size}; give at least {_MINIMUM_SAMPLES}"
        )
    _check_moving(table, "voltage", values["voltage"])
    if not need_displacement and np.isnan(values.get("displacement", 0.0)).all():
        del values["displacement"]
    if "displacement" in values:
        readings = values["displacement"][~np.isnan(values["displacement"])]
        if readings.size < _MINIMUM_SAMPLES:
            problem = f"too few readings: {readings.size}; give at least {_MINIMUM_SAMPLES}"
            raise table.error(problem, "displacement")
        _check_moving(table, "displacement", readings)
    texts = [table.notes.get(name) or "0" for name in INSTRUMENT_NOTES]
    try:
        noted = Instruments(*map(float, texts))
    except ValueError as error:  # an InputError is one
        raise table.error(f"{', '.join(INSTRUMENT_NOTES)}: {error}; correct them") from error
    held = kind == "command"
    covariates = {
        name: _without_gaps(table, grid, name, values.pop(name), held=False)
        for name in table.columns
        if name in values and name not in (*QUANTITIES, "truth")
    }
    return {
        "displacement": None,
        **{name: grid.filled(column) for name, column in values.items()},
        "covariates": covariates,
        "voltage": _without_gaps(table, grid, "voltage", values["voltage"], held),
        "interval": grid.interval,
        "start": grid.start,
        "voltage_is": kind,
        "quantities": table.quantities,
        "instruments": noted.updated(table.naming.instruments),
        "read_as": read_as,
        "origin": table.notes.get("origin") or path_text(table.source.path.name),
        "time_offset": grid.time_offset + float(table.notes.get("time_offset_s", 0.0)),
    }


def reference_fields(table: ColumnTable) -> tuple[FloatArray, float]:
    """Return a reference displacement (samples,), um, and its sampling interval, s.

    Raises InputError: for the first problem, in one line.
    """
    _check_lengths(table)
    table, grid = _grid(_without_empty_ends(table))
    values = _convert_column(table, "displacement")
    if np.isnan(values).any():
        sample = int(np.argmax(np.isnan(values)))
        raise table.error("not a number; give one at every sample", "displacement", sample)
    return _without_gaps(table, grid, "displacement", values, held=False), grid.interval


def _check_lengths(table: ColumnTable) -> None:
    first, *others = table.values
    samples = table.values[first].size
    for quantity in others:
        size = table.values[quantity].size
        if size != samples:
            problem = f"{size} values where {first} has {samples}"
            raise table.error(f"{problem}; store one per sample", quantity)
    if samples < 2:
        raise table.error(f"too short, samples: {samples}; give at least {_MINIMUM_SAMPLES}")


def _without_empty_ends(table: ColumnTable) -> ColumnTable:
    """Return the table without rows at its ends that have nothing but a time."""
    columns = [values for name, values in table.values.items() if name != "time"]
    filled = np.flatnonzero(np.any([~np.isnan(values) for values in columns], axis=0))
    if not filled.size or filled[-1] + 1 - filled[0] == columns[0].size:
        return table
    rows = np.arange(filled[0], filled[-1] + 1)
    count = columns[0].size - rows.size
    remark = f"{count} row{'s' * (count > 1)} without a voltage or displacement at an end left out"
    warnings.warn(str(table.error(remark)), InputWarning, stacklevel=4)
    return table.only(rows)


def _without_marks(table: ColumnTable) -> ColumnTable:
    """Return the table without readings that mark missing ones, such as inf, -9999 or 1e30.

    A finite mark is a repeated number that is farther from all other readings than these are from
    each other, mostly at voltages within the range at which the others were read.
    """
    voltage = table.values["voltage"]
    readings = np.array(table.values["displacement"], dtype=np.float64)
    is_finite = np.isfinite(readings)
    if (is_infinite := np.isinf(readings)).any():
        count = int(np.count_nonzero(is_infinite))
        remark = f"inf {count} time{'s' * (count > 1)}, no number, is taken as missing"
        where = int(np.argmax(is_infinite))
        warnings.warn(str(table.error(remark, "displacement", where)), InputWarning, stacklevel=4)
        readings[is_infinite] = np.nan
    levels, counts = np.unique(readings[is_finite], return_counts=True)
    center = np.median(levels / 2) if levels.size else 0.0
    farthest = np.argsort(-np.abs(levels / 2 - center))
    for mark in levels[farthest][counts[farthest] > 1]:
        is_mark = readings == mark
        is_other = is_finite & ~is_mark
        if np.count_nonzero(is_other) < _MINIMUM_SAMPLES:
            break
        # Halve all numbers: the difference of the largest ones could overflow.
        others, volts = readings[is_other] / 2, voltage[is_other]
        distance = max(others.min() - mark / 2, mark / 2 - others.max())
        inside = (voltage[is_mark] >= volts.min()) & (voltage[is_mark] <= volts.max())
        if not (distance > np.ptp(others) > 0 and np.mean(inside) > 0.5):
            break
        count, sample = int(np.count_nonzero(is_mark)), int(np.argmax(is_mark))
        remark = f"{mark:g} {count} times, far from all other readings, is taken as missing"
        warnings.warn(str(table.error(remark, "displacement", sample)), InputWarning, stacklevel=4)
        readings[is_mark] = np.nan
        is_finite = is_other
    return replace(table, values={**table.values, "displacement": readings})


def _check_moving(table: ColumnTable, quantity: str, values: FloatArray) -> None:
    extent = float(np.ptp(values))
    if extent == 0:
        problem = f"constant at {values[0]:g}; give a record in which it moves"
        raise table.error(problem, quantity)
    if extent < 1e-9 and table.quantities.are_default:  # V or um
        problem = f"moves by {extent:.3g} at most, which is absurdly little; check the unit"
        raise table.error(problem, quantity)


def _convert_column(table: ColumnTable, quantity: str) -> FloatArray:
    """Convert a column to the package's unit; refuse numbers not finite or absurdly large."""
    column = table.values[quantity]
    largest = 1e12 if quantity == "time" else 1e9  # s; V or um, whatever the actuator
    if not table.quantities.are_default and quantity != "time":
        largest = 1e100
    with np.errstate(all="ignore"):
        values = table.convert(np.asarray(column, dtype=np.float64), quantity)
        refused = ~(np.abs(values) <= largest)
    if quantity == "displacement":
        refused &= ~np.isnan(values)
    if refused.any():
        sample = int(np.argmax(refused))
        raw = column[sample]
        problem = f"{raw:g} is absurdly large; check the unit in the column's name"
        if not np.isfinite(raw):
            fact = "no number (empty or nan)" if np.isnan(raw) else f"{raw} is not a finite number"
            problem = f"{fact}; give one, or leave the sample out (a displacement may be nan)"
        raise table.error(problem, quantity, sample)
    return values


def _grid(table: ColumnTable) -> tuple[ColumnTable, Grid]:
    if "time" in table.columns:
        return time_grid(table, _convert_column(table, "time"))
    name, column = next(iter(table.columns.items()))
    stated, start, _ = column.clock or Clock(0.0)
    interval = 1 / table.naming.fs if table.naming.fs else stated
    require_plausible(table, interval, table.values[name].size)
    return table, Grid(start, interval)


def _without_gaps(
    table: ColumnTable, grid: Grid, quantity: str, values: FloatArray, held: bool
) -> FloatArray:
    """Return a column at all times of the grid; hold or interpolate it where samples are missing.

    An interpolation fills a gap if it is right elsewhere to 1% of the range: the line between both
    ends, else a polynomial, else the line if no value between ends as far apart lies beyond both.

    Raises InputError: the column is interpolated, and no interpolation is right elsewhere.
    """
    positions, sources = grid.positions, grid.sources
    if positions is None or sources is None:
        return values
    values, steps = grid.filled(values)[positions], np.diff(positions)
    samples = int(positions[-1]) + 1
    if held:
        full = np.repeat(values, np.append(steps, 1))
    else:
        full = np.interp(np.arange(samples), positions, values)
    for missing in () if held else np.unique(steps[steps > 1] - 1)[::-1].tolist():
        ends = np.array([values[: -missing - 1], values[missing + 1 :]])
        places = np.unique(np.linspace(1, missing, 9).astype(np.int64))
        inside = np.array([values[i : i + ends.shape[1]] for i in places])
        share = places[:, np.newaxis] / (missing + 1)
        errors = np.abs(inside - (1 - share) * ends[0] - share * ends[1])
        if errors.size and errors.max() <= 0.01 * np.ptp(values):
            continue
        # Hysteresis depends on extrema alone: measure by how much such a gap would hide one.
        hidden = np.abs(inside - inside.clip(ends.min(axis=0), ends.max(axis=0)))
        hides_none = hidden.size > 0 and hidden.max() <= 0.01 * np.ptp(values)
        smooth = is_smooth(values, positions, missing)
        for gap in np.flatnonzero(steps == missing + 1).tolist():
            before, after = positions[gap], positions[gap + 1]
            first = np.searchsorted(positions, before - missing)
            last = np.searchsorted(positions, after + missing, side="right")
            if smooth and min(gap + 1 - first, last - gap - 1) > 0.75 * missing:
                near = positions[first:last]
                curve = np.polynomial.Polynomial.fit(
                    near, values[first:last], min(5, near.size - 1)
                )
                full[before + 1 : after] = curve(np.arange(before + 1, after))
                continue
            if hides_none:
                continue
            since = clock(grid.start + positions[gap] * grid.interval, grid.interval)
            held_too = ""
            if quantity == "voltage":
                held_too = (
                    ' (the displacement may be nan), say voltage_is = "command" if it was held'
                )
            problem = f"gap of {steps[gap] * grid.interval:.6g} s after {since} s"
            advice = f"give the {quantity} there{held_too}, or cut the record"
            problem = f"{problem}, about {missing} missing; {advice}"
            raise table.error(problem, "time", int(sources[gap + 1]))
    if count := int(np.count_nonzero(steps > 1)):
        kind = "held" if held else "interpolated"
        remark = f"{samples - values.size} samples are missing, from here on in "
        remark += f"{count} gap{'s' * (count > 1)}; the {quantity} is {kind} there"
        where = int(sources[int(np.argmax(steps > 1)) + 1])
        warnings.warn(str(table.error(remark, "time", where)), InputWarning, stacklevel=5)
    return full


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
    driven, read = table.values["voltage"], table.values["displacement"]
    # Times of the readings and the places of the nearest voltages, in samples of the voltage.
    ratio = displacement.clock.interval / interval
    times = delay / interval + ratio * np.arange(read.size, dtype=np.float64)
    samples = np.arange(driven.size)
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
    columns = {
        "voltage": replace(voltage, clock=clock),
        "displacement": replace(displacement, clock=clock),
    }
    values = {
        "voltage": driven[first : last + 1],
        "displacement": grid.filled(read.astype(np.float64)),
    }
    return replace(table, columns=columns, values=values, rows=np.arange(first, last + 1))


def select_pair(sources: Mapping[str, Source], naming: Naming) -> ColumnTable:
    """Return the columns of two files, by "voltage" and "displacement", as one table.

    Raises ColumnsError: a column or unit of either file that is not known; all of both; InputError:
    as for one file; or the files differ in their numbers of samples or in their times.
    """
    tables: dict[str, ColumnTable] = {}
    errors: list[ColumnsError] = []
    for quantity in ("displacement", "voltage"):
        source = sources[quantity]
        own_naming = naming.of_file(source, quantity)
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
    return _join_tables(tables["voltage"], tables["displacement"], naming)


def _join_tables(voltage: ColumnTable, displacement: ColumnTable, naming: Naming) -> ColumnTable:
    path, other = voltage.source.path, displacement.source.path
    reading, read = displacement.columns["displacement"], displacement.values["displacement"]
    driven = [q for q in voltage.columns if q not in ("displacement", "truth")]
    columns = {quantity: voltage.columns[quantity] for quantity in driven}
    values = {quantity: voltage.values[quantity] for quantity in driven}
    samples, readings = values["voltage"].size, read.size
    if samples != readings and reading.clock is None:
        raise InputError(
            f"{other}: {readings} displacements for {samples} voltages in {path}; give files of "
            "the same samples"
        )
    if "time" in displacement.columns:
        name = displacement.columns["time"].name
        timed = voltage if "time" in columns else displacement
        reading_times, times = (
            table.convert(table.values["time"], "time") for table in (displacement, timed)
        )
        apart = np.abs(reading_times - times) > 0.01 * np.ptp(reading_times) / reading_times.size
        if apart.any():
            sample = int(np.argmax(apart))
            raise InputError(
                f"{other}: {name}: sample {sample} is at {reading_times[sample]:.9g} s, "
                f"in {path} at {times[sample]:.9g} s; give both at the same times, or `fs=HZ` for "
                "the times"
            )
        columns["time"], values["time"] = timed.columns["time"], timed.values["time"]
    values["displacement"] = read
    columns["displacement"] = replace(reading, name=f"{other.name}: {reading.name}")
    used = {q: c for q, c in voltage.naming.columns.items() if q != "displacement"}
    if "displacement" in naming.columns:
        used["displacement"] = naming.columns["displacement"]
    alike = voltage.source.lines == displacement.source.lines
    return ColumnTable(
        replace(voltage.source, lines=voltage.source.lines if alike else ()),
        columns,
        values,
        {"origin": path_text(f"{path.name}, {other.name}"), **voltage.notes},
        replace(naming, columns=used, fs=voltage.naming.fs),
        quantities=voltage.quantities,
    )
