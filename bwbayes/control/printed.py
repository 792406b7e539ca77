"""C printed from a Python function, so that what a controller runs is written once.

An operator's step is arithmetic on numbers: assignments, ``if``, loops, functions of ``math.h``,
and functions of its own that are made of the same. Its syntax tree says all that C needs.
"""

from __future__ import annotations

import ast
import inspect
import textwrap
import unicodedata
from collections.abc import Callable, Mapping
from types import FunctionType
from typing import Any

from bwbayes.errors import InputError

__all__ = ["ascii_of", "c_functions", "number_in_c"]

# NumPy's functions by the names that math.h has for them; the others are alike in both.
NAMES = {"abs": "fabs", "minimum": "fmin", "maximum": "fmax", "power": "pow"}

# How closely operators bind, and their sign in C.
OPERATORS: Mapping[type[ast.AST], tuple[int, str]] = {
    ast.BitOr: (1, "||"), ast.Or: (1, "||"), ast.BitAnd: (2, "&&"), ast.And: (2, "&&"),
    ast.Eq: (3, "=="), ast.NotEq: (3, "!="), ast.Lt: (4, "<"), ast.LtE: (4, "<="),
    ast.Gt: (4, ">"), ast.GtE: (4, ">="), ast.Add: (5, "+"), ast.Sub: (5, "-"),
    ast.Mult: (6, "*"), ast.Div: (6, "/"),
}  # fmt: skip
CHOICE, UNARY, CALL = 0, 7, 8

# Signs of docstrings in ASCII.
PLAIN = {"−": "-", "′": "'", "≥": ">=", "≤": "<=", "``": "", "Σ": "sum of", "²": "^2", "ⁿ": "^n"}

# Arguments of these names are rows of numbers; all others are numbers.
ROWS = {
    "parameters": "const double *parameters",
    "memory": "const double *memory",
    "after": "double *after",
}


def c_functions(function: Callable[..., Any], lengths: Mapping[str, int], prefix: str) -> str:
    """Return a function and those that it calls as static functions of C, callees first.

    Parameters
    ----------
    function
        Of numbers, and of rows of them that are called ``parameters``, ``memory`` and ``after``. It
        returns a number, or some: in C the first is returned, and pointers take the others.
    lengths
        How long the rows are, by their names.
    prefix
        What the names of functions begin with.

    Raises
    ------
    InputError
        Something in it that has no counterpart here.
    """
    assert inspect.isfunction(function)
    printed: dict[FunctionType, str] = {}
    _Printer(function, lengths, prefix, printed)
    return "\n".join(printed.values())


def ascii_of(text: str) -> str:
    """Return a text with Greek letters by their names and exponents as plain digits."""
    for letter, plain in PLAIN.items():
        text = text.replace(letter, plain)
    for letter in set(text):
        if "GREEK" in unicodedata.name(letter, ""):
            text = text.replace(letter, unicodedata.name(letter).rsplit(" ", 1)[1].lower())
    return unicodedata.normalize("NFKD", text).encode("ascii", "ignore").decode()


