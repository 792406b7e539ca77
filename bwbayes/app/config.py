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
from typing import Annotated, Literal

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

from bwbayes.errors import InputError, suggestion
from bwbayes.inference.engine import EngineChoice

__all__ = [
    "LARGEST_SEED",
    "ActuatorConfig",
    "Config",
    "ModelConfig",
    "ParameterConfig",
    "RecordConfig",
    "SignalConfig",
    "ValidationConfig",
    "dump",
    "load",
    "parse",
]

# What files hold as a whole number.
LARGEST_SEED = 2**63 - 1

# Python's TOML reader takes time and memory by the square of what it reads, or worse.
LARGEST_FILE = 1_000_000  # bytes
MOST_KEY_PARTS = 100

# What people call a key of a config, and its name here.
MEANINGS = {
    "draws": "ess",
    "samples": "ess",
    "chains": "ensembles",
    "iterations": "steps",
    "budget": "steps",
    "warmup": "pilot_steps",
    "burn_in": "pilot_steps",
    "path": "file",
    "data": "file",
    "filename": "file",
    "fit": "train",
    "training": "train",
    "windows": "train",
    "begin": "start",
    "end": "stop",
    "thin": "decimate",
    "downsample": "decimate",
    "skip": "exclude",
    "mask": "exclude",
    "ignore": "exclude",
    "value": "fixed",
    "constant": "fixed",
    "min": "lower",
    "minimum": "lower",
    "max": "upper",
    "maximum": "upper",
    "units": "unit",
    "symbol": "label",
    "rate": "sample_rate",
    "sampling_rate": "sample_rate",
    "random_seed": "seed",
    "rng": "seed",
    "priors": "parameters",
    "holdout": "validation",
    "test": "validation",
    "waveform": "signal",
    "freq": "frequency",
    "length": "duration",
}

# Names go into file names.
Name = Annotated[str, StringConstraints(pattern=r"^[A-Za-z0-9_-]+$", max_length=100)]
Positive = Annotated[float, Field(gt=0)]
Window = Annotated[list[float], Field(min_length=2, max_length=2)]


class _Table(BaseModel):
    model_config = ConfigDict(extra="forbid", strict=True, allow_inf_nan=False)


class SignalConfig(_Table):
    """A voltage to be drawn up: V, Hz, s. ``decay`` is the part of the amplitude lost a second.

    "steps" has ``levels`` of ``dwell`` s each, the last one up to the end.
    """

    shape: Literal["sine", "triangle", "steps"] = "sine"
    amplitude: Positive | None = None
    frequency: Positive | None = None
    levels: Annotated[list[float], Field(min_length=1)] | None = None
    dwell: Positive | None = None
    duration: Positive
    start: Annotated[float, Field(ge=0)] = 0.0
    decay: Annotated[float, Field(ge=0)] = 0.0
    decay_from: Annotated[float, Field(ge=0)] = 0.0

    @model_validator(mode="after")
    def _of_its_shape(self) -> SignalConfig:
        own, other = (self.levels, self.dwell), (self.amplitude, self.frequency)
        if self.shape != "steps":
            own, other = other, own  # type: ignore[assignment]
        if None in own or other != (None, None):
            raise ValueError("give levels and dwell for steps, else amplitude and frequency")
        return self


class _Source(_Table):
    """Where samples come from: a file, or a signal on the virtual test stand."""

    file: str | None = None
    signal: str | SignalConfig | None = None
    voltage_is: Literal["command", "output"] | None = None


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


class ActuatorConfig(_Table):
    """The parts of an actuator.

    ``hysteresis`` and ``dynamics`` are names or import paths. ``gain`` adds "quadratic" and "cubic"
    terms of the voltage. ``creep = true`` adds creep with a lag per decade of time, a list of times
    in s with lags of those; with ``creep_growth`` it grows with the voltage.

    Some operators have options: ``passive`` (Bouc-Wen): |gamma| <= beta, and not only
    beta + gamma >= 0; ``thresholds`` (plays, Maxwell-slip): how many, or which, V; ``odd`` (Duhem):
    no even terms; ``terms`` (asymmetric Bouc-Wen): which shape terms.
    """

    hysteresis: str = "bouc-wen"
    gain: list[str] = Field(default_factory=list)
    creep: bool | list[float] = False
    creep_growth: bool = False
    dynamics: str = "lag"
    passive: bool | None = None
    thresholds: int | list[float] | None = None
    odd: bool | None = None
    terms: list[str] | None = None


