"""A model for a controller: its coefficients with units, and a C file that does a sample a call.

The C file needs no library but ``math.h`` and allocates nothing. It holds the very functions of
:mod:`bwbayes.control.sampled`, forward and, where the model has one, inverse; both take a bounded
time. Where a voltage is held between samples, forward returns the displacement just before its
voltage acts and inverse the voltage for the next sample: forward of inverse is one sample late. A
value that is not a number holds the last voltage and sets ``held`` of the state.

:func:`c_functions` prints Python functions of numbers as C, so that a controller's code is written
once. They are made of assignments, ``if``, loops, arithmetic, those of NumPy's functions that
``math.h`` has, and functions of the same kind. Python's own unparser writes their expressions; what
C spells otherwise is replaced in the syntax tree first.
"""

from __future__ import annotations

import ast
import inspect
import re
import textwrap
import unicodedata
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from importlib.metadata import version
from pathlib import Path
from textwrap import wrap
from types import FunctionType, MappingProxyType
from typing import Any, ClassVar

import numpy as np
from jinja2 import Environment, PackageLoader, StrictUndefined

from bwbayes.arrays import FloatArray
from bwbayes.control.compensation import facts_of
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
from bwbayes.model.inputs import Limits
from bwbayes.model.registry import HYSTERESIS
from bwbayes.quantities import DEFAULT
from bwbayes.record.instruments import EXACT, Instruments
from bwbayes.report.report import Facts, Product, Report
from bwbayes.report.result import refuse_existing, write_summary
from bwbayes.shown import brief
from bwbayes.watching import Watch, unwatched

# NumPy's functions of numbers that math.h has, by their names there.
MATH_H: Mapping[str, str] = {
    **{name: name for name in ("sin", "cos", "tan", "sinh", "cosh", "tanh")},
    **{f"arc{name}": f"a{name}" for name in ("sin", "cos", "tan", "sinh", "cosh", "tanh", "tan2")},
    **{name: name for name in ("exp", "exp2", "expm1", "log", "log2", "log10", "log1p")},
    **{name: name for name in ("sqrt", "cbrt", "hypot", "floor", "ceil", "trunc", "rint")},
    **{name: name for name in ("fabs", "copysign", "fmod", "fmin", "fmax")},
    "abs": "fabs",
    "minimum": "fmin",
    "maximum": "fmax",
    "power": "pow",
}


def c_functions(
    functions: Sequence[Callable[..., Any]],
    shapes: Mapping[str, tuple[int, ...]],
    prefix: str,
    bindings: Mapping[str, Callable[..., Any]] = MappingProxyType({}),
) -> str:
    """Return functions and those that they call as static functions of C, callees first.

    They are of numbers and of arrays, with ``shapes`` by the names of arguments; ``after``,
    ``settled`` and ``filtered`` are written to. C returns the first number that a function returns,
    and writes the others through pointers. ``bindings`` are functions that arguments stand for: C
    has these by their names. All names begin with ``prefix``.

    Raises InputError: an expression or statement that has no counterpart here.
    """
    printed: dict[FunctionType, str] = {}
    for function in functions:
        assert inspect.isfunction(function)
        _Printer(function, shapes, prefix, bindings, printed)
    return "\n".join(printed.values())


def to_ascii(text: str) -> str:
    """Return a text with Greek letters by their names and exponents as plain digits."""
    signs = {"−": "-", "′": "'", "≥": ">=", "≤": "<=", "``": "", "Σ": "sum of", "²": "^2"}
    for sign, plain in {**signs, "ⁿ": "^n"}.items():
        text = text.replace(sign, plain)
    for letter in set(text):
        if "GREEK" in unicodedata.name(letter, ""):
            text = text.replace(letter, unicodedata.name(letter).rsplit(" ", 1)[1].lower())
    return unicodedata.normalize("NFKD", text).encode("ascii", "ignore").decode()


def to_c_number(value: float) -> str:
    """Return a number as C writes it, to the last bit."""
    return repr(float(value)).replace("inf", "HUGE_VAL")


