"""Description of a model: a chain of stages in the order of the signal, and a noise.

A :class:`ModelSpec` describes a model without any record. It makes the actuator for a record, says
what it is in words and as a config has it, and gives another one with a stage added, replaced or
left out. A diagnosis, a comparison or a choice of noise changes the spec to get another model; a
config reads and writes it.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, Literal, NamedTuple, Self, get_args

from bwbayes.errors import InputError
from bwbayes.model.actuator import Actuator
from bwbayes.model.inputs import Hold, Span
from bwbayes.model.linear import Creep, creep_times
from bwbayes.model.nonlinearity import TERMS, PolynomialNonlinearity
from bwbayes.model.operator import Operator
from bwbayes.model.registry import HYSTERESIS, OPTIONS, PARTS, STAGES, build_part
from bwbayes.model.stage import Stage

Slot = Literal["input", "hysteresis", "nonlinearity", "dynamics", "creep", "output"]
"""Where a stage stands; the slots are in the order of the signal's way."""


class Extent(NamedTuple):
    """The quantities that a model takes from all records of an actuator.

    ``span`` of their voltages, V, from which nonlinearity and creep count; the ``shortest``
    interval between samples and the ``longest`` duration, s, between which creep has its times.
    """

    span: Span
    shortest: float
    longest: float


class StageSpec(NamedTuple):
    """A stage by name or import path, where it stands, and its options, by a config's keys."""

    slot: Slot
    name: str
    options: tuple[tuple[str, Any], ...] = ()

    @classmethod
    def of(cls, slot: Slot, name: str, options: Mapping[str, Any]) -> Self:
        """Return a stage with those of the options that are said, whose lists become tuples."""
        stated_options = [
            (option, tuple(value) if isinstance(value, list) else value)
            for option, value in sorted(options.items())
            if value is not None
        ]
        return cls(slot, name, tuple(stated_options))

    @property
    def place(self) -> str:
        """The place that one stage of a chain takes: hysteresis or dynamics, or its name."""
        return self.slot if self.slot in ("hysteresis", "dynamics") else self.name


