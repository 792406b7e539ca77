"""Configs in short: from keyword arguments, with records in memory, and models in a line.

``bwbayes.fit(record, dynamics="lag", train=(0, 12), ess=4000)`` says what a config says under
``[model]``, ``[record]`` and ``[sampling]``; it is checked by the same models and refused in the
same words. ``parameters`` and ``validation`` are tables, as in a config.

``bouc-wen; bouc-wen + quadratic; maxwell-slip(thresholds=4) + creep`` are three models: of each the
first word is the hysteresis operator, with its options in brackets; what follows after plus signs
are terms of the nonlinearity, ``creep``, linear dynamics, stages and noise, by the names that a
config gives them, or by import paths. All else stays as the config has it, but for nonlinearity and
creep, which are left out.
"""

from __future__ import annotations

import re
import tomllib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import ValidationError

from bwbayes.app.config.config import (
    ALONE,
    Config,
    ModelConfig,
    RecordConfig,
    SamplingConfig,
    validated_config,
)
from bwbayes.app.config.keys import one_line, synonyms
from bwbayes.errors import InputError, suggestion
from bwbayes.inference.noise import NOISES
from bwbayes.inference.state_space import Noise
from bwbayes.model.registry import HYSTERESIS, OPTIONS, PARTS, build_part
from bwbayes.model.spec import ModelSpec, StageSpec
from bwbayes.record.record import Record


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
        ``validation``, ``truth`` and ``certificate``. A validation is a pair (start, stop) in s,
        which is a window of the training record; another record or its file; or a table of the keys
        of [validation.NAME], in which ``record`` may be a record.
    where
        Name of the call, for errors.

    Raises InputError: a key that does not exist, or what no config can say.
    """
    tables: dict[str, Any] = {"record": {}, "model": {}, "sampling": {}}
    homes = dict.fromkeys(SamplingConfig.model_fields, "sampling")
    homes |= dict.fromkeys(RecordConfig.model_fields.keys() - {"file", "signal"}, "record")
    # Where two tables have a key of the same name, the model's counts.
    homes |= dict.fromkeys(ModelConfig.model_fields, "model")
    homes |= dict.fromkeys(("name", "seed", "parameters", "validation", "truth", "certificate"), "")
    for key, value in keys.items():
        if key not in homes:
            example = next((name for name, table in homes.items() if table == key), None)
            hint = f"give the keys of [{key}] themselves, {example} for instance"
            if example is None:
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
    return validated_config(tables, where), records


def _by_name(record: Any, where: str) -> Mapping[str, Any]:
    """Return several records by name."""
    if isinstance(record, Mapping) and record:
        return {str(name): source for name, source in record.items()}
    if not isinstance(record, list | tuple) or not record:
        _file(record, ALONE, {}, where)
    names = [
        Path(source).stem if isinstance(source, str | Path) else f"record_{number}"
        for number, source in enumerate(record, start=1)
    ]
    for name in names:
        if names.count(name) > 1:
            raise InputError(
                f"{where}: two records are called {name!r}; give a dict of names and records"
            )
    return dict(zip(names, record, strict=True))


def _table(name: str, source: Any, records: dict[str, Record], where: str) -> dict[str, Any]:
    """Return a record, or the keys of its table with ``record`` among them, as in a config."""
    table = dict(source) if isinstance(source, Mapping) else {"record": source}
    file = {"file": _file(table.pop("record"), name, records, where)} if "record" in table else {}
    return {str(key): _plain(value) for key, value in table.items()} | file


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
    match value:
        case np.ndarray() | np.generic():
            return _plain(value.tolist())
        case Mapping():
            return {str(key): _plain(item) for key, item in value.items()}
        case list() | tuple():
            return [_plain(item) for item in value]
    return value


def models_of(text: str, base: ModelConfig) -> dict[str, ModelConfig]:
    """Return the models of a line by their names, which are what was written of them.

    Raises InputError: a word that is not known, or the same model twice.
    """
    models: dict[str, ModelConfig] = {}
    for written in filter(None, (" ".join(model.split()) for model in text.split(";"))):
        name = re.sub(r"\s*\+\s*", " + ", written)
        if name in models:
            raise InputError(f"models: {name!r} is there twice; leave one out")
        try:
            models[name] = ModelConfig.model_validate(base.model_dump() | _keys_of(name, base))
        except ValidationError as error:
            raise InputError(one_line(f"models: {name!r}", error, ModelConfig)) from None
    if not models:
        raise InputError('models: names no model; write "bouc-wen; bouc-wen + quadratic"')
    return models


def _keys_of(name: str, base: ModelConfig) -> dict[str, Any]:
    """Return the keys of [model] that a model's name says; dynamics and noise may be the base's."""
    first, *others = re.split(r"\+(?![^(]*\))", name)
    match = re.fullmatch(r"\s*([^\s()+]+)\s*(?:\((.*)\))?\s*", first)
    if match is None:
        raise InputError(f"models: {name!r}: begin with an operator, see `bwbayes models`")
    operator, options = match[1], match[2] or ""
    if operator not in HYSTERESIS and ":" not in operator:
        raise InputError(f"models: {operator!r} is unknown; {suggestion(operator, HYSTERESIS)}")
    try:
        stated = tomllib.loads(f"options = {{ {options} }}")["options"]
    except (ValueError, RecursionError):
        raise InputError(
            f"models: {name!r}: cannot read {options!r}; write options as in thresholds=4"
        ) from None
    for key in stated:
        if key not in OPTIONS:
            raise InputError(f"models: {name!r}: {key} is unknown; {suggestion(key, OPTIONS)}")
    words = [term.strip() for term in others]
    stages = [name for key in PARTS if key != "hysteresis" for name in PARTS[key]]
    noises = {*NOISES}
    for word in words:
        if ":" in word:
            outside: object = build_part(f"models: {name!r}", word, {}, {})
            (noises.add if isinstance(outside, Noise) else stages.append)(word)
        elif word not in (*stages, *NOISES):
            hint = suggestion(word, [*stages, *NOISES])
            raise InputError(f"models: {name!r}: {word!r} is unknown; {hint}")
    core = StageSpec.of("hysteresis", operator, stated), StageSpec("dynamics", base.dynamics)
    spec = ModelSpec(core).with_stages(*(word for word in words if word in stages))
    noise = " + ".join(word for word in words if word in noises)
    # The course of the voltage and what was before are of the record, not of a model.
    kept: dict[str, Any] = {"hold": base.hold, "history": base.history}
    # A search found these of the base.
    kept |= {"unexplained": None, "tied": []}
    return dict.fromkeys(OPTIONS) | spec.keys | kept | {"noise": noise or base.noise}
