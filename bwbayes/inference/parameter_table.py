"""The table of a model's parameters: one order of θ's columns, and everybody asks by name.

The actuator's parameters come first, then the noise's, each in the order in which their parts
declare them. Several records of one actuator share the actuator's parameters. Each record has its
own initial state and offset, side by side, named after it: ``offset[step_10]``.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np

from bwbayes.arrays import FloatArray
from bwbayes.errors import InputError, suggestion
from bwbayes.inference.state_space import Noise
from bwbayes.model.actuator import Actuator
from bwbayes.model.declaration import Declaration, Scope
from bwbayes.shown import brief


class Column(NamedTuple):
    """A column of θ: its name, what its part declares, and whose it is.

    ``record`` is empty for what all records share.
    """

    name: str
    declaration: Declaration
    record: str


@dataclass(frozen=True)
class ParameterTable:
    """The parameters of a model and its records, in the order of θ's columns.

    Parameters
    ----------
    actuator_part, noise_part
        The model's parts, which all records have.
    records
        The records' names; of one alone, or none, all parameters have plain names.
    per_record, shared
        Parameters that each record has of its own, or that all share, whatever scope their part
        declares.

    Raises
    ------
    InputError
        A parameter that no part has, or that is to be both; bounds that ask for one.
    """

    __repr__ = brief

    actuator_part: Actuator
    noise_part: Noise
    records: tuple[str, ...] = ()
    per_record: tuple[str, ...] = ()
    shared: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        plain = [declaration.name for declaration in self.declarations]
        for key, names in (("per_record", self.per_record), ("shared", self.shared)):
            for name in names:
                if name not in plain:
                    hint = suggestion(name, plain)
                    raise InputError(f"model.{key}: no part here has {name!r}; {hint}")
        repeated = [name for name in self.per_record if name in self.shared]
        if repeated:
            raise InputError(
                f"model.per_record: {repeated[0]!r} is in model.shared too; "
                "remove it from one of them"
            )
        unit_values = {name: np.ones(1) for name in plain}
        for declaration in self.declarations:
            if declaration.bounds is None:
                continue
            try:
                with np.errstate(all="ignore"):
                    declaration.bounds(unit_values)
            except KeyError as unknown:
                raise InputError(
                    f"model: the bounds of {declaration.name} ask for {unknown}, which no part "
                    "here declares; declare it"
                ) from None

    @cached_property
    def declarations(self) -> tuple[Declaration, ...]:
        """The parameters of one record as their parts declare them."""
        return (*self.actuator_part.declarations, *self.noise_part.declarations)

    @cached_property
    def layout(self) -> tuple[Column, ...]:
        """The columns of θ, in their order."""
        columns = []
        for declared in self.declarations:
            by_record = declared.scope != "actuator" and declared.name not in self.shared
            if len(self.records) > 1 and (by_record or declared.name in self.per_record):
                for record in self.records:
                    columns.append(Column(f"{declared.name}[{record}]", declared, record))
            else:
                columns.append(Column(declared.name, declared, ""))
        return tuple(columns)

    @cached_property
    def names(self) -> tuple[str, ...]:
        """Names of θ's columns."""
        return tuple(column.name for column in self.layout)

    @property
    def loop(self) -> tuple[str, ...]:
        """Names of the parameters that shape the loop."""
        return tuple(column.name for column in self.layout if column.declaration.loop)

    @property
    def physical(self) -> tuple[str, ...]:
        """Names of the parameters that are the actuator's parts', not the noise's."""
        names = self.actuator_part.parameters
        return tuple(column.name for column in self.layout if column.declaration.name in names)

    def of_scope(self, *scopes: Scope) -> tuple[str, ...]:
        """Return the names of parameters of the actuator, of one record, or of its events."""
        return tuple(c.name for c in self.layout if c.declaration.scope in scopes)

    def columns(self, theta: FloatArray) -> dict[str, FloatArray]:
        """Return the columns (models,) of θ (models, parameters) by name."""
        return dict(zip(self.names, theta.T, strict=True))

    def actuator(self, theta: FloatArray) -> FloatArray:
        """Return the columns of one record's θ that the actuator takes, (models, parameters)."""
        return theta[:, : len(self.actuator_part.parameters)]

    def noise(self, theta: FloatArray) -> FloatArray:
        """Return the columns of one record's θ that the noise takes, (models, parameters)."""
        return theta[:, len(self.actuator_part.parameters) :]

    def replaced(self, theta: FloatArray, name: str, values: FloatArray) -> FloatArray:
        """Return a copy of θ (models, parameters) with other values (models,) of one parameter."""
        theta = theta.copy()
        theta[:, self.names.index(name)] = values
        return theta

    @cached_property
    def columns_of(self) -> dict[str, list[int]]:
        """Where each record's own θ has its columns in the joint one, by record."""
        return {
            record: [i for i, column in enumerate(self.layout) if column.record in ("", record)]
            for record in self.records
        }

    def of(self, theta: FloatArray, record: str) -> FloatArray:
        """Return θ of one record (models, its parameters) from the joint one."""
        columns: FloatArray = theta[:, self.columns_of[record]]
        return columns

    def name_of(self, name: str, record: str) -> str:
        """Return the name of the column that is a record's parameter ``name``."""
        plain = [declaration.name for declaration in self.declarations]
        return self.names[self.columns_of[record][plain.index(name)]]