class _Printer(ast.NodeVisitor):
    """One function on its way to C; ``printed`` gets those that it calls, and then itself."""

    def __init__(
        self,
        function: FunctionType,
        lengths: Mapping[str, int],
        prefix: str,
        printed: dict[FunctionType, str],
    ) -> None:
        self.function, self.lengths, self.prefix, self.printed = function, lengths, prefix, printed
        self.tables: dict[str, tuple[float, ...]] = {}
        self.local = set(function.__code__.co_varnames)
        tree = ast.parse(textwrap.dedent(inspect.getsource(function))).body[0]
        assert isinstance(tree, ast.FunctionDef)
        statements = tree.body[1:] if ast.get_docstring(tree) else tree.body
        lines = [f"/* {ascii_of(inspect.getdoc(function) or '')} */".replace("\n", "\n * ")]
        lines += _wrapped(self.head(tree))
        body = [wrapped for line in self.block(statements) for wrapped in _wrapped(f"    {line}")]
        lines += ["{", *self.constants(), *self.variables(tree), "", *body]
        printed[function] = "\n".join([*(line.rstrip() for line in lines), "}", ""])

    def head(self, tree: ast.FunctionDef) -> str:
        """Return what a function is called, takes and returns."""
        returned = [node.value for node in ast.walk(tree) if isinstance(node, ast.Return)]
        results = max(len(v.elts) if isinstance(v, ast.Tuple) else 1 for v in returned)
        arguments = [ROWS.get(name, f"double {name}") for name in _arguments(tree)]
        arguments += [f"double *result_{number}" for number in range(1, results)]
        return f"static double {self.prefix}{tree.name}({', '.join(arguments)})"

    def constants(self) -> list[str]:
        """Return the lines of the rows of constants that it reads."""
        texts = {name: ", ".join(map(number_in_c, row)) for name, row in self.tables.items()}
        lines = [f"    static const double {name}[] = {{ {row} }};" for name, row in texts.items()]
        return [wrapped for line in lines for wrapped in _wrapped(line)]

    def variables(self, tree: ast.FunctionDef) -> list[str]:
        """Return the lines that declare what is not an argument."""
        loops = [node for node in ast.walk(tree) if isinstance(node, ast.For)]
        counters = dict.fromkeys(ast.unparse(loop.target) for loop in loops)
        stored = [node for node in ast.walk(tree) if isinstance(node, ast.Name)]
        names = dict.fromkeys(node.id for node in stored if isinstance(node.ctx, ast.Store))
        numbers = [name for name in names if name not in {*_arguments(tree), *counters}]
        kinds = {"double": numbers, "int": counters}
        lines = [f"    {kind} {', '.join(names)};" for kind, names in kinds.items() if names]
        return [wrapped for line in lines for wrapped in _wrapped(line)]

    def block(self, statements: list[ast.stmt]) -> list[str]:
        """Return the lines of statements."""
        return [line for statement in statements for line in self.visit(statement)]

    def braced(self, head: str, statements: list[ast.stmt]) -> list[str]:
        """Return the lines of a block in braces."""
        return [f"{head} {{", *(f"    {line}" for line in self.block(statements)), "}"]

    def visit_Assign(self, node: ast.Assign) -> list[str]:
        """Return an assignment, of more than one number if it has as many targets."""
        match node.targets[0], node.value:
            case ast.Tuple(elts=targets), ast.Tuple(elts=values):
                texts = [self.of(target) for target in targets]
                for number, value in enumerate(values):
                    read = {ast.unparse(node) for node in ast.walk(value)}
                    if read & set(texts[:number]):
                        raise self.refused(node)  # in C one comes after the other
                return [f"{t} = {self.of(v)};" for t, v in zip(texts, values, strict=True)]
            case ast.Tuple(elts=targets), ast.Call() as call:
                first, *others = (self.of(target) for target in targets)
                return [f"{first} = {self.called(call, [f'&{name}' for name in others])};"]
            case target, value:
                return [f"{self.of(target)} = {self.of(value)};"]

    def visit_AugAssign(self, node: ast.AugAssign) -> list[str]:
        """Return what is assigned in full."""
        return [f"{self.of(node.target)} = {self.of(ast.BinOp(node.target, node.op, node.value))};"]

    def visit_Return(self, node: ast.Return) -> list[str]:
        """Return the first number that is returned, after pointers have taken the others."""
        values = node.value.elts if isinstance(node.value, ast.Tuple) else [node.value]
        first, *others = (self.of(value) for value in values if value is not None)
        return [*(f"*result_{n} = {x};" for n, x in enumerate(others, 1)), f"return {first};"]

    def visit_If(self, node: ast.If) -> list[str]:
        """Return a branch, and the other one if there is one."""
        lines = self.braced(f"if ({self.of(node.test)})", node.body)
        return [*lines[:-1], *self.braced("} else", node.orelse)] if node.orelse else lines

    def visit_While(self, node: ast.While) -> list[str]:
        """Return a loop."""
        return self.braced(f"while ({self.of(node.test)})", node.body)

    def visit_For(self, node: ast.For) -> list[str]:
        """Return a loop over a range."""
        match node.iter:
            case ast.Call(func=ast.Name(id="range"), args=bounds):
                ends = [self.whole(bound) for bound in bounds]
                start, end = (ends if ends[1:] else ["0", *ends])[:2]
                forward = "<", "++"
                sign, turn = (">", "--") if ends[2:] == ["-1"] else forward
                name = ast.unparse(node.target)
                head = f"for ({name} = {start}; {name} {sign} {end}; {name}{turn})"
                return self.braced(head, node.body)
        raise self.refused(node)

    def of(self, node: ast.expr) -> str:
        """Return an expression."""
        return self.bound(node)[0]

    def bound(self, node: ast.expr) -> tuple[str, int]:
        """Return an expression, and how closely it binds."""
        bound: tuple[str, int] = self.visit(node)
        return bound

    def within(self, node: ast.expr, binds: int) -> str:
        """Return an expression as a part of one that binds so closely, in brackets if it must."""
        text, level = self.bound(node)
        return text if level >= binds else f"({text})"

    def whole(self, node: ast.expr) -> str:
        """Return an expression that is a whole number."""
        text = self.of(node)
        if text.lstrip("-").removesuffix(".0").isdigit():
            return text.removesuffix(".0")
        return text if isinstance(node, ast.Name) else f"(int)({text})"

    def visit_Constant(self, node: ast.Constant) -> tuple[str, int]:
        """Return a number."""
        if not isinstance(node.value, int | float):
            raise self.refused(node)
        return number_in_c(node.value), CALL

    def visit_Name(self, node: ast.Name) -> tuple[str, int]:
        """Return a variable, or the number that a module's constant is."""
        local = node.id in self.local
        return (node.id if local else number_in_c(self.function.__globals__[node.id])), CALL

    def visit_Subscript(self, node: ast.Subscript) -> tuple[str, int]:
        """Return a number in a row."""
        row = ast.unparse(node.value)
        if row not in self.local:
            self.tables[row] = self.function.__globals__[row]
        return f"{row}[{self.whole(node.slice)}]", CALL

    def visit_UnaryOp(self, node: ast.UnaryOp) -> tuple[str, int]:
        """Return what has a sign, or is denied."""
        sign = "-" if isinstance(node.op, ast.USub) else "!"
        return f"{sign}{self.within(node.operand, UNARY)}", UNARY

    def visit_BinOp(self, node: ast.BinOp) -> tuple[str, int]:
        """Return an operation on two numbers."""
        if isinstance(node.op, ast.Pow):
            return f"pow({self.of(node.left)}, {self.of(node.right)})", CALL
        return self.joined(node, node.op, [node.left, node.right])

    def visit_BoolOp(self, node: ast.BoolOp) -> tuple[str, int]:
        """Return conditions together."""
        return self.joined(node, node.op, node.values)

    def visit_Compare(self, node: ast.Compare) -> tuple[str, int]:
        """Return whether a number is less than another, or more, or the same."""
        if len(node.ops) > 1:
            raise self.refused(node)
        return self.joined(node, node.ops[0], [node.left, *node.comparators])

    def joined(self, node: ast.expr, sign: ast.AST, sides: list[ast.expr]) -> tuple[str, int]:
        """Return expressions with an operator between them."""
        if type(sign) not in OPERATORS:
            raise self.refused(node)
        level, text = OPERATORS[type(sign)]
        first, *others = sides
        brackets = [self.within(first, level), *(self.within(side, level + 1) for side in others)]
        return f" {text} ".join(brackets), level

    def visit_Call(self, node: ast.Call) -> tuple[str, int]:
        """Return what a formula for numbers and arrays needs, as it is of numbers; or a call."""
        match node:
            case ast.Call(func=ast.Name(id="anywhere"), args=[condition]):
                return self.bound(condition)
            case ast.Call(func=ast.Name(id="look_up"), args=[table, place]):
                return f"{self.of(table)}[{self.whole(place)}]", CALL
            case ast.Call(func=ast.Name(id="len"), args=[ast.Name(id=row)]):
                return number_in_c(self.lengths[row]), CALL
            case ast.Call(func=ast.Name(id="select"), args=choice):
                test, yes, no = (self.within(side, CHOICE + 1) for side in choice)
                return f"{test} ? {yes} : {no}", CHOICE
        return self.called(node, []), CALL

    def called(self, node: ast.Call, results: list[str]) -> str:
        """Return a call of a function of math.h, or of one that is printed before."""
        arguments = ", ".join([*map(self.of, node.args), *results])
        match node.func:
            case ast.Attribute(value=ast.Name(id="np" | "math"), attr=name):
                return f"{NAMES.get(name, name)}({arguments})"
            case ast.Name(id=name):
                function = self.function.__globals__.get(name)
                if inspect.isfunction(function):
                    if function not in self.printed:
                        _Printer(function, self.lengths, self.prefix, self.printed)
                    return f"{self.prefix}{name}({arguments})"
        raise self.refused(node)

    def generic_visit(self, node: ast.AST) -> Any:
        """Refuse what has no method here."""
        raise self.refused(node)

    def refused(self, node: ast.AST) -> InputError:
        """Return what to say of something that is not printed."""
        return InputError(
            f"{self.function.__qualname__}: `{ast.unparse(node)}` has no counterpart in C here; "
            "write it with arithmetic, if, for, while and NumPy's functions of a number"
        )


def _arguments(tree: ast.FunctionDef) -> list[str]:
    """Return the names of a function's arguments."""
    return [argument.arg for argument in tree.args.args]


def _wrapped(line: str) -> list[str]:
    """Return a line of C in so many as it takes."""
    space = " " * (len(line) - len(line.lstrip()))
    return textwrap.wrap(line, 100, initial_indent="", subsequent_indent=f"{space}        ")


def number_in_c(value: float) -> str:
    """Return a number as C has it, to the last bit."""
    return repr(float(value)).replace("inf", "HUGE_VAL")
