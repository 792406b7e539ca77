"""What is wrong with a config, in one line: where, what, and what to do.

A key that does not exist is answered with the key that is meant, if it is a near one or a name that
other programs have for it, or with the table that it belongs to.
"""

from __future__ import annotations

from collections.abc import Mapping

from pydantic import BaseModel, ValidationError

from bwbayes.errors import suggestion

__all__ = ["MEANINGS", "in_words"]

Tables = Mapping[str, type[BaseModel]]

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


def in_words(where: str, error: ValidationError, config: type[BaseModel], tables: Tables) -> str:
    """Say the first thing that is wrong: where, what, what to do.

    Parameters
    ----------
    where
        What is checked: a file's name, for instance.
    error
        What pydantic says of it.
    config, tables
        The model of the whole, and those of its tables by their names.
    """
    found = error.errors()
    # Unknown keys first: a misspelt key is often why another one seems to be missing. Then the
    # deepest place: the branch of a union that the user meant.
    first = min(found, key=lambda e: (e["type"] != "extra_forbidden", -len(e["loc"])))
    place = [str(part) for part in first["loc"] if not _is_branch(str(part))]
    path = ".".join(place) or "config"
    if first["type"] == "extra_forbidden":
        hint = _home(place, config, tables) or suggestion(
            place[-1], _keys_at(place[:-1], config, tables), MEANINGS
        )
        return f"{where}: {path}: unknown key; {hint}"
    message = first["msg"].removeprefix("Value error, ")
    if place[-1:] == ["prior"]:
        message = 'write a table like { distribution = "normal", mean = 1.0, sd = 0.1 }'
    elif place[-1:] == ["signal"]:
        message = (
            "write a signal's name or a table like { amplitude = 100.0, frequency = 1.0, ... }"
        )
    elif first["type"] == "dict_type":
        message = f"is not a table; write [{path}.NAME] and its keys below"
    elif first["type"] == "model_type":
        message = f"is not a table; known keys are {', '.join(_keys_at(place, config, tables))}"
    elif first["type"] == "missing":
        message = "is missing"
    got = "" if isinstance(first["input"], dict) else f", got {_shown(first['input'])}"
    return f"{where}: {path}: {message[:1].lower()}{message[1:]}{got}; correct the config"


def _home(place: list[str], config: type[BaseModel], tables: Tables) -> str:
    """Say where a key belongs that is known, but in another table; nothing if it is not."""
    key, table = place[-1], place[0] if len(place) > 1 else ""
    if key in config.model_fields:
        return "it belongs above the first table, or is a table of its own"
    homes = ("record", "model", "sampling", "stand")
    names = [name for name in homes if key in tables[name].model_fields and name != table]
    return f"it belongs under [{names[0]}]" if names else ""


def _shown(value: object) -> str:
    try:
        return f"{value!r:.60}"
    except ValueError:  # Python writes no whole number of more than 4300 digits
        return "a very long number"


def _is_branch(part: str) -> bool:
    """Tell the names that pydantic gives to the branches of a union from keys."""
    return part in ("str", "float", "SignalConfig")


def _keys_at(place: list[str], config: type[BaseModel], tables: Tables) -> list[str]:
    """Return the keys that exist at a place of a config."""
    table = config
    named = place[:1] in (["parameters"], ["validation"])
    for part in place[:1] + place[1 + named :]:
        table = tables.get(part, table)
    return list(table.model_fields)
