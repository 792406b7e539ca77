"""From a config to the actuator's parts, and back to a config in explicit words and numbers."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from bwbayes.app.config.config import ActuatorConfig, ModelConfig
from bwbayes.data import Record
from bwbayes.errors import InputError
from bwbayes.model.actuator import Actuator
from bwbayes.model.creep import Creep, creep_times
from bwbayes.model.gain import PolynomialGain
from bwbayes.model.linear import Hold
from bwbayes.model.operator import Operator, Span
from bwbayes.model.registry import HYSTERESIS, OPTIONS, made

__all__ = ["actuator_of", "explicit_model", "in_words"]


def actuator_of(
    model: ActuatorConfig, record: Record, every: Sequence[Record] | None = None
) -> Actuator:
    """Put the actuator together that a config asks for; ``auto`` and ``true`` ask the record.

    Gain and creep count from the voltages of ``every`` record of the actuator; by default there is
    none but this.

    Raises
    ------
    InputError
        A part that does not exist, or an option that it does not have.
    """
    hold: Hold = "zero" if record.voltage_is == "command" else "first"
    if isinstance(model, ModelConfig) and model.hold != "auto":
        hold = model.hold
    every = every or [record]
    span = Span(
        min(float(np.min(one.voltage)) for one in every),
        max(float(np.max(one.voltage)) for one in every),
    )
    return Actuator(
        model.dynamics,
        hold,
        record.interval,
        made("model.hysteresis", model.hysteresis, HYSTERESIS, _options(model), Operator),
        PolynomialGain(tuple(model.gain), span) if model.gain else None,
        _creep(model, every, span),
        span,
    )


def explicit_model(model: ModelConfig, actuator: Actuator) -> ModelConfig:
    """Return what a config says of the model with all that it left open but the hold.

    The hold stays: another record has its own.
    """
    times = list(actuator.creep.times) if actuator.creep else False
    return model.model_copy(update={"creep": times, **_chosen(actuator.hysteresis)})


def _creep(model: ActuatorConfig, every: Sequence[Record], span: Span) -> Creep | None:
    """Return the creep that a config asks for, if any; ``true`` asks the records."""
    if model.creep is False or model.creep == []:
        if model.creep_growth:
            raise InputError("model.creep_growth: there is no creep; give creep = true with it")
        return None
    shortest, longest = min(one.interval for one in every), max(one.duration for one in every)
    times = creep_times(shortest, longest) if model.creep is True else model.creep
    return Creep(tuple(times), model.creep_growth, span)


def _options(model: ActuatorConfig) -> dict[str, object]:
    """Return what the config says of the hysteresis operator beside its name."""
    given = {name: getattr(model, name) for name in OPTIONS}
    return {name: tuple(v) if isinstance(v, list) else v for name, v in given.items()}


def _chosen(operator: Operator) -> dict[str, Any]:
    """Return the options that an operator has, by name, as a config has them."""
    chosen = {name: getattr(operator, name) for name in OPTIONS if hasattr(operator, name)}
    return {name: list(v) if isinstance(v, tuple) else v for name, v in chosen.items()}


def in_words(model: ModelConfig) -> str:
    """Return which parts a model has, in a line."""
    parts = [model.hysteresis]
    if model.gain:
        parts.append(f"{' and '.join(model.gain)} gain")
    if model.creep:
        parts.append("creep that grows with the voltage" if model.creep_growth else "creep")
    return f"{', '.join(parts)}, dynamics {model.dynamics}, {model.hold} hold"
