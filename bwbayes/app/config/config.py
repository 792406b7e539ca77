"""Configs: what to run, in TOML, checked before anything starts.

Only ``[record]`` is needed; everything else has a default. A key that does not exist is an error
that names its place and the nearest key that does. :func:`load` reads a config, :func:`dump` writes
one back, with every default made explicit.

The reference on the screen: every key of a config, and every part of a model.

``bwbayes config`` prints what the config's models say of their keys, ``bwbayes models`` what the
registered parts say of themselves: their docstrings, which hold the equation and its source, and
the parameters that they declare. Nothing is written down here a second time.
"""

from __future__ import annotations

import inspect
import re
import textwrap
import tomllib
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from itertools import groupby
from pathlib import Path
from typing import Annotated, Any, Self

import tomlkit
from pydantic import Discriminator, Field, Tag, ValidationError, field_validator, model_validator

from bwbayes.app.config import MAX_SEED
from bwbayes.app.config.keys import ANY, ConfigTable, Key, key, keys, one_line, synonyms
from bwbayes.app.config.settings import (
    CertificateConfig,
    ModelConfig,
    Name,
    ParameterConfig,
    RecordConfig,
    SamplingConfig,
    StandConfig,
    ValidationConfig,
)
from bwbayes.errors import InputError, suggestion
from bwbayes.inference.noise import NOISES
from bwbayes.model import registry
from bwbayes.model.declaration import FAMILIAR, Context, Declaration
from bwbayes.model.registry import build_part
from bwbayes.record.teststand import RING_BENDER
from bwbayes.record.waveforms import signal_names

MAX_FILE_SIZE = 1_000_000  # bytes

# The name of a record that is the only one.
ALONE = "record"

# The branches of the key, as pydantic calls them; no record can have such a name.
ONE, SEVERAL = "one record", "several records"


def _one_or_several(value: object) -> str:
    """Tell the keys of one record from the tables of several."""
    if not isinstance(value, Mapping) or not value:
        return ONE
    tables = [name for name in value if isinstance(value[name], Mapping | RecordConfig)]
    is_several = tables == [*value] and not RecordConfig.model_fields.keys() & value.keys()
    return SEVERAL if is_several else ONE


