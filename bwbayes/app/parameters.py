"""From a config to parameters: what it says of each, and the defaults for what it does not say.

:func:`parameters_of` puts the config's priors, fixed values, bounds and names before the defaults;
:func:`as_config` writes a parameter back in explicit numbers.
"""

from __future__ import annotations

import re
from collections.abc import Collection, Mapping

import numpy as np

from bwbayes.app.config import Config, ParameterConfig
from bwbayes.data import Record
from bwbayes.errors import InputError, suggestion
from bwbayes.inference.defaults import CATALOGUE, Defaults, Ranges
from bwbayes.inference.parameters import Parameter
from bwbayes.model.distributions import Distribution

__all__ = ["as_config", "defaults_of", "parameters_of"]

# What people call a parameter, and its name here.
MEANINGS = {
    "n": "exponent",
    "h0": "initial",
    "k": "stiffness",
    "m": "mass",
    "b": "damping",
    "a": "alpha",
    "tau": "lag",
    "time_constant": "lag",
    "y0": "offset",
    "gain": "d",
    "d33": "d",
    "noise": "sensor_sd",
    "sigma": "discrepancy_sd",
}

# No parameter in the package's units is larger than this, or smaller than its inverse, but zero.
LARGEST = 1e60


def parameters_of(config: Config, names: tuple[str, ...], defaults: Defaults) -> list[Parameter]:
    """Return the parameters of those names.

    Raises
    ------
    InputError
        The config says something of a parameter that the model does not have, or cannot have.
    """
    _require_known("parameters", config.parameters, names)
    _require_known("truth", config.truth, CATALOGUE)
    given = {name: config.parameters.get(name, ParameterConfig()) for name in names}
    if config.record.from_rest:
        given |= {"initial": config.parameters.get("initial", ParameterConfig(fixed=0.0))}
    return [_parameter(name, given[name], defaults) for name in names]


def defaults_of(config: Config, record: Record, training: tuple[slice, ...]) -> Defaults:
    """Return what gives default priors, from the training windows (slices) of the record.

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
    return Defaults(
        Ranges.of(record.voltage, record.displacement, record.interval, training),
        _exponent(config),
        _fixed(config, "stiffness", None),
        _fixed(config, "gamma", None) is None,
    )


def _require_known(table: str, given: Collection[str], known: Collection[str]) -> None:
    for name in given:
        if name not in known:
            if name in CATALOGUE:
                raise InputError(f"{table}.{name}: is not in this model; see [model], or remove it")
            raise InputError(
                f"{table}.{name}: no such parameter here; {suggestion(name, known, MEANINGS)}"
            )


def _fixed(config: Config, name: str, default: float | None) -> float | None:
    given = config.parameters.get(name)
    return default if given is None or given.fixed is None else given.fixed


def _exponent(config: Config) -> float | Distribution:
    """Return the exponent's value, or its prior if the config frees it."""
    given = config.parameters.get("exponent")
    if given is not None and given.prior is not None:
        return _distribution("exponent", given.prior)
    value = _fixed(config, "exponent", 1.0)
    return 1.0 if value is None else value


def _parameter(name: str, given: ParameterConfig, defaults: Defaults) -> Parameter:
    """Put what the config says of a parameter before what the defaults say."""
    meaning = CATALOGUE[name]
    prior, fixed = None, given.fixed
    if given.prior is not None:
        prior = _distribution(name, given.prior)
    elif fixed is None:
        try:
            default = defaults.of(name)
        except KeyError:
            raise InputError(
                f"parameters.{name}: has no default prior; give prior or fixed (a record shows "
                "mass and stiffness only through the damping)"
            ) from None
        if isinstance(default, Distribution):
            prior = default
        else:
            fixed = default
    _require_in_proportion(name, [fixed or 0.0, *(prior.arguments.values() if prior else ())])
    unit = meaning.unit
    if name in ("beta", "gamma") and defaults.exponent != 1.0:
        unit = "um^(1-n)/V"
    if given.unit is not None and re.sub("[µμ]", "u", given.unit) != unit:
        raise InputError(
            f"parameters.{name}.unit: its numbers are in {unit}, not {given.unit}; convert them"
        )
    return Parameter(
        name,
        given.unit or unit,
        given.label or meaning.label,
        given.description or meaning.description,
        prior,
        fixed,
        -np.inf if given.lower is None else given.lower,
        np.inf if given.upper is None else given.upper,
    )


def _require_in_proportion(name: str, values: Collection[float]) -> None:
    """Refuse numbers of which the model's products and quotients are too large or small to hold."""
    for value in values:
        if value and not 1 / LARGEST < abs(value) < LARGEST:
            raise InputError(f"parameters.{name}: {value:g} is out of proportion; check its unit")


def _distribution(name: str, prior: Mapping[str, str | float]) -> Distribution:
    arguments = {key: value for key, value in prior.items() if key != "distribution"}
    try:
        # The distribution itself refuses arguments that are no numbers.
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
