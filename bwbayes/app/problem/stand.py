"""The virtual stand that a config asks for, and what of its truth a fitted model can recover."""

from __future__ import annotations

from collections.abc import Sequence

from bwbayes.app.config.config import Config
from bwbayes.app.problem.model import actuator_of
from bwbayes.data import Record
from bwbayes.data.teststand import VirtualTestStand
from bwbayes.data.waveforms import Waveform
from bwbayes.errors import InputError
from bwbayes.model.actuator import Actuator
from bwbayes.model.operators.bouc_wen import BoucWen

__all__ = ["planned", "recoverable", "stand_of"]


def planned(config: Config, waveform: Waveform, stop: float | None) -> Record:
    """Return the part of a signal's command, up to ``stop`` in s, that a training record has."""
    rate = config.stand.sample_rate
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
    try:
        actuator = actuator_of(config.stand.model, training[0], training)
    except InputError as error:
        raise InputError(f"stand.{error}") from None
    stand = config.stand
    return VirtualTestStand(
        stand.discrepancy, stand.sample_rate, actuator=actuator, true=stand.parameters
    )


def recoverable(stand: VirtualTestStand, fitted: Actuator) -> dict[str, float]:
    """Return the true values, except those that mean something else in a fitted actuator.

    Parts that differ may have parameters of the same name.
    """
    simulated, other = stand.actuator, set[str]()
    # Whether Bouc-Wen hysteresis is passive says where its parameters may lie, not what they mean.
    both_bouc_wen = isinstance(simulated.hysteresis, BoucWen) and isinstance(
        fitted.hysteresis, BoucWen
    )
    if not both_bouc_wen and simulated.hysteresis != fitted.hysteresis:
        other |= {declared.name for declared in fitted.hysteresis.parameters}
    if simulated.creep and fitted.creep and simulated.creep.times != fitted.creep.times:
        other |= {declared.name for declared in fitted.creep.parameters}
    return {name: value for name, value in stand.parameters().items() if name not in other}
