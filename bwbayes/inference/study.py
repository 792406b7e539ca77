"""A study: a model, its records, and statements about its parameters.

A :class:`Study` makes the posterior of the records that are fitted, and knows what is held out.
Statements about parameters (priors, values, bounds, names) come before the declarations of the
model's parts. The same study with another model keeps the statements about parameters that both
have.
"""

from __future__ import annotations

import json
import re
from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from hashlib import sha256
from itertools import chain
from typing import Any, Self

import numpy as np

from bwbayes.arrays import FloatArray, IntArray
from bwbayes.errors import InputError, suggestion
from bwbayes.inference import Engine
from bwbayes.inference.defaults import join_ranges, ranges_of
from bwbayes.inference.likelihood import Likelihood
from bwbayes.inference.noise import NOISES, noise_model
from bwbayes.inference.parameters import Column, JointPrior, Parameter, ParameterTable
from bwbayes.inference.posterior import Posterior
from bwbayes.model.actuator import OFFSET
from bwbayes.model.declaration import Context, Declaration, Distribution, Ranges
from bwbayes.model.inputs import Hold, Span
from bwbayes.model.registry import PARTS
from bwbayes.model.spec import Extent, ModelSpec
from bwbayes.quantities import Quantities
from bwbayes.record import Record
from bwbayes.record.instruments import EXACT, Scales
from bwbayes.record.record import Window
from bwbayes.shown import brief

type Slices = tuple[slice, ...]


@dataclass(frozen=True)
class Stated:
    """The user's statements about a parameter: its prior or value, bounds, and names for people.

    All that is None is as the part declares it.
    """

    prior: Distribution | None = None
    fixed: float | None = None
    lower: float | None = None
    upper: float | None = None
    unit: str | None = None
    label: str | None = None
    description: str | None = None

    @property
    def keys(self) -> dict[str, Any]:
        """The keys of a config's [parameters.NAME]."""
        keys = {name: value for name, value in vars(self).items() if value is not None}
        if self.prior is not None:
            keys["prior"] = {"distribution": self.prior.name, **self.prior.arguments}
        return keys

    @classmethod
    def of(cls, parameter: Parameter, quantities: Quantities) -> Self:
        """State all of a parameter in explicit numbers, in the quantities' units."""
        return cls(
            parameter.prior,
            parameter.fixed,
            parameter.lower if np.isfinite(parameter.lower) else None,
            parameter.upper if np.isfinite(parameter.upper) else None,
            quantities.say(parameter.unit),
            parameter.label,
            parameter.description,
        )


@dataclass(frozen=True)
class InitialConditions:
    """Initial conditions of another record.

    Parameters
    ----------
    from_rest
        The actuator starts demagnetized and at rest: the voltage came from zero volts. Otherwise
        h is a state that an earlier drive within the voltage range could have left, and the
        dynamics may be moving.
    estimate_offset
        The sensor has an offset of its own, estimated from the lead-in. Otherwise it is that of
        the training record, as it is for a planned voltage without a measurement.
    lead_in
        Length of the lead-in, s; by default a quarter of the record, and ten correlation times of
        the discrepancy at most: after these the offset hardly widens the bands.
    lead_in_start
        Time at which it begins, s; by default that of the record's first sample. Samples before it
        are simulated.
    hold
        How the voltage goes between samples; by default as the record says.
    after
        Everything after the lead-in is a forecast: the discrepancy goes on from where the lead-in's
        readings leave it.
    settled
        Without a lead-in: the actuator has waited at the first voltage until it stood still, with
        whatever earlier drives have left of hysteresis and creep, and displacements count from
        where it stands.
    """

    __repr__ = brief

    from_rest: bool = False
    estimate_offset: bool = True
    lead_in: float | None = None
    lead_in_start: float | None = None
    hold: Hold | None = None
    after: bool = False
    settled: bool = False

    def window(self, record: Record, memory: float = np.inf) -> slice | None:
        """Return the samples of the lead-in, or None if nothing can be learned from one.

        ``memory`` is the discrepancy's correlation time, s.

        Raises
        ------
        InputError
            It reaches outside the record, leaves nothing of it, or holds no reading; a forecast of
            a record without any.
        """
        if self.after and record.displacement is None:
            raise InputError(
                f"{record.origin}: has no readings after which a forecast could start; give a "
                "record with a measured lead-in, or leave the forecast out"
            )
        if record.displacement is None:
            return None
        if self.from_rest and not self.estimate_offset and not self.after:
            return None
        begin = record.start if self.lead_in_start is None else self.lead_in_start
        first = round((begin - record.start) / record.interval)
        # White noise forgets at once: then a hundred readings tell the offset.
        longest = max(10 * memory, 100 * record.interval)
        length = self.lead_in or min(0.25 * (record.samples - first) * record.interval, longest)
        last = first + round(length / record.interval)
        lead_in = f"a lead-in of {length:g} s from {record.clock(begin)} s on"
        if not (0 <= first < last < record.samples):
            end = record.start + record.duration
            raise InputError(
                f"{record.origin}: {lead_in} leaves nothing of the record from "
                f"{record.clock(record.start)} to {record.clock(end)} s; choose another one"
            )
        if not np.isfinite(record.displacement[first:last]).any():
            raise InputError(f"{record.origin}: no reading in {lead_in}; choose another one")
        return slice(first, last)


