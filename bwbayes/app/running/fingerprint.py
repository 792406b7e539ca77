"""Which posterior a chain belongs to, and what was worked out of it, kept with the run.

Draws are stored as coordinates of one posterior: of a model, priors, bounds, fixed values, windows
and readings. Under any other they mean something else, so a chain notes the posterior it was
sampled from, and code that resumes or reads the chain compares. Settings that leave the posterior
as it is may change: names, the target and budget of the sampling, the engine (which has a check of
its own), and predictions.

Opening a run only reads files. The file with the results worked out of a chain begins with a
digest of the rest: arrays, and a text that says how dataclasses are made of them. Nothing in it is
run: only dataclasses of this package come out of it, and noises from outside that the config names.
It belongs to one state of the run; the results of another state, or of a damaged file, are worked
out again.
"""

from __future__ import annotations

import json
import platform
import sys
from collections.abc import Mapping, Sequence
from dataclasses import fields, is_dataclass
from hashlib import sha256
from importlib import import_module
from importlib.metadata import version
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bwbayes.app.config.config import CertificateConfig, dump
from bwbayes.app.fit.fitted import Run
from bwbayes.errors import InputError
from bwbayes.inference import Engine
from bwbayes.inference.parameters import COORDINATES
from bwbayes.inference.state_space import Noise
from bwbayes.record.io.formats import draft_of


def fingerprint(run: Run) -> str:
    """Return what a chain notes of its run as JSON: the posterior, and how it is sampled."""
    plan = run.plan
    return json.dumps(
        {
            "coordinates": COORDINATES,
            "seed": run.study.seed,
            "sampling.ensembles": plan.ensembles,
            "sampling.walkers": plan.walkers,
            "sampling.block": plan.block,
            **run.study.keys,
        }
    )


def require_own(run: Run, chain: Path, attributes: Mapping[str, str | int]) -> None:
    """Refuse a ``chain`` of another posterior than a folder's config and records describe.

    ``attributes`` are what the chain notes: the readings' digest, and its fingerprint.

    Raises InputError: they differ, and the text says in what; or the chain has no fingerprint.
    """
    if attributes.get("data_sha256") != run.study.sha256:
        raise InputError(f"{chain}: belongs to another record; undo the edit or start a new run")
    if "posterior" not in attributes:
        raise InputError(
            f"{chain}: does not say which priors and settings it was sampled with; start a new run"
        )
    before: dict[str, object] = json.loads(str(attributes["posterior"]))
    now: dict[str, object] = json.loads(fingerprint(run))
    differing = [key for key in before | now if before.get(key) != now.get(key)]
    if differing:
        first, *others = differing
        also = f" (also {', '.join(others)})" if others else ""
        raise InputError(
            f"{chain}: {first} was {_show(before.get(first))} when the chain was sampled, is "
            f"{_show(now.get(first))}{also}; undo the edit or start a new run"
        )


def versions(engine: Engine = "numpy") -> dict[str, str]:
    """Return the versions of what computed a result."""
    packages = ["bwbayes", "numpy", "scipy", "emcee", "arviz", "h5py"]
    packages += ["numba"] * (engine == "numba")
    return {"python": platform.python_version()} | {name: version(name) for name in packages}


def _show(value: object) -> str:
    """Write a value as a config does, more or less; a prior as a function of its arguments."""
    if isinstance(value, Mapping):
        arguments = ", ".join(f"{k} {v}" for k, v in value.items() if k != "distribution")
        return f"{value['distribution']} ({arguments})" if "distribution" in value else arguments
    return "not set" if value is None else str(value)


def state_of(run: Run) -> str:
    """Return a digest of all that a result depends on."""
    depends = (
        # A certificate's statements about the measurement may be written afterwards.
        dump(run.config.model_copy(update={"certificate": CertificateConfig()})),
        run.study.digests,
        versions(run.study.engine),
        run.chain.attributes(),
        run.chain.steps("sampling"),
    )
    return sha256(json.dumps(depends, sort_keys=True).encode()).hexdigest()


def save(path: Path, state: str, values: Mapping[str, object]) -> None:
    """Write what was worked out of a run in that state."""
    arrays: dict[str, NDArray[Any]] = {}
    text = json.dumps({"state": state, "values": _text_of(values, arrays)})
    content, members = BytesIO(), dict[str, Any](text=np.array(text), **arrays)
    np.savez(content, **members)
    with draft_of(path) as draft:
        draft.write_bytes(sha256(content.getvalue()).digest() + content.getvalue())


def load(path: Path, state: str) -> dict[str, Any] | None:
    """Return what was kept of a run in that state; None if there is none, or it is damaged."""
    try:
        digest, content = (file_bytes := path.read_bytes())[:32], file_bytes[32:]
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
    inside = module.startswith("bwbayes.")
    # A noise from outside is loaded by now, since the config names it.
    cls = getattr(import_module(module) if inside else sys.modules.get(module), name)
    if not isinstance(cls, type) or _names_of(cls) is None:
        raise ValueError(f"{value['class']} is no dataclass")
    if not (inside or issubclass(cls, Noise)):
        raise ValueError(f"{value['class']} is no class of this package")
    return cls(**items)


def _names_of(kind: type) -> Sequence[str] | None:
    """Return the names of what a dataclass or named tuple is made of; None of another class."""
    if is_dataclass(kind):
        return [item.name for item in fields(kind) if item.init]
    return getattr(kind, "_fields", None)
