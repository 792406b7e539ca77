"""The reference on the screen: every key of a config, and every part of a model.

``bwbayes config`` prints what the config's models say of their keys, ``bwbayes models`` what the
registered parts say of themselves: their docstrings, which hold the equation and its source, and
the parameters that they declare. Nothing is written down here a second time.
"""

from __future__ import annotations

import inspect
import re
import textwrap
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from itertools import groupby
from typing import Any

from bwbayes.app.config.config import Config
from bwbayes.app.config.keys import ANY, Key, keys, synonyms
from bwbayes.errors import InputError, suggestion
from bwbayes.inference.noise import NOISES
from bwbayes.model import registry
from bwbayes.model.declaration import FAMILIAR, Context, Declaration
from bwbayes.model.registry import build_part
from bwbayes.record.teststand import RING_BENDER
from bwbayes.record.waveforms import signal_names

Maker = Callable[..., Any]

# The kinds of parts by the key that chooses them.
PARTS: Mapping[str, Mapping[str, Maker]] = {
    **registry.PARTS,
    "noise": {name: partial(maker, interval=1e-3) for name, maker in NOISES.items()},
}

# Choices of a text in a config by its key's name, besides its own.
CHOICES: Mapping[str, tuple[str, ...]] = {
    "nonlinearity": tuple(PARTS["nonlinearity"]),
    **{key: (*PARTS[key], "or module:Class") for key in ("hysteresis", "dynamics", "stages")},
    "noise": ("auto", *NOISES, "or module:Class"),
    "prior": (*(f"{n}({', '.join(a)})" for n, a in FAMILIAR.items()), "or one of scipy.stats"),
    "signal": signal_names(),
}


def config_reference(requested: str | None) -> str:
    """Describe the keys of a config: type, unit, default and an example; of all, or of one KEY.

    Parameters
    ----------
    requested
        Its name or path. A path may have the user's own names in it, and may leave out its first
        tables: ``parameters.d.prior``, ``ess``.

    Raises
    ------
    InputError
        There is no such key.

    Examples
    --------
    bwbayes config record.train
    """
    documented = keys(Config)
    if requested is None:
        head = (
            "Every key of a config, by table. `bwbayes config KEY` shows one; notebooks and runs "
            "have whole configs."
        )
        # The keys of a table that stands in two places are shown once.
        first = {key.table: key.path for key in reversed(documented)}
        repeated = tuple(f"{k.path}." for k in documented if k.table and first[k.table] != k.path)
        shown = [key for key in documented if not key.path.startswith(repeated)]
        return "\n\n".join([_wrap(head), *map(_entry, shown)])
    path = requested.split(".")
    matches = [key for key in documented if _ends_with(key, path)]
    if not matches:
        names = list(dict.fromkeys(key.name for key in documented))
        hint = suggestion(path[-1], names, synonyms(Config))
        raise InputError(f"config: no key {requested!r}; {hint}")
    inside = tuple(f"{key.path}." for key in matches if key.table is not None)
    shown = [key for key in documented if key in matches or key.path.startswith(inside)]
    return "\n\n".join(map(_entry, shown))


def _ends_with(key: Key, written: Sequence[str]) -> bool:
    """Tell whether a key's path ends as a user wrote it, with a name of theirs for NAME."""
    for path in (key.path, key.path.removesuffix(f".{ANY}")):
        end = path.split(".")[-len(written) :]
        if len(end) == len(written) and end[0] == written[0]:
            return all(a in (ANY, b) for a, b in zip(end, written, strict=True))
    return False


def _entry(key: Key) -> str:
    """Say all of a key: where and what it is, then an example in TOML."""
    holds_keys = key.table is not None and key.name != "signal"
    unit = f" ({key.unit})" if key.unit else ""
    default = {"none": "", "required": "; required"}.get(key.default, f"; default: {key.default}")
    title = f"[{key.path}]" if holds_keys else f"{key.path}: {key.kind}{unit}{default}"
    lines = [title, _wrap(key.description, "    ")]
    if key.name in CHOICES and not holds_keys:
        lines.append(_wrap(f"Choices: {', '.join(CHOICES[key.name])}.", "    "))
    if key.example:
        lines.append(_wrap(f"Example: {key.name} = {key.example}", "    "))
    return "\n".join(lines)


def _wrap(text: str, indent: str = "") -> str:
    return textwrap.fill(
        text, 96, initial_indent=indent, subsequent_indent=indent, break_on_hyphens=False
    )


