"""What the model may lack: another value of a key of [model], with the evidence of that model."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from itertools import product
from types import MappingProxyType
from typing import Any

import numpy as np

from bwbayes.diagnosis.scene import Explanation, Scene
from bwbayes.inference import map_estimate as pointfit
from bwbayes.inference.noise import DiscrepancyNoise

__all__ = ["creep", "dynamics", "hold", "nonlinearity", "operator", "smooth"]

# Operators that are tried: compiled ones, each of another family.
OPERATORS = ("bouc-wen", "bouc-wen-asymmetric", "prandtl-ishlinskii", "duhem")


def nonlinearity(scene: Scene) -> Iterator[Explanation]:
    """Try quadratic and cubic terms of the voltage."""
    gain = scene.posterior.only.actuator.gain
    present = set(gain.terms) if gain else set()
    for terms in (["quadratic"], ["cubic"], ["quadratic", "cubic"]):
        if not present.issuperset(terms) and present.issubset(terms):
            yield from _changed(scene, f"{' and '.join(terms)} nonlinearity", {"gain": terms})


def creep(scene: Scene) -> Iterator[Explanation]:
    """Try slow lags."""
    if scene.posterior.only.actuator.creep is None:
        yield from _changed(scene, "creep", {"creep": True})


def dynamics(scene: Scene) -> Iterator[Explanation]:
    """Try a mass on a spring; readings show the ratios of its parameters alone."""
    if scene.posterior.only.actuator.dynamics == "second-order":
        return
    frequency = 10 / scene.turn_time
    stiffness = {"distribution": "lognormal", "median": (2 * np.pi * frequency) ** 2, "sigma": 2.0}
    damping = {"distribution": "lognormal", "median": 2 * np.pi * frequency, "sigma": 2.0}
    yield from _changed(
        scene,
        "second-order dynamics",
        {"dynamics": "second-order"},
        parameters={
            "mass": {"fixed": 1.0},
            "stiffness": {"prior": stiffness},
            "damping": {"prior": damping},
        },
        starts=[{"stiffness": z, "damping": z / 2 - 1} for z in (-1.0, 0.0, 0.5, 1.0, 1.5, 2.0)],
    )


def hold(scene: Scene) -> Iterator[Explanation]:
    """Try the other thing that the voltage may do between samples."""
    other = "first" if scene.posterior.only.actuator.hold == "zero" else "zero"
    text = "voltage that is held between samples"
    if other == "first":
        text = "voltage that changes steadily between samples"
    yield from _changed(scene, text, {"hold": other}, "hold")


def operator(scene: Scene) -> Iterator[Explanation]:
    """Try other hysteresis operators."""
    present = type(scene.posterior.only.actuator.hysteresis)
    for name in OPERATORS:
        changes = {"hysteresis": name}
        posterior = scene.rebuilt(changes)
        if posterior is None or type(posterior.only.actuator.hysteresis) is present:
            continue
        fit = scene.extended(
            posterior=posterior, places=pointfit.fit(posterior, scene.generator).optima
        )
        text = f"another operator, {name}"
        yield scene.explained(f"operator {name}", text, _lines(changes), fit, changes=changes)


def smooth(scene: Scene) -> Iterator[Explanation]:
    """Try a discrepancy without corners, in place of a rough one."""
    if isinstance(scene.posterior.only.noise, DiscrepancyNoise):
        yield from _changed(scene, "a smooth discrepancy", {"noise": "smooth"})


def _changed(
    scene: Scene,
    text: str,
    changes: Mapping[str, object],
    kind: str = "",
    parameters: Mapping[str, Mapping[str, Any]] = MappingProxyType({}),
    starts: Sequence[Mapping[str, float]] = ({},),
) -> Iterator[Explanation]:
    """Fit the changed model from the mode; its new parameters start at their priors' medians."""
    posterior = scene.rebuilt(changes, parameters)
    if posterior is None:
        return
    places = []
    for coordinates, start in product(scene.places, starts):
        values = {**dict(zip(scene.posterior.names, coordinates, strict=True)), **start}
        places.append([values.get(name, 0.0) for name in posterior.names])
    fit = scene.extended(posterior=posterior, places=np.array(places))
    fix = _lines(changes)
    if parameters:
        fix += f", with what is known of {', '.join(parameters)} in [parameters]"
    yield scene.explained(kind or text, text, fix, fit, changes=changes, parameters=parameters)


def _lines(changes: Mapping[str, object]) -> str:
    """Return the lines of config that change a model."""
    lines = ", ".join(f"{key} = {json.dumps(value)}" for key, value in changes.items())
    return f"set {lines} in [model]"