class Config(ConfigTable):
    """A whole run."""

    name: Annotated[str, Field(min_length=1)] | None = key(None, example='"bender 7"')
    """The run's name; by default the config's file name."""
    seed: int = key(1, ge=0, le=MAX_SEED, example="7", called="random_seed rng")
    """Seed of all random numbers."""
    record: Annotated[
        Annotated[RecordConfig, Tag(ONE)] | Annotated[dict[Name, RecordConfig], Tag(SEVERAL)],
        Discriminator(_one_or_several),
    ] = key()
    """The training record; file or signal is required. Several records of one actuator, fitted
    jointly: a table [record.NAME] with these keys for each, under names of your choice, and none of
    the keys in [record] itself.
    """
    stand: StandConfig = key(StandConfig())
    """The virtual test stand, for signals."""
    model: ModelConfig = key(ModelConfig())
    """The model of the actuator and of the residual."""
    parameters: dict[str, ParameterConfig] = key({}, called="priors")
    """Prior, value and labels of a parameter; NAME is its name, see `bwbayes models`."""
    sampling: SamplingConfig = key(SamplingConfig())
    """How to sample, and when to stop."""
    validation: dict[Name, ValidationConfig] = key({}, called="holdout test")
    """Data to predict and judge, under a NAME of your choice."""
    certificate: CertificateConfig = key(CertificateConfig())
    """What a certificate says of the measurement."""
    truth: dict[str, float] = key({}, unit="the parameter's", example="{ d = 0.7, alpha = 0.3575 }")
    """True parameters of a simulated record, to be shown beside the estimates."""

    @field_validator("record", mode="before")
    @classmethod
    def _not_both(cls, value: object) -> object:
        if isinstance(value, Mapping):
            single = [key for key in value if key in RecordConfig.model_fields]
            others = [key for key in value if key not in single]
            tables = [key for key in others if isinstance(value[key], Mapping | RecordConfig)]
            if single and tables:
                raise ValueError(
                    f"{single[0]} is a key of one record, and {tables[0]} a table of several; move "
                    f"{single[0]} into a table [record.NAME] of its own"
                )
        return value

    @model_validator(mode="after")
    def _different_names(self) -> Self:
        for name in self.records if len(self.records) > 1 else ():
            if re.fullmatch(r"record|training(-\d+)?", name):
                raise ValueError(f"the name {name!r} of a record is taken; choose another")
        reserved = "|".join(map(re.escape, (ALONE, "training", *self.records)))
        for name, validation in self.validation.items():
            if re.fullmatch(rf"({reserved})(-\d+)?", name):
                raise ValueError(f"validation: the name {name!r} is taken by a training record")
            if validation.of is not None and validation.of not in self.records:
                hint = suggestion(validation.of, list(self.records))
                raise ValueError(
                    f"validation.{name}.of: no training record {validation.of!r}; {hint}"
                )
            if validation.of is None and not validation.another and len(self.records) > 1:
                raise ValueError(
                    f"validation.{name}: its window is of one of several records; say of which, "
                    f'of = "{next(iter(self.records))}" for instance'
                )
        return self

    def with_record(self, file: Path) -> Config:
        """Return the config of another file in place of its record's.

        Raises InputError: it has several records.
        """
        if not isinstance(self.record, RecordConfig):
            names = ", ".join(self.record)
            raise InputError(
                f"record: the config has several ({names}), and another one cannot stand for all "
                "of them; change their files there"
            )
        changes = {
            "file": str(file.resolve()),
            "displacement_file": None,
            "signal": None,
            "remarks": None,
        }
        source = self.record.model_copy(update=changes)
        return self.model_copy(update={"record": source})

    def renamed(self, name: str, seed: int | None) -> Config:
        """Return the config with a name, if it has none, and another seed, if there is one."""
        changes = {"name": self.name or name} | ({} if seed is None else {"seed": seed})
        return self.model_copy(update=changes)

    def searched(self, search: str | None) -> Config:
        """Return the config with another longest time of the search for stages, if there is one.

        Raises InputError: it is no time.
        """
        if search is None:
            return self
        try:
            model = ModelConfig.model_validate(self.model.model_dump() | {"search": search})
        except ValidationError:
            raise InputError(f"--search: {search!r} is no time; write 60s, 2min or none") from None
        return self.model_copy(update={"model": model})

    @property
    def records(self) -> Mapping[str, RecordConfig]:
        """The training records by name; one alone is called "record"."""
        return {ALONE: self.record} if isinstance(self.record, RecordConfig) else self.record


def load(path: str | Path) -> Config:
    """Read a config from a TOML file.

    Raises InputError: the file cannot be read, is not valid TOML, or says something that no config
    can say.
    """
    return validated_config(read_toml(Path(path)), str(path))


def read_toml(path: Path) -> dict[str, Any]:
    """Return the tables of a TOML file.

    Raises InputError: the file cannot be read, or is not valid TOML.
    """
    try:
        if path.exists() and not path.is_file() and not path.is_dir():
            raise InputError(f"{path}: is not a regular file; give one")
        if path.stat().st_size > MAX_FILE_SIZE:
            raise InputError(f"{path}: is larger than 1 MB; no config is; check the path")
        text = path.read_text(encoding="utf-8-sig")
    except (OSError, UnicodeError) as error:
        reason = getattr(error, "strerror", None) or "is not UTF-8 text"
        raise InputError(f"{path}: {reason}; check the config's path") from None
    return _tables(text, str(path))


