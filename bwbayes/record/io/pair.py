"""A record in two files: one has the voltage, the other the displacement of the same samples.

Each file has one column, or several of which one is chosen as in any file, with or without times.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from bwbayes.errors import ColumnsError, InputError, path_text
from bwbayes.record.io.columns import ColumnTable, Naming, select
from bwbayes.record.io.recognition import likeness, rises
from bwbayes.record.io.series import Source
from bwbayes.record.io.units import QUANTITIES


def select_pair(sources: Mapping[str, Source], naming: Naming) -> ColumnTable:
    """Return the columns of two files, by "voltage" and "displacement", as one table.

    Raises
    ------
    ColumnsError
        A column or unit of either file that is not known; all of both.
    InputError
        As for one file; or the files differ in their numbers of samples or in their times.
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
