"""From a config to a model and its parameters, and back to explicit words and numbers.

:func:`actuator_of` puts the parts together, fitted or on the stand; :func:`parameters_of` puts the
priors, fixed values, bounds and names that a config gives before the defaults.
"""

from __future__ import annotations

import re
from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace
from itertools import chain

import numpy as np

from bwbayes.app.config.config import ALONE, Config
from bwbayes.app.config.settings import ActuatorConfig, ModelConfig, ParameterConfig
from bwbayes.arrays import FloatArray
from bwbayes.errors import InputError, suggestion
from bwbayes.inference.defaults import joined, ranges_of
from bwbayes.inference.noise import NOISES, noise_model
from bwbayes.inference.parameter_table import Column, ParameterTable
from bwbayes.inference.parameters import Parameter
from bwbayes.model.actuator import OFFSET, Actuator
from bwbayes.model.creep import MOST_TIMES, Creep, creep_times
from bwbayes.model.declaration import Context, Declaration
from bwbayes.model.distributions import Distribution
from bwbayes.model.gain import PolynomialGain
from bwbayes.model.linear import Hold
from bwbayes.model.operator import Operator, Span
from bwbayes.model.operators.bouc_wen import BoucWen
from bwbayes.model.registry import DYNAMICS, HYSTERESIS, OPTIONS, made
from bwbayes.record import Record
from bwbayes.record.teststand import VirtualTestStand


def parameters_of(
    config: Config, table: ParameterTable, contexts: Mapping[str, Context]
) -> list[Parameter]:
    """Return the parameters that a model's parts declare, in the order of θ's columns.

    ``contexts`` are those of :func:`contexts_of`.

    Raises InputError: the config says something of a parameter that the model does not have, or
    cannot have.
    """
    declarations, columns = table.declarations, table.layout
    named = [replace(column.declaration, name=column.name) for column in columns]
    _require_known("parameters", config.parameters, [*declarations, *named])
    _require_known("truth", config.truth, [*declarations, *named], elsewhere=True)
    return [
        _parameter(column, _given(config, column), contexts[column.record]) for column in columns
    ]


def _given(config: Config, column: Column) -> ParameterConfig:
    """Return what a config says of a column of θ: of it alone, or of all records' together."""
    name = column.declaration.name
    stated = config.parameters.get(column.name, config.parameters.get(name))
    if stated is not None:
        return stated
    if name == "initial":
        names = [column.record] if column.record else list(config.records)
        rested = [config.records[record].from_rest for record in names]
        if all(rested):
            return ParameterConfig(fixed=0.0)
        if any(rested):
            raise InputError(
                "model.shared: initial cannot be shared by records of which some start from rest "
                "and some do not; remove it"
            )
    return ParameterConfig()


def contexts_of(
    config: Config, records: Mapping[str, Record], training: Mapping[str, tuple[slice, ...]]
) -> dict[str, Context]:
    """Return what default priors may know of each record, by name, and ("") of all together.

    From the training windows (slices) of the records.

    Raises InputError: voltage or displacement does not vary there, in any of them.
    """
    ranges = {
        name: ranges_of(record.path.voltage, readings_of(record), record.interval, training[name])
        for name, record in records.items()
    }
    varied = [
        extents for extents in ranges.values() if extents.voltage > 0 and extents.displacement > 0
    ]
    if not varied:
        table = place_of(next(iter(records)))
        raise InputError(f"{table}.train: voltage or displacement is constant there; widen it")
    pooled = joined(varied)
    contexts = {"": Context(pooled, _stated(config))}
    for name, extents in ranges.items():
        # A record whose voltage stands still says where its sensor is, and nothing else.
        extent = extents if extents in varied else replace(pooled, middle=extents.middle)
        contexts[name] = Context(extent, _stated(config, name))
    return contexts


def place_of(name: str) -> str:
    """Return where a config speaks of a training record of that name."""
    return "record" if name == ALONE else f"record.{name}"


def readings_of(record: Record) -> FloatArray:
    """Return the displacement of a record that has one."""
    assert record.displacement is not None
    return record.displacement


def _stated(config: Config, record: str = "") -> dict[str, float | Distribution]:
    """Return what the config states of parameters, also of a record's own: values, and priors."""
    values: dict[str, float | Distribution] = {}
    for name, stated in config.parameters.items():
        plain = name.removesuffix(f"[{record}]")
        if stated.prior is not None:
            values[plain] = _distribution(name, stated.prior)
        elif stated.fixed is not None:
            values[plain] = stated.fixed
    return values


def every_declaration() -> list[Declaration]:
    """Return what all parts of the package declare, whatever the model."""
    operators = (make().parameters for make in HYSTERESIS.values())
    filters = (make().parameters for make in DYNAMICS.values())
    noises = (make(interval=1.0).declarations for make in NOISES.values())
    creep = Creep(tuple(float(t) for t in range(1, MOST_TIMES + 1)), growing=True)
    others = PolynomialGain().parameters, creep.parameters, (OFFSET,)
    return [*chain.from_iterable((*operators, *filters, *others, *noises))]