@dataclass(frozen=True)
class Validation:
    """Held-out data: windows (slices) of a training record, or another record and its start.

    ``judged`` is the window in s of another record that is judged, if not all of it. ``of`` is the
    training record that the windows are of, or whose own parameters another record takes where
    nothing tells its own.
    """

    windows: Slices = ()
    record: Record | None = None
    start: InitialConditions = field(default_factory=InitialConditions)
    judged: Window | None = None
    of: str = "record"


@dataclass(frozen=True)
class Study:
    """A model, the records that it is fitted to and held against, and what is stated of both.

    Parameters
    ----------
    spec
        The model.
    records
        Records to fit, by name.
    training
        Windows of each that are fitted (slices), by its name.
    from_rest
        Names of those that start from a demagnetized actuator at rest.
    stated
        Statements about parameters, by name, or by name[record] for one record.
    per_record, shared
        Parameters that each record has of its own besides those that declare it, and of these
        those that all records share.
    engine
        Engine of the likelihood.
    validations
        What is held out, by name.
    seed
        Seed of all random numbers.
    """

    __repr__ = brief

    spec: ModelSpec
    records: Mapping[str, Record]
    training: Mapping[str, Slices]
    from_rest: frozenset[str] = frozenset()
    stated: Mapping[str, Stated] = field(default_factory=dict)
    per_record: tuple[str, ...] = ()
    shared: tuple[str, ...] = ()
    engine: Engine = "numpy"
    validations: Mapping[str, Validation] = field(default_factory=dict)
    seed: int = 1

    def __post_init__(self) -> None:
        reaches = self.spec.hold == "corners"
        records = {name: _reaching(record, reaches) for name, record in self.records.items()}
        validations = {
            name: replace(other, record=other.record and _reaching(other.record, reaches))
            for name, other in self.validations.items()
        }
        object.__setattr__(self, "records", records)
        object.__setattr__(self, "validations", validations)

    @property
    def record(self) -> Record:
        """The record that is fitted; of several, the first."""
        return next(iter(self.records.values()))

    @property
    def others(self) -> dict[str, Record]:
        """The records that are predicted, by name, besides those that are fitted."""
        records = {name: validation.record for name, validation in self.validations.items()}
        return {name: record for name, record in records.items() if record is not None}

    @property
    def quantities(self) -> Quantities:
        """Quantities of the records, in whose words all is said."""
        return self.record.quantities

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """All parameters of the model and the noise."""
        return self.posterior.prior.parameters

    def generator(self, purpose: str) -> np.random.Generator:
        """Return the generator of one purpose: each has a stream of its own."""
        return generator(self.seed, purpose)

    def held_out(self, record: str) -> dict[str, Slices]:
        """Return the windows of a training record that were held out, by name."""
        validations = self.validations.items()
        return {name: v.windows for name, v in validations if v.windows and v.of == record}

    def windows(self, record: str) -> dict[str, Slices]:
        """Return the windows of a training record by the names of their bands, fitted ones first.

        Those of one record alone are called "training", those of several as their record is.
        """
        name = "training" if len(self.records) == 1 else record
        return {name: self.training[record], **self.held_out(record)}

    def with_model(self, spec: ModelSpec, added: Mapping[str, Stated] | None = None) -> Self:
        """Return the study of another model.

        It keeps statements about parameters that the other model has too: a parameter of
        another unit is another one, whatever its name. ``added`` is stated of others, or instead.
        """
        say, statements = self.quantities.say, {**self.stated, **(added or {})}
        values = _values_of(statements)
        units = {d.name: say(d.unit_in(values)) for d in declarations_of(spec, self.extent)}
        stated = {}
        for name, statement in statements.items():
            plain, _, _ = name.partition("[")
            if plain in units and statement.unit in (None, units[plain]):
                stated[name] = statement
        per_record, shared = (
            tuple(name for name in names if name in units)
            for names in (self.per_record, self.shared)
        )
        other = replace(self, spec=spec, stated=stated, per_record=per_record, shared=shared)
        vars(other)["ranges"] = self.ranges  # of the same windows
        return other

    def for_record(self, record: str) -> Self:
        """Return the study of one of the records, with what is stated of its own parameters."""
        stated = {
            name.removesuffix(f"[{record}]"): statement for name, statement in self.stated.items()
        }
        alone = replace(
            self,
            records={record: self.records[record]},
            stated={name: statement for name, statement in stated.items() if "[" not in name},
            per_record=(),
            shared=(),
        )
        vars(alone)["ranges"] = {record: self.ranges[record]}
        return alone

    def without(self, rows: Mapping[str, IntArray]) -> Self:
        """Return the study without the readings of some samples of its records, by name.

        Default priors are those that the other readings lead to.
        """
        records = {name: self.records[name].without(left_out) for name, left_out in rows.items()}
        return replace(self, records={**self.records, **records})

    @property
    def explicit(self) -> Self:
        """The study with all that it leaves open stated in numbers, but the hold.

        So a config says it, and another model keeps the numbers that both have.
        """
        posterior = self.posterior
        explicit = replace(
            self,
            spec=self.spec.explicit(posterior.datasets[0].actuator),
            stated={p.name: Stated.of(p, self.quantities) for p in self.parameters},
        )
        vars(explicit).update(posterior=posterior, ranges=self.ranges)
        return explicit

    @property
    def keys(self) -> dict[str, Any]:
        """All that its posterior depends on besides the readings: values by a config's keys.

        The names that people read of parameters do not, nor does the engine.
        """
        keys: dict[str, Any] = {f"model.{key}": value for key, value in self.spec.keys.items()}
        keys |= {"model.per_record": [*self.per_record], "model.shared": [*self.shared]}
        for name, stated in self.stated.items():
            for key, value in stated.keys.items():
                if key not in ("label", "description"):
                    keys[f"parameters.{name}.{key}"] = value
        for name, record in self.records.items():
            table = place_of(name)
            edges = np.array([[window.start, window.stop] for window in self.training[name]])
            keys[f"{table}.train"] = (record.start + record.interval * edges).tolist()
            keys[f"{table}.from_rest"] = name in self.from_rest
            if record.path.noise_sd:
                keys[f"voltage of {name}"] = "without its noise"
        return keys

    @property
    def digests(self) -> dict[str, str]:
        """The digest of each record by name, of those that are fitted and those predicted."""
        return {name: record.sha256 for name, record in {**self.records, **self.others}.items()}

    @property
    def sha256(self) -> str:
        """A digest of all fitted readings: that of the record, or of several with their names."""
        digests = {name: record.sha256 for name, record in self.records.items()}
        if len(digests) == 1:
            return next(iter(digests.values()))
        return sha256(json.dumps(digests).encode()).hexdigest()

    @cached_property
    def extent(self) -> Extent:
        """The quantities that the model takes from all records."""
        return extent_of(self.records.values())

    @cached_property
    def ranges(self) -> dict[str, Ranges]:
        """Ranges of each record in its windows, which default priors may depend on."""
        return {
            name: ranges_of(record.inputs, _readings(record), self.training[name])
            for name, record in self.records.items()
        }

    @cached_property
    def posterior(self) -> Posterior:
        """The posterior of all records.

        Raises
        ------
        InputError
            Something is stated of a parameter that the model does not have, or cannot have; or
            nothing is free.
        """
        datasets = [
            Likelihood(
                record.inputs,
                _readings(record),
                self.training[name],
                self.spec.actuator(record.interval, record.hold, self.extent),
                noise_model(self.spec.noise, record.interval),
                name in self.from_rest,
                name,
            )
            for name, record in self.records.items()
        ]
        for dataset in datasets:
            for stage in dataset.actuator.stages:
                stage.seen(dataset.inputs)  # refuses a missing covariate before any fit
        first = datasets[0]
        table = ParameterTable(
            first.actuator, first.noise, tuple(self.records), self.per_record, self.shared
        )
        require_known("parameters", self.stated, table)
        parameters = [
            _parameter(column, self._said_of(column), self.contexts[column.record], self.quantities)
            for column in table.layout
        ]
        prior = JointPrior(parameters, first.actuator.hysteresis.holds)
        if not prior.dimensions:
            raise InputError("parameters: all are fixed, so there is nothing to fit; free some")
        return Posterior(tuple(datasets), prior, self.engine, table).known()

    @cached_property
    def contexts(self) -> dict[str, Context]:
        """The ranges that default priors use, of each record by name, and ("") of all together.

        From the windows that are fitted.

        Raises
        ------
        InputError
            Voltage or displacement does not vary there, in any of them.
        """
        varied = [
            ranges
            for ranges in self.ranges.values()
            if ranges.voltage > 0 and ranges.displacement > 0
        ]
        if not varied:
            table = place_of(next(iter(self.records)))
            raise InputError(f"{table}.train: voltage or displacement is constant there; widen it")
        pooled = join_ranges(varied)
        contexts = {"": Context(pooled, _values_of(self.stated))}
        for name, ranges in self.ranges.items():
            # A record whose voltage stands still says where its sensor is, and nothing else.
            extent = ranges if ranges in varied else replace(pooled, middle=ranges.middle)
            contexts[name] = Context(extent, _values_of(self.stated, name))
        return contexts

    @cached_property
    def defaults(self) -> dict[str, Distribution]:
        """The default priors of these records, by the parameters' names."""
        defaults = {
            column.name: column.declaration.default(self.contexts[column.record])
            for column in self.posterior.table.layout
        }
        return {
            name: default for name, default in defaults.items() if isinstance(default, Distribution)
        }

    def scales(self, draws: int) -> Scales:
        """Return the scales of the instruments for so many draws."""
        return self.record.instruments.scales(draws, self.generator("instruments"))

    def true_draws(self, read: FloatArray) -> FloatArray:
        """Return draws (..., free), as the readings have them, in true um and V."""
        if self.record.instruments == EXACT:
            return read
        flat, names = read.reshape(-1, read.shape[-1]), self.posterior.names
        scales, parameters = self.scales(len(flat)), {p.name: p for p in self.parameters}
        exponent: float | FloatArray | None = 1.0
        if "exponent" in parameters:
            exponent = parameters["exponent"].fixed
        if exponent is None:
            exponent = flat[:, names.index("exponent")]
        factors = [scales.factor(parameters[name].unit, exponent) for name in names]
        return (flat * np.stack(factors, axis=1)).reshape(read.shape)

    def _said_of(self, column: Column) -> Stated:
        """Return what is stated of a column of θ: of it alone, or of all records' together."""
        name = column.declaration.name
        statement = self.stated.get(column.name, self.stated.get(name))
        if statement is not None:
            return statement
        at_rest = 0.0 if name == "initial" else column.declaration.at_rest
        if column.declaration.scope == "record" and at_rest is not None:
            names = [column.record] if column.record else [*self.records]
            known = name == "initial" and self.spec.history == "demagnetized"
            rested = [known or record in self.from_rest for record in names]
            if all(rested):
                return Stated(fixed=at_rest)
            if any(rested):
                raise InputError(
                    f"model.shared: {name} cannot be shared by records of which some start from "
                    "rest and some do not; remove it"
                )
        return Stated()


