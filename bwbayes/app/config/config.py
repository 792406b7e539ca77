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
from typing import Annotated

import tomlkit
from pydantic import Field, ValidationError, field_validator

from bwbayes.app.config.keys import Table, described, one_line
from bwbayes.app.config.limits import LARGEST_SEED
from bwbayes.app.config.model_settings import ActuatorConfig, ModelConfig, StandConfig
from bwbayes.app.config.settings import (
    Name,
    ParameterConfig,
    RecordConfig,
    SamplingConfig,
    SignalConfig,
    ValidationConfig,
)
from bwbayes.errors import InputError

__all__ = [
    "ActuatorConfig",
    "Config",
    "ModelConfig",
    "ParameterConfig",
    "RecordConfig",
    "SignalConfig",
    "ValidationConfig",
    "checked",
    "dump",
    "load",
    "parse",
]

# Python's TOML reader takes time and memory by the square of what it reads, or worse.
LARGEST_FILE = 1_000_000  # bytes
MOST_KEY_PARTS = 100


class Config(Table):
    """A whole run."""

    name: Annotated[
        Annotated[str, Field(min_length=1)] | None,
        described("The run's name; by default the config's file name.", example='"bender 7"'),
    ] = None
    seed: Annotated[
        int,
        Field(ge=0, le=LARGEST_SEED),
        described("Seed of all random numbers.", example="7"),
    ] = 1
    record: Annotated[RecordConfig, described("The training record; file or signal is required.")]
    stand: Annotated[StandConfig, described("The virtual test stand, for signals.")] = StandConfig()
    model: Annotated[ModelConfig, described("The model of the actuator and of the residual.")] = (
        ModelConfig()
    )
    parameters: Annotated[
        dict[str, ParameterConfig],
        described(
            "What is known of a parameter; NAME is its name, see `bwbayes models`.",
        ),
    ] = Field(default_factory=dict)
    sampling: Annotated[SamplingConfig, described("How to sample, and when to stop.")] = (
        SamplingConfig()
    )
    validation: Annotated[
        dict[Name, ValidationConfig],
        described("Data to predict and judge, under a NAME of your choice."),
    ] = Field(default_factory=dict)
    truth: Annotated[
        dict[str, float],
        described(
            "True parameters of a simulated record, to be shown beside the estimates.",
            unit="the parameter's",
            example="{ d = 0.7, alpha = 0.3575 }",
        ),
    ] = Field(default_factory=dict)

    @field_validator("validation")
    @classmethod
    def _names_of_its_own(cls, given: dict[str, object]) -> dict[str, object]:
        for name in given:
            if name == "record" or re.fullmatch(r"training(-\d+)?", name):
                raise ValueError(f"the name {name!r} is taken by the training record")
        return given


def load(path: str | Path) -> Config:
    """Read a config from a TOML file.

    Raises
    ------
    InputError
        The file cannot be read, is not valid TOML, or says something that no config can say.
    """
    path = Path(path)
    try:
        if path.exists() and not path.is_file() and not path.is_dir():
            raise InputError(f"{path}: is not a regular file; give one")
        if path.stat().st_size > LARGEST_FILE:
            raise InputError(f"{path}: is larger than 1 MB; no config is; check the path")
        text = path.read_text(encoding="utf-8-sig")
    except (OSError, UnicodeError) as error:
        reason = getattr(error, "strerror", None) or "is not UTF-8 text"
        raise InputError(f"{path}: {reason}; check the config's path") from None
    return parse(text, str(path))


def parse(text: str, where: str) -> Config:
    r"""Read a config from TOML text; ``where`` names it in errors, which are as in :func:`load`.

    Examples
    --------
    >>> config = parse('[record]\nfile = "my_record.csv"', "my config")
    >>> config.model.hysteresis, config.model.dynamics
    ('bouc-wen', 'lag')
    """
    try:
        _check_keys(text)
        table = tomllib.loads(text)
    except (ValueError, RecursionError) as error:
        # Besides its own error, a ValueError for a whole number that is too long for Python.
        raise InputError(f"{where}: invalid TOML: {error}; correct the config") from None
    return checked(table, where)


def checked(table: Mapping[str, object], where: str) -> Config:
    """Return the config of tables and their keys, with errors as in :func:`load`."""
    try:
        return Config.model_validate(table)
    except ValidationError as error:
        raise InputError(one_line(where, error, Config)) from None


def _check_keys(text: str) -> None:
    for line in text.splitlines():
        parts = max(part.count(".") for part in re.split("[=,{]", line))
        if parts > MOST_KEY_PARTS and not line.lstrip().startswith("#"):
            raise ValueError("a key has too many parts")


def dump(config: Config) -> str:
    """Write a config as TOML."""
    return tomlkit.dumps(config.model_dump(exclude_none=True))
