"""From a config to a problem: records read, windows cut, every prior a number.

:func:`resolve` does once what must not happen twice: it runs the virtual stand, sets default
priors, and takes ``hold = "auto"`` from the record. What comes out is a config that says all this
in explicit numbers and refers to the records as files beside it, so that a run's folder can be
moved, continued and run again by itself.
"""

from __future__ import annotations

import warnings
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from bwbayes.app.config.config import Config, RecordConfig, SignalConfig, ValidationConfig
from bwbayes.app.problem.model import actuator_of, explicit_model
from bwbayes.app.problem.parameters import as_config, context_of, parameters_of
from bwbayes.app.problem.stand import planned, recoverable, stand_of
from bwbayes.data import Record, Split, read_record
from bwbayes.data.inspection import Finding, inspect
from bwbayes.data.record import require_readable
from bwbayes.data.teststand import VirtualTestStand
from bwbayes.data.waveforms import Carrier, Decay, Sine, Staircase, Triangle, Waveform, signal
from bwbayes.errors import InputError, InputWarning
from bwbayes.inference.defaults import default_priors
from bwbayes.inference.engine import Engine, choose
from bwbayes.inference.noise import noise_model
from bwbayes.inference.outliers import outliers
from bwbayes.inference.parameters import JointPrior, Parameter
from bwbayes.inference.posterior import Dataset, Posterior
from bwbayes.inference.table import Table
from bwbayes.model.distributions import Distribution
from bwbayes.results.extrapolation import beyond_training
from bwbayes.results.prediction import Start
from bwbayes.sampling.sampler import SamplingPlan, best_together

__all__ = ["Problem", "Validation", "generator", "resolve", "sampled_waveform"]

# Times of outliers that a remark lists.
MOST_TIMES = 10


@dataclass(frozen=True)
class Validation:
    """Held-out data: a window (slice) of the training record, or another record and its start.

    ``judged`` is the window in s of another record that is judged, if not all of it.
    """

    window: slice | None = None
    record: Record | None = None
    start: Start = field(default_factory=Start)
    judged: tuple[float, float] | None = None


@dataclass(frozen=True)
class Problem:
    """All that a run needs, and the config that says the same in explicit numbers."""

    config: Config
    record: Record
    posterior: Posterior
    plan: SamplingPlan
    validations: Mapping[str, Validation]
    remarks: tuple[str, ...] = ()
    defaults: Mapping[str, Distribution] = field(default_factory=dict)
    """What the default priors of this record would be, by name."""
    findings: tuple[Finding, ...] = ()

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """All parameters of the model and the noise."""
        return self.posterior.prior.parameters

    @property
    def others(self) -> dict[str, Record]:
        """The records that are predicted, by name, besides the one that is fitted."""
        every = {name: one.record for name, one in self.validations.items()}
        return {name: record for name, record in every.items() if record is not None}


def generator(seed: int, purpose: str) -> np.random.Generator:
    """Return the generator of one purpose of a run: each has a stream of its own."""
    return np.random.default_rng([seed, *purpose.encode()])


def sampled_waveform(source: str | SignalConfig) -> Waveform:
    """Return the waveform of that name, or the one that a config describes."""
    if isinstance(source, str):
        return signal(source)
    carrier: Carrier
    if source.shape == "steps":
        carrier = Staircase(tuple(source.levels or ()), source.dwell or 0.0)
    else:
        shape = Sine if source.shape == "sine" else Triangle
        carrier = shape(source.amplitude or 0.0, source.frequency or 0.0)
    decay = Decay(source.decay_from, source.decay)
    return Waveform(carrier, source.duration, source.start, decay)