def generator(seed: int, purpose: str) -> np.random.Generator:
    """Return the generator of one purpose of a run: each has a stream of its own."""
    return np.random.default_rng([seed, *purpose.encode()])


def _reaching(record: Record, corners: bool) -> Record:
    """Return a record whose path reaches its corners, or does not."""
    return record if record.corners == corners else replace(record, corners=corners)


def _readings(record: Record) -> FloatArray:
    """Return the displacement (samples,), um, of a record that has one."""
    usable = record.usable_displacement
    assert usable is not None
    return usable


def _values_of(stated: Mapping[str, Stated], record: str = "") -> dict[str, float | Distribution]:
    """Return the values and priors among statements, also of a record's own parameters."""
    values: dict[str, float | Distribution] = {}
    for name, statement in stated.items():
        value = statement.fixed if statement.prior is None else statement.prior
        if value is not None:
            values[name.removesuffix(f"[{record}]")] = value
    return values


# The name of a record that is fitted alone.
ALONE = "record"


def place_of(name: str) -> str:
    """Return where a config speaks of a training record of that name."""
    return "record" if name == ALONE else f"record.{name}"


def extent_of(records: Collection[Record]) -> Extent:
    """Return what a model takes from all records of an actuator."""
    paths = [record.path.voltage for record in records]
    span = Span(float(min(map(np.min, paths))), float(max(map(np.max, paths))))
    shortest = min(record.interval for record in records)
    return Extent(span, shortest, max(record.duration for record in records))


