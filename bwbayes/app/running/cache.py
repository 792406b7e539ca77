"""What was worked out of a chain, kept with the run: to open a run is to read files.

A file holds arrays and a text that says how dataclasses are made of them, after a digest of both.
Nothing in it is run: only dataclasses of this package come out of it. It belongs to one state of
the run; what belongs to another one, or is damaged, is worked out again.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import fields, is_dataclass
from hashlib import sha256
from importlib import import_module
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bwbayes.app.config.config import dump
from bwbayes.app.problem.problem import Problem
from bwbayes.app.running.fingerprint import versions
from bwbayes.sampling.storage import ChainFile


def state_of(problem: Problem, chain: ChainFile) -> str:
    """Return a digest of all that a result depends on."""
    depends = (
        dump(problem.config),
        problem.digests,
        versions(problem.posterior.engine),
        chain.attributes(),
        chain.steps("sampling"),
    )
    return sha256(json.dumps(depends, sort_keys=True).encode()).hexdigest()


def save(path: Path, state: str, values: Mapping[str, object]) -> None:
    """Write what was worked out of a run in that state."""
    arrays: dict[str, NDArray[Any]] = {}
    text = json.dumps({"state": state, "values": _text_of(values, arrays)})
    content = BytesIO()
    np.savez(content, allow_pickle=False, text=np.array(text), **arrays)
    draft = path.with_suffix(".partial")
    draft.write_bytes(sha256(content.getbuffer()).digest() + content.getbuffer())
    draft.replace(path)


def load(path: Path, state: str) -> dict[str, Any] | None:
    """Return what was kept of a run in that state; None if there is none, or it is damaged."""
    try:
        digest, content = (whole := path.read_bytes())[:32], whole[32:]
    except OSError:
        return None
    if sha256(content).digest() != digest:
        return None
    with np.load(BytesIO(content), allow_pickle=False) as arrays:
        text = json.loads(str(arrays["text"]))
        if text["state"] != state:
            return None
        try:
            values: dict[str, Any] = _object_of(text["values"], arrays)
        except (ImportError, AttributeError, TypeError):
            return None  # of a version whose dataclasses were others
        return values


def _text_of(value: Any, arrays: dict[str, NDArray[Any]]) -> Any:
    """Return what JSON can hold in place of a value; arrays are put aside, and named in it."""
    if isinstance(value, np.ndarray):
        name = f"array_{len(arrays)}"
        arrays[name] = value
        return {"array": name}
    if isinstance(value, np.generic):
        return value.item()
    if (names := _names_of(type(value))) is not None:
        stated = {name: getattr(value, name) for name in names}
        kind = f"{type(value).__module__}:{type(value).__qualname__}"
        return {"class": kind, "fields": _text_of(stated, arrays)["pairs"]}
    if isinstance(value, Mapping):
        pairs = [[_text_of(k, arrays), _text_of(v, arrays)] for k, v in value.items()]
        return {"pairs": pairs}
    if isinstance(value, tuple | list):
        return {type(value).__name__: [_text_of(item, arrays) for item in value]}
    return value


def _object_of(value: Any, arrays: Mapping[str, NDArray[Any]]) -> Any:
    """Return the value that a text of :func:`_text_of` stands for."""
    if not isinstance(value, dict):
        return value
    if "array" in value:
        return arrays[value["array"]]
    for kind in (tuple, list):
        if kind.__name__ in value:
            return kind(_object_of(item, arrays) for item in value[kind.__name__])
    pairs = value["fields" if "class" in value else "pairs"]
    items = {_object_of(key, arrays): _object_of(item, arrays) for key, item in pairs}
    if "class" not in value:
        return items
    module, _, name = value["class"].partition(":")
    if not module.startswith("bwbayes."):
        raise ValueError(f"{value['class']} is no class of this package")
    made = getattr(import_module(module), name)
    if not isinstance(made, type) or _names_of(made) is None:
        raise ValueError(f"{value['class']} is no dataclass")
    return made(**items)


def _names_of(kind: type) -> Sequence[str] | None:
    """Return the names of what a dataclass or named tuple is made of; None of another class."""
    if is_dataclass(kind):
        return [item.name for item in fields(kind) if item.init]
    return getattr(kind, "_fields", None)