class ModelConfig(ActuatorConfig):
    """The model: an actuator, and what is read of it.

    ``hold = "auto"``: zero-order for a command, first-order for an output. ``noise`` is a name or
    import path. ``outliers``: readings far outside of what their neighbours predict are set aside.
    """

    hold: Literal["auto", "first", "zero"] = "auto"
    noise: str = "discrepancy"
    outliers: bool = False


class StandModelConfig(ActuatorConfig):
    """The actuator on the stand, by default the paper's ring bender."""

    dynamics: str = "second-order"


class StandConfig(_Table):
    """The virtual test stand that signals are run on; ``parameters`` are true values."""

    discrepancy: Literal["none", "process", "structural"] = "process"
    sample_rate: Positive = 1000.0
    model: StandModelConfig = StandModelConfig()
    parameters: dict[str, float] = Field(default_factory=dict)


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


TABLES: Mapping[str, type[BaseModel]] = {
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
    try:
        return Config.model_validate(table)
    except ValidationError as error:
        raise InputError(_one_line(where, error)) from None


def _check_keys(text: str) -> None:
    for line in text.splitlines():
        parts = max(part.count(".") for part in re.split("[=,{]", line))
        if parts > MOST_KEY_PARTS and not line.lstrip().startswith("#"):
            raise ValueError("a key has too many parts")


def dump(config: Config) -> str:
    """Write a config as TOML."""
    return tomlkit.dumps(config.model_dump(exclude_none=True))


def _one_line(where: str, error: ValidationError) -> str:
    """Say the first thing that is wrong: where, what, what to do."""
    found = error.errors()
    # Unknown keys first: a misspelt key is often why another one seems to be missing. Then the
    # deepest place: the branch of a union that the user meant.
    first = min(found, key=lambda e: (e["type"] != "extra_forbidden", -len(e["loc"])))
    place = [str(part) for part in first["loc"] if not _is_branch(str(part))]
    path = ".".join(place) or "config"
    if first["type"] == "extra_forbidden":
        hint = _home(place) or suggestion(place[-1], _keys_at(place[:-1]), MEANINGS)
        return f"{where}: {path}: unknown key; {hint}"
    message = first["msg"].removeprefix("Value error, ")
    if place[-1:] == ["prior"]:
        message = 'write a table like { distribution = "normal", mean = 1.0, sd = 0.1 }'
    elif place[-1:] == ["signal"]:
        message = (
            "write a signal's name or a table like { amplitude = 100.0, frequency = 1.0, ... }"
        )
    elif first["type"] == "dict_type":
        message = f"is not a table; write [{path}.NAME] and its keys below"
    elif first["type"] == "model_type":
        message = f"is not a table; known keys are {', '.join(_keys_at(place))}"
    elif first["type"] == "missing":
        message = "is missing"
    got = "" if isinstance(first["input"], dict) else f", got {_shown(first['input'])}"
    return f"{where}: {path}: {message[:1].lower()}{message[1:]}{got}; correct the config"


def _home(place: list[str]) -> str:
    """Say where a key belongs that is known, but in another table; nothing if it is not."""
    key, table = place[-1], place[0] if len(place) > 1 else ""
    if key in Config.model_fields:
        return "it belongs above the first table, or is a table of its own"
    homes = ("record", "model", "sampling", "stand")
    names = [name for name in homes if key in TABLES[name].model_fields and name != table]
    return f"it belongs under [{names[0]}]" if names else ""


def _shown(value: object) -> str:
    try:
        return f"{value!r:.60}"
    except ValueError:  # Python writes no whole number of more than 4300 digits
        return "a very long number"


def _is_branch(part: str) -> bool:
    """Tell the names that pydantic gives to the branches of a union from keys."""
    return part in ("str", "float", "SignalConfig") or part.startswith("function-after")


def _keys_at(place: list[str]) -> list[str]:
    """Return the keys that exist at a place of a config."""
    table: type[BaseModel] = Config
    named = place[:1] in (["parameters"], ["validation"])
    for part in place[:1] + place[1 + named :]:
        table = TABLES.get(part, table)
    return list(table.model_fields)