def declarations_of(spec: ModelSpec, extent: Extent) -> tuple[Declaration, ...]:
    """Return what the parts of a model declare, actuator and noise."""
    actuator = spec.actuator(extent.shortest, "first", extent)
    return ParameterTable(actuator, noise_model(spec.noise, extent.shortest)).declarations


def every_declaration() -> Iterator[Declaration]:
    """Yield what all parts of the package declare, whatever the model."""
    for make in chain.from_iterable(makers.values() for makers in PARTS.values()):
        yield from make().parameters
    for noise in NOISES.values():
        yield from noise(interval=1.0).declarations
    yield OFFSET


def require_known(
    where: str, stated: Collection[str], table: ParameterTable, *, elsewhere: bool = False
) -> None:
    """Refuse what is said of a parameter that the model has not, nor any model if ``elsewhere``.

    Raises
    ------
    InputError
        For the first such parameter; ``where`` is the table of the config.
    """
    columns = [replace(column.declaration, name=column.name) for column in table.layout]
    declarations = [*table.declarations, *columns]
    names = list(dict.fromkeys(declared.name for declared in declarations))
    for name in [name for name in stated if name not in names]:
        if name not in {declared.name for declared in every_declaration()}:
            aliases = {alias: d.name for d in declarations for alias in d.aliases}
            hint = suggestion(name, names, aliases)
            raise InputError(f"{where}.{name}: no such parameter here; {hint}")
        if not elsewhere:
            raise InputError(f"{where}.{name}: is not in this model; see [model], or remove it")


