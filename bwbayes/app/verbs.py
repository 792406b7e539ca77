"""The verbs, a line each, from which commands, methods of a fit and the help of both come.

A verb is a function. Its positional arguments are words of the command, its keyword arguments
options of the same names, types and defaults. The help is the docstring: its text before the
parameters, the first sentence on each parameter, and the first command among the examples.

`VERBS` are functions of a ``fit: Run``, and of a ``watch`` if they show progress, that return a
:class:`~bwbayes.report.report.Product`. Their commands take the FOLDER of a run, show the progress,
save and show the product, and end with the worse of the run's and the product's status; their
methods of :class:`bwbayes.Run` warn where the commands show a note. `COMMANDS` are all others. They
return an exit status, a text to be shown, or the files that they have written.

A verb's source is read, not loaded: loading it takes a second, and neither ``--help`` nor
completion should wait for that.
"""

from __future__ import annotations

import ast
import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from types import MethodType
from typing import Any, Literal


@dataclass(frozen=True)
class Verb:
    """A function that is a command, and its names on the command line where they differ.

    Parameters
    ----------
    function
        Where it is: ``"package.module:name"``.
    also
        The function whose keyword arguments its ``**options`` are, with their help.
    command
        The command's name, if not the function's with hyphens.
    flags
        Names of options and words that differ from their arguments'; one without is no option.
    either
        The ways to give the first argument: a word, an option, or an option with a FILE;
        and how the error for none or two of them calls each. The argument's description has a
        sentence on each way, in their order.
    instead
        The option that takes the place of that argument, and how that error calls it.
    below
        Subfolder of a run's FOLDER for the files, by default the verb's name; NAME is the
        argument's.
    parts
        Whether the help lists the parts that a model may have.
    """

    function: str
    also: str = ""
    command: str = ""
    flags: Mapping[str, str] = field(default_factory=dict)
    either: Mapping[str, str] = field(default_factory=dict)
    instead: Mapping[str, str] = field(default_factory=dict)
    below: str = ""
    parts: bool = False

    @property
    def method(self) -> str:
        """The name of the function and the method."""
        return self.function.partition(":")[2]

    @property
    def name(self) -> str:
        """The name of the command."""
        return self.command or self.method.replace("_", "-")

    def load(self, name: str = "") -> Any:
        """Return the function itself, or what has another name in its module."""
        module = self.function.partition(":")[0]
        return getattr(import_module(module), name or self.method)

    def __get__(self, fit: Any, _: object = None) -> Any:
        """Return it as a method of a fit, loaded when it is asked for."""
        from bwbayes.app.jobs.fit_methods import fit_method  # noqa: PLC0415

        method = fit_method(self.load())
        return method if fit is None else MethodType(method, fit)

    @cached_property
    def _source(self) -> ast.FunctionDef:
        # The packages between would be loaded, if one asked for the module itself.
        module, _, name = self.function.partition(":")
        package, *inner = module.split(".")
        spec = find_spec(package)
        path = Path(str(spec and spec.origin))
        if inner:
            path = path.parent.joinpath(*inner).with_suffix(".py")
        # Only the function's lines are parsed, to the next one that begins at the margin.
        lines = rf"^def {name}\b.*\n(?:(?:[ )].*)?\n)*"
        (text,) = re.findall(lines, path.read_text(encoding="utf-8"), re.MULTILINE)
        (function,) = ast.parse(text).body
        assert isinstance(function, ast.FunctionDef)
        return function

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
        return _hint(self._source.returns).partition(" | ")[0]

    @property
    def is_of_run(self) -> bool:
        """Whether its first argument is a fit."""
        return any(_hint(arg.annotation) == "Run" for arg in self._source.args.args[:1])

    @property
    def is_watched(self) -> bool:
        """Whether it takes a ``watch``, which is told how far it is."""
        args = self._source.args
        return any(arg.arg == "watch" for arg in (*args.args, *args.kwonlyargs))

    @property
    def words(self) -> list[tuple[str, str, Literal["one", "optional", "several"]]]:
        """Name, type hint and number of the arguments besides a fit.

        Those without a default, or with None for one.
        """
        args = self._source.args
        defaults = [""] * (len(args.args) - len(args.defaults))
        defaults += [ast.unparse(default) for default in args.defaults]
        words: list[tuple[str, str, Literal["one", "optional", "several"]]] = []
        for arg, default in zip(args.args, defaults, strict=True):
            # A run's folder for files is --out, as of any command of one.
            is_word = default in ("", "None") and not (self.is_of_run and arg.arg == "folder")
            hint = _hint(arg.annotation)
            if hint and is_word:
                optional = self.either or hint.endswith(" | None")
                words.append((arg.arg, hint, "optional" if optional else "one"))
        if args.vararg is not None and args.vararg.annotation is not None:
            words.append((args.vararg.arg, _hint(args.vararg.annotation), "several"))
        return words[1:] if self.is_of_run else words

    def options(self) -> dict[str, tuple[str, Any, str]]:
        """Return type hint, default and help of the keyword arguments, by name.

        All but those that are no option of a command, or one of every command of a run.
        """
        args = self._source.args
        further = Verb(self.also).options() if self.also else {}
        options = dict[str, tuple[str, Any, str]]()
        for arg, default in zip(args.kwonlyargs, args.kw_defaults, strict=True):
            if arg.annotation and arg.arg not in ("folder", "progress", "watch"):
                hint = _hint(arg.annotation).removesuffix(" | None")
                value = None if default is None else ast.literal_eval(default)
                text = self.sentences(arg.arg)[0] or further.get(arg.arg, ("", None, ""))[2]
                options[arg.arg] = hint, value, text
        words = [word.arg for word in args.args]
        return options | {
            key: option
            for key, option in further.items()
            if key not in options and key not in words
        }


