"""A config as a study: its model, parameters and stand, and back to explicit words and numbers."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from bwbayes.app.config.config import Config
from bwbayes.app.config.settings import ParameterConfig
from bwbayes.errors import InputError
from bwbayes.inference.engine import resolve_engine
from bwbayes.inference.parameters import Parameter
from bwbayes.inference.study import (
    Stated,
    Study,
    TrainingRecord,
    declarations_of,
    extent_of,
)
from bwbayes.model.actuator import Actuator
from bwbayes.model.declaration import Distribution
from bwbayes.model.operators.bouc_wen import BoucWen
from bwbayes.model.spec import ModelSpec
from bwbayes.quantities import Quantities
from bwbayes.record import Record
from bwbayes.record.teststand import VirtualTestStand


def study_of(
    config: Config, records: Mapping[str, Record], training: Mapping[str, tuple[slice, ...]]
) -> Study:
    """Return what a config fits to these records, of which the ``training`` windows are fitted.

    Raises InputError: a prior that is none.
    """
    return Study(
        config.model.spec,
        {
            name: TrainingRecord(record, training[name], config.records[name].from_rest)
            for name, record in records.items()
        },
        {name: _stated(name, parameter) for name, parameter in config.parameters.items()},
        tuple(config.model.per_record),
        tuple(config.model.shared),
        resolve_engine(config.sampling.engine),
    )


def _stated(name: str, parameter: ParameterConfig) -> Stated:
    """Return what a config says of a parameter."""
    prior = None
    if parameter.prior is not None:
        arguments = {key: v for key, v in parameter.prior.items() if key != "distribution"}
        try:
            # The distribution itself refuses arguments that are not numbers.
            prior = Distribution(str(parameter.prior["distribution"]), arguments)  # type: ignore[arg-type]
        except InputError as error:
            raise InputError(f"parameters.{name}.prior: {error}") from None
    others = parameter.model_dump(exclude={"prior"})
    return Stated(prior, **others)


def with_model(
    config: Config,
    spec: ModelSpec,
    records: Mapping[str, Record],
    added: Mapping[str, Stated] | None = None,
) -> Config:
    """Return a config with another model, and of what it says of parameters what that has too.

    ``added`` is stated of parameters that the config says nothing of.
    """
    study = study_of(config, records, dict.fromkeys(records, ())).with_model(spec, added)
    declared = {declaration.name for declaration in declarations_of(study.spec, study.extent)}
    scopes = {"per_record": [*study.per_record], "shared": [*study.shared]}
    return config.model_copy(
        update={
            "model": config.model.with_spec(spec).model_copy(update=scopes),
            "parameters": {
                name: ParameterConfig(**stated.keys) for name, stated in study.stated.items()
            },
            "truth": {
                name: value
                for name, value in config.truth.items()
                if name.partition("[")[0] in declared
            },
        }
    )


def as_config(parameter: Parameter, quantities: Quantities) -> ParameterConfig:
    """Write a parameter as a config does, in explicit numbers and the quantities' units."""
    stated = Stated(
        parameter.prior,
        parameter.fixed,
        parameter.lower if np.isfinite(parameter.lower) else None,
        parameter.upper if np.isfinite(parameter.upper) else None,
        quantities.say(parameter.unit),
        parameter.label,
        parameter.description,
    )
    return ParameterConfig(**stated.keys)


def stand_of(config: Config, training: Sequence[Record]) -> VirtualTestStand:
    """Return the virtual stand that a config asks for.

    Gain and creep count from the range of the ``training`` records' voltages, as in a fit to them,
    so that a fit can recover their true values. Refused (InputError) are a part that does not
    exist, an option that it does not have, and a true value of no parameter of the actuator.
    """
    stand = config.stand
    try:
        first, extent = training[0], extent_of(training)
        actuator = stand.model.spec.actuator(first.interval, first.hold, extent)
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
    if parts[0] != parts[1] and not all(isinstance(operator, BoucWen) for operator in parts):
        other |= {declared.name for declared in fitted.hysteresis.parameters}
    if fitted.creep and stand.actuator.creep and fitted.creep.times != stand.actuator.creep.times:
        other |= {declared.name for declared in fitted.creep.parameters}
    return {name: value for name, value in stand.parameters().items() if name not in other}
