"""The keys of a config: where they are, what is said of them, and what to say where one is wrong.

A config is a pydantic model whose fields are tables and keys; :func:`key` and the docstring below
a field say what a person needs to know of it. :func:`keys` walks through a config's model and lists
them, and :func:`one_line` makes one line of what pydantic has against a config. Neither knows any
key: the models say it all.
"""

from __future__ import annotations

import types
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Annotated, Any, Literal, Union, get_args, get_origin

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, ValidationError
from pydantic.fields import FieldInfo

from bwbayes.errors import suggestion
from bwbayes.shown import brief

__all__ = [
    "ANY",
    "MEANINGS",
    "ConfigTable",
    "Key",
    "Positive",
    "Texts",
    "key",
    "keys",
    "one_line",
]

# What people call a key of a config, and its name here.
MEANINGS = {
    "draws": "ess",
    "samples": "ess",
    "chains": "ensembles",
    "iterations": "steps",
    "budget": "steps",
    "warmup": "pilot_steps",
    "burn_in": "pilot_steps",
    "path": "file",
    "data": "file",
    "filename": "file",
    "fit": "train",
    "training": "train",
    "windows": "train",
    "begin": "start",
    "end": "stop",
    "thin": "decimate",
    "downsample": "decimate",
    "skip": "exclude",
    "mask": "exclude",
    "ignore": "exclude",
    "follows": "continues",
    "value": "fixed",
    "constant": "fixed",
    "min": "lower",
    "minimum": "lower",
    "max": "upper",
    "maximum": "upper",
    "units": "unit",
    "symbol": "label",
    "rate": "sample_rate",
    "sampling_rate": "sample_rate",
    "random_seed": "seed",
    "rng": "seed",
    "priors": "parameters",
    "holdout": "validation",
    "test": "validation",
    "waveform": "signal",
    "freq": "frequency",
    "length": "duration",
}

# What stands for the name that a user gives to one of several tables of a kind.
ANY = "NAME"

Positive = Annotated[float, Field(gt=0)]

# A list of texts; a text stands for a list of one.
Texts = Annotated[
    list[str], BeforeValidator(lambda value: [value] if isinstance(value, str) else value)
]

KINDS = {str: "text", bool: "true or false", int: "whole number", float: "number", dict: "table"}


class ConfigTable(BaseModel):
    """A table of a config: it knows its keys, and takes no others."""

    __repr__ = brief

    model_config = ConfigDict(
        extra="forbid", strict=True, allow_inf_nan=False, use_attribute_docstrings=True
    )


def key(default: Any = ..., *, unit: str = "", example: str = "", **limits: Any) -> Any:
    """Return a field for a key: its default, unit, example in TOML, and limits as pydantic's.

    What it is stands below the field, as its docstring.
    """
    examples = [example] if example else None
    return Field(default, examples=examples, json_schema_extra={"unit": unit}, **limits)


@dataclass(frozen=True)
class Key:
    """A key of a config.

    ``path`` has its tables before it, with NAME where a user chooses a name. ``kind`` says in words
    what it holds, ``default`` what it is if it is not given (TOML, or words), ``example`` is TOML;
    ``unit`` is empty where there is none. ``table`` is the model of what it holds if that can be a
    table of its own.
    """

    path: str
    kind: str
    unit: str
    default: str
    example: str
    description: str
    table: type[BaseModel] | None = None

    @property
    def name(self) -> str:
        """The last part of its path."""
        return self.path.split(".")[-1]


def keys(model: type[BaseModel], tables: tuple[str, ...] = ()) -> Iterator[Key]:
    """Yield the keys of a config's model, each table before what is in it."""
    for name, field in model.model_fields.items():
        table, named = _table(field.annotation)
        path = (*tables, name, ANY) if named else (*tables, name)
        extra = field.json_schema_extra if isinstance(field.json_schema_extra, dict) else {}
        yield Key(
            path=".".join(path),
            kind=_kind(field),
            unit=str(extra.get("unit", "")),
            default=_default(field, table),
            example=str((field.examples or [""])[0]),
            description=" ".join((field.description or "").split()),
            table=table,
        )
        if table is not None:
            yield from keys(table, path)


def _parts(annotation: Any) -> Iterator[Any]:
    """Yield the branches of a union, stripped of what is said about them."""
    if get_origin(annotation) is Annotated:
        yield from _parts(get_args(annotation)[0])
    elif get_origin(annotation) in (Union, types.UnionType):
        for branch in get_args(annotation):
            yield from _parts(branch)
    else:
        yield annotation


def _table(annotation: Any) -> tuple[type[BaseModel] | None, bool]:
    """Return the model of a table that a field holds, if any, and whether users name its tables."""
    for branch in _parts(annotation):
        if isinstance(branch, type) and issubclass(branch, BaseModel):
            return branch, False
        if get_origin(branch) is dict:
            inner, _ = _table(get_args(branch)[1])
            if inner is not None:
                return inner, True
    return None, False


def _kind(field: FieldInfo) -> str:
    kinds = [_words(branch) for branch in _parts(field.annotation) if branch is not types.NoneType]
    words = " or ".join(dict.fromkeys(kinds))
    limits = [
        _limit(constraint) for constraint in (*field.metadata, *_inner_limits(field.annotation))
    ]
    return ", ".join([words, *dict.fromkeys(limit for limit in limits if limit)])


