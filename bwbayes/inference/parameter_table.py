"""The tables of a model's parameters: one order of θ's columns, and everybody asks by name.

A :class:`ParameterTable` is that of one record: the actuator's parameters come first, then the
noise's, each in the order in which their parts declare them. A :class:`JointTable` is that of
several records that were measured on one actuator: what belongs to the actuator is there once, what
belongs to a record (its initial state, its offset) once for each, side by side, and named after it:
``offset[step_10]``. Of one record both are the same.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np

from bwbayes.arrays import FloatArray, IntArray
from bwbayes.errors import InputError, suggestion
from bwbayes.inference.noise import Noise
from bwbayes.model.actuator import Actuator
from bwbayes.model.declaration import Declaration, Scope
from bwbayes.shown import brief

__all__ = ["Column", "JointTable", "ParameterTable"]


@dataclass(frozen=True)
class ParameterTable:
    """The parameters of an actuator and of a noise, in the order of θ's columns."""

    __repr__ = brief

    actuator_part: Actuator
    noise_part: Noise

    @cached_property
    def declarations(self) -> tuple[Declaration, ...]:
        """The parameters as their parts declare them."""
        return (*self.actuator_part.declarations, *self.noise_part.declarations)

    @cached_property
    def names(self) -> tuple[str, ...]:
        """Names of θ's columns."""
        return tuple(declaration.name for declaration in self.declarations)

    def of_scope(self, scope: Scope) -> tuple[str, ...]:
        """Return the names of parameters of the actuator, or of one record."""
        return tuple(d.name for d in self.declarations if d.scope == scope)

    @property
    def loop(self) -> tuple[str, ...]:
        """Names of the parameters that shape the loop."""
        return tuple(d.name for d in self.declarations if d.loop)

    def columns(self, theta: FloatArray) -> dict[str, FloatArray]:
        """Return the columns (models,) of θ (models, parameters) by name."""
        return dict(zip(self.names, theta.T, strict=True))

    def actuator(self, theta: FloatArray) -> FloatArray:
        """Return the columns of θ that the actuator takes, (models, its parameters)."""
        return theta[:, : len(self.actuator_part.parameters)]

    def noise(self, theta: FloatArray) -> FloatArray:
        """Return the columns of θ that the noise takes, (models, its parameters)."""
        return theta[:, len(self.actuator_part.parameters) :]

    def replaced(self, theta: FloatArray, name: str, values: FloatArray) -> FloatArray:
        """Return a copy of θ (models, parameters) with other values (models,) of one parameter."""
        theta = theta.copy()
        theta[:, self.names.index(name)] = values
        return theta


class Column(NamedTuple):
    """A column of a joint θ: its name, what its part declares, and whose it is.

    ``record`` is empty for what all records share.
    """

    name: str
    declaration: Declaration
    record: str


@dataclass(frozen=True)
class JointTable:
    """The parameters of one model and several records, in the order of θ's columns.

    Parameters
    ----------
    table
        The parameters of one record: of all of them, for they have the same parts.
    records
        The records' names.
    per_record, shared
        Parameters that each record has of its own, or that all share, whatever scope their part
        declares.

    Raises
    ------
    InputError
        A parameter that no part has, or that is to be both.
    """

    table: ParameterTable
    records: tuple[str, ...]
    per_record: tuple[str, ...] = ()
    shared: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        for key, names in (("per_record", self.per_record), ("shared", self.shared)):
            for name in names:
                if name not in self.table.names:
                    hint = suggestion(name, self.table.names)
                    raise InputError(f"model.{key}: no part here has {name!r}; {hint}")
        repeated = [name for name in self.per_record if name in self.shared]
        if repeated:
            raise InputError(
                f"model.per_record: {repeated[0]!r} is in model.shared too; "
                "remove it from one of them"
            )

    @cached_property
    def layout(self) -> tuple[Column, ...]:
        """The columns of θ, in their order."""
        return tuple(self._laid_out())

    def _laid_out(self) -> Iterator[Column]:
        for declared in self.table.declarations:
            if len(self.records) > 1 and self._is_own(declared):
                for record in self.records:
                    yield Column(f"{declared.name}[{record}]", declared, record)
            else:
                yield Column(declared.name, declared, "")

    def _is_own(self, declared: Declaration) -> bool:
        if declared.scope == "record":
            return declared.name not in self.shared
        return declared.name in self.per_record

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
        names = self.table.actuator_part.parameters
        return tuple(column.name for column in self.layout if column.declaration.name in names)

    def columns(self, theta: FloatArray) -> dict[str, FloatArray]:
        """Return the columns (models,) of θ (models, parameters) by name."""
        return dict(zip(self.names, theta.T, strict=True))

    @cached_property
    def _places(self) -> dict[str, IntArray]:
        """Of each record, where its own θ's columns are in the joint one."""
        places = {}
        for record in self.records:
            columns = {
                column.declaration.name: index
                for index, column in enumerate(self.layout)
                if column.record in ("", record)
            }
            places[record] = np.array([columns[name] for name in self.table.names])
        return places

    def places(self, record: str) -> IntArray:
        """Return where the columns of a record's own θ are in the joint one."""
        return self._places[record]

    def of(self, theta: FloatArray, record: str) -> FloatArray:
        """Return θ of one record (models, its parameters) from the joint one."""
        columns: FloatArray = theta[:, self._places[record]]
        return columns

    def name_of(self, name: str, record: str) -> str:
        """Return the name of the column that is a record's parameter ``name``."""
        return self.names[int(self._places[record][self.table.names.index(name)])]
