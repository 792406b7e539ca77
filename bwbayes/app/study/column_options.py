"""A file beside a run, read as the run's record was: the same columns, in the same units.

A run stores its record under the package's own names. It notes how the columns of the original file
were read, and the names of all of them: a file that has no others is of the same kind.
"""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from bwbayes.app.config.settings import RecordConfig
from bwbayes.errors import InputWarning
from bwbayes.quantities import Quantities
from bwbayes.record import Record
from bwbayes.record.io.columns import Naming
from bwbayes.record.io.formats import read_source

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


def column_options_from(
    path: str | Path, noted: dict[str, Any] | None, reading: Mapping[str, Any] | None = None
) -> dict[str, Any]:
    """Return how a file is read, as keyword arguments of ``read_record``, by what was noted.

    None of one that has other columns than the record had. It may lack some, as a planned voltage
    lacks the displacement. The user's own ``reading``, of such arguments too, comes first: with
    columns, units or a rate no note counts.

    Raises InputError: the file cannot be read.
    """
    as_stated = {key: value for key, value in (reading or {}).items() if value not in (None, {})}
    if noted is None:
        return as_stated
    # The same quantities in whatever columns.
    as_stated = {key: noted[key] for key in ("input", "output") if key in noted} | as_stated
    if as_stated.keys() & {"columns", "units", "fs"}:
        return as_stated
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", InputWarning)  # said where the record is read
        content = read_source(Path(path), as_stated.get("table"))
    names = {series.name for series in content.series}
    if not names <= {*noted.get("all_columns", ())}:
        return as_stated
    columns = {q: name for q, name in noted.get("columns", {}).items() if name in names}
    options = {key: noted[key] for key in noted if key in KEPT}
    further = Naming(covariates=noted.get("covariates", ())).covariate_columns
    options["covariates"] = {name: column for name, column in further.items() if column in names}
    return options | as_stated | {"columns": columns}
