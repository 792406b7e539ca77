"""From a config to the parts of an actuator, fitted or on the stand, and back to explicit words."""

from __future__ import annotations

from collections.abc import Sequence

from bwbayes.app.config.config import ActuatorConfig, Config, ModelConfig
from bwbayes.errors import InputError
from bwbayes.model.actuator import Actuator
from bwbayes.model.creep import Creep, creep_times
from bwbayes.model.gain import PolynomialGain
from bwbayes.model.linear import Hold
from bwbayes.model.operator import Operator, Span
from bwbayes.model.operators.bouc_wen import BoucWen
from bwbayes.model.registry import HYSTERESIS, OPTIONS, made
from bwbayes.record import Record
from bwbayes.record.teststand import VirtualTestStand
from bwbayes.record.waveforms import Waveform

__all__ = ["actuator_of", "explicit_model", "in_words", "planned", "recoverable", "stand_of"]


def actuator_of(model: ActuatorConfig, record: Record, records: Sequence[Record]) -> Actuator:
    """Put the actuator together that a config asks for; ``auto`` and ``true`` ask the record.

    Gain and creep count from the voltages of all ``records`` of the actuator.

    Raises
    ------
    InputError
        A part that does not exist, or an option that it does not have.
    """
    hold: Hold = "zero" if record.voltage_is == "command" else "first"
    if isinstance(model, ModelConfig) and model.hold != "auto":
        hold = model.hold
    ranges = [record.range_voltage for record in records]
    span = Span(min(low for low, _ in ranges), max(high for _, high in ranges))
    stated = {name: getattr(model, name) for name in OPTIONS}
    options = {name: tuple(v) if isinstance(v, list) else v for name, v in stated.items()}
    creep = None
    if model.creep:
        times = model.creep
        if times is True:
            shortest = min(record.interval for record in records)
            times = list(creep_times(shortest, max(record.duration for record in records)))
        creep = Creep(tuple(times), model.creep_growth, span)
    elif model.creep_growth:
        raise InputError("model.creep_growth: there is no creep; give creep = true with it")
    return Actuator(
        model.dynamics,
        hold,
        record.interval,
        made("model.hysteresis", model.hysteresis, HYSTERESIS, options, Operator),
        PolynomialGain(tuple(model.gain), span) if model.gain else None,
        creep,
        span,
    )


def explicit_model(model: ModelConfig, actuator: Actuator) -> ModelConfig:
    """Return what a config says of the model with all that it left open but the hold.

    The hold stays: another record has its own.
    """
    operator = actuator.hysteresis
    chosen = {name: getattr(operator, name) for name in OPTIONS if hasattr(operator, name)}
    options = {name: list(v) if isinstance(v, tuple) else v for name, v in chosen.items()}
    creep = list(actuator.creep.times) if actuator.creep else False
    return model.model_copy(update={"creep": creep, **options})


def in_words(model: ModelConfig) -> str:
    """Return which parts a model has, in a line."""
    parts = [model.hysteresis]
    if model.gain:
        parts.append(f"{' and '.join(model.gain)} gain")
    if model.creep:
        parts.append("creep that grows with the voltage" if model.creep_growth else "creep")
    return f"{', '.join(parts)}, dynamics {model.dynamics}, {model.hold} hold"


def planned(waveform: Waveform, rate: float, stop: float | None) -> Record:
    """Return the part of a signal's command, up to ``stop`` in s, that a training record has."""
    record = Record(waveform.sample(rate)[1], None, 1 / rate, voltage_is="command")
    return record if stop is None else record.upto(stop)


def stand_of(config: Config, training: Sequence[Record]) -> VirtualTestStand:
    """Return the virtual stand that a config asks for.

    Gain and creep count from the range of the ``training`` records' voltages, as in a fit to them,
    so that a fit can recover their true values.

    Raises
    ------
    InputError
        A part that does not exist, an option that it does not have, or a true value of no parameter
        of the actuator.
    """
    stand = config.stand
    try:
        actuator = actuator_of(stand.model, training[0], training)
    except InputError as error:
        raise InputError(f"stand.{error}") from None
    return VirtualTestStand(
        stand.discrepancy, stand.sample_rate, actuator=actuator, true=stand.parameters
    )


def recoverable(stand: VirtualTestStand, fitted: Actuator) -> dict[str, float]:
    """Return the true values, except those that mean something else in a fitted actuator.

    Parts that differ may have parameters of the same name.
    """
    other = set[str]()
    parts = stand.actuator.hysteresis, fitted.hysteresis
    # Whether Bouc-Wen hysteresis is passive says where its parameters may lie, not what they mean.
    if parts[0] != parts[1] and not all(isinstance(part, BoucWen) for part in parts):
        other |= {declared.name for declared in fitted.hysteresis.parameters}
    creeps = stand.actuator.creep, fitted.creep
    if creeps[0] and creeps[1] and creeps[0].times != creeps[1].times:
        other |= {declared.name for declared in creeps[1].parameters}
    return {name: value for name, value in stand.parameters().items() if name not in other}