def parts_reference(requested: str | None) -> str:
    """Describe the parts of a model, or of one NAME its equation, parameters and default priors.

    Parameters
    ----------
    requested
        A part's name, or the import path of one from outside.

    Raises
    ------
    InputError
        There is no such part.

    Examples
    --------
    bwbayes models prandtl-ishlinskii
    """
    if requested is not None:
        matches = [
            (kind, makers[requested]()) for kind, makers in PARTS.items() if requested in makers
        ]
        if not matches:
            registered = {
                name: maker for makers in PARTS.values() for name, maker in makers.items()
            }
            matches = [("from outside", build_part("models", requested, registered, {}))]
        return "\n\n".join(_part(kind, requested, component) for kind, component in matches)
    lines = ["The parts of a model, by the key of [model] that chooses them.", ""]
    for kind, makers in PARTS.items():
        lines.append(f"{kind}:")
        for name, maker in makers.items():
            summary, *_ = (inspect.getdoc(type(maker())) or "").split("\n\n")
            lines.append(f"  {name:25}{' '.join(summary.split())}")
        lines.append("")
    lines.append(
        _wrap(
            "`bwbayes models NAME` shows one: its equation, parameters, default priors and source. "
            "A part from outside the package goes by its import path, module:Class."
        )
    )
    return "\n".join(lines)


def _part(kind: str, name: str, component: Any) -> str:
    """Say all of a part: its docstring, then its parameters."""
    lines = [f"{name} ({kind})", ""]
    body, *sections = re.split(
        r"\n\n(?=\w+\n-+\n)", inspect.getdoc(type(component)) or "It has no docstring."
    )
    lines.append(_without_marks(body))
    for title, _, content in (section.split("\n", 2) for section in sections):
        if title == "Notes":
            lines += ["", _without_marks(content)]
        elif title == "Parameters" and kind == "hysteresis":
            lines += ["", "Options:", textwrap.indent(_without_marks(content), "    ")]
    declared: Sequence[Declaration] = (
        component.declarations if hasattr(component, "declarations") else component.parameters
    )
    seen = sorted({*getattr(component, "sees", ())} - {"time", "voltage"})
    if declared:
        lines += [
            "",
            _wrap(
                "Parameters, with the default priors that they have at the ring bender's ranges "
                f"(+-{RING_BENDER.voltage:g} V, +-{RING_BENDER.displacement:g} um, "
                f"{RING_BENDER.time:g} s from turn to turn"
                f"{''.join(f', {name} from 0 to 1' for name in seen)}); they scale with those of a "
                "record. `bwbayes check` prints yours."
            ),
        ]
    for _, numbered in groupby(
        declared, lambda declaration: re.sub(r"_\d+$", "_#", declaration.name)
    ):
        lines += ["", *_parameter(list(numbered), "residual" if kind == "noise" else "actuator")]
    return "\n".join(lines)


def _without_marks(text: str) -> str:
    """Return a text without the marks of reStructuredText; prose is wrapped again."""
    text = re.sub(r"(?:^|\n)::\n", "", text).replace("::\n", ":\n").replace("``", "")
    # The text that is shown for a name in a role, or the last part of its path.
    role = re.compile(r":\w+:`(?:([^<`]+?)\s*<[^`]*>|~?(?:[\w.]*\.)?(\w+))`")
    text = role.sub(lambda name: name[1] or name[2], text)
    paragraphs = (p if "\n " in f"\n{p}" else _wrap(p) for p in text.split("\n\n"))
    return "\n\n".join(paragraphs)


def _parameter(numbered: Sequence[Declaration], of: str) -> Iterator[str]:
    """Yield the lines of a parameter, or of a row of numbered ones that are alike."""
    declared, last = numbered[0], numbered[-1]
    unit = "no unit" if declared.unit == "-" else declared.unit
    names = declared.name if last is declared else f"{declared.name} to {last.name}"
    until = "" if last is declared else f", and so on to: {last.description}"
    yield _wrap(f"{names} ({unit}): {declared.description}{until}", "  ")
    limits = declared.stated_bounds or ("positive" if declared.positive else "")
    scopes = {"record": "of each record", "event": "of an event in one record"}
    scope = scopes.get(declared.scope, f"of the {of}")
    facts = ", ".join(fact for fact in (scope, limits) if fact)
    default, condition = declared.default(Context(RING_BENDER)), ""
    if default is None:
        stiffness = 4.10e5  # N/m, the ring bender's
        default = declared.default(Context(RING_BENDER, {"stiffness": stiffness}))
        if default is not None:
            condition = f" if stiffness is fixed, here at {stiffness:g} N/m"
    text = f"fixed at {default:g}" if isinstance(default, float | int) else str(default)
    if default is None:
        why = f" ({declared.without_default})" if declared.without_default else ""
        text = f"no default: give prior or fixed{why}"
    yield _wrap(f"{facts}; {text}{condition}", "      ")
