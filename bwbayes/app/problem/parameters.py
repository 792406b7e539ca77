"""From a config to parameters: what it says of each, and the defaults for what it does not say.

:func:`parameters_of` puts the config's priors, fixed values, bounds and names before the defaults;
:func:`as_config` writes a parameter back in explicit numbers.
"""

from __future__ import annotations

import re
from collections.abc import Collection, Iterator, Mapping, Sequence

import numpy as np

from bwbayes.app.config.config import Config, ParameterConfig
from bwbayes.data import Record
from bwbayes.errors import InputError, suggestion
from bwbayes.inference.defaults import ranges_of
from bwbayes.inference.noise import NOISES
from bwbayes.inference.parameters import Parameter
from bwbayes.model.actuator import OFFSET
from bwbayes.model.creep import MOST_TIMES, Creep
from bwbayes.model.declaration import Context, Declaration
from bwbayes.model.distributions import Distribution
from bwbayes.model.gain import PolynomialGain
from bwbayes.model.registry import DYNAMICS, HYSTERESIS

__all__ = ["as_config", "context_of", "every_declaration", "parameters_of"]

# No parameter in the package's units is larger than this, or smaller than its inverse, but zero.
LARGEST = 1e60


def parameters_of(
    config: Config, declarations: Sequence[Declaration], context: Context
) -> list[Parameter]:
    """Return the parameters that a model's parts declare.

    Raises
    ------
    InputError
        The config says something of a parameter that the model does not have, or cannot have.
    """
    _require_known("parameters", config.parameters, declarations)
    _require_known("truth", config.truth, [*declarations, *every_declaration()])
    given = {d.name: config.parameters.get(d.name, ParameterConfig()) for d in declarations}
    if config.record.from_rest:
        given |= {"initial": config.parameters.get("initial", ParameterConfig(fixed=0.0))}
    return [_parameter(d, given[d.name], context) for d in declarations]


def context_of(config: Config, record: Record, training: tuple[slice, ...]) -> Context:
    """Return what default priors may know, from the training windows (slices) of the record.

    Raises
    ------
    InputError
        Voltage or displacement does not vary there.
    """
    rows = np.concatenate([np.arange(window.start, window.stop) for window in training])
    assert record.displacement is not None
    voltage, displacement = record.voltage[rows], record.displacement[rows]
    if np.ptp(voltage) == 0 or np.nanmax(displacement) == np.nanmin(displacement):
        raise InputError("record.train: voltage or displacement is constant there; widen it")
    ranges = ranges_of(record.voltage, record.displacement, record.interval, training)
    return Context(ranges, dict(_stated(config)))


def _stated(config: Config) -> Iterator[tuple[str, float | Distribution]]:
    """Yield what the config states of parameters: values, and priors."""
    for name, given in config.parameters.items():
        if given.prior is not None:
            yield name, _distribution(name, given.prior)
        elif given.fixed is not None:
            yield name, given.fixed


def every_declaration() -> list[Declaration]:
    """Return what all parts of the package declare, whatever the model."""
    operators = (make().parameters for make in HYSTERESIS.values())
    filters = (make().parameters for make in DYNAMICS.values())
    noises = (make(interval=1.0).declarations for make in NOISES.values())
    crept = Creep(tuple(float(t) for t in range(1, MOST_TIMES + 1)), growing=True)
    others = PolynomialGain().parameters, crept.parameters, (OFFSET,)
    return [d for part in (*operators, *filters, *others, *noises) for d in part]


def _require_known(
    table: str, given: Collection[str], declarations: Collection[Declaration]
) -> None:
    known = {d.name for d in declarations}
    for name in given:
        if name not in known:
            if name in {d.name for d in every_declaration()}:
                raise InputError(f"{table}.{name}: is not in this model; see [model], or remove it")
            aliases = {alias: d.name for d in declarations for alias in d.aliases}
            names = list(dict.fromkeys(d.name for d in declarations))
            raise InputError(
                f"{table}.{name}: no such parameter here; {suggestion(name, names, aliases)}"
            )


def _parameter(declared: Declaration, given: ParameterConfig, context: Context) -> Parameter:
    """Put what the config says of a parameter before what its part declares."""
    name = declared.name
    prior, fixed = None, given.fixed
    if given.prior is not None:
        prior = _distribution(name, given.prior)
    elif fixed is None:
        default = declared.default(context)
        if default is None:
            why = f" ({declared.without_default})" if declared.without_default else ""
            raise InputError(f"parameters.{name}: has no default prior; give prior or fixed{why}")
        if isinstance(default, Distribution):
            prior = default
        else:
            fixed = default
    _require_in_proportion(name, [fixed or 0.0, *(prior.arguments.values() if prior else ())])
    unit = declared.unit_in(context)
    if given.unit is not None and re.sub("[µμ]", "u", given.unit) != unit:
        raise InputError(
            f"parameters.{name}.unit: its numbers are in {unit}, not {given.unit}; convert them"
        )
    return Parameter(
        name,
        given.unit or unit,
        given.label or declared.label,
        given.description or declared.description,
        prior,
        fixed,
        -np.inf if given.lower is None else given.lower,
        np.inf if given.upper is None else given.upper,
        declared,
    )


def _require_in_proportion(name: str, values: Collection[float]) -> None:
    """Refuse numbers of which the model's products and quotients are too large or small to hold."""
    for value in values:
        if value and not 1 / LARGEST < abs(value) < LARGEST:
            raise InputError(f"parameters.{name}: {value:g} is out of proportion; check its unit")


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