def is_config(path: Path) -> bool:
    """Tell by its content whether a file is meant as a config, be it a faulty one."""
    try:
        if path.stat().st_size > MAX_FILE_SIZE:
            return False
        text = path.read_text(encoding="utf-8-sig")
    except (OSError, UnicodeError):
        return path.suffix == ".toml"
    # A record, which may be called .toml by mistake and have a line [s];[V];[um], is mostly rows
    # that begin with a number; in prose few lines are titles of tables, keys or comments.
    rows = re.findall(r"^[ \t,;|\"']*[-+.]?\d", text, re.MULTILINE)
    written = re.findall(r"""^\s*(?:[#[\]}]|[\w."'-]+\s*=)""", text, re.MULTILINE)
    has_table = re.search(r"^\s*(\[+[a-z]|record\b)", text, re.MULTILINE) is not None
    has_keys = has_table and 2 * len(written) >= len(re.findall(r"^.*\S", text, re.MULTILINE))
    return 2 * len(rows) <= len(text.splitlines()) and (path.suffix == ".toml" or has_keys)


def parse(text: str, where: str) -> Config:
    r"""Read a config from TOML text; ``where`` names it in errors, which are as in :func:`load`.

    Examples
    --------
    >>> config = parse('[record]\nfile = "my_record.csv"', "my config")
    >>> config.model.hysteresis, config.model.dynamics
    ('bouc-wen', 'lag')
    """
    return validated_config(_tables(text, where), where)


def _tables(text: str, where: str) -> dict[str, Any]:
    """Return the tables of a text in TOML."""
    try:
        # Python's TOML reader takes time and memory by the square of a key's parts.
        lines = (line for line in text.splitlines() if not line.lstrip().startswith("#"))
        if any(name.count(".") > 100 for line in lines for name in re.split("[=,{]", line)):
            raise ValueError("a key has too many parts")
        return tomllib.loads(text)
    except (ValueError, RecursionError) as error:
        # Besides its own error, a ValueError for a whole number that is too long for Python.
        raise InputError(f"{where}: invalid TOML: {error}; correct the config") from None


def validated_config(table: Mapping[str, object], where: str) -> Config:
    """Return the config of tables and their keys, with errors as in :func:`load`."""
    try:
        return Config.model_validate(table)
    except ValidationError as error:
        raise InputError(one_line(where, error, Config)) from None


def dump(config: Config) -> str:
    """Write a config as TOML."""
    return tomlkit.dumps(config.model_dump(exclude_none=True))


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
        return "\n\n".join([_wrapped(head), *map(_entry, shown)])
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
    lines = [title, _wrapped(key.description, "    ")]
    if key.name in CHOICES and not holds_keys:
        lines.append(_wrapped(f"Choices: {', '.join(CHOICES[key.name])}.", "    "))
    if key.example:
        lines.append(_wrapped(f"Example: {key.name} = {key.example}", "    "))
    return "\n".join(lines)


def _wrapped(text: str, indent: str = "") -> str:
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
        _wrapped(
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
    if declared:
        lines += [
            "",
            _wrapped(
                "Parameters, with the default priors that they have at the ring bender's ranges "
                f"(+-{RING_BENDER.voltage:g} V, +-{RING_BENDER.displacement:g} um, "
                f"{RING_BENDER.time:g} s from turn to turn); they scale with those of a record. "
                "`bwbayes check` prints yours."
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
    paragraphs = (p if "\n " in f"\n{p}" else _wrapped(p) for p in text.split("\n\n"))
    return "\n\n".join(paragraphs)


def _parameter(numbered: Sequence[Declaration], of: str) -> Iterator[str]:
    """Yield the lines of a parameter, or of a row of numbered ones that are alike."""
    declared, last = numbered[0], numbered[-1]
    unit = "no unit" if declared.unit == "-" else declared.unit
    names = declared.name if last is declared else f"{declared.name} to {last.name}"
    until = "" if last is declared else f", and so on to: {last.description}"
    yield _wrapped(f"{names} ({unit}): {declared.description}{until}", "  ")
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
    yield _wrapped(f"{facts}; {text}{condition}", "      ")