def resolve(config: Config, folder: Path, records: Mapping[str, Record] | None = None) -> Problem:
    """Make a problem of a config whose files are relative to ``folder``.

    ``records`` are those that are not read from the config's files because they are in memory:
    "record", the training record, and others by the names of their validations.

    Raises
    ------
    InputError
        Anything in the config or the records that cannot be used.
    """
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", InputWarning)
        given = records or {}
        record, stand = _training_record(config, folder, given.get("record"))
        split = _split(config, record)
        others = {
            name: _other_record(config, name, folder, record, given.get(name))
            for name, validation in config.validation.items()
            if validation.another
        }
    said = [str(w.message) for w in caught if issubclass(w.category, InputWarning)]
    said = list(dict.fromkeys([*(config.record.remarks or ()), *said]))
    findings = _findings(record, (*split.training, *split.held_out))
    remarks = [*said, *(f"record: {finding}" for finding in findings)]
    remarks += [text for name, other in others.items() for text in _unlike(config, name, other)]
    actuator = actuator_of(config.model, record)
    noise = noise_model(config.model.noise, record.interval)
    table, context = Table(actuator, noise), context_of(config, record, split.training)
    parameters = parameters_of(config, table.declarations, context)
    prior = JointPrior(parameters, actuator.hysteresis.holds)
    if not prior.dimensions:
        raise InputError("parameters: all are fixed, so there is nothing to fit; free some")
    assert record.displacement is not None
    dataset = Dataset(
        record.voltage,
        record.displacement,
        split.training,
        actuator,
        noise,
        config.record.from_rest,
    )
    posterior = Posterior((dataset,), prior, choose(config.sampling.engine))
    aside = config.record.outliers
    if config.model.outliers and aside is None:
        samples = outliers(posterior, generator(config.seed, "outliers"))["record"]
        aside = record.time[samples].tolist()
        record = record.without(samples)
        assert record.displacement is not None
        posterior = posterior.altered(displacement=record.displacement)
    if aside is not None:
        remarks.append(_set_aside(aside))
    windows = iter(split.held_out)
    validations = {
        name: Validation(
            record=others[name],
            start=_start(config, name),
            judged=None if v.window is None else (v.window[0], v.window[1]),
        )
        if v.another
        else Validation(window=next(windows))
        for name, v in config.validation.items()
    }
    for name, one in validations.items():
        other = one.record or record
        voltage = other.voltage[one.window or slice(None)]
        leaving = beyond_training(posterior, voltage, other.interval)
        remarks += [f"{name}: {remark}" for remark in leaving]
    truth = (recoverable(stand, actuator) if stand else {}) | config.truth
    explicit = _explicit(config, posterior, truth, aside, said)
    plan = _plan(config, posterior)
    return Problem(
        explicit,
        record,
        posterior,
        plan,
        validations,
        tuple(remarks),
        default_priors(table.declarations, context),
        findings,
    )


def _findings(record: Record, windows: Sequence[slice]) -> tuple[Finding, ...]:
    """Return what is wrong with a record in the places that some window uses."""
    # Borders that differ by less than half a sample are the same.
    times = [
        record.start + record.interval * np.array([w.start + 0.5, w.stop - 0.5]) for w in windows
    ]
    return tuple(
        one
        for one in inspect(record)
        if any(one.start < stop and start < one.stop for start, stop in times)
    )


def _unlike(config: Config, name: str, record: Record) -> Iterator[str]:
    """Yield what is wrong with the record of a file that is predicted."""
    if config.validation[name].file is None:
        return
    for one in inspect(record):
        if one.kind == "switch-on transient":
            remedy = f"lead_in_from = {one.stop:.3g} under [validation.{name}]"
            yield f"{name}: {one.kind}: {one.text}; {remedy}"
        elif one.kind not in ("one amplitude", "few readings"):
            yield f"{name}: {one}"


def _read(source: RecordConfig | ValidationConfig, folder: Path, given: Record | None) -> Record:
    """Return the record that is given, or else read the source's file."""
    if given is not None:
        return replace(given, voltage_is=source.voltage_is or given.voltage_is)
    assert source.file is not None
    return read_record(
        folder / source.file,
        voltage_is=source.voltage_is,
        columns=source.columns,
        units=source.units,
    )


