"""Configs: what to run, in TOML, checked before anything starts.

Only ``[record]`` is needed; everything else has a default. A key that does not exist is an error
that names its place and the nearest key that does. :func:`load` reads a config, :func:`dump` writes
one back, with every default made explicit.
"""

from __future__ import annotations

import re
import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Self

import tomlkit
from pydantic import Discriminator, Field, Tag, ValidationError, field_validator, model_validator

from bwbayes.app.config import MAX_SEED
from bwbayes.app.config.keys import ConfigTable, key, one_line
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
