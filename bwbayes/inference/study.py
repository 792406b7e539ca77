"""A study: a model, the records to fit, and statements about its parameters.

A :class:`Study` makes the posterior. Statements about parameters (priors, values, bounds, names)
come before the declarations of the model's parts. The same study with another model keeps the
statements about parameters that both have.
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

from bwbayes.arrays import FloatArray
from bwbayes.errors import InputError, suggestion
from bwbayes.inference.defaults import join_ranges, ranges_of
from bwbayes.inference.engine import Engine
from bwbayes.inference.noise import NOISES, noise_model
from bwbayes.inference.parameter_table import Column, ParameterTable
from bwbayes.inference.parameters import JointPrior, Parameter
from bwbayes.inference.posterior import Dataset, Posterior
from bwbayes.model.actuator import OFFSET
from bwbayes.model.declaration import Context, Declaration, Distribution, Ranges
from bwbayes.model.inputs import Span
from bwbayes.model.registry import PARTS
from bwbayes.model.spec import Extent, ModelSpec
from bwbayes.quantities import Quantities
from bwbayes.record import Record
from bwbayes.shown import brief


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


@dataclass(frozen=True)
class TrainingRecord:
    """A record that is fitted, the windows of it (slices), and whether it starts from rest."""

    __repr__ = brief

    record: Record
    windows: tuple[slice, ...]
    from_rest: bool = False

    @property
    def displacement(self) -> FloatArray:
        """The displacement (samples,), um, of a record that has one."""
        assert self.record.displacement is not None
        return self.record.displacement

    @cached_property
    def ranges(self) -> Ranges:
        """Ranges in its windows, which default priors may depend on."""
        return ranges_of(self.record.inputs, self.displacement, self.windows)


@dataclass(frozen=True)
class Study:
    """A model, the records that it is fitted to, and what is stated of its parameters.

    Parameters
    ----------
    spec
        The model.
    records
        Records to fit, by name.
    stated
        Statements about parameters, by name, or by name[record] for one record.
    per_record, shared
        Parameters that each record has of its own besides those that declare it, and of these
        those that all records share.
    engine
        Engine of the likelihood.
    """

    __repr__ = brief

    spec: ModelSpec
    records: Mapping[str, TrainingRecord]
    stated: Mapping[str, Stated] = field(default_factory=dict)
    per_record: tuple[str, ...] = ()
    shared: tuple[str, ...] = ()
    engine: Engine = "numpy"

    @property
    def quantities(self) -> Quantities:
        """Quantities of the records."""
        return next(iter(self.records.values())).record.quantities

    def with_model(self, spec: ModelSpec, added: Mapping[str, Stated] | None = None) -> Self:
        """Return the study of another model.

        It keeps statements about parameters that the other model has too: a parameter of
        another unit is another one, whatever its name. ``added`` is stated of others, or instead.
        """
        say, statements = self.quantities.say, {**self.stated, **(added or {})}
        values = _values_of(statements)
        units = {d.name: say(d.unit_in(values)) for d in declarations_of(spec, self.extent)}
        stated = {
            name: statement
            for name, statement in statements.items()
            if (plain := name.partition("[")[0]) in units and statement.unit in (None, units[plain])
        }
        per_record, shared = (
            tuple(name for name in names if name in units)
            for names in (self.per_record, self.shared)
        )
        return replace(self, spec=spec, stated=stated, per_record=per_record, shared=shared)

    def for_record(self, record: str) -> Self:
        """Return the study of one of the records, with what is stated of its own parameters."""
        stated = {
            name.removesuffix(f"[{record}]"): statement for name, statement in self.stated.items()
        }
        return replace(
            self,
            records={record: self.records[record]},
            stated={name: statement for name, statement in stated.items() if "[" not in name},
            per_record=(),
            shared=(),
        )

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
        for name, training in self.records.items():
            record, table = training.record, place_of(name)
            edges = np.array([[window.start, window.stop] for window in training.windows])
            keys[f"{table}.train"] = (record.start + record.interval * edges).tolist()
            keys[f"{table}.from_rest"] = training.from_rest
            if record.path.noise_sd:
                keys[f"voltage of {name}"] = "without its noise"
        return keys

    @property
    def data_sha256(self) -> str:
        """A digest of all readings: that of the record, or of several with their names."""
        digests = {name: training.record.sha256 for name, training in self.records.items()}
        if len(digests) == 1:
            return next(iter(digests.values()))
        return sha256(json.dumps(digests).encode()).hexdigest()

    @cached_property
    def extent(self) -> Extent:
        """The quantities that the model takes from all records."""
        return extent_of([training.record for training in self.records.values()])

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
            Dataset(
                training.record.inputs,
                training.displacement,
                training.windows,
                self.spec.actuator(training.record.interval, training.record.hold, self.extent),
                noise_model(self.spec.noise, training.record.interval),
                training.from_rest,
                name,
            )
            for name, training in self.records.items()
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
        return Posterior(tuple(datasets), prior, self.engine, table)

    @cached_property
    def contexts(self) -> dict[str, Context]:
        """The ranges that default priors use, of each record by name, and ("") of all together.

        From the windows that are fitted.

        Raises
        ------
        InputError
            Voltage or displacement does not vary there, in any of them.
        """
        ranges = {name: training.ranges for name, training in self.records.items()}
        varied = [
            extents
            for extents in ranges.values()
            if extents.voltage > 0 and extents.displacement > 0
        ]
        if not varied:
            table = place_of(next(iter(self.records)))
            raise InputError(f"{table}.train: voltage or displacement is constant there; widen it")
        pooled = join_ranges(varied)
        contexts = {"": Context(pooled, self._values())}
        for name, extents in ranges.items():
            # A record whose voltage stands still says where its sensor is, and nothing else.
            extent = extents if extents in varied else replace(pooled, middle=extents.middle)
            contexts[name] = Context(extent, self._values(name))
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

    def _values(self, record: str = "") -> dict[str, float | Distribution]:
        """Return what is stated of parameters, also of a record's own: values, and priors."""
        return _values_of(self.stated, record)

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
            rested = [known or self.records[record].from_rest for record in names]
            if all(rested):
                return Stated(fixed=at_rest)
            if any(rested):
                raise InputError(
                    f"model.shared: {name} cannot be shared by records of which some start from "
                    "rest and some do not; remove it"
                )
        return Stated()


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