def _training_record(
    config: Config, folder: Path, given: Record | None
) -> tuple[Record, VirtualTestStand | None]:
    """Return the record, and the stand that made it, if one did."""
    source, stand = config.record, None
    if source.file is not None:
        record = _read(source, folder, given)
    else:
        assert source.signal is not None
        waveform = sampled_waveform(source.signal)
        stand = stand_of(config, planned(config, waveform))
        record = _named(stand.run(waveform, generator(config.seed, "record")), source.signal)
    if source.exclude is not None:
        record = record.exclude([(window[0], window[1]) for window in source.exclude])
    if source.start is not None or source.stop is not None:
        end = record.start + record.duration if source.stop is None else source.stop
        record = record.upto(end, source.start)
    if source.decimate > 1:
        record = record.decimate(source.decimate)
    require_readable(record, "record")
    return record, stand


def _other_record(
    config: Config, name: str, folder: Path, training: Record, given: Record | None
) -> Record:
    source = config.validation[name]
    if source.file is not None:
        record = _read(source, folder, given)
        if given is not None:
            require_readable(record, f"validation.{name}")
    else:
        assert source.signal is not None
        waveform = sampled_waveform(source.signal)
        made = stand_of(config, training).run(waveform, generator(config.seed, f"record {name}"))
        record = _named(made, source.signal)
        require_readable(record, f"validation.{name}")
    # Said now: it would be a pity after the sampling.
    try:
        _start(config, name).window(record)
    except InputError as error:
        raise InputError(f"validation.{name}.lead_in: {error}") from None
    if source.window is not None:
        try:
            record.window_slice(source.window[0], source.window[1])
        except InputError as error:
            raise InputError(f"validation.{name}.{error}") from None
    return record


def _start(config: Config, name: str) -> Start:
    """Return what a config knows of another record's start; its hold is its own, unless given."""
    source, hold = config.validation[name], config.model.hold
    return Start(
        source.from_rest,
        source.own_offset,
        source.lead_in,
        source.lead_in_from,
        None if hold == "auto" else hold,
    )


def _named(record: Record, source: str | SignalConfig) -> Record:
    name = source if isinstance(source, str) else source.shape
    return replace(record, origin=f"{record.origin}, {name} signal")


def _split(config: Config, record: Record) -> Split:
    held_out = {n: v.window for n, v in config.validation.items() if v.window and not v.another}
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
        together=best_together(given.ensembles, walkers, posterior.only.readings.samples),
    )


def _set_aside(times: Sequence[float]) -> str:
    """Say which readings were set aside as outliers."""
    if not times:
        return "no reading is an isolated outlier: none was set aside"
    first = ", ".join(f"{time:g}" for time in times[:MOST_TIMES])
    more = f" and {len(times) - MOST_TIMES} more" if len(times) > MOST_TIMES else ""
    plural = "s" if len(times) > 1 else ""
    return f"{len(times)} reading{plural} set aside as isolated outliers, at {first} s{more}"


def _explicit(
    config: Config,
    posterior: Posterior,
    truth: Mapping[str, float],
    outliers: list[float] | None,
    remarks: list[str],
) -> Config:
    """Return the config with every choice made, its records as files beside it."""
    prior = posterior.prior
    validation = {
        name: v.model_copy(
            update={
                "file": f"records/{name}.h5",
                **dict.fromkeys(("signal", "voltage_is", "columns", "units")),
            }
        )
        if v.another
        else v
        for name, v in config.validation.items()
    }
    return config.model_copy(
        update={
            "record": RecordConfig(
                file="records/record.h5",
                train=config.record.train,
                from_rest=config.record.from_rest,
                outliers=outliers,
                remarks=remarks or None,
            ),
            "model": explicit_model(config.model, posterior.only.actuator),
            "parameters": {p.name: as_config(p) for p in prior.parameters},
            "sampling": config.sampling.model_copy(
                update={"walkers": _plan(config, posterior).walkers, "engine": posterior.engine}
            ),
            "validation": validation,
            "truth": {n: v for n, v in truth.items() if n in prior.names},
        }
    )
