"""What a model is made of: its parts by name, in the order of the signal path, and its noise.

A :class:`ModelSpec` describes a model without any record. It makes the actuator for a record, says
what it is in words and as a config has it, and gives another one with a part replaced. Whoever
wants another model (a diagnosis, a comparison, a choice of noise) changes the spec.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from hashlib import sha256
from typing import Any, NamedTuple, Self

from bwbayes.errors import InputError
from bwbayes.model.actuator import Actuator
from bwbayes.model.creep import Creep, creep_times
from bwbayes.model.linear import Hold
from bwbayes.model.nonlinearity import TERMS, PolynomialNonlinearity
from bwbayes.model.operator import Operator, Span
from bwbayes.model.registry import DYNAMICS, HYSTERESIS, OPTIONS, STAGES, choose, made
from bwbayes.model.stage import Side, Stage


class Extent(NamedTuple):
    """What a model takes from all records of an actuator.

    ``span`` of their voltages, V, from which nonlinearity and creep count; the ``shortest``
    interval between samples and the ``longest`` duration, s, between which creep has its times.
    """

    span: Span
    shortest: float
    longest: float


@dataclass(frozen=True)
class ModelSpec:
    """A model: the parts of an actuator, by name or import path, and the noise of its readings.

    Parameters
    ----------
    hysteresis
        The operator.
    nonlinearity
        Terms of the static nonlinearity.
    creep
        Whether there is creep, or the times of its lags, s.
    creep_growth
        Whether the creep grows with the voltage.
    dynamics
        The linear dynamics.
    hold
        What the voltage does between samples; ``"auto"`` takes it from the record.
    noise
        The model of the residual.
    options
        Of the operator, by name.
    stages
        Further stages; those of the package stand in the order of :data:`STAGES`, others come last.
    """

    hysteresis: str = "bouc-wen"
    nonlinearity: tuple[str, ...] = ()
    creep: bool | tuple[float, ...] = False
    creep_growth: bool = False
    dynamics: str = "lag"
    hold: Hold | str = "auto"
    noise: str = "discrepancy"
    options: Mapping[str, Any] = field(default_factory=dict)
    stages: tuple[str, ...] = ()

    def with_parts(self, **changes: Any) -> Self:
        """Return the spec with other parts; another operator has options of its own."""
        if "hysteresis" in changes:
            changes = {"options": {}, **changes}
        return replace(self, **changes)

    def actuator(self, interval: float, hold: Hold, extent: Extent) -> Actuator:
        """Put the actuator together for a record, whose own ``hold`` counts where it is open.

        Raises
        ------
        InputError
            A part that does not exist, or an option that it does not have.
        """
        creep = None
        if self.creep:
            times: Sequence[float] = creep_times(extent.shortest, extent.longest)
            if isinstance(self.creep, tuple):
                times = self.creep
            creep = Creep(tuple(times), self.creep_growth, extent.span)
        elif self.creep_growth:
            raise InputError("model.creep_growth: there is no creep; give creep = true with it")
        return Actuator(
            self.dynamics,
            hold if self.hold == "auto" else self.hold,  # type: ignore[arg-type]  # refuses others
            interval,
            made("model.hysteresis", self.hysteresis, HYSTERESIS, self.options, Operator),
            PolynomialNonlinearity(self.nonlinearity, extent.span) if self.nonlinearity else None,
            creep,
            extent.span,
            tuple(made("model.stages", name, STAGES, {}, Stage) for name in self._in_order),
        )

    @property
    def chain(self) -> tuple[str, ...]:
        """Names of all stages that the model has, in the order of the signal's way."""
        further = {name: self._side_of(name) for name in self._in_order}
        core = (
            self.hysteresis,
            *self.nonlinearity,
            self.dynamics,
            *(("creep",) if self.creep else ()),
        )
        inputs = [name for name, side in further.items() if side == "input"]
        outputs = [name for name, side in further.items() if side == "output"]
        return (*inputs, *core, *outputs)

    def with_stage(self, name: str) -> Self:
        """Return the spec with a stage of the package, by its name.

        One operator and one dynamics exclude another; all else is added to what is there.

        Raises
        ------
        InputError
            No stage has that name.
        """
        if name in HYSTERESIS:
            return self.with_parts(hysteresis=name)
        if name in DYNAMICS:
            return self.with_parts(dynamics=name)
        if name in TERMS:
            terms = tuple(term for term in TERMS if term in (*self.nonlinearity, name))
            return self.with_parts(nonlinearity=terms)
        if name == "creep":
            return self if self.creep else self.with_parts(creep=True)
        choose("model.stages", name, STAGES)
        return self.with_parts(stages=(*self.stages, name))

    def without(self, name: str) -> Self:
        """Return the spec without a stage; that of the dynamics leaves none, the operator stays.

        Raises
        ------
        InputError
            The model has no such stage, or cannot do without.
        """
        if name in self.nonlinearity:
            return self.with_parts(
                nonlinearity=tuple(term for term in self.nonlinearity if term != name)
            )
        if name == "creep" and self.creep:
            return self.with_parts(creep=False, creep_growth=False)
        if name == self.dynamics and name != "none":
            return self.with_parts(dynamics="none")
        if name in self.stages:
            return self.with_parts(stages=tuple(one for one in self.stages if one != name))
        raise InputError(f"model: cannot leave out {name!r}; it has {', '.join(self.chain)}")

    def _side_of(self, name: str) -> Side:
        return made("model.stages", name, STAGES, {}, Stage).side

    @property
    def _in_order(self) -> list[str]:
        """The further stages in the order of the signal's way."""
        order = [*STAGES]
        repeated = [name for name in self.stages if self.stages.count(name) > 1]
        if repeated:
            raise InputError(f"model.stages: {repeated[0]!r} is there twice; leave one out")
        return sorted(
            self.stages, key=lambda name: order.index(name) if name in order else len(order)
        )

    def explicit(self, actuator: Actuator) -> Self:
        """Return the spec with all that it left open as an actuator of it has it, but the hold.

        The hold stays: another record has its own.
        """
        operator = actuator.hysteresis
        options = {name: getattr(operator, name) for name in OPTIONS if hasattr(operator, name)}
        creep = actuator.creep.times if actuator.creep else False
        return replace(self, creep=creep, options=options)

    def changes_to(self, other: ModelSpec) -> dict[str, Any]:
        """Return what another spec has that this one has not, by key of a config's [model]."""
        before, after = self.keys, other.keys
        return {name: value for name, value in after.items() if before.get(name) != value}

    @property
    def keys(self) -> dict[str, Any]:
        """What a config's [model] says of it, by key; lists for tuples."""
        keys = {name: value for name, value in vars(self).items() if name != "options"}
        return {
            name: list(value) if isinstance(value, tuple) else value
            for name, value in {**keys, **self.options}.items()
        }

    @property
    def sha256(self) -> str:
        """A digest: the same for the same model."""
        return sha256(json.dumps(self.keys, sort_keys=True).encode()).hexdigest()

    def __str__(self) -> str:
        """Return which parts there are, in a line."""
        parts = [self.hysteresis]
        if self.nonlinearity:
            parts.append(f"{' and '.join(self.nonlinearity)} nonlinearity")
        if self.creep:
            parts.append("creep that grows with the voltage" if self.creep_growth else "creep")
        parts += self.stages
        return f"{', '.join(parts)}, dynamics {self.dynamics}, {self.hold} hold"
