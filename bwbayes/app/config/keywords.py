"""A config from keyword arguments: the keys of all its tables side by side, and records in memory.

``bwbayes.fit(record, dynamics="lag", train=(0, 12), ess=4000)`` says what a config says under
``[model]``, ``[record]`` and ``[sampling]``; it is checked by the same models and refused in the
same words. ``parameters`` and ``validation`` are tables, as in a config.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import BaseModel

from bwbayes.app.config.config import ALONE, Config, checked
from bwbayes.app.config.keys import synonyms
from bwbayes.app.config.settings import ModelConfig, RecordConfig, SamplingConfig
from bwbayes.errors import InputError, suggestion
from bwbayes.record.record import Record

__all__ = ["config_of"]


def config_of(
    record: Record | str | Path | Sequence[Any] | Mapping[str, Any],
    keys: Mapping[str, Any],
    where: str = "fit",
) -> tuple[Config, dict[str, Record]]:
    """Return the config of records and of keyword arguments, and the records in memory by name.

    Parameters
    ----------
    record
        The training record, or its file; several of them, fitted jointly, as a list or as a dict by
        name, in which a record may be a table of the keys of [record.NAME] with ``record`` the
        record itself. In a list a file's record is called as the file is, others record_1,
        record_2, ... Keys of [record] beside count for all that do not say otherwise.
    keys
        Keys of a config's [record], [model] and [sampling], and ``name``, ``seed``, ``parameters``,
        ``validation`` and ``truth``. A validation is a pair (start, stop) in s, which is a window
        of the training record; another record or its file; or a table of the keys of
        [validation.NAME], in which ``record`` may be a record.
    where
        What is called, for errors.

    Raises
    ------
    InputError
        A key that does not exist, or what no config can say.
    """
    keyed: dict[str, type[BaseModel]] = {
        "sampling": SamplingConfig,
        "record": RecordConfig,
        "model": ModelConfig,  # the last of two tables with a key of the same name counts
    }
    homes = {key: table for table, kind in keyed.items() for key in kind.model_fields}
    homes |= dict.fromkeys(("name", "seed", "parameters", "validation", "truth"), "")
    del homes["file"], homes["signal"]
    tables: dict[str, Any] = {"record": {}, "model": {}, "sampling": {}}
    for key, value in keys.items():
        if key in keyed:
            example = next(iter(keyed[key].model_fields))
            hint = f"give the keys of [{key}] themselves, {example} for instance"
            raise InputError(f"{where}: {key}: unknown key; {hint}")
        if key not in homes:
            hint = suggestion(key, [*homes], synonyms(Config))
            raise InputError(f"{where}: {key}: unknown key; {hint}")
        (tables[homes[key]] if homes[key] else tables)[key] = _plain(value)
    records: dict[str, Record] = {}
    if isinstance(record, Record | str | Path):
        tables["record"]["file"] = _file(record, ALONE, records, where)
    else:
        tables["record"] = {
            name: tables["record"] | _table(name, training, records, where)
            for name, training in _by_name(record, where).items()
        }
    validations = keys.get("validation")
    for name, held_out in validations.items() if isinstance(validations, Mapping) else ():
        if isinstance(held_out, Record | str | Path | Mapping):
            tables["validation"][str(name)] = _table(str(name), held_out, records, where)
        else:
            tables["validation"][str(name)] = {"window": _plain(held_out)}
    return checked(tables, where), records


def _by_name(record: Any, where: str) -> Mapping[str, Any]:
    """Return several records by name."""
    if isinstance(record, Mapping) and record:
        return {str(name): source for name, source in record.items()}
    if not isinstance(record, list | tuple) or not record:
        _file(record, ALONE, {}, where)
    named: dict[str, Any] = {}
    for number, source in enumerate(record, start=1):
        name = Path(source).stem if isinstance(source, str | Path) else f"record_{number}"
        if name in named:
            raise InputError(
                f"{where}: two records are called {name!r}; give a dict of names and records"
            )
        named[name] = source
    return named


def _table(name: str, source: Any, records: dict[str, Record], where: str) -> dict[str, Any]:
    """Return a record, or the keys of its table with ``record`` among them, as in a config."""
    if not isinstance(source, Mapping):
        return {"file": _file(source, name, records, where)}
    table: dict[str, Any] = _plain(source)
    if "record" in source:
        del table["record"]
        table["file"] = _file(source["record"], name, records, where)
    return table


def _file(source: Any, name: str, records: dict[str, Record], where: str) -> str:
    """Return the file of a record; of one in memory, which is noted, the name it will have."""
    if isinstance(source, Record):
        if source.displacement is None:
            raise InputError(f"{where}: {name}: has no displacement; give a measured record")
        records[name] = source
        return f"records/{name}.h5"
    if isinstance(source, str | Path):
        return str(Path(source).absolute())
    raise InputError(
        f"{where}: {name}: {type(source).__name__} is not a record; make one with "
        "Record.from_arrays(voltage, displacement, interval=...) or Record.from_pandas(frame)"
    )


def _plain(value: Any) -> Any:
    """Return a value in the types of TOML: lists for tuples and arrays, Python's own numbers."""
    if isinstance(value, np.ndarray | np.generic):
        return _plain(value.tolist())
    if isinstance(value, Mapping):
        return {str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    return value