def _inner_limits(annotation: Any) -> Iterator[Any]:
    """Yield what is said about the branches of a field that are not lists."""
    for branch in get_args(annotation):
        if get_origin(branch) is Annotated:
            inner, *metadata = get_args(branch)
            if get_origin(inner) is not list:
                for constraint in metadata:
                    yield from (
                        constraint.metadata if isinstance(constraint, FieldInfo) else [constraint]
                    )


def _words(branch: Any) -> str:
    """Say what a branch holds."""
    if get_origin(branch) is Literal:
        return "one of " + ", ".join(f'"{value}"' for value in get_args(branch))
    if get_origin(branch) is list:
        inner = " or ".join(dict.fromkeys(_words(item) for item in _parts(get_args(branch)[0])))
        if inner == KINDS[str]:
            return "text or list of texts"
        return f"list of {inner}s" if not inner.startswith("list of ") else "list of [start, stop]"
    if get_origin(branch) is dict or (isinstance(branch, type) and issubclass(branch, BaseModel)):
        return KINDS[dict]
    return KINDS[branch]


def _limit(constraint: Any) -> str:
    """Say a limit of a number."""
    words = {"gt": "above", "ge": "at least", "lt": "below", "le": "at most", "multiple_of": "even"}
    for name, word in words.items():
        value = getattr(constraint, name, None)
        if value is not None and abs(value) < 2**62:
            return word if name == "multiple_of" else f"{word} {value:g}"
    return ""


def _default(field: FieldInfo, table: type[BaseModel] | None) -> str:
    """Say what a field is if it is not given."""
    if field.is_required():
        return "required"
    value = field.get_default(call_default_factory=True)
    if value is None or value == {} or table is not None:
        return "none"
    return toml_value(value)


def toml_value(value: object) -> str:
    """Write a number, text, truth or list as TOML does."""
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, str):
        return f'"{value}"'
    if isinstance(value, list):
        return f"[{', '.join(map(toml_value, value))}]"
    return f"{value}"


def one_line(where: str, error: ValidationError, root: type[BaseModel]) -> str:
    """Say the first thing that is wrong with a config: where, what, what to do."""
    errors = error.errors()
    # Unknown keys first: a misspelled key is often why another one seems to be missing. Then the
    # deepest place: the branch of a union that the user meant.
    first = min(errors, key=lambda e: (e["type"] != "extra_forbidden", -len(e["loc"])))
    names = [str(name) for name in first["loc"] if not _is_branch(str(name))]
    path = ".".join(names) or "config"
    if first["type"] == "extra_forbidden":
        hint = _home(names, root) or suggestion(names[-1], _keys_at(names[:-1], root), MEANINGS)
        return f"{where}: {path}: unknown key; {hint}"
    message = first["msg"].removeprefix("Value error, ")
    if names[-1:] == ["prior"]:
        message = 'write a table like { distribution = "normal", mean = 1.0, sd = 0.1 }'
    elif names[-1:] == ["signal"]:
        message = (
            "write a signal's name or a table like { amplitude = 100.0, frequency = 1.0, ... }"
        )
    elif first["type"] == "dict_type":
        message = f"is not a table; write [{path}.NAME] and its keys below"
    elif first["type"] == "model_type":
        message = f"is not a table; known keys are {', '.join(_keys_at(names, root))}"
    elif first["type"] == "missing":
        message = "is missing"
    got = "" if isinstance(first["input"], dict) else f", got {_shown(first['input'])}"
    return f"{where}: {path}: {message[:1].lower()}{message[1:]}{got}; correct the config"


def _home(names: list[str], root: type[BaseModel]) -> str:
    """Say where a key belongs that is known, but in another table; nothing if it is not."""
    key, table = names[-1], names[0] if len(names) > 1 else ""
    if key in root.model_fields:
        return "it belongs above the first table, or is a table of its own"
    homes = {name: _table(field.annotation) for name, field in root.model_fields.items()}
    tables = [
        name
        for name, (table_model, named) in homes.items()
        if table_model is not None
        and not named
        and key in table_model.model_fields
        and name != table
    ]
    return f"it belongs under [{tables[0]}]" if tables else ""


def _shown(value: object) -> str:
    try:
        return f"{value!r:.60}"
    except ValueError:  # Python writes no whole number of more than 4300 digits
        return "a very long number"


def _is_branch(name: str) -> bool:
    """Tell the names that pydantic gives to the branches of a union from keys."""
    return name in (
        "str",
        "float",
        "SignalConfig",
        "one record",
        "several records",
    ) or name.startswith("function-after")


def _keys_at(names: list[str], root: type[BaseModel]) -> list[str]:
    """Return the keys that exist at a place of a config."""
    model, parts = root, list(names)
    while parts:
        field = model.model_fields.get(parts.pop(0))
        table, named = _table(field.annotation) if field is not None else (None, False)
        if table is None:
            continue
        model = table
        # The name that the user chose.
        del parts[: int(named)]
    return list(model.model_fields)