@dataclass(frozen=True)
class ModelSpec:
    """A model: the stages of an actuator, and the noise of its readings.

    Parameters
    ----------
    stages
        In whatever order, one hysteresis operator among them; they are kept in that of the signal's
        way, those of the package before others in the same slot.
    hold
        Course of the voltage between samples; ``"auto"`` takes it from the record, and so does
        ``"corners"``, with which straight lines meet at reversals between samples.
    history
        The drive before a record: ``"unknown"``, any over the voltages of the record, or
        ``"demagnetized"``, a voltage straight from 0 V.
    noise
        The model of the residual.

    Raises
    ------
    InputError
        A stage that is there twice, or two operators or dynamics; an unknown history.
    """

    stages: tuple[StageSpec, ...] = (
        StageSpec("hysteresis", "bouc-wen"),
        StageSpec("dynamics", "lag"),
    )
    hold: Hold | str = "auto"
    history: str = "unknown"
    noise: str = "discrepancy"

    def __post_init__(self) -> None:
        slots, names = get_args(Slot), (*TERMS, *STAGES)
        places = [stage.place for stage in self.stages]
        for place in places:
            if places.count(place) > 1:
                raise InputError(f"model: {place!r} is there twice; leave one out")
        if self.history not in ("unknown", "demagnetized"):
            raise InputError(
                f"history: {self.history!r} is unknown; write one of unknown, demagnetized"
            )

        def position(stage: StageSpec) -> tuple[int, int]:
            return slots.index(stage.slot), (*names, stage.name).index(stage.name)

        chain = sorted((stage for stage in self.stages if stage.name != "none"), key=position)
        object.__setattr__(self, "stages", tuple(chain))

    @classmethod
    def from_keys(cls, said: Mapping[str, Any]) -> Self:
        """Return the model that a config's [model] describes by these keys; others do not count.

        Raises
        ------
        InputError
            Something that no model can be.
        """
        keys = cls().keys | {key: value for key, value in said.items() if value is not None}
        stages = [
            StageSpec.of(
                "hysteresis", keys["hysteresis"], {name: keys.get(name) for name in OPTIONS}
            ),
            StageSpec("dynamics", keys["dynamics"]),
            *(StageSpec("nonlinearity", term) for term in keys["nonlinearity"]),
            *(StageSpec(_stage_named(name).side, name) for name in keys["stages"]),
        ]
        if keys["creep"]:
            stages.append(_creep(keys["creep"], keys["creep_growth"]))
        elif keys["creep_growth"]:
            raise InputError("model.creep_growth: there is no creep; give creep = true with it")
        return cls(tuple(stages), keys["hold"], keys["history"], keys["noise"])

    @property
    def keys(self) -> dict[str, Any]:
        """The keys of a config's [model]; lists for tuples."""
        keys = {
            "hysteresis": self.operator.name,
            "nonlinearity": self._in("nonlinearity"),
            "creep": "creep" in self.chain,
            "creep_growth": False,
            "dynamics": "".join(self._in("dynamics")) or "none",
            "hold": self.hold,
            "history": self.history,
            "noise": self.noise,
            "stages": self._in("input", "output"),
            **dict(option for stage in self.stages for option in stage.options),
        }
        return {
            key: list(value) if isinstance(value, tuple) else value for key, value in keys.items()
        }

    def changes_to(self, other: ModelSpec) -> dict[str, Any]:
        """Return what another spec has that this one has not, by key of a config's [model]."""
        before, after = self.keys, other.keys
        return {name: value for name, value in after.items() if before.get(name) != value}

    @property
    def operator(self) -> StageSpec:
        """The hysteresis operator."""
        return next(stage for stage in self.stages if stage.slot == "hysteresis")

    @property
    def chain(self) -> tuple[str, ...]:
        """Names of all stages, in the order of the signal's way."""
        return tuple(stage.name for stage in self.stages)

    def _in(self, *slots: Slot) -> list[str]:
        return [stage.name for stage in self.stages if stage.slot in slots]

    def with_stages(self, *stages: StageSpec | str) -> Self:
        """Return the spec with further stages; those that the package has go by their names.

        A stage replaces one of its name; an operator replaces another, dynamics do too.

        Raises
        ------
        InputError
            No stage has that name.
        """
        chain = list(self.stages)
        for stage in stages:
            added = stage if isinstance(stage, StageSpec) else StageSpec(_slot_of(stage), stage)
            chain = [*(other for other in chain if other.place != added.place), added]
        return replace(self, stages=tuple(chain))

    def without(self, *names: str) -> Self:
        """Return the spec without stages; the operator cannot be left out.

        Raises
        ------
        InputError
            The model has no such stage, or cannot do without.
        """
        for name in names:
            if name not in self.chain or name == self.operator.name:
                raise InputError(
                    f"model: cannot leave out {name!r}; it has {', '.join(self.chain)}"
                )
        return replace(
            self, stages=tuple(stage for stage in self.stages if stage.name not in names)
        )

    @property
    def without_clock(self) -> Self:
        """The model of records that have no time: its rate-independent stages and white noise."""
        timed = [
            stage.name
            for stage in self.stages
            if stage.slot in ("dynamics", "creep")
            or (stage.slot in ("input", "output") and not _stage_named(stage.name).rate_independent)
        ]
        return replace(self.without(*timed), noise="white")

    def explicit(self, actuator: Actuator) -> Self:
        """Return the spec with all that it left open as an actuator of it has it, but the hold.

        The hold stays: another record has its own.
        """
        operator, creep = actuator.hysteresis, actuator.creep
        options = {name: getattr(operator, name, None) for name in OPTIONS}
        stages = [StageSpec.of("hysteresis", self.operator.name, options)]
        if creep is not None:
            stages.append(_creep(creep.times, creep.growing))
        return self.with_stages(*stages)

    def actuator(self, interval: float, hold: Hold, extent: Extent) -> Actuator:
        """Put the actuator together for a record, whose own ``hold`` counts where it is open.

        Raises
        ------
        InputError
            A stage that does not exist, or an option that it does not have.
        """
        keys, terms, times = self.keys, tuple(self._in("nonlinearity")), self.keys["creep"]
        if times is True:
            times = creep_times(extent.shortest, extent.longest)
        return Actuator(
            keys["dynamics"],
            hold if self.hold in ("auto", "corners") else self.hold,  # type: ignore[arg-type]  # refuses others
            interval,
            build_part(
                "model.hysteresis",
                self.operator.name,
                HYSTERESIS,
                dict(self.operator.options),
                Operator,
            ),
            PolynomialNonlinearity(terms, extent.span) if terms else None,
            Creep(tuple(times), keys["creep_growth"], extent.span) if times else None,
            extent.span,
            tuple(map(_stage_named, keys["stages"])),
            self.history == "demagnetized",
        )

    def __str__(self) -> str:
        """Return which parts there are, in a line."""
        keys = self.keys
        parts = [keys["hysteresis"]]
        if keys["nonlinearity"]:
            parts.append(f"{' and '.join(keys['nonlinearity'])} nonlinearity")
        if keys["creep"]:
            parts.append(f"creep{' that grows with the voltage' * keys['creep_growth']}")
        parts += keys["stages"]
        if self.history == "demagnetized":
            parts.append("demagnetized before the record")
        course = "corners between samples" if self.hold == "corners" else f"{self.hold} hold"
        return f"{', '.join(parts)}, dynamics {keys['dynamics']}, {course}"


def _creep(times: Any, growth: bool) -> StageSpec:
    options = {"creep": None if times is True else times, "creep_growth": growth or None}
    return StageSpec.of("creep", "creep", options)


def _slot_of(name: str) -> Slot:
    slots = (slot for slot in get_args(Slot) if name in PARTS.get(slot, ()))
    return next(slots, None) or _stage_named(name).side


def _stage_named(name: str) -> Stage:
    """Return a stage before or behind the hysteresis, by its name or import path."""
    return build_part("model.stages", name, STAGES, {}, Stage)
