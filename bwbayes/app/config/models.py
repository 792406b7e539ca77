"""Models in a line: ``bouc-wen; bouc-wen + quadratic; maxwell-slip(thresholds=4) + creep``.

Semicolons separate models. Of each the first word is the hysteresis operator, with its options in
brackets; what follows after plus signs are terms of the gain, ``creep``, linear dynamics and noise,
by the names that a config gives them. What is not said stays as the config has it, but for gain and
creep, which are left out.
"""

from __future__ import annotations

import re
import tomllib
from typing import Any

from pydantic import ValidationError

from bwbayes.app.config.config import ModelConfig
from bwbayes.app.config.keys import one_line
from bwbayes.errors import InputError, suggestion
from bwbayes.inference.noise import NOISES
from bwbayes.model.gain import TERMS
from bwbayes.model.registry import DYNAMICS, HYSTERESIS, OPTIONS

__all__ = ["models_of", "slug"]


def models_of(text: str, base: ModelConfig) -> dict[str, ModelConfig]:
    """Return the models of a line by their names, which are what was written of them.

    Raises
    ------
    InputError
        A word that is not known, or the same model twice.
    """
    models: dict[str, ModelConfig] = {}
    for written in filter(None, (" ".join(model.split()) for model in text.split(";"))):
        name = re.sub(r"\s*\+\s*", " + ", written)
        if name in models:
            raise InputError(f"models: {name!r} is there twice; leave one out")
        try:
            models[name] = ModelConfig.model_validate(base.model_dump() | _changes(name))
        except ValidationError as error:
            raise InputError(one_line(f"models: {name!r}", error, ModelConfig)) from None
    if not models:
        raise InputError('models: names no model; write "bouc-wen; bouc-wen + quadratic"')
    return models


def slug(name: str) -> str:
    """Return the name of a model's folder."""
    return re.sub(r"[^A-Za-z0-9_.-]+", "-", name).strip("-.")


def _changes(name: str) -> dict[str, Any]:
    """Return the keys of [model] that a model's name says."""
    first, *others = re.split(r"\+(?![^(]*\))", name)
    match = re.fullmatch(r"\s*([^\s()+]+)\s*(?:\((.*)\))?\s*", first)
    if match is None:
        raise InputError(f"models: {name!r}: begin with an operator, see `bwbayes models`")
    operator, options = match[1], match[2] or ""
    if operator not in HYSTERESIS and ":" not in operator:
        raise InputError(f"models: {operator!r} is unknown; {suggestion(operator, HYSTERESIS)}")
    changes: dict[str, Any] = dict.fromkeys(OPTIONS)
    changes |= {"hysteresis": operator, "gain": [], "creep": False, "creep_growth": False}
    try:
        said = tomllib.loads(f"options = {{ {options} }}")["options"]
    except (ValueError, RecursionError):
        raise InputError(
            f"models: {name!r}: cannot read {options!r}; write options as in thresholds=4"
        ) from None
    for key in said:
        if key not in OPTIONS:
            raise InputError(f"models: {name!r}: {key} is unknown; {suggestion(key, OPTIONS)}")
    changes |= said
    for word in (term.strip() for term in others):
        if word in TERMS:
            changes["gain"] = [*changes["gain"], word]
        elif word == "creep":
            changes["creep"] = True
        elif word in DYNAMICS or word in NOISES:
            changes["dynamics" if word in DYNAMICS else "noise"] = word
        else:
            words = [*TERMS, "creep", *DYNAMICS, *NOISES]
            raise InputError(f"models: {name!r}: {word!r} is unknown; {suggestion(word, words)}")
    return changes