def _require_known(
    table: str,
    stated: Collection[str],
    declarations: Collection[Declaration],
    *,
    elsewhere: bool = False,
) -> None:
    """Refuse what is said of a parameter that the model has not, nor any model if ``elsewhere``."""
    names = list(dict.fromkeys(d.name for d in declarations))
    for name in [name for name in stated if name not in names]:
        if name not in {d.name for d in every_declaration()}:
            aliases = {alias: d.name for d in declarations for alias in d.aliases}
            hint = suggestion(name, names, aliases)
            raise InputError(f"{table}.{name}: no such parameter here; {hint}")
        if not elsewhere:
            raise InputError(f"{table}.{name}: is not in this model; see [model], or remove it")


def _parameter(column: Column, stated: ParameterConfig, context: Context) -> Parameter:
    """Put what the config says of a parameter before what its part declares."""
    name, declared, record = column
    prior, fixed = None, stated.fixed
    if stated.prior is not None:
        prior = _distribution(name, stated.prior)
    elif fixed is None:
        default = declared.default(context)
        if default is None:
            why = f" ({declared.without_default})" if declared.without_default else ""
            raise InputError(f"parameters.{name}: has no default prior; give prior or fixed{why}")
        if isinstance(default, Distribution):
            prior = default
        else:
            fixed = default
    for value in (fixed or 0.0, *(prior.arguments.values() if prior else ())):
        # The model's products and quotients could not hold it.
        if value and not 1e-60 < abs(value) < 1e60:
            raise InputError(f"parameters.{name}: {value:g} is out of proportion; check its unit")
    unit = declared.unit_in(context.stated)
    if stated.unit is not None and re.sub("[µμ]", "u", stated.unit) != unit:
        raise InputError(
            f"parameters.{name}.unit: its numbers are in {unit}, not {stated.unit}; convert them"
        )
    above = record.replace("_", r"\_")
    return Parameter(
        name,
        stated.unit or unit,
        stated.label or declared.label + (rf"^{{\mathrm{{{above}}}}}" if record else ""),
        stated.description or declared.description + (f" of {record}" if record else ""),
        declared,
        prior,
        fixed,
        -np.inf if stated.lower is None else stated.lower,
        np.inf if stated.upper is None else stated.upper,
        record,
    )


def _distribution(name: str, prior: Mapping[str, str | float]) -> Distribution:
    arguments = {key: value for key, value in prior.items() if key != "distribution"}
    try:
        # The distribution itself refuses arguments that are not numbers.
        return Distribution(str(prior["distribution"]), arguments)  # type: ignore[arg-type]
    except InputError as error:
        raise InputError(f"parameters.{name}.prior: {error}") from None


def as_config(parameter: Parameter) -> ParameterConfig:
    """Write a parameter as a config does, in explicit numbers."""
    prior: dict[str, str | float] | None = None
    if parameter.prior is not None:
        prior = {"distribution": parameter.prior.name, **parameter.prior.arguments}
    return ParameterConfig(
        prior=prior,
        fixed=parameter.fixed,
        lower=parameter.lower if np.isfinite(parameter.lower) else None,
        upper=parameter.upper if np.isfinite(parameter.upper) else None,
        unit=parameter.unit,
        label=parameter.label,
        description=parameter.description,
    )


def with_model(config: Config, model: ModelConfig, records: Sequence[Record]) -> Config:
    """Return a config with another model, and of what it says of parameters what that has too.

    A parameter of another unit is another one, whatever its name.
    """
    actuator = actuator_of(model, records[0], records)
    noise = noise_model(model.noise_until_chosen, actuator.interval)
    units = {each.name: each.unit for each in ParameterTable(actuator, noise).declarations}
    # A parameter of one record alone is called name[record].
    parameters = {
        name: stated
        for name, stated in config.parameters.items()
        if (plain := name.partition("[")[0]) in units and stated.unit in (None, units[plain])
    }
    truth = {n: value for n, value in config.truth.items() if n.partition("[")[0] in units}
    scopes = {
        key: [name for name in getattr(model, key) if name in units]
        for key in ("per_record", "shared")
    }
    model = model.model_copy(update=scopes)
    return config.model_copy(update={"model": model, "parameters": parameters, "truth": truth})


def actuator_of(model: ActuatorConfig, record: Record, records: Sequence[Record]) -> Actuator:
    """Put the actuator together that a config asks for; ``auto`` and ``true`` ask the record.

    Gain and creep count from the voltages of all ``records`` of the actuator.

    Raises InputError: a part that does not exist, or an option that it does not have.
    """
    hold: Hold = "zero" if record.voltage_is == "command" else "first"
    if isinstance(model, ModelConfig) and model.hold != "auto":
        hold = model.hold
    paths = [record.path.voltage for record in records]
    span = Span(float(min(map(np.min, paths))), float(max(map(np.max, paths))))
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


def stand_of(config: Config, training: Sequence[Record]) -> VirtualTestStand:
    """Return the virtual stand that a config asks for.

    Gain and creep count from the range of the ``training`` records' voltages, as in a fit to them,
    so that a fit can recover their true values. Refused (InputError) are a part that does not
    exist, an option that it does not have, and a true value of no parameter of the actuator.
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
    if fitted.creep and stand.actuator.creep and fitted.creep.times != stand.actuator.creep.times:
        other |= {declared.name for declared in fitted.creep.parameters}
    return {name: value for name, value in stand.parameters().items() if name not in other}