class _Printer(ast.NodeTransformer):
    """Prints one function into ``printed``, after those that it calls."""

    def __init__(
        self,
        function: FunctionType,
        shapes: Mapping[str, tuple[int, ...]],
        prefix: str,
        bindings: Mapping[str, Callable[..., Any]],
        printed: dict[FunctionType, str],
    ) -> None:
        self.function, self.shapes, self.prefix = function, shapes, prefix
        self.bindings, self.printed = bindings, printed
        self.tables: dict[str, Sequence[float]] = {}
        self.variables = set(function.__code__.co_varnames)
        tree = ast.parse(textwrap.dedent(inspect.getsource(function))).body[0]
        assert isinstance(tree, ast.FunctionDef)
        body = [f"    {line}" for line in self.block(tree.body)]
        declared = list(self.declarations(tree))
        used = {node.id for node in ast.walk(tree) if isinstance(node, ast.Name)}
        unused = {argument.arg for argument in tree.args.args} - used - {*bindings}
        body = [*(f"    (void){name};" for name in sorted(unused)), *body]
        lines = [self.head(tree), "{", *declared, *[""] * bool(declared), *body, "}", ""]
        comment = (
            to_ascii(inspect.getdoc(function) or "").replace("\n", "\n * ").replace(" * \n", " *\n")
        )
        deeper = "            "
        wrapped = [textwrap.fill(line, 100, subsequent_indent=deeper) for line in lines]
        printed[function] = "\n".join([f"/* {comment} */", *wrapped])

    def head(self, tree: ast.FunctionDef) -> str:
        """Return the function's name, arguments, and pointers for further results."""
        returned = [node.value for node in ast.walk(tree) if isinstance(node, ast.Return)]
        results = max(len(v.elts) if isinstance(v, ast.Tuple) else 1 for v in returned)
        names = [argument.arg for argument in tree.args.args]
        written = ("after", "settled", "filtered")
        kinds = dict.fromkeys(self.shapes, "const double *") | dict.fromkeys(written, "double *")
        arguments = [f"{kinds.get(n, 'double ')}{n}" for n in names if n not in self.bindings]
        arguments += [f"double *result_{number}" for number in range(1, results)]
        return f"static double {self.prefix}{tree.name}({', '.join(arguments)})"

    def declarations(self, tree: ast.FunctionDef) -> Iterator[str]:
        """Yield the lines that declare tables, numbers and counters of loops."""
        for name, row in self.tables.items():
            numbers = ", ".join(map(to_c_number, row))
            yield f"    static const double {name}[] = {{ {numbers} }};"
        nodes = list(ast.walk(tree))
        counters = [ast.unparse(node.target) for node in nodes if isinstance(node, ast.For)]
        stored = [n.id for n in nodes if isinstance(n, ast.Name) and isinstance(n.ctx, ast.Store)]
        declared = {*counters, *(argument.arg for argument in tree.args.args)}
        numbers_of = [name for name in dict.fromkeys(stored) if name not in declared]
        for kind, names in (("double", numbers_of), ("int", list(dict.fromkeys(counters)))):
            if names:
                yield f"    {kind} {', '.join(names)};"

    def block(self, statements: Sequence[ast.stmt]) -> list[str]:
        """Return the lines of statements."""
        return [line for statement in statements for line in self.statement(statement)]

    def braced(self, head: str, statements: Sequence[ast.stmt]) -> list[str]:
        """Return the lines of a block in braces."""
        return [f"{head} {{", *(f"    {line}" for line in self.block(statements)), "}"]

    def statement(self, node: ast.stmt) -> Iterator[str]:
        """Yield the lines of a statement."""
        match node:
            case ast.Expr(value=ast.Constant(value=str())):  # a docstring
                pass
            case ast.Assign(targets=[ast.Tuple(elts=targets)], value=ast.Tuple(elts=values)):
                texts = [self.text(target) for target in targets]
                for number, value in enumerate(values):
                    if {ast.unparse(inner) for inner in ast.walk(value)} & set(texts[:number]):
                        raise self.refused(node)  # in C one comes after the other
                    yield f"{texts[number]} = {self.text(value)};"
            case ast.Assign(targets=[ast.Tuple(elts=[target, *others])], value=ast.Call() as call):
                pointers = [f"&{self.text(other)}" for other in others]
                yield f"{self.text(target)} = {self.call(call, pointers)};"
            case ast.Assign(targets=[target], value=value):
                yield f"{self.text(target)} = {self.text(value)};"
            case ast.AugAssign(target=target, op=op, value=value):
                yield f"{self.text(target)} = {self.text(ast.BinOp(target, op, value))};"
            case ast.Return(value=ast.expr() as value):
                first, *others = value.elts if isinstance(value, ast.Tuple) else [value]
                yield from (f"*result_{n} = {self.text(x)};" for n, x in enumerate(others, 1))
                yield f"return {self.text(first)};"
            case ast.If(test=test, body=body, orelse=orelse):
                lines = self.braced(f"if ({self.text(test)})", body)
                yield from [*lines[:-1], *self.braced("} else", orelse)] if orelse else lines
            case ast.While(test=test, body=body):
                yield from self.braced(f"while ({self.text(test)})", body)
            case ast.For(target=target, iter=ast.Call(func=ast.Name(id="range"), args=bounds)):
                implied = [] if bounds[1:] else ["0"]
                start, stop, step = (implied + self.whole(*bounds) + ["1"])[:3]
                compared, change = (">", "--") if step == "-1" else ("<", "++")
                name = ast.unparse(target)
                head = f"for ({name} = {start}; {name} {compared} {stop}; {name}{change})"
                yield from self.braced(head, node.body)
            case _:
                raise self.refused(node)

    def text(self, node: ast.expr) -> str:
        """Return an expression."""
        return ast.unparse(self.visit(node))

    def whole(self, *nodes: ast.expr) -> list[str]:
        """Return expressions that are whole numbers."""
        texts = [self.text(node).removesuffix(".0") for node in nodes]
        return [text if re.fullmatch(r"-?\w+", text) else f"(int)({text})" for text in texts]

    def visit_Constant(self, node: ast.Constant) -> ast.expr:
        """Return a number."""
        if not isinstance(node.value, int | float):
            raise self.refused(node)
        return ast.Name(to_c_number(node.value))

    def visit_Name(self, node: ast.Name) -> ast.expr:
        """Return a variable, or the value of a module's constant."""
        if node.id in self.variables:
            return node
        constant = self.function.__globals__.get(node.id)
        if not isinstance(constant, int | float):
            raise self.refused(node)
        return ast.Name(to_c_number(constant))

    def visit_Subscript(self, node: ast.Subscript) -> ast.expr:
        """Return an element of an array, or of a module's table."""
        name = ast.unparse(node.value)
        if name not in self.variables:
            self.tables[name] = self.function.__globals__[name]
        if isinstance(node.slice, ast.Tuple):
            row, column = self.whole(*node.slice.elts)
            return ast.Name(f"{name}[{self.shapes[name][1]} * {row} + {column}]")
        return ast.Name(f"{name}[{self.whole(node.slice)[0]}]")

    def visit_UnaryOp(self, node: ast.UnaryOp) -> ast.expr:
        """Return a number with its sign, or a condition that is denied."""
        operand = self.visit(node.operand)
        if isinstance(node.op, ast.Not):
            return ast.Name(f"!({ast.unparse(operand)})")
        return ast.UnaryOp(node.op, operand)

    def visit_BinOp(self, node: ast.BinOp) -> ast.expr:
        """Return an operation; a power is a function of C."""
        if isinstance(node.op, ast.Pow):
            return ast.Name(f"pow({self.text(node.left)}, {self.text(node.right)})")
        allowed = ast.Add | ast.Sub | ast.Mult | ast.Div | ast.BitAnd | ast.BitOr
        if not isinstance(node.op, allowed):
            raise self.refused(node)
        return ast.BinOp(self.visit(node.left), node.op, self.visit(node.right))

    def visit_BoolOp(self, node: ast.BoolOp) -> ast.expr:
        """Return conditions together."""
        sign = " && " if isinstance(node.op, ast.And) else " || "
        return ast.Name(f"({sign.join(f'({self.text(value)})' for value in node.values)})")

    def visit_Compare(self, node: ast.Compare) -> ast.expr:
        """Return a comparison of two numbers."""
        if len(node.ops) > 1 or isinstance(node.ops[0], ast.Is | ast.IsNot | ast.In | ast.NotIn):
            raise self.refused(node)
        return ast.Compare(self.visit(node.left), node.ops, [self.visit(node.comparators[0])])

    def visit_Call(self, node: ast.Call) -> ast.expr:
        """Return a call, or the number that stands for a function of arrays."""
        match node:
            case ast.Call(func=ast.Name(id="anywhere"), args=[condition]):
                return self.visit(condition)  # type: ignore[no-any-return]
            case ast.Call(func=ast.Name(id="look_up"), args=[table, index]):
                return ast.Name(f"{self.text(table)}[{self.whole(index)[0]}]")
            case ast.Call(func=ast.Name(id="len"), args=[ast.Name(id=array)]):
                return ast.Name(to_c_number(self.shapes[array][0]))
            case ast.Call(func=ast.Name(id="select"), args=choice):
                test, yes, no = map(self.text, choice)
                return ast.Name(f"({test} ? {yes} : {no})")
        return ast.Name(self.call(node, []))

    def call(self, node: ast.Call, pointers: Sequence[str]) -> str:
        """Return a call of a function of math.h, or of one that is printed before this one."""
        if node.keywords:
            raise self.refused(node)
        texts = [self.text(x) for x in node.args if ast.unparse(x) not in self.bindings]
        arguments = ", ".join([*texts, *pointers])
        match node.func:
            case ast.Attribute(value=ast.Name(id="np"), attr=name) if name in MATH_H:
                return f"{MATH_H[name]}({arguments})"
            case ast.Name(id=name):
                function = self.bindings.get(name, self.function.__globals__.get(name))
                if inspect.isfunction(function):
                    if function not in self.printed:
                        _Printer(function, self.shapes, self.prefix, self.bindings, self.printed)
                    return f"{self.prefix}{name}({arguments})"
        raise self.refused(node)

    def generic_visit(self, node: ast.AST) -> ast.AST:
        """Refuse all other expressions."""
        raise self.refused(node)

    def refused(self, node: ast.AST) -> InputError:
        """Return the error that names what cannot be printed."""
        return InputError(
            f"{self.function.__qualname__}: `{ast.unparse(node)}` has no counterpart in C here; "
            "write it with arithmetic, if, for, while, bwbayes.arrays.select, and those of NumPy's "
            "functions that math.h has"
        )


