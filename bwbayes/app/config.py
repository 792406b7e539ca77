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
from typing import Annotated, Literal, Self

import tomlkit
from pydantic import (
    BaseModel,
    ConfigDict,
    Field,
    StringConstraints,
    ValidationError,
    field_validator,
    model_validator,
)

from bwbayes.app.wording import in_words
from bwbayes.errors import InputError
from bwbayes.inference.engine import EngineChoice

__all__ = [
    "LARGEST_SEED",
    "TABLES",
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

# What files hold as a whole number.
LARGEST_SEED = 2**63 - 1

# Python's TOML reader takes time and memory by the square of what it reads, or worse.
LARGEST_FILE = 1_000_000  # bytes
MOST_KEY_PARTS = 100

# Names go into file names.
Name = Annotated[str, StringConstraints(pattern=r"^[A-Za-z0-9_-]+$", max_length=100)]
Positive = Annotated[float, Field(gt=0)]
Window = Annotated[list[float], Field(min_length=2, max_length=2)]


class _Table(BaseModel):
    model_config = ConfigDict(extra="forbid", strict=True, allow_inf_nan=False)


class SignalConfig(_Table):
    """A voltage to be drawn up: V, Hz, s. ``decay`` is the part of the amplitude lost a second."""

    shape: Literal["sine", "triangle"] = "sine"
    amplitude: Positive
    frequency: Positive
    duration: Positive
    start: Annotated[float, Field(ge=0)] = 0.0
    decay: Annotated[float, Field(ge=0)] = 0.0
    decay_from: Annotated[float, Field(ge=0)] = 0.0


class StandConfig(_Table):
    """The virtual test stand that signals are run on."""

    discrepancy: Literal["none", "process", "structural"] = "process"
    sample_rate: Positive = 1000.0


class _Source(_Table):
    """Where samples come from: a file, or a signal on the virtual test stand."""

    file: str | None = None
    signal: str | SignalConfig | None = None
    voltage_is: Literal["command", "output"] | None = None
    columns: dict[str, str] | None = None
    units: dict[str, str] | None = None

    @model_validator(mode="after")
    def _naming(self) -> Self:
        from bwbayes.data.columns import Naming  # noqa: PLC0415  # --help need not wait for scipy

        Naming(self.columns or {}, self.units or {})
        if self.file is None and (self.columns or self.units):
            raise ValueError("columns and units are a file's; give file with them")
        return self


class RecordConfig(_Source):
    """The training record: its source, the readings to use, and the windows to fit (default: all).

    ``start``, ``exclude`` and ``decimate`` leave out readings, never the voltage: the simulation
    runs from the file's first sample. ``stop`` cuts the record. ``from_rest`` says that it starts
    with a demagnetised actuator at rest. ``outliers`` are the times of readings that a run with
    ``outliers = true`` in its model has set aside.
    """

    from_rest: bool = False
    start: float | None = None
    stop: float | None = None
    exclude: Annotated[list[Window], Field(min_length=1)] | None = None
    outliers: list[float] | None = None
    decimate: Annotated[int, Field(ge=1)] = 1
    train: Annotated[list[Window], Field(min_length=1)] | None = None

    @field_validator("train", "exclude", mode="before")
    @classmethod
    def _one_window(cls, given: object) -> object:
        """Take a single window for a list of one."""
        alone = isinstance(given, list) and given and not any(isinstance(x, list) for x in given)
        return [given] if alone else given

    @model_validator(mode="after")
    def _one_source(self) -> RecordConfig:
        if (self.file is None) == (self.signal is None):
            raise ValueError("give either file or signal")
        return self


class ModelConfig(_Table):
    """The model. ``hold = "auto"``: zero-order for a command, first-order for an output.

    ``hysteresis``, ``dynamics`` and ``noise`` are names of parts, or import paths of others.
    ``gain`` adds "quadratic" and "cubic" terms of the voltage. ``creep = true`` adds creep with a
    lag per decade of time, a list of times in s with lags of those; with ``creep_growth`` it grows
    with the voltage. ``outliers``: readings far outside of what their neighbours predict are set
    aside.

    Some operators have options: ``passive`` (Bouc-Wen): |gamma| <= beta, and not only
    beta + gamma >= 0; ``thresholds`` (plays, Maxwell-slip): how many, or which, V; ``odd`` (Duhem):
    no even terms; ``terms`` (asymmetric Bouc-Wen): which shape terms.
    """

    hysteresis: str = "bouc-wen"
    gain: list[str] = Field(default_factory=list)
    creep: bool | list[float] = False
    creep_growth: bool = False
    dynamics: str = "lag"
    hold: Literal["auto", "first", "zero"] = "auto"
    noise: str = "discrepancy"
    passive: bool | None = None
    thresholds: int | list[float] | None = None
    odd: bool | None = None
    terms: list[str] | None = None
    outliers: bool = False


class ParameterConfig(_Table):
    """A parameter's prior or fixed value, bounds, and names for people."""

    prior: dict[str, float | str] | None = None
    fixed: float | None = None
    lower: float | None = None
    upper: float | None = None
    unit: str | None = None
    label: str | None = None
    description: str | None = None

    @model_validator(mode="after")
    def _prior_or_value(self) -> ParameterConfig:
        if self.prior is not None and self.fixed is not None:
            raise ValueError("give prior or fixed, not both")
        if self.prior is not None and not isinstance(self.prior.get("distribution"), str):
            raise ValueError('prior needs a name: distribution = "normal", for instance')
        return self


class SamplingConfig(_Table):
    """When to stop and how to sample; see :class:`bwbayes.inference.sampling.SamplingPlan`."""

    engine: EngineChoice = "auto"
    ess: Positive = 2000.0
    ensembles: Annotated[int, Field(ge=4)] = 4
    walkers: Annotated[int, Field(ge=4, multiple_of=2)] | None = None
    block: Annotated[int, Field(ge=10)] = 50
    steps: Annotated[int, Field(ge=1)] = 20_000
    pilot_steps: Annotated[int, Field(ge=1)] = 3_000


class ValidationConfig(_Source):
    """Held-out data: a window of the training record, or another record.

    Of another record ``window`` is the part to judge. The lead-in of ``lead_in`` s, which tells
    the record's start, begins at the time ``lead_in_from``, by default with the record.
    """

    window: Window | None = None
    from_rest: bool = False
    own_offset: bool = True
    lead_in: Positive = 1.0
    lead_in_from: float | None = None

    @model_validator(mode="after")
    def _one_source(self) -> ValidationConfig:
        both = self.file is not None and self.signal is not None
        if both or not (self.another or self.window is not None):
            raise ValueError("give one of window, file and signal")
        if not self.another and self.lead_in_from is not None:
            raise ValueError("lead_in_from is for another record; give file or signal with it")
        return self

    @property
    def another(self) -> bool:
        """Whether this is another record, and no window of the training record."""
        return self.file is not None or self.signal is not None


class Config(_Table):
    """A whole run. ``truth`` holds the true parameters of a simulated record, to be shown."""

    name: Annotated[str, Field(min_length=1)] | None = None
    seed: Annotated[int, Field(ge=0, le=LARGEST_SEED)] = 1
    record: RecordConfig
    stand: StandConfig = StandConfig()
    model: ModelConfig = ModelConfig()
    parameters: dict[str, ParameterConfig] = Field(default_factory=dict)
    sampling: SamplingConfig = SamplingConfig()
    validation: dict[Name, ValidationConfig] = Field(default_factory=dict)
    truth: dict[str, float] = Field(default_factory=dict)

    @field_validator("validation")
    @classmethod
    def _names_of_its_own(cls, found: dict[str, object]) -> dict[str, object]:
        for name in found:
            if name == "record" or re.fullmatch(r"training(-\d+)?", name):
                raise ValueError(f"the name {name!r} is taken by the training record")
        return found


# The tables of a config by their names.
TABLES: dict[str, type[BaseModel]] = {
    "record": RecordConfig,
    "stand": StandConfig,
    "model": ModelConfig,
    "parameters": ParameterConfig,
    "sampling": SamplingConfig,
    "validation": ValidationConfig,
    "signal": SignalConfig,
}


def load(path: str | Path) -> Config:
    """Read a config from a TOML file.

    Raises
    ------
    InputError
        The file cannot be read, is not TOML, or says something that no config can say.
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
    """Read a config from TOML text; ``where`` names it in errors, which are as in :func:`load`."""
    try:
        _check_keys(text)
        table = tomllib.loads(text)
    except (ValueError, RecursionError) as error:
        # Besides its own error, a ValueError for a whole number that is too long for Python.
        raise InputError(f"{where}: is not TOML: {error}; correct the config") from None
    return checked(table, where)


def checked(table: Mapping[str, object], where: str) -> Config:
    """Return the config of tables and their keys, with errors as in :func:`load`."""
    try:
        return Config.model_validate(table)
    except ValidationError as error:
        raise InputError(in_words(where, error, Config, TABLES)) from None


def _check_keys(text: str) -> None:
    for line in text.splitlines():
        parts = max(part.count(".") for part in re.split("[=,{]", line))
        if parts > MOST_KEY_PARTS and not line.lstrip().startswith("#"):
            raise ValueError("a key has too many parts")


def dump(config: Config) -> str:
    """Write a config as TOML."""
    return tomlkit.dumps(config.model_dump(exclude_none=True))
