"""A model for a controller: its coefficients with units, and a C file that does a sample a call.

The C file needs no library but ``math.h`` and allocates nothing. It holds the very functions of
:mod:`bwbayes.control.sampled`, forward and, where the model has one, inverse; both take a bounded
time. Where a voltage is held between samples, forward returns the displacement just before its
voltage acts and inverse the voltage for the next sample: forward of inverse is one sample late. A
value that is not a number holds the last voltage and sets ``held`` of the state.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import partial
from importlib.metadata import version
from pathlib import Path
from textwrap import wrap
from typing import Any, ClassVar

import numpy as np
from jinja2 import Environment, PackageLoader, StrictUndefined

from bwbayes.arrays import FloatArray
from bwbayes.control.codegen import c_functions, to_ascii, to_c_number
from bwbayes.control.sampled import (
    SampledModel,
    SampledStage,
    advance,
    require_inverse,
    resolution,
    search,
    settle,
)
from bwbayes.diagnosis.validation import ValidationSummary
from bwbayes.errors import InputError, refuse_unwritable
from bwbayes.model.actuator import Actuator
from bwbayes.model.limits import Limits
from bwbayes.model.registry import HYSTERESIS
from bwbayes.quantities import DEFAULT
from bwbayes.report.outputs import refuse_existing, write_summary
from bwbayes.report.report import Facts, Product, Report
from bwbayes.shown import brief
from bwbayes.watching import Watch, unwatched

FILES = ("model.json", "actuator.c")


@dataclass(frozen=True)
class Exported(Product):
    """A model of an actuator that is ready for a controller.

    ``model`` is the one model, a sample at a time; its inverse gives voltages within ``limits``, V,
    and changes them as fast; ``without_inverse`` says why it has none. ``sds`` are the standard
    deviations of its parameters, by name, if they are known, and ``standing`` is how the validation
    of its run came out.
    """

    NAME: ClassVar[str] = "model"
    __repr__ = __str__ = brief

    name: str
    model: SampledModel
    limits: Limits
    sds: Mapping[str, float]
    without_inverse: str | None
    standing: ValidationSummary = field(default_factory=ValidationSummary)

    @property
    def shortfall(self) -> str:
        """Why it has no inverse; empty if it has one."""
        return f"no inverse in it: {self.without_inverse}" if self.without_inverse else ""

    def report(self) -> Report:
        """Return the parts, for a page: the files are all there is to see on a screen."""
        facts = [(name, str(value)) for name, value in self.numbers()["parts"].items()]
        facts += [("limits of the inverse", str(self.limits))]
        return Report(title=self.name, blocks=[Facts(facts)])

    def save(
        self, folder: str | Path, *, overwrite: bool = False, watch: Watch = unwatched
    ) -> list[Path]:
        """Write ``model.json`` and ``actuator.c`` to a folder, and return them.

        Raises InputError: a file that exists, unless it may be replaced, or that cannot be written.
        """
        numbers, code = files = [Path(folder) / name for name in FILES]
        refuse_existing(files, overwrite=overwrite)
        with refuse_unwritable(folder, "choose another folder"):
            numbers.parent.mkdir(parents=True, exist_ok=True)
            write_summary(numbers, self.quantities.rendered(self.numbers()))
            code.write_text(self.c_code(), encoding="ascii")
        watch(1.0)
        return files

    @property
    def linear(self) -> Any:
        """The linear part, a discrete ``scipy.signal.StateSpace``."""
        return self.model.linear

    def numbers(self) -> dict[str, Any]:
        """Return what ``model.json`` says: parts, parameters and coefficients, with their units."""
        actuator = self.model.actuator
        means = {name: float(values[0]) for name, values in self.model.column.items()}
        linear = self.linear
        nonlinearity: dict[str, float] | None = None
        if actuator.nonlinearity is not None and actuator.nonlinearity.reference.half > 0:
            terms = {f"{n}_um": means.get(n, 0.0) for n in ("quadratic", "cubic")}
            reference = actuator.nonlinearity.reference
            nonlinearity = {"middle_V": reference.middle, "half_V": reference.half, **terms}
        return {
            "name": self.name,
            "bwbayes": version("bwbayes"),
            "validation": self.standing.numbers,
            "interval_s": actuator.interval,
            "hold": actuator.hold,
            **self.limits.numbers,
            "inverse": self.without_inverse is None,
            "without_inverse": self.without_inverse,
            "parts": {
                "hysteresis": self._called,
                "nonlinearity": list(actuator.nonlinearity.terms) if actuator.nonlinearity else [],
                "dynamics": actuator.dynamics,
                "creep_times_s": list(actuator.creep.times) if actuator.creep else [],
                "stages": [stage.name for stage in actuator.stages],
            },
            "parameters": {
                declaration.name: {
                    "mean": means[declaration.name],
                    "sd": self.sds.get(declaration.name),
                    "unit": declaration.unit_in(means),
                    "description": declaration.description,
                }
                for declaration in actuator.declarations
            },
            "hysteresis": {
                name: {"value": value, "unit": unit}
                for name, (value, unit) in self.model.step.coefficients().items()
            },
            "nonlinearity": nonlinearity,
            "creep_growth_per_V": float(self.model.curve[4, 0]),
            "zero": {
                "value": float(self.model.zero[0]),
                "unit": "um",
                "description": "subtracted, so that 0 um is where the demagnetized actuator stands "
                "at zero volts",
            },
            "sections": {
                "unit": "um of displacement for a um of drive, both from rest",
                "recursions": [
                    {
                        "what": "creep" if number else "dynamics",
                        "numerator": numerator,
                        "denominator": denominator,
                        "gain": gain,
                    }
                    for number, (numerator, denominator, gain) in enumerate(
                        zip(*(taps[0].tolist() for taps in self.model.sections), strict=True)
                    )
                ],
            },
            "state_space": {
                "unit": "um of displacement for a um of drive, both from rest",
                **{name: getattr(linear, name).tolist() for name in "ABCD"},
                "dt_s": actuator.interval,
            },
        }

    def c_code(self) -> str:
        """Return the C file."""
        environment = Environment(
            loader=PackageLoader("bwbayes.control"),
            autoescape=False,  # it is C, and all that fills it in are numbers and plain words
            undefined=StrictUndefined,
            trim_blocks=True,
            lstrip_blocks=True,
            keep_trailing_newline=True,
            finalize=lambda value: to_c_number(value) if isinstance(value, float) else value,
        )
        # Characters that end no comment in C.
        environment.filters["plain"] = partial(re.sub, r"[^\w .,:;=+()%-]", "_", flags=re.ASCII)
        model, actuator, step = self.model, self.model.actuator, self.model.step
        remembered = step.demagnetized()[0].tolist()
        parts = [f"hysteresis {self._called}", f"dynamics {actuator.dynamics}"]
        parts += ["static nonlinearity"] * bool(actuator.nonlinearity) + ["creep"] * bool(
            actuator.creep
        )
        parts += [stage.name for stage in actuator.stages]
        tables = {"parameters": step.parameters[0], "curve": model.curve[:, 0]}
        tables["taps"] = model.taps[:, :, 0]
        sections = len(tables["taps"])
        shapes = {name: values.shape for name, values in tables.items()}
        shapes |= dict.fromkeys(("memory", "after"), (len(remembered),))
        shapes |= dict.fromkeys(("initial", "settled"), (sections,))
        shapes |= dict.fromkeys(("filters", "filtered"), (sections, 2))
        functions: list[Callable[..., Any]] = [settle, advance]
        functions += [search] * (self.without_inverse is None)
        code = environment.get_template("actuator.c.j2").render(
            **self.numbers(),
            parts_line=f"Parts: {', '.join(parts)}.",
            warnings=[line for text in self.standing.messages for line in wrap(text, 92)],
            held=actuator.hold == "zero",
            hysteresis_is=to_ascii(type(step).__doc__ or "").split("\n\n")[0],
            parameters_are=to_ascii(step.ROW),
            tables={name: [*map(to_c_number, x.ravel())] for name, x in tables.items()},
            remembered=remembered,
            functions=c_functions(functions, shapes, "actuator_", {"move": type(step).move}),
            close=resolution(self.limits.span),
            limits=str(self.limits),
            step=self.limits.rate * actuator.interval,
            inputs=[*map(self._stage_in_c, model.inputs[0])],
            outputs=[*map(self._stage_in_c, model.outputs[0])],
        )
        if self.quantities == DEFAULT:
            return code
        # Comments speak of the quantities; in the code the names are those of any.
        parts = re.split(r"(/\*.*?\*/)", code, flags=re.DOTALL)
        parts[1::2] = [to_ascii(self.quantities.say(comment)) for comment in parts[1::2]]
        names = re.compile(r"\b(voltage|displacement)\b")
        roles = {"voltage": "input", "displacement": "output"}
        parts[::2] = [names.sub(lambda name: roles[name[0]], plain) for plain in parts[::2]]
        return "".join(parts)

    def _stage_in_c(self, sampled: SampledStage) -> dict[str, Any]:
        """Return what the template says of a stage before or behind the model's core."""
        stage, numbers, at_rest = sampled
        name = re.sub(r"\W", "_", stage.name)
        size = max(stage.remembers, 1)  # C has no empty arrays
        shapes = {"parameters": (len(numbers),), "memory": (size,), "after": (size,)}
        functions: list[Callable[..., Any]] = [stage.settle] * (stage.remembers > 0) + [stage.move]
        functions += [stage.undo] * (self.without_inverse is None)
        return {
            "name": name,
            "what": to_ascii(type(stage).__doc__ or "").split("\n\n")[0],
            "parameters": [*map(to_c_number, numbers[:, 0])],
            "size": size,
            "settles": stage.remembers > 0,
            "keeps_path": stage.rate_independent and stage.remembers > 0,
            "at_rest": float(at_rest[0]),
            "functions": c_functions(functions, shapes, f"actuator_{name}_"),
        }

    @property
    def _called(self) -> str:
        """The operator's name in a config."""
        kind = type(self.model.actuator.hysteresis)
        path = f"{kind.__module__}:{kind.__qualname__}"
        return next((name for name, operator in HYSTERESIS.items() if operator is kind), path)


def exported(
    name: str,
    actuator: Actuator,
    theta: FloatArray,
    limits: Limits,
    sds: Mapping[str, float] | None = None,
) -> Exported:
    """Return a model with parameters θ (parameters,) that is ready for a controller.

    The actuator has parts, hold and the controller's sampling interval; the others are those of
    :class:`Exported`.

    Raises InputError: a hysteresis that has no step of bounded time, or voltages without a limit.
    """
    if not np.isfinite(limits.span).all():
        raise InputError(f"limits: {limits.low:g} to {limits.high:g} V; give two voltages")
    model = SampledModel.of(actuator, np.atleast_2d(theta))
    without_inverse = None
    try:
        require_inverse(model, limits.span)
    except InputError as error:
        without_inverse = str(error)
    return Exported(name, model, limits, sds or {}, without_inverse)