def _hint(annotation: ast.expr | None) -> str:
    """Return a type hint as it is written, without quotes around it; none is empty."""
    return ast.unparse(annotation).strip("'\"") if annotation else ""


# Verbs of a run.
VERBS = (
    Verb(
        "bwbayes.app.jobs.predict:predict",
        flags={"estimate_offset": "estimate-offset/same-offset", "name": ""},
        either={"--record/--voltage FILE": "a record"},
        instead={"signal": "a signal"},
        below="predictions/NAME.csv",
    ),
    Verb(
        "bwbayes.app.jobs.control:compensate",
        flags={"smoothed": "smooth"},
        either={"SHAPE": "a shape", "--reference FILE": "--reference"},
        below="compensation/NAME",
    ),
    Verb(
        "bwbayes.app.jobs.design:design",
        either={"--parameter": "a parameter", "--drive FILE": "a drive"},
        instead={"validate": "--validate"},
    ),
    Verb("bwbayes.app.jobs.control:export"),
    Verb("bwbayes.app.jobs.control:track", flags={"frequencies": "frequency"}),
    Verb("bwbayes.app.jobs.certificate:budget"),
    Verb("bwbayes.app.jobs.certificate:certificate"),
    Verb("bwbayes.app.jobs.calibrate:calibrate"),  # its command is below: it takes a config, too
)

PAIR = "--voltage FILE and --displacement FILE"

# All other verbs: from a record to a run, many of them, and what there is without any.
COMMANDS = (
    Verb("bwbayes.app.commands.runs:init", either={"RECORD": "RECORD,", "--voltage FILE": PAIR}),
    Verb("bwbayes.app.commands.runs:check", either={"CONFIG": "CONFIG,", "--voltage FILE": PAIR}),
    Verb(
        "bwbayes.app.commands.runs:run",
        also="bwbayes.app.fit.calls:fit",
        either={"CONFIG": "CONFIG,", "--voltage FILE": PAIR},
    ),
    Verb("bwbayes.app.commands.runs:resume", also="bwbayes.app.fit.calls:resume"),
    Verb("bwbayes.app.commands.runs:report"),
    Verb("bwbayes.app.commands.runs:compare", also="bwbayes.app.fit.calls:compare", parts=True),
    Verb(
        "bwbayes.app.commands.runs:campaign",
        also="bwbayes.app.fit.calls:campaign",
        flags={"resumed": "resume"},
        either={"FOLDER": "a FOLDER of records"},
        instead={"resumed": "--resume CAMPAIGN"},
    ),
    Verb(
        "bwbayes.app.commands.runs:calibrate",
        also="bwbayes.app.jobs.calibrate:resume",
        flags={"resumed": "resume"},
        either={"CONFIG": "a CONFIG"},
        instead={"resumed": "--resume FOLDER"},
    ),
    Verb("bwbayes.app.commands.runs:simulate"),
    Verb(
        "bwbayes.app.config.reference:config_reference",
        command="config",
        flags={"requested": "KEY"},
    ),
    Verb(
        "bwbayes.app.config.reference:parts_reference",
        command="models",
        flags={"requested": "NAME"},
        parts=True,
    ),
)
