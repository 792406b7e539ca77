"""From a config to a problem: records read, windows cut, every prior a number.

:func:`resolve` does once what must not happen twice: it runs the virtual stand, draws up default
priors, and takes ``hold = "auto"`` from the record. What comes out is a config that says all this
in explicit numbers and refers to the records as files beside it, so that a run's folder can be
moved, continued and run again by itself.
"""

from __future__ import annotations

import re
import warnings
from collections.abc import Collection, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from bwbayes.app.config import (
    Config,
    ModelConfig,
    ParameterConfig,
    RecordConfig,
    SignalConfig,
    ValidationConfig,
)
from bwbayes.data import Record, Split, read_record
from bwbayes.data.checks import require_readable
from bwbayes.data.inspection import inspect
from bwbayes.data.teststand import VirtualTestStand
from bwbayes.data.waveforms import Decay, Sine, Triangle, Waveform, signal
from bwbayes.errors import InputError, InputWarning, suggestion
from bwbayes.inference.defaults import CATALOGUE, Ranges, default_prior
from bwbayes.inference.distributions import Distribution
from bwbayes.inference.engine import Engine, choose
from bwbayes.inference.noise import noise_model
from bwbayes.inference.parameters import JointPrior, Parameter
from bwbayes.inference.posterior import Posterior
from bwbayes.inference.sampling import SamplingPlan
from bwbayes.model.actuator import Actuator
from bwbayes.results.prediction import Start, beyond_training

__all__ = ["Problem", "Validation", "generator", "resolve", "sampled_waveform"]

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


@dataclass(frozen=True)
class Validation:
    """Held-out data: a window (slice) of the training record, or another record and its start."""

    window: slice | None = None
    record: Record | None = None
    start: Start = field(default_factory=Start)


@dataclass(frozen=True)
class Problem:
    """All that a run needs, and the config that says the same in explicit numbers."""

    config: Config
    record: Record
    posterior: Posterior
    plan: SamplingPlan
    validations: Mapping[str, Validation]
    remarks: tuple[str, ...] = ()

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """All parameters of the model and the noise."""
        return self.posterior.prior.parameters


def generator(seed: int, purpose: str) -> np.random.Generator:
    """Return the generator of one purpose of a run: each has a stream of its own."""
    return np.random.default_rng([seed, *purpose.encode()])


def sampled_waveform(wanted: str | SignalConfig) -> Waveform:
    """Return the waveform of that name, or the one a config draws up."""
    if isinstance(wanted, str):
        return signal(wanted)
    shape = Sine if wanted.shape == "sine" else Triangle
    return Waveform(
        shape(wanted.amplitude, wanted.frequency),
        wanted.duration,
        wanted.start,
        Decay(wanted.decay_from, wanted.decay),
    )


def resolve(config: Config, folder: Path) -> Problem:
    """Make a problem of a config whose files are relative to ``folder``.

    Raises
    ------
    InputError
        Anything in the config or the records that cannot be used.
    """
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", InputWarning)
        record, truth = _training_record(config, folder)
        split = _split(config, record)
        others = {
            name: _other_record(config, name, folder)
            for name, validation in config.validation.items()
            if validation.window is None
        }
    remarks = [str(w.message) for w in caught if issubclass(w.category, InputWarning)]
    remarks += [f"record: {finding}" for finding in inspect(record)]
    hold = config.model.hold
    if hold == "auto":
        hold = "zero" if record.voltage_is == "command" else "first"
    actuator = Actuator(config.model.dynamics, hold, record.interval)
    noise = noise_model(config.model.noise, record.interval)
    names = (*actuator.parameters, *noise.parameters)
    prior = JointPrior(_parameters(config, names, record, split.training))
    if not prior.dimensions:
        raise InputError("parameters: all are fixed, so there is nothing to find; free some")
    assert record.displacement is not None
    posterior = Posterior(
        record.voltage,
        record.displacement,
        split.training,
        actuator,
        noise,
        prior,
        choose(config.sampling.engine),
    )
    windows = iter(split.held_out)
    validations = {
        name: Validation(window=next(windows))
        if v.window is not None
        else Validation(record=others[name], start=Start(v.from_rest, v.own_offset, v.lead_in))
        for name, v in config.validation.items()
    }
    for name, one in validations.items():
        voltage = record.voltage[one.window] if one.record is None else one.record.voltage
        if remark := beyond_training(posterior, voltage):
            remarks.append(f"{name}: {remark}")
    explicit = _explicit(config, posterior, truth)
    plan = _plan(config, posterior)
    return Problem(explicit, record, posterior, plan, validations, tuple(remarks))


def _training_record(config: Config, folder: Path) -> tuple[Record, dict[str, float]]:
    source = config.record
    truth = dict(config.truth)
    if source.file is not None:
        record = read_record(folder / source.file, voltage_is=source.voltage_is)
    else:
        assert source.signal is not None
        stand = _stand(config)
        waveform = sampled_waveform(source.signal)
        record = _named(stand.run(waveform, generator(config.seed, "record")), source.signal)
        truth = stand.parameters() | truth
    if source.exclude is not None:
        record = record.exclude([(window[0], window[1]) for window in source.exclude])
    if source.start is not None or source.stop is not None:
        end = record.start + record.duration if source.stop is None else source.stop
        record = record.upto(end, source.start)
    if source.decimate > 1:
        record = record.decimate(source.decimate)
    require_readable(record, "record")
    return record, truth


