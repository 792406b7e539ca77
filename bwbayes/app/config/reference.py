"""The reference on the screen: every key of a config, and every part of a model.

``bwbayes config`` prints what the config's models say of their keys, ``bwbayes models`` what the
registered parts say of themselves: their docstrings, which hold the equation and its source, and
the parameters that they declare. Nothing is written down here a second time.
"""

from __future__ import annotations

import inspect
import re
import textwrap
from collections.abc import Callable, Iterator, Mapping
from functools import partial
from itertools import groupby
from typing import Any

from bwbayes.app.config.config import Config
from bwbayes.app.config.keys import ANY, Key, keys, synonyms
from bwbayes.data.waveforms import signal_names
from bwbayes.errors import InputError, suggestion
from bwbayes.inference.noises import NOISES
from bwbayes.model.creep import Creep
from bwbayes.model.declaration import Context, Declaration, Ranges
from bwbayes.model.distributions import FAMILIAR
from bwbayes.model.gain import TERMS, PolynomialGain
from bwbayes.model.registry import DYNAMICS, HYSTERESIS, made

__all__ = ["config_reference", "parts_reference"]

WIDTH = 96

# The paper's ring bender on its identification signal: +-100 V at 1 Hz, +-62 um.
RING_BENDER = Ranges(
    voltage=100.0, displacement=62.0, middle=0.0, time=0.5, interval=1e-3, duration=16.0
)
STIFFNESS = 4.10e5  # N/m

Maker = Callable[..., Any]

# The kinds of parts by the key that chooses them, in the order of the signal's way.
PARTS: Mapping[str, Mapping[str, Maker]] = {
    "hysteresis": HYSTERESIS,
    "gain": {name: partial(PolynomialGain, (name,)) for name in TERMS},
    "creep": {"creep": partial(Creep, (0.1, 1.0, 10.0), growing=True)},
    "dynamics": DYNAMICS,
    "noise": {name: partial(maker, interval=1e-3) for name, maker in NOISES.items()},
}

# What a text in a config may be, by its key's name, besides a choice of its own.
IMPORTED = "or module:Class"
CHOICES: Mapping[str, tuple[str, ...]] = {
    "hysteresis": (*HYSTERESIS, IMPORTED),
    "gain": tuple(TERMS),
    "dynamics": (*DYNAMICS, IMPORTED),
    "noise": ("auto", *NOISES, IMPORTED),
    "prior": (*(f"{n}({', '.join(a)})" for n, a in FAMILIAR.items()), "or one of scipy.stats"),
    "signal": signal_names(),
}

# How reStructuredText marks names: the text to show, or the last part of a path.
ROLE = re.compile(r":\w+:`(?:([^<`]+?)\s*<[^`]*>|~?(?:[\w.]*\.)?(\w+))`")


def config_reference(requested: str | None) -> str:
    """Describe a config's keys: all of them, or those of a name or path.

    A path may have the user's own names in it, and may leave out its first tables:
    ``parameters.d.prior``, ``ess``.

    Raises
    ------
    InputError
        There is no such key.
    """
    documented = list(keys(Config))
    if requested is None:
        head = (
            "Every key of a config, by table. `bwbayes config KEY` shows one; notebooks and runs "
            "have whole configs."
        )
        return "\n\n".join([_wrapped(head), *(_entry(key) for key in _once(documented))])
    requested_keys = [key for key in documented if _is_asked(key, requested.split("."))]
    if not requested_keys:
        names = list(dict.fromkeys(key.name for key in documented))
        last = requested.split(".")[-1]
        raise InputError(
            f"config: no key {requested!r}; {suggestion(last, names, synonyms(Config))}"
        )
    inside = tuple(f"{key.path}." for key in requested_keys if key.table is not None)
    shown = [key for key in documented if key in requested_keys or key.path.startswith(inside)]
    return "\n\n".join(_entry(key) for key in shown)


def _once(documented: list[Key]) -> Iterator[Key]:
    """Yield keys without those of a table that stands elsewhere already."""
    first_paths: dict[str, str] = {}
    skipped: tuple[str, ...] = ()
    for key in documented:
        if key.path.startswith(skipped or ("\n",)):
            continue
        yield key
        if key.table is not None and first_paths.setdefault(key.table, key.path) != key.path:
            skipped = (*skipped, f"{key.path}.")


def _is_asked(key: Key, requested: list[str]) -> bool:
    """Tell whether the path that a user wrote ends a key's path, with a name of theirs for NAME."""
    path = key.path.split(".")
    for candidate in (path, path[:-1] if path[-1] == ANY else path):
        tail = candidate[-len(requested) :]
        if len(tail) == len(requested) and tail[0] == requested[0]:
            return all(
                documented in (ANY, written)
                for documented, written in zip(tail, requested, strict=True)
            )
    return False


def _entry(key: Key) -> str:
    """Say all of a key: where and what it is, then an example in TOML."""
    holds_keys = key.table is not None and key.name != "signal"
    unit = f" ({key.unit})" if key.unit else ""
    default = "" if key.default == "none" else f"; default: {key.default}"
    if key.default == "required":
        default = "; required"
    title = f"[{key.path}]" if holds_keys else f"{key.path}: {key.kind}{unit}{default}"
    lines = [title, _wrapped(key.description, "    ")]
    if key.name in CHOICES and not holds_keys:
        lines.append(_wrapped(f"Choices: {', '.join(CHOICES[key.name])}.", "    "))
    if key.example:
        lines.append(_wrapped(f"Example: {key.name} = {key.example}", "    "))
    return "\n".join(lines)


