"""The keys of a config: where they are, what is said of them, and what to say where one is wrong.

A config is a pydantic model whose fields are tables and keys; :func:`key` and the docstring below
a field say what a person needs to know of it. :func:`keys` lists them, and :func:`one_line` makes
one line of what pydantic has against a config. Neither knows any key: the models say it all.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, Any

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, ValidationError

from bwbayes.errors import suggestion
from bwbayes.shown import brief

# The placeholder of the name that a user gives to one of several tables of a kind.
ANY = "NAME"

Positive = Annotated[float, Field(gt=0)]

# A list of texts; a text stands for a list of one.
Texts = Annotated[
    list[str], BeforeValidator(lambda value: [value] if isinstance(value, str) else value)
]


class ConfigTable(BaseModel):
    """A table of a config: it knows its keys, and takes no others."""

    __repr__ = brief

    model_config = ConfigDict(
        extra="forbid", strict=True, allow_inf_nan=False, use_attribute_docstrings=True
    )


def key(
    default: Any = ..., *, unit: str = "", example: str = "", called: str = "", **limits: Any
) -> Any:
    """Return a field for a key: its default, unit, example in TOML, and limits as pydantic's.

    ``called`` is what people call it elsewhere, words with blanks between. The field's docstring
    below it describes it.
    """
    extra: Any = {"unit": unit, "example": example, "called": called.split()}
    return Field(default, json_schema_extra=extra, **limits)


@dataclass(frozen=True)
class Key:
    """A key of a config.

    ``path`` has its tables before it, with NAME where a user chooses a name. ``kind`` says in words
    what it holds, ``default`` what it is if it is not given (TOML, or words), ``example`` is TOML;
    ``unit`` is empty where there is none; ``called`` is what people call it elsewhere. ``table``
    is the name of the model of what it holds if that can be a table of its own.
    """

    path: str
    kind: str
    unit: str
    default: str
    example: str
    description: str
    called: tuple[str, ...] = ()
    table: str | None = None

    @property
    def name(self) -> str:
        """Its name, without the tables before it."""
        return self.path.removesuffix(f".{ANY}").rpartition(".")[2]

    @property
    def parent(self) -> str:
        """The path of the table that it is in, empty at the top."""
        return self.path.removesuffix(f".{ANY}").rpartition(".")[0]


def keys(model: type[BaseModel]) -> list[Key]:
    """Return the keys of a config's model, each table before what is in it."""
    schema = model.model_json_schema()
    return list(_keys(schema, schema.get("$defs", {}), ""))


def synonyms(model: type[BaseModel]) -> dict[str, str]:
    """Return the keys of a config's model by what people call them elsewhere."""
    return {word: key.name for key in keys(model) for word in key.called}


def _keys(table: Mapping[str, Any], tables: Mapping[str, Any], parent: str) -> Iterator[Key]:
    """Yield the keys of a table's JSON schema; ``tables`` has those of all tables by name."""
    for name, field in table["properties"].items():
        branches = field.get("anyOf") or field.get("oneOf") or [field]
        references = {branch["$ref"]: name for branch in branches if "$ref" in branch}
        for branch in branches:
            values = branch.get("patternProperties", {"": branch.get("additionalProperties")})
            named = (value["$ref"] for value in values.values() if value and "$ref" in value)
            references |= {reference: f"{name}.{ANY}" for reference in named if not references}
        reference, path = next(iter(references.items()), ("", name))
        inner = reference.rpartition("/")[2] or None
        default = json.dumps(field.get("default"))  # which is TOML, too
        if name in table.get("required", ()):
            default = "required"
        elif inner is not None or default in ("null", "{}"):
            default = "none"
        kinds = [_kind(branch) for branch in branches if branch.get("type") != "null"]
        yield Key(
            path=f"{parent}{path}",
            kind=" or ".join(dict.fromkeys(kinds)),
            unit=field["unit"],
            default=default,
            example=field["example"],
            description=" ".join(field["description"].split()),
            called=tuple(field["called"]),
            table=inner,
        )
        if inner is not None:
            yield from _keys(tables[inner], tables, f"{parent}{path}.")


def _kind(branch: Mapping[str, Any]) -> str:
    """Say in words what a branch of a JSON schema holds, with its limits."""
    match branch:
        case {"enum": values}:
            return "one of " + ", ".join(f'"{value}"' for value in values)
        case {"items": {"type": "array"}}:
            return "list of [start, stop]"
        case {"items": {"type": "string"}}:
            return "text or list of texts"
        case {"items": items}:
            return f"list of {_kind(items)}s"
    types = {"string": "text", "boolean": "true or false", "integer": "whole number"}
    kind = branch.get("type", "object")
    words = [types.get(kind, "number" if kind == "number" else "table")]
    limits = {"minimum": "at least {:g}", "exclusiveMinimum": "above {:g}", "multipleOf": "even"}
    words += [text.format(branch[name]) for name, text in limits.items() if name in branch]
    return ", ".join(words)


def one_line(where: str, error: ValidationError, root: type[BaseModel]) -> str:
    """Say the first thing that is wrong with a config: where, what, what to do."""
    # Unknown keys first: a misspelled key is often why another one seems to be missing. Then the
    # deepest place: the branch of a union that the user meant.
    first = min(error.errors(), key=lambda e: (e["type"] != "extra_forbidden", -len(e["loc"])))
    # Pydantic names the branches of unions too.
    branch = re.compile("str|float|SignalConfig|one record|several records|function-after.*")
    names = [str(name) for name in first["loc"] if not branch.fullmatch(str(name))]
    path = ".".join(names) or "config"
    if first["type"] == "extra_forbidden":
        hint = suggestion(names[-1], _names_in(names[:-1], root), synonyms(root))
        homes = [key.parent for key in keys(root) if key.name == names[-1]]
        for home in [home for home in homes if home not in ("", names[0]) and "." not in home][:1]:
            hint = f"it belongs under [{home}]"
        if names[-1] in root.model_fields:
            hint = "it belongs above the first table, or is a table of its own"
        return f"{where}: {path}: unknown key; {hint}"
    message = first["msg"].removeprefix("Value error, ")
    match names[-1:], first["type"]:
        case ["prior"], _:
            message = 'write a table like { distribution = "normal", mean = 1.0, sd = 0.1 }'
        case ["signal"], _:
            message = (
                "write a signal's name or a table like { amplitude = 100.0, frequency = 1.0, ... }"
            )
        case _, "dict_type":
            message = f"is not a table; write [{path}.NAME] and its keys below"
        case _, "model_type":
            message = f"is not a table; known keys are {', '.join(_names_in(names, root))}"
        case _, "missing":
            message = "is missing"
    try:
        got = "" if isinstance(first["input"], dict) else f", got {first['input']!r:.60}"
    except ValueError:  # Python writes no whole number of more than 4300 digits
        got = ", got a very long number"
    return f"{where}: {path}: {message[:1].lower()}{message[1:]}{got}; correct it"


def _names_in(path: Sequence[str], root: type[BaseModel]) -> list[str]:
    """Return the names of the keys of the table at a path, in which there are users' names too."""
    names = keys(root)
    parents, table = {key.parent for key in names}, ""
    for name in path:
        inner = f"{table}.{name}".removeprefix(".")
        table = next((p for p in (f"{inner}.{ANY}", inner) if p in parents), table)
    return [key.name for key in names if key.parent == table]