FILES = ("model.json", "actuator.c")


@dataclass(frozen=True)
class Exported(Product):
    """A model of an actuator that is ready for a controller.

    ``model`` is the one model, a sample at a time; its inverse gives voltages within ``limits``, V,
    and changes them as fast; ``without_inverse`` says why it has none. ``sds`` are the standard
    deviations of its parameters, by name, if they are known, ``standing`` is how the validation of
    its run came out, and ``instruments`` are those whose readings it was fitted to.
    """

    NAME: ClassVar[str] = "model"
    __repr__ = __str__ = brief

    name: str
    model: SampledModel
    limits: Limits
    sds: Mapping[str, float]
    without_inverse: str | None
    standing: ValidationSummary = field(default_factory=ValidationSummary)
    instruments: Instruments = EXACT

    @property
    def shortfall(self) -> str:
        """Why it has no inverse; empty if it has one."""
        reason = (self.without_inverse or "").removeprefix("inverse: ")
        return f"no inverse in it: {reason}" if reason else ""

    def report(self) -> Report:
        """Return the parts, for a page: the files are all there is to see on a screen."""
        facts = [(name, str(value)) for name, value in self.numbers()["parts"].items()]
        facts += [("limits of the inverse", str(self.limits))]
        facts += facts_of(self.model.actuator.conditions)
        return Report(title=self.name, blocks=[Facts(facts)])

    def save(
        self, folder: str | Path, *, overwrite: bool = False, watch: Watch = unwatched
    ) -> list[Path]:
        """Write ``model.json`` and ``actuator.c`` to a folder, and return them.

        Raises InputError: a file that exists, unless it may be replaced, or that cannot be written.
        """
        numbers, code = files = [Path(folder) / name for name in FILES]
        refuse_existing(files, overwrite=overwrite)
        printed = self.c_code()  # may be refused: then no file is written
        with refuse_unwritable(folder, "choose another folder"):
            numbers.parent.mkdir(parents=True, exist_ok=True)
            write_summary(numbers, self.quantities.rendered(self.numbers()))
            code.write_text(printed, encoding="ascii")
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
            "conditions": dict(actuator.conditions),
            "inverse": self.without_inverse is None,
            "without_inverse": self.without_inverse,
            "instruments": self.instruments.facts,
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


def export_model(
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