def _parameter(
    column: Column, stated: Stated, context: Context, quantities: Quantities
) -> Parameter:
    """Put what is stated of a parameter before what its part declares."""
    name, declared, record = column
    prior, fixed = stated.prior, stated.fixed
    if prior is None and fixed is None:
        default = declared.default(context)
        if default is None:
            why = f" ({declared.without_default})" if declared.without_default else ""
            raise InputError(f"parameters.{name}: has no default prior; give prior or fixed{why}")
        if isinstance(default, Distribution):
            prior = default
        else:
            fixed = default
    for value in chain([fixed or 0.0], prior.arguments.values() if prior else ()):
        # The model's products and quotients could not hold it.
        if value and not 1e-60 < abs(value) < 1e60:
            raise InputError(f"parameters.{name}: {value:g} is out of proportion; check its unit")
    unit = declared.unit_in(context.stated)
    own_unit = quantities.say(unit)
    if stated.unit is not None and own_unit not in (stated.unit, re.sub("[µμ]", "u", stated.unit)):
        raise InputError(
            f"parameters.{name}.unit: its numbers are in {own_unit}, not {stated.unit}; convert "
            "them"
        )
    above = record.replace("_", r"\_")
    return Parameter(
        name,
        stated.unit if stated.unit and own_unit == unit else unit,
        stated.label or declared.label + (rf"^{{\mathrm{{{above}}}}}" if record else ""),
        stated.description or declared.description + (f" of {record}" if record else ""),
        declared,
        prior,
        fixed,
        -np.inf if stated.lower is None else stated.lower,
        np.inf if stated.upper is None else stated.upper,
        record,
    )
