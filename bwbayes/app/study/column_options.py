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
from bwbayes.record.io.columns import Naming
from bwbayes.record.io.formats import read_source
from bwbayes.record.io.recognition import series_named
from bwbayes.record.io.series import Source

# Options by which another file of the same columns is read, too.
KEPT = ("units", "fs", "voltage_is", "input", "output", "linearity")


def record_naming(source: RecordConfig, folder: Path) -> dict[str, Any] | None:
    """Return what to note of how a record's file, relative to ``folder``, was read, if anything.

    Raises InputError: the file cannot be read.
    """
    stated = {
        key: getattr(source, key)
        for key in (*KEPT, "columns", "covariates")
        if getattr(source, key) is not None
    }
    if not stated or source.file is None:
        return None
    content = _content(folder / source.file, source.table)
    columns = {
        q: series_named(content, c, q).name
        for q, c in (source.columns or {}).items()
        if q != "displacement" or source.displacement_file is None
    }
    names = [item.name for item in content.series]
    return {**stated, "columns": columns, "all_columns": names}


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
    names = {item.name for item in _content(Path(path), as_stated.get("table")).series}
    if not names <= {*noted.get("all_columns", ())}:
        return as_stated
    columns = {q: name for q, name in noted.get("columns", {}).items() if name in names}
    options = {key: noted[key] for key in noted if key in KEPT}
    further = Naming(covariates=noted.get("covariates", ())).covariate_columns
    options["covariates"] = {name: column for name, column in further.items() if column in names}
    return options | as_stated | {"columns": columns}


def _content(path: Path, table: int | str | None) -> Source:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", InputWarning)  # said where the record is read
        return read_source(path, table)
