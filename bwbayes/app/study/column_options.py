"""A file beside a run, read as the run's record was: the same columns, in the same units.

A run stores its record under the package's own names. It notes how the columns of the original file
were read, and the names of all of them: a file that has no others is of the same kind.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from bwbayes.app.config.settings import RecordConfig
from bwbayes.model.inputs import VoltageIs
from bwbayes.quantities import Quantities
from bwbayes.record import Record
from bwbayes.record.io.columns import Naming
from bwbayes.record.io.formats import read_source
from bwbayes.record.io.series import Source

# Options by which another file of the same columns is read, too.
KEPT = ("units", "fs", "voltage_is", "input", "output", "linearity")


def record_naming(source: RecordConfig, record: Record) -> dict[str, Any] | None:
    """Return what to note of how a record was read from its file, if anything."""
    stated = {
        key: getattr(source, key)
        for key in (*KEPT, "columns", "covariates")
        if getattr(source, key) is not None
    }
    if not stated or source.file is None:
        return None
    by_key, names = Quantities.of(source.input, source.output).by_key, record.read_as["columns"]
    quantities = {key: by_key.get(key.casefold(), key) for key in source.columns or {}}
    columns = {
        key: names[quantity]
        for key, quantity in quantities.items()
        if quantity != "displacement" or source.displacement_file is None
    }
    return {**stated, "columns": columns, "all_columns": record.read_as["all_columns"]}


def open_like(
    path: str | Path, noted: Mapping[str, Any] | None, reading: Mapping[str, Any] | None = None
) -> tuple[Source, Naming, VoltageIs | None]:
    """Return a file's content, its naming and the kind of its voltage, by what was noted.

    A file that has other columns than the record had is named by itself. It may lack some, as a
    planned voltage lacks the displacement. The user's own ``reading``, keyword arguments of
    ``read_record``, comes first: with columns, units or a rate no note counts.

    Raises InputError: the file cannot be read, or the user's reading is wrong.
    """
    options = {key: value for key, value in (reading or {}).items() if value not in (None, {})}
    source, noted = read_source(Path(path), options.get("table")), noted or {}
    # The same quantities in whatever columns.
    options = {key: noted[key] for key in ("input", "output") if key in noted} | options
    names = {series.name for series in source.series}
    is_like = bool(noted) and names <= {*noted.get("all_columns", ())}
    if is_like and not options.keys() & {"columns", "units", "fs"}:
        columns = {q: name for q, name in noted.get("columns", {}).items() if name in names}
        further = Naming(covariates=noted.get("covariates", ())).covariate_columns
        covariates = {name: column for name, column in further.items() if column in names}
        kept = {key: noted[key] for key in noted if key in KEPT}
        options = {"covariates": covariates} | kept | options | {"columns": columns}
    voltage_is = options.pop("voltage_is", None)
    return source, Naming.stated(**options), voltage_is
