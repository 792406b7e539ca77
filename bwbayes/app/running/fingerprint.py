"""Which posterior a chain belongs to, and what an edited config changes of it.

Draws are stored as coordinates of one posterior: of a model, priors, bounds, fixed values, windows
and readings. Under any other they mean something else, so a chain notes the posterior it was
sampled from, and whoever goes on with the chain, or reads it, compares. What does not change the
posterior may change: names, the target and budget of the sampling, the engine (which has a check
of its own), and what is predicted.
"""

from __future__ import annotations

import json
import platform
import re
from collections.abc import Iterator, Mapping
from importlib.metadata import version
from pathlib import Path

from bwbayes.app.config.config import Config
from bwbayes.app.problem.problem import Problem
from bwbayes.errors import InputError
from bwbayes.inference.engine import Engine
from bwbayes.inference.parameters import COORDINATES


def fingerprint(config: Config) -> str:
    """Return what a chain notes of a resolved config: its keys and values, as JSON."""
    values = dict(_flat(config.model_dump(exclude_none=True)))
    # Keys that a chain does not depend on; of tables, everything in them. The record is compared by
    # its readings, not by its file's name.
    free_to_change = re.compile(
        r"(name|stand|truth|validation|sampling\.(engine|ess|steps|pilot_steps)"
        r"|record\.([^.]+\.)?(file|remarks|signal)|parameters\..*\.(label|description))(\..*)?"
    )
    noted = {key: value for key, value in values.items() if not free_to_change.fullmatch(key)}
    return json.dumps({"coordinates": COORDINATES, **noted})


def require_own(problem: Problem, chain: Path, attributes: Mapping[str, str | int]) -> None:
    """Refuse a ``chain`` of another posterior than a folder's config and records describe.

    ``attributes`` are what the chain notes: the readings' digest, and its fingerprint.

    Raises InputError: they differ, and the text says in what; or the chain has no fingerprint.
    """
    if attributes.get("data_sha256") != problem.sha256:
        raise InputError(f"{chain}: belongs to another record; undo the edit or start a new run")
    if "posterior" not in attributes:
        raise InputError(
            f"{chain}: does not say which priors and settings it was sampled with; start a new run"
        )
    before: dict[str, object] = json.loads(str(attributes["posterior"]))
    now: dict[str, object] = json.loads(fingerprint(problem.config))
    differing = [key for key in before | now if before.get(key) != now.get(key)]
    if differing:
        first, *others = differing
        also = f" (also {', '.join(others)})" if others else ""
        raise InputError(
            f"{chain}: {first} was {_shown(before.get(first))} when the chain was sampled, is "
            f"{_shown(now.get(first))}{also}; undo the edit or start a new run"
        )


def versions(engine: Engine = "numpy") -> dict[str, str]:
    """Return the versions of what computed a result."""
    packages = ["bwbayes", "numpy", "scipy", "emcee", "arviz", "h5py"]
    packages += ["numba"] * (engine == "numba")
    return {"python": platform.python_version()} | {name: version(name) for name in packages}


def version_remarks(noted: object, now: Mapping[str, str]) -> tuple[str, ...]:
    """Say, in one remark, which packages have other versions than when the chain was begun."""
    before: dict[str, str] = json.loads(str(noted)) if noted else {}
    changed = [
        f"{name} {before[name]}, now {now[name]}"
        for name in now
        if before.get(name, now[name]) != now[name]
    ]
    return (f"the chain was begun with other versions: {'; '.join(changed)}",) if changed else ()


def _flat(table: Mapping[str, object], prefix: str = "") -> Iterator[tuple[str, object]]:
    """Yield keys with their tables' names before them, and values; a prior counts as one."""
    for name, value in table.items():
        if isinstance(value, Mapping) and name != "prior":
            yield from _flat(value, f"{prefix}{name}.")
        else:
            yield f"{prefix}{name}", value


def _shown(value: object) -> str:
    """Write a value as a config does, more or less; a prior as a function of its arguments."""
    if isinstance(value, Mapping):
        arguments = ", ".join(f"{k} {v}" for k, v in value.items() if k != "distribution")
        return f"{value['distribution']} ({arguments})" if "distribution" in value else arguments
    return "not set" if value is None else str(value)