def _other_record(config: Config, name: str, folder: Path) -> Record:
    source = config.validation[name]
    if source.file is not None:
        record = read_record(folder / source.file, voltage_is=source.voltage_is)
    else:
        assert source.signal is not None
        waveform = sampled_waveform(source.signal)
        made = _stand(config).run(waveform, generator(config.seed, f"record {name}"))
        record = _named(made, source.signal)
        require_readable(record, f"validation.{name}")
    # Said now: it would be a pity after the sampling.
    if source.own_offset and not 1 <= round(source.lead_in / record.interval) < record.samples:
        raise InputError(
            f"validation.{name}.lead_in: {source.lead_in:g} s is not a part of the record's "
            f"{record.duration:g} s; choose another one"
        )
    return record


def _stand(config: Config) -> VirtualTestStand:
    return VirtualTestStand(config.stand.discrepancy, config.stand.sample_rate)


def _named(record: Record, wanted: str | SignalConfig) -> Record:
    name = wanted if isinstance(wanted, str) else wanted.shape
    return replace(record, origin=f"{record.origin}, {name} signal")


def _split(config: Config, record: Record) -> Split:
    held_out = {n: v.window for n, v in config.validation.items() if v.window is not None}
    if config.record.train is None:
        first, last = np.flatnonzero(record.has_reading)[[0, -1]]
        train = [(float(record.time[first]), float(record.time[last]) + record.interval)]
    else:
        train = [(window[0], window[1]) for window in config.record.train]
    split = record.split(train, [(window[0], window[1]) for window in held_out.values()])
    parts = [("record.train", window) for window in split.training]
    parts += [
        (f"validation.{name}.window", w) for name, w in zip(held_out, split.held_out, strict=True)
    ]
    for place, part in parts:
        if not record.has_reading[part].any():
            begin, end = record.time[part][[0, -1]]
            raise InputError(
                f"{place}: no readings from {begin:g} to {end:g} s; choose another window, or see "
                "start, exclude and decimate in [record]"
            )
    return split


def _parameters(
    config: Config, names: tuple[str, ...], record: Record, training: tuple[slice, ...]
) -> list[Parameter]:
    _require_known("parameters", config.parameters, names)
    _require_known("truth", config.truth, CATALOGUE)
    rows = np.concatenate([np.arange(window.start, window.stop) for window in training])
    assert record.displacement is not None
    voltage, displacement = record.voltage[rows], record.displacement[rows]
    if np.ptp(voltage) == 0 or np.nanmax(displacement) == np.nanmin(displacement):
        raise InputError("record.train: voltage or displacement is constant there; widen it")
    ranges = Ranges.of(voltage, displacement, record.interval)
    exponent = _fixed(config, "exponent", 1.0)
    stiffness = _fixed(config, "stiffness", None)
    given = {name: config.parameters.get(name, ParameterConfig()) for name in names}
    return [_parameter(name, given[name], ranges, exponent, stiffness) for name in names]


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


def _parameter(
    name: str,
    given: ParameterConfig,
    ranges: Ranges,
    exponent: float | None,
    stiffness: float | None,
) -> Parameter:
    """Put what the config says of a parameter before what the defaults say."""
    meaning = CATALOGUE[name]
    prior, fixed = None, given.fixed
    if given.prior is not None:
        prior = _distribution(name, given.prior)
    elif fixed is None:
        prior, fixed = _default(name, ranges, exponent or 1.0, stiffness)
    _require_in_proportion(name, [fixed or 0.0, *(prior.arguments.values() if prior else ())])
    unit = meaning.unit
    if name in ("beta", "gamma") and exponent != 1.0:
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


def _default(
    name: str, ranges: Ranges, exponent: float, stiffness: float | None
) -> tuple[Distribution | None, float | None]:
    try:
        found = default_prior(name, ranges, exponent, stiffness)
    except KeyError:
        raise InputError(
            f"parameters.{name}: has no default prior; give prior or fixed (a record shows mass "
            "and stiffness only through the damping)"
        ) from None
    return (found, None) if isinstance(found, Distribution) else (None, found)


# Walkers by default: halves of an ensemble then fill the compiled engine's lanes.
WALKERS: Mapping[Engine, int] = {"numba": 64, "numpy": 32}


def _plan(config: Config, posterior: Posterior) -> SamplingPlan:
    given, prior = config.sampling, posterior.prior
    # Six more than the least: complementary halves must span all directions.
    least = 2 * prior.dimensions
    walkers = given.walkers or max(least + 6, WALKERS[posterior.engine])
    if walkers < least:
        raise InputError(
            f"sampling.walkers: {walkers} are too few for {prior.dimensions} free parameters; "
            f"use at least {least}"
        )
    return SamplingPlan(
        ess=given.ess,
        ensembles=given.ensembles,
        walkers=walkers,
        block=given.block,
        most_steps=given.steps,
        most_pilot_steps=given.pilot_steps,
    )


def _explicit(config: Config, posterior: Posterior, truth: Mapping[str, float]) -> Config:
    """Return the config with every choice made, its records as files beside it."""
    prior = posterior.prior
    validation = {
        name: v
        if v.window is not None
        else ValidationConfig(
            file=f"records/{name}.h5",
            from_rest=v.from_rest,
            own_offset=v.own_offset,
            lead_in=v.lead_in,
        )
        for name, v in config.validation.items()
    }
    return config.model_copy(
        update={
            "record": RecordConfig(file="records/record.h5", train=config.record.train),
            "model": ModelConfig(
                dynamics=config.model.dynamics,
                hold=posterior.actuator.hold,
                noise=config.model.noise,
            ),
            "parameters": {p.name: _as_config(p) for p in prior.parameters},
            "sampling": config.sampling.model_copy(
                update={"walkers": _plan(config, posterior).walkers, "engine": posterior.engine}
            ),
            "validation": validation,
            "truth": {n: v for n, v in truth.items() if n in prior.names},
        }
    )


def _as_config(parameter: Parameter) -> ParameterConfig:
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
