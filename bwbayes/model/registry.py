"""Which parts there are, by the names that a config gives them.

A new part is a file of its own and a line here. A part that is not in the package goes by its
import path, ``module:Class``.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping
from functools import partial
from pkgutil import resolve_name
from typing import Any

from bwbayes.errors import InputError, suggestion
from bwbayes.model.linear import Creep, Filter, Lag, NoDynamics, SecondOrder
from bwbayes.model.nonlinearity import TERMS, PolynomialNonlinearity
from bwbayes.model.operator import Operator
from bwbayes.model.stage import Stage

HYSTERESIS: Mapping[str, Callable[..., Operator]] = {
    name: resolve_name(f"bwbayes.model.operators.{path}")
    for name, path in {
        "bouc-wen": "bouc_wen:BoucWen",
        "bouc-wen-asymmetric": "bouc_wen_asymmetric:BoucWenAsymmetric",
        "backlash-like": "duhem:BacklashLike",
        "duhem": "duhem:Duhem",
        "prandtl-ishlinskii": "prandtl_ishlinskii:PrandtlIshlinskii",
        "plays": "prandtl_ishlinskii:Plays",
        "maxwell-slip": "prandtl_ishlinskii:MaxwellSlip",
        "preisach": "preisach:Preisach",
        "krasnoselskii-pokrovskii": "preisach:KrasnoselskiiPokrovskii",
        "jiles-atherton": "pinned:JilesAtherton",
        "domain-wall": "pinned:DomainWall",
        "linear": "no_hysteresis:NoHysteresis",
    }.items()
}

# Options of a hysteresis operator beside its name: all that any of them takes.
OPTIONS = tuple(
    dict.fromkeys(
        name for maker in HYSTERESIS.values() for name in inspect.signature(maker).parameters
    )
)

DYNAMICS: Mapping[str, Callable[..., Filter]] = {
    "none": NoDynamics,
    "lag": Lag,
    "second-order": SecondOrder,
}

# Stages before and behind the hysteresis, in the order of the signal's way.
STAGES: Mapping[str, Callable[..., Stage]] = {
    stage.name: stage
    for stage in (
        resolve_name(f"bwbayes.model.stages.{path}")
        for path in (
            "lags:Delay",
            "lags:AmplifierLag",
            "amplifier_limits:SlewLimit",
            "amplifier_limits:Saturation",
            "gain:TemperatureWidth",
            "gain:LoadWidth",
            "gain:Temperature",
            "gain:Load",
            "gain:Heating",
            "gain:MovingGain",
            "backlash:Backlash",
            "backlash:SeriesPlays",
            "lags:SensorLag",
            "sensor:SensorCurve",
            "sensor:ReversedSign",
            "gain:TemperatureOffset",
            "gain:LoadOffset",
            "additions:Drift",
            "additions:Transient",
            "additions:OffsetStep",
            "additions:Oscillation",
        )
    )
}

# All of these by the key of a config's [model] that chooses them, in the order of the signal's way.
PARTS: Mapping[str, Mapping[str, Callable[..., Any]]] = {
    "hysteresis": HYSTERESIS,
    "nonlinearity": {name: partial(PolynomialNonlinearity, (name,)) for name in TERMS},
    "creep": {"creep": partial(Creep, tuple(10.0**n for n in range(-2, 6)), growing=True)},
    "dynamics": DYNAMICS,
    "stages": STAGES,
}


def _maker_of[Part](
    where: str, name: str, registry: Mapping[str, Callable[..., Part]]
) -> Callable[..., Part]:
    if name in registry:
        return registry[name]
    if ":" not in name:
        raise InputError(f"{where}: {name!r} is unknown; {suggestion(name, registry)}")
    try:
        maker: Callable[..., Part] = resolve_name(name)
    except Exception as error:  # a module from outside may raise anything
        reason = f"{type(error).__name__}: {error}"
        module = name.partition(":")[0]
        raise InputError(
            f"{where}: cannot import {name!r} ({reason}); write module:Class, and make sure that "
            f"`python -c 'import {module}'` works where you run this"
        ) from None
    if not callable(maker):
        raise InputError(f"{where}: {name!r} is not a class; write module:Class")
    return maker


def build_part[Part](
    where: str,
    name: str,
    registry: Mapping[str, Callable[..., Part]],
    options: Mapping[str, Any],
    kind: type | None = None,
) -> Part:
    """Return the part of that name or import path, with those ``options`` that are not None.

    Raises
    ------
    InputError
        No part has that name, or nothing can be imported from that path; the part does not take an
        option, cannot be made, or is not of the ``kind`` that is asked for. ``where`` says where.
    """
    maker = _maker_of(where, name, registry)
    arguments = {key: value for key, value in options.items() if value is not None}
    takes = inspect.signature(maker).parameters
    for key in arguments:
        if key not in takes:
            raise InputError(f"{where}: {name!r} has no option {key}; remove it")
    if name in registry:
        return maker(**arguments)
    try:
        component = maker(**arguments)
    except TypeError as error:  # an abstract method is missing, or an argument has no default
        raise InputError(f"{where}: {name!r} cannot be made: {error}; complete it") from None
    if kind is not None and not isinstance(component, kind):
        raise InputError(
            f"{where}: {name!r} makes a {type(component).__name__}, which is not a "
            f"{kind.__module__}.{kind.__name__}; derive it from that"
        )
    if isinstance(component, Operator):
        names = [declared.name for declared in component.parameters]
        if len(set(names)) < len(names):
            raise InputError(f"{where}: {name!r} declares a parameter twice: {', '.join(names)}")
        if names[-1:] != ["initial"] or component.parameters[-1].scope != "record":
            raise InputError(
                f'{where}: {name!r} declares {", ".join(names)}; the last must be "initial", with '
                'scope = "record": the state before a record'
            )
    return component