def _wrapped(text: str, indent: str = "") -> str:
    return textwrap.fill(
        text, WIDTH, initial_indent=indent, subsequent_indent=indent, break_on_hyphens=False
    )


def parts_reference(requested: str | None) -> str:
    """Describe a model's parts: each in a line, or one of them in full.

    ``requested`` is a part's name or the import path of one from outside.

    Raises
    ------
    InputError
        There is no such part.
    """
    if requested is not None:
        return "\n\n".join(_part(kind, requested, maker) for kind, maker in _asked_parts(requested))
    lines = ["The parts of a model, by the key of [model] that chooses them.", ""]
    for kind, makers in PARTS.items():
        lines.append(f"{kind}:")
        for name, maker in makers.items():
            summary, *_ = (inspect.getdoc(type(maker())) or "").split("\n\n")
            lines.append(f"  {name:25}{' '.join(summary.split())}")
        lines.append("")
    lines.append(
        _wrapped(
            "`bwbayes models NAME` shows one: its equation, parameters, default priors and source. "
            "A part from outside the package goes by its import path, module:Class."
        )
    )
    return "\n".join(lines)


def _asked_parts(requested: str) -> Iterator[tuple[str, Maker]]:
    kinds = [kind for kind, makers in PARTS.items() if requested in makers]
    for kind in kinds:
        yield kind, PARTS[kind][requested]
    if not kinds:
        registered = {name: maker for makers in PARTS.values() for name, maker in makers.items()}
        component = made("models", requested, registered, {})
        yield "from outside", lambda: component


def _part(kind: str, name: str, maker: Maker) -> str:
    """Say all of a part: its docstring, then its parameters."""
    component = maker()
    text = inspect.getdoc(type(component)) or "It has no docstring."
    declared: tuple[Declaration, ...] = (
        component.declarations if hasattr(component, "declarations") else component.parameters
    )
    lines = [f"{name} ({kind})", "", *_plain(text, options=kind == "hysteresis")]
    if declared:
        ranges = RING_BENDER
        lines += [
            "",
            _wrapped(
                "Parameters, with the default priors that they have at the ring bender's ranges "
                f"(+-{ranges.voltage:g} V, +-{ranges.displacement:g} um, {ranges.time:g} s from "
                "turn to turn); they scale with those of a record. `bwbayes check` prints yours."
            ),
        ]
        for _, group in groupby(
            declared, lambda declaration: re.sub(r"_\d+$", "_#", declaration.name)
        ):
            lines += ["", *_parameter(list(group), "residual" if kind == "noise" else "actuator")]
    return "\n".join(lines)


def _plain(doc: str, *, options: bool) -> Iterator[str]:
    """Yield the lines of a docstring without its marks, and of its sections those for a user."""
    body, *sections = re.split(r"\n\n(?=\w+\n-+\n)", doc)
    yield from _unmarked(body)
    for section in sections:
        title, _, content = section.split("\n", 2)
        if title == "Notes":
            yield from ("", *_unmarked(content))
        elif title == "Parameters" and options:
            yield from ("", "Options:", *(f"    {line}" for line in _unmarked(content)))


def _unmarked(text: str) -> Iterator[str]:
    """Yield the lines of a text without its marks; prose is wrapped again."""
    text = re.sub(r"(?:^|\n)::\n", "", text).replace("::\n", ":\n").replace("``", "")
    text = ROLE.sub(lambda role: role[1] or role[2], text)
    paragraphs = [p if "\n " in f"\n{p}" else _wrapped(p) for p in text.split("\n\n")]
    yield from "\n\n".join(paragraphs).splitlines()


def _parameter(group: list[Declaration], of: str) -> Iterator[str]:
    """Yield the lines of a parameter, or of a row of numbered ones that are alike."""
    declared, last = group[0], group[-1]
    unit = "no unit" if declared.unit == "-" else declared.unit
    names = declared.name if last is declared else f"{declared.name} to {last.name}"
    until = "" if last is declared else f", and so on to: {last.description}"
    yield _wrapped(f"{names} ({unit}): {declared.description}{until}", "  ")
    limits = declared.stated_bounds or ("positive" if declared.positive else "")
    scope = "of each record" if declared.scope == "record" else f"of the {of}"
    facts = ", ".join(fact for fact in (scope, limits) if fact)
    yield _wrapped(f"{facts}; {_default(declared)}", "      ")


def _default(declared: Declaration) -> str:
    """Say a default prior at the ring bender's ranges."""
    default, condition = declared.default(Context(RING_BENDER)), ""
    if default is None:
        default = declared.default(Context(RING_BENDER, {"stiffness": STIFFNESS}))
        condition = f" if stiffness is fixed, here at {STIFFNESS:g} N/m"
    if default is None:
        why = f" ({declared.without_default})" if declared.without_default else ""
        return f"no default: give prior or fixed{why}"
    if isinstance(default, float | int):
        return f"fixed at {default:g}{condition}"
    return f"{default}{condition}"
