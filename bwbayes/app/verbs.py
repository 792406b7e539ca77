"""The verbs of a run, a line each, from which their commands, methods and help come.

A verb is a function of a ``fit`` and a ``watch`` that returns a
:class:`~bwbayes.report.report.Product`. Its command takes the FOLDER of a run, shows the progress,
saves and shows the product, and ends with the worse of the run's and the product's status. Its
method of :class:`bwbayes.Run` warns where the command shows a note. Positional arguments are words;
keyword arguments are options of the same names, types and defaults. The help is the docstring: its
text before the parameters, the first sentence on each parameter, and the first command among the
examples.

A verb's source is read, not loaded: loading it takes a second, and neither ``--help`` nor
completion should wait for that.
"""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import Any


@dataclass(frozen=True)
class Verb:
    """A function of a run, and its names on the command line where they differ.

    Parameters
    ----------
    place
        Where it is: ``"package.module:name"``.
    flags
        Names of options that differ from their arguments'.
    either
        The ways to give the argument after the fit: a word, an option, or an option with a FILE;
        and how the error for none or two of them calls each. The argument's description has a
        sentence on each way, in their order.
    instead
        The option that takes the place of that argument.
    below
        Subfolder of FOLDER for the files, by default the verb's name; NAME is the argument's.
    """

    place: str
    flags: Mapping[str, str] = field(default_factory=dict)
    either: Mapping[str, str] = field(default_factory=dict)
    instead: str = ""
    below: str = ""

    @property
    def name(self) -> str:
        """The name of function, command and method."""
        return self.place.partition(":")[2]

    def load(self, name: str = "") -> Any:
        """Return the function itself, or what has another name in its module."""
        return getattr(import_module(self.place.partition(":")[0]), name or self.name)

    @cached_property
    def _source(self) -> ast.FunctionDef:
        # The packages between would be loaded, if one asked for the module itself.
        package, *inner = self.place.partition(":")[0].split(".")
        spec = find_spec(package)
        path = Path(str(spec and spec.origin))
        if inner:
            path = path.parent.joinpath(*inner).with_suffix(".py")
        body = ast.parse(path.read_text(encoding="utf-8")).body
        functions = (node for node in body if isinstance(node, ast.FunctionDef))
        return next(function for function in functions if function.name == self.name)

    @cached_property
    def _sections(self) -> dict[str, str]:
        """The sections of the docstring by their titles; the first one has none."""
        text = (ast.get_docstring(self._source) or "").replace("``", "")
        first, *others = re.split(r"\n\n(\w+)\n-{3,}\n", text)
        return {"": first, **dict(zip(others[::2], others[1::2], strict=True))}

    @property
    def help(self) -> list[str]:
        """The paragraphs before the parameters, and the first command among the examples."""
        match = re.search(r"^ *(bwbayes .*)", self._sections.get("Examples", ""), re.MULTILINE)
        return [self._sections[""], *([f"Example: {match[1]}"] if match else [])]

    def sentences(self, parameter: str) -> list[str]:
        """Return what is said of a parameter."""
        lines = rf"^(?:.*, )?{parameter}(?:, .*| : .*)?\n((?: {{4}}.*(?:\n|$))+)"
        match = re.search(lines, self._sections.get("Parameters", ""), re.MULTILINE)
        return re.split(r"(?<=\.) (?=[A-Z])", " ".join(match[1].split()) if match else "")

    @property
    def product(self) -> str:
        """The type of what it returns; of several, the first."""
        returned = ast.unparse(self._source.returns) if self._source.returns else ""
        return returned.partition(" | ")[0]

    @property
    def words(self) -> dict[str, str]:
        """The type hints of the arguments after the fit without a default, or with None for one."""
        args = self._source.args
        defaults = [ast.unparse(default) for default in args.defaults]
        has_value = [False] * (len(args.args) - len(defaults)) + [d != "None" for d in defaults]
        return {
            arg.arg: ast.unparse(arg.annotation).removesuffix(" | None")
            for arg, valued in zip(args.args[1:], has_value[1:], strict=True)
            if arg.annotation and not valued and arg.arg != "folder"  # --out, as of any command
        }

    def options(self) -> Iterator[tuple[str, str, Any, str]]:
        """Yield name, type hint, default and help of the keyword arguments.

        All but those that every command has otherwise: ``--out``, ``--quiet`` and its progress.
        """
        args = self._source.args
        for arg, default in zip(args.kwonlyargs, args.kw_defaults, strict=True):
            if arg.annotation and default and arg.arg not in ("folder", "progress", "watch"):
                hint = ast.unparse(arg.annotation).removesuffix(" | None")
                yield arg.arg, hint, ast.literal_eval(default), self.sentences(arg.arg)[0]


VERBS = (
    Verb("bwbayes.app.jobs.predict:predict"),
    Verb(
        "bwbayes.app.jobs.control:compensate",
        flags={"smoothed": "smooth"},
        either={"SHAPE": "a shape", "--reference FILE": "--reference"},
        below="compensation/NAME",
    ),
    Verb(
        "bwbayes.app.jobs.design:design",
        either={"--parameter": "a parameter", "--drive FILE": "a drive"},
        instead="validate",
    ),
    Verb("bwbayes.app.jobs.control:export"),
    Verb("bwbayes.app.jobs.control:track", flags={"frequencies": "frequency"}),
)
