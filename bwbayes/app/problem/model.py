"""From a config to the actuator's parts, and back to a config in explicit words and numbers."""

from __future__ import annotations

from collections.abc import Sequence

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
    model: ActuatorConfig, record: Record, records: Sequence[Record] | None = None
) -> Actuator:
    """Put the actuator together that a config asks for; ``auto`` and ``true`` ask the record.

    Gain and creep count from the voltages of all ``records`` of the actuator; by default there is
    none but this.

    Raises
    ------
    InputError
        A part that does not exist, or an option that it does not have.
    """
    hold: Hold = "zero" if record.voltage_is == "command" else "first"
    if isinstance(model, ModelConfig) and model.hold != "auto":
        hold = model.hold
    records = records or [record]
    span = Span(
        min(float(np.min(recorded.voltage)) for recorded in records),
        max(float(np.max(recorded.voltage)) for recorded in records),
    )
    stated = {name: getattr(model, name) for name in OPTIONS}
    options = {name: tuple(v) if isinstance(v, list) else v for name, v in stated.items()}
    return Actuator(
        model.dynamics,
        hold,
        record.interval,
        made("model.hysteresis", model.hysteresis, HYSTERESIS, options, Operator),
        PolynomialGain(tuple(model.gain), span) if model.gain else None,
        _creep(model, records, span),
        span,
    )


def explicit_model(model: ModelConfig, actuator: Actuator) -> ModelConfig:
    """Return what a config says of the model with all that it left open but the hold.

    The hold stays: another record has its own.
    """
    times = list(actuator.creep.times) if actuator.creep else False
    operator = actuator.hysteresis
    chosen = {name: getattr(operator, name) for name in OPTIONS if hasattr(operator, name)}
    options = {name: list(v) if isinstance(v, tuple) else v for name, v in chosen.items()}
    return model.model_copy(update={"creep": times, **options})


def _creep(model: ActuatorConfig, records: Sequence[Record], span: Span) -> Creep | None:
    """Return the creep that a config asks for, if any; ``true`` asks the records."""
    if model.creep is False or model.creep == []:
        if model.creep_growth:
            raise InputError("model.creep_growth: there is no creep; give creep = true with it")
        return None
    shortest, longest = (
        min(record.interval for record in records),
        max(record.duration for record in records),
    )
    times = creep_times(shortest, longest) if model.creep is True else model.creep
    return Creep(tuple(times), model.creep_growth, span)


def in_words(model: ModelConfig) -> str:
    """Return which parts a model has, in a line."""
    parts = [model.hysteresis]
    if model.gain:
        parts.append(f"{' and '.join(model.gain)} gain")
    if model.creep:
        parts.append("creep that grows with the voltage" if model.creep_growth else "creep")
    return f"{', '.join(parts)}, dynamics {model.dynamics}, {model.hold} hold"
