"""Configs: what to run, in TOML, checked before anything starts.

Only ``[record]`` is needed; everything else has a default. A key that does not exist is an error
that names its place and the nearest key that does. :func:`load` reads a config, :func:`dump` writes
one back, with every default made explicit.

A key is a field here and nowhere else: its type is what is checked, its docstring what
``bwbayes config`` prints. A new key is a new field, and a new table a model that :class:`Config`
has a field for.
"""

from __future__ import annotations

import re
import tomllib
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any, Literal, Self

import tomlkit
from pydantic import (
    BeforeValidator,
    Discriminator,
    Field,
    StringConstraints,
    Tag,
    ValidationError,
    field_validator,
    model_validator,
)

from bwbayes.app.config import MAX_SEED
from bwbayes.app.config.keys import ConfigTable, Positive, Texts, key, one_line
from bwbayes.errors import InputError, suggestion
from bwbayes.inference import EngineChoice
from bwbayes.model.inputs import Hold
from bwbayes.model.registry import OPTIONS
from bwbayes.model.spec import ModelSpec

# Names go into file names.
Name = Annotated[str, StringConstraints(pattern=r"^[A-Za-z0-9_-]+$", max_length=100)]
Duration = Annotated[str, StringConstraints(pattern=r"^(none|\d+(\.\d+)? ?(s|min))$")]
NotNegative = Annotated[float, Field(ge=0)]
Window = Annotated[list[float], Field(min_length=2, max_length=2)]
# A single window stands for a list of one.
Windows = Annotated[
    list[Window],
    BeforeValidator(
        lambda value: (
            [value]
            if isinstance(value, list) and value and not any(isinstance(x, list) for x in value)
            else value
        )
    ),
    Field(min_length=1),
]


class SignalConfig(ConfigTable):
    """A voltage for the virtual test stand: V, Hz, s."""

    shape: Literal["sine", "triangle", "steps"] = key("sine", example='"triangle"')
    """Shape of a period, or steps."""
    amplitude: Positive | None = key(None, unit="V", example="100.0")
    """Amplitude; not for steps."""
    frequency: Positive | None = key(None, unit="Hz", example="1.0", called="freq")
    """Frequency; not for steps."""
    levels: Annotated[list[float], Field(min_length=1)] | None = key(
        None, unit="V", example="[10.0, 50.0, 0.0]"
    )
    """Voltages of steps."""
    dwell: Positive | None = key(None, unit="s", example="2.0")
    """How long each step lasts; the last one stays to the end."""
    duration: Positive = key(unit="s", example="16.0", called="length")
    """Length of the record, from zero."""
    start: NotNegative = key(0.0, unit="s", example="0.5", called="begin")
    """When the voltage leaves zero."""
    decay: NotNegative = key(0.0, unit="1/s", example="0.1")
    """Part of the amplitude that is lost every second."""
    decay_from: NotNegative = key(0.0, unit="s", example="4.0")
    """When the decay begins."""

    @model_validator(mode="after")
    def _of_its_shape(self) -> SignalConfig:
        needed, other = (self.levels, self.dwell), (self.amplitude, self.frequency)
        if self.shape != "steps":
            needed, other = other, needed  # type: ignore[assignment]
        if None in needed or other != (None, None):
            raise ValueError("give levels and dwell for steps, else amplitude and frequency")
        return self


class _Source(ConfigTable):
    """Where samples come from: a file, or a signal on the virtual test stand."""

    file: str | None = key(None, example='"my_record.csv"', called="path data filename")
    """A record's file (text, HDF5, MATLAB, NumPy, LVM, TDMS), relative to the config; or signal."""
    signal: str | SignalConfig | None = key(
        None,
        example="{ amplitude = 100.0, frequency = 1.0, duration = 16.0, decay = 0.1 }",
        called="waveform",
    )
    """A voltage that the virtual test stand runs, by name or as a table."""
    voltage_is: Literal["command", "output"] | None = key(None, example='"command"')
    """Whether the voltage is the command that a DAC held, or the amplifier's measured output; by
    default what the file says, else the output.
    """
    columns: dict[str, str | int] | None = key(
        None, example='{ time = "t [ms]", voltage = "U_mV", displacement = "3" }'
    )
    """The file's columns by quantity, where their names are not like voltage_V: names, the ends of
    paths, or numbers counted from 1.
    """
    units: dict[str, str] | None = key(None, example='{ displacement = "nm" }')
    """Units by quantity, where the file does not state them; "0.35 um" is a sensor's sensitivity,
    that of 1 in the column, and a minus turns the sign; "0.35 +- 0.004 um" or "um +- 1.2 %" is one
    with its standard uncertainty.
    """
    fs: Positive | None = key(None, unit="Hz", example="1e3")
    """The file's sampling rate, in place of a time column."""
    table: int | str | None = key(None, example="2", called="sheet")
    """The table that counts, of a workbook or text with several: its number, from 1 on, or the
    sheet's name.
    """
    displacement_file: str | None = key(None, example='"my_displacement.csv"')
    """The file with the displacement, if the record's has the voltage alone."""
    covariates: list[str] | dict[str, str] | None = key(None, example='["temperature_degC"]')
    """Further columns of the file that a part of the model sees, as stages = ["temperature"] does;
    where they are called otherwise { temperature_degC = "T2" }.
    """
    input: str | None = key(None, example='"H (A/m)"')
    """The input, where it is no voltage in V: its name, and the unit of all numbers."""
    output: str | None = key(None, example='"B (T)"')
    """The output, where it is no displacement in um."""
    linearity: str | None = key(None, example='"0.1 %"')
    """The sensor's largest departure from a straight line, of the range."""
    missing: list[float] | None = key(None, unit="um", example="[-20.0, 20.0]", called="na clipped")
    """Displacements that are no readings, as a sensor's limits where it is clipped; of a record
    that is predicted by default those of the training record.
    """

    @model_validator(mode="after")
    def _naming(self) -> Self:
        from bwbayes.record.io.columns import Naming  # noqa: PLC0415  # --help need not wait for scipy

        keys = ("columns", "units", "fs", "displacement_file", "covariates", "input", "output")
        Naming.stated(**{key: getattr(self, key) for key in (*keys, "linearity")})
        return self


class RecordConfig(_Source):
    """A training record: its source, the readings to use, and the windows to fit.

    ``start``, ``exclude`` and ``decimate`` leave out readings, never the voltage: the simulation
    runs from the file's first sample.
    """

    from_rest: bool = key(False, example="true")
    """Whether the record starts at rest, demagnetized."""
    continues: Name | None = key(None, example='"first"', called="follows")
    """The record that this one continues at once: state, offset and discrepancy carry over, and the
    two are fitted as one record of that name.
    """
    start: float | None = key(None, unit="s", example="2.0")
    """Readings before are left out; the voltage is not, because the hysteresis remembers it."""
    stop: float | None = key(None, unit="s", example="14.0", called="end")
    """The record is cut here."""
    exclude: Windows | None = key(None, unit="s", example="[[3.1, 3.2]]", called="skip mask ignore")
    """Stretches whose readings are left out."""
    outliers: list[float] | None = key(None, unit="s", example="[3.105, 7.42]")
    """Times of single readings that are left out; a run with model.outliers writes them."""
    remarks: Texts | None = key(None, example='["my_record.csv:1: ignored columns: temperature_C"]')
    """Notes from reading the record's files; a run writes them and shows them again."""
    read_as: dict[str, dict[str, str] | list[str] | float | str] | None = key(
        None, example='{ columns = { displacement = "U2" }, all_columns = ["t", "U1", "U2"] }'
    )
    """How the record's own file was read; a run writes it, and reads files of the same columns
    alike.
    """
    decimate: int = key(1, ge=1, example="5", called="thin downsample")
    """One of so many readings is used."""
    train: Windows | None = key(
        None, unit="s", example="[[0.0, 12.0]]", called="fit training windows"
    )
    """Windows to fit, [start, stop]; by default the whole record."""

    @model_validator(mode="after")
    def _one_source(self) -> RecordConfig:
        if (self.file is None) == (self.signal is None):
            raise ValueError("give either file or signal")
        return self


class ActuatorConfig(ConfigTable):
    """The parts of an actuator, by name or by import path, and their options.

    ``passive``, ``thresholds``, ``odd`` and ``terms`` are options of some operators only.
    """

    hysteresis: str = key("bouc-wen", example='"prandtl-ishlinskii"')
    """The hysteresis operator."""
    nonlinearity: Texts = key([], example='["quadratic", "cubic"]', called="gain")
    """Static nonlinearity: terms about the middle of the voltage's range, for asymmetric loops."""
    creep: bool | list[float] = key(False, example="true")
    """Slow growth after a step: true for a lag per decade of time, or the lags' times in s."""
    creep_growth: bool = key(False, example="true")
    """Whether the creep grows with the voltage; needs creep."""
    dynamics: str = key("lag", example='"second-order"')
    """The linear dynamics behind the hysteresis."""
    stages: Literal["auto"] | Texts = key("auto", example='["backlash"]')
    """Further stages between command and reading, see `bwbayes models`; auto: those that the record
    has evidence for, in a search that may also add a nonlinearity or creep, or take another
    operator or other dynamics. A drift, transient or step is fitted in its record and not expected
    of the next.
    """
    passive: bool | None = key(None, example="false")
    """For bouc-wen: whether |gamma| <= beta, not only beta + gamma >= 0 (default: true)."""
    thresholds: int | list[float] | None = key(
        None, unit="V if a list", example="[5.0, 20.0, 60.0]"
    )
    """For plays and maxwell-slip: how many thresholds (default: 10), or which."""
    odd: bool | None = key(None, example="false")
    """For duhem: whether there are no even terms (default: true)."""
    terms: Texts | None = key(None, example='["b4", "b5"]')
    """For bouc-wen-asymmetric: which of b2 to b6 are parameters (default: all)."""

    @property
    def spec(self) -> ModelSpec:
        """The model that it describes."""
        stages = () if self.stages == "auto" else self.stages
        return ModelSpec.from_keys(vars(self) | {"stages": stages})


class ModelConfig(ActuatorConfig):
    """The model: an actuator, and what is read of it."""

    hold: Literal["auto", "first", "zero", "corners"] = key("auto", example='"zero"')
    """How the voltage goes between samples: in straight lines (first), held (zero), or held if it
    is a command (auto); straight lines that meet between samples at reversals (corners).
    """
    history: Literal["unknown", "demagnetized"] = key("unknown", example='"demagnetized"')
    """The drive before the record: any over the record's voltages (unknown), or a voltage
    straight from 0 V after demagnetization; dynamics may still be moving.
    """
    search: Duration = key("60s", example='"none"', called="improve")
    """Longest time of the search for stages, as in 60s or 2min; none: no search."""
    unexplained: float | None = key(None, unit="SDs of the sensor's noise", example="0.9")
    """The model error left by a search that did not find the mechanism; such a run is inconclusive.
    """
    tied: list[dict[str, Any]] = key([], example='[{ stages = ["sensor-lag"] }]')
    """Changes of these keys with which the record is as probable: unlike drives tell such models.
    """
    noise: str = key("auto", example='"smooth"')
    """The model of the residual; auto: the one that the records have evidence for."""
    per_record: Texts = key([], example='["sensor_sd"]')
    """Parameters that each of several records has of its own, besides initial and offset."""
    shared: Texts = key([], example='["offset"]')
    """Which of initial and offset all of several records share."""
    outliers: bool = key(False, example="true")
    """Whether readings far from what their neighbors predict are set aside."""

    @property
    def spec(self) -> ModelSpec:
        """The model that it describes; where the noise is open, the one that claims least."""
        spec = super().spec
        return replace(spec, noise="discrepancy") if spec.noise == "auto" else spec

    @property
    def stated_hold(self) -> Hold | None:
        """The hold of other records, too; None where each has its own."""
        match self.hold:
            case "first" | "zero":
                return self.hold
        return None

    @property
    def search_seconds(self) -> float:
        """The longest time of the search for stages; 0 where there is none."""
        if self.stages != "auto" or self.search == "none":
            return 0.0
        return float(self.search.rstrip(" mins")) * (60.0 if "min" in self.search else 1.0)

    def with_spec(self, spec: ModelSpec) -> Self:
        """Return the config of another model; what both have in common is said as it was."""
        dropped = dict.fromkeys(name for name in OPTIONS if name not in spec.keys)
        return self.model_copy(update=dropped | self.spec.changes_to(spec))


class StandModelConfig(ActuatorConfig):
    """The actuator on the stand, by default the paper's ring bender."""

    dynamics: str = key("second-order", example='"lag"')
    """The linear dynamics of the stand's actuator."""


class StandConfig(ConfigTable):
    """The virtual test stand that signals are run on."""

    discrepancy: Literal["none", "process", "structural"] = key("process", example='"structural"')
    """How the stand's actuator departs from the model: not at all, by a random process, or by
    creep, drift and an even term.
    """
    sample_rate: Positive = key(1000.0, unit="Hz", example="200.0", called="rate sampling_rate")
    """Samples of a record per second."""
    model: StandModelConfig = key(StandModelConfig())
    """The actuator on the stand, in parts."""
    parameters: dict[str, float] = key({}, unit="the parameter's", example="{ d = 0.8 }")
    """True values of its parameters; by default those of the paper's ring bender, or typical ones.
    """


class ParameterConfig(ConfigTable):
    """A parameter's prior or fixed value, bounds, and names for people."""

    prior: dict[str, float | str] | None = key(
        None, example='{ distribution = "normal", mean = 0.7, sd = 0.07 }'
    )
    """Its prior: a distribution and its arguments."""
    fixed: float | None = key(None, unit="the parameter's", example="0.7", called="value constant")
    """Its value, if it is not fitted."""
    lower: float | None = key(None, unit="the parameter's", example="0.5", called="min minimum")
    """Lower bound."""
    upper: float | None = key(None, unit="the parameter's", example="0.9", called="max maximum")
    """Upper bound."""
    unit: str | None = key(None, example='"um/V"', called="units")
    """Its unit, to be checked; no other can be chosen."""
    label: str | None = key(None, example='"d_{33}"', called="symbol")
    """Its symbol in figures, in LaTeX."""
    description: str | None = key(None, example='"gain of the bender"')
    """Its description in the report."""

    @model_validator(mode="after")
    def _prior_or_value(self) -> ParameterConfig:
        if self.prior is not None and self.fixed is not None:
            raise ValueError("give prior or fixed, not both")
        if self.prior is not None and not isinstance(self.prior.get("distribution"), str):
            raise ValueError('prior needs a name: distribution = "normal", for instance')
        return self


class CertificateConfig(ConfigTable):
    """A measurement for a certificate: its object, conditions and instruments."""

    number: str | None = key(None, example='"2026-114"')
    """The certificate's number."""
    laboratory: str | None = key(None, example='"Precision Lab, room 3"')
    """Who measured."""
    object: str | None = key(None, example='"stack P-885.51, serial 0917"', called="specimen")
    """The object that was measured."""
    conditions: str | None = key(None, example='"(23.0 +- 0.2) degC, unloaded, after 30 min"')
    """Under which conditions."""
    instruments: Texts = key([], example='["capacitive sensor CS1, calibrated 2026-03-02"]')
    """With which instruments."""


class SamplingConfig(ConfigTable):
    """When to stop and how to sample; see :class:`bwbayes.sampling.plan.SamplingPlan`."""

    engine: EngineChoice = key("auto", example='"numpy"')
    """The engine that evaluates the likelihood; auto: numba if installed."""
    ess: Positive = key(2000.0, example="4000", called="draws samples")
    """Effective draws of every parameter at which to stop."""
    ensembles: int = key(4, ge=4, example="8", called="chains")
    """Independent ensembles of walkers."""
    walkers: Annotated[int, Field(ge=4, multiple_of=2)] | None = key(None, example="40")
    """Walkers of each ensemble; by default 64 (numba) or 32 (NumPy), or more for many parameters.
    """
    block: int = key(25, ge=10, example="50")
    """Steps between two looks at convergence."""
    steps: int = key(20_000, ge=1, example="40_000", called="iterations budget")
    """Largest number of steps that count."""
    pilot_steps: int = key(3_000, ge=1, example="6_000", called="warmup burn_in")
    """Largest number of steps until the ensembles have met."""


class ValidationConfig(_Source):
    """Held-out data: a window of the training record, or another record."""

    window: Windows | None = key(None, unit="s", example="[[6.0, 8.0], [14.0, 16.0]]")
    """Windows [start, stop] of the training record that are held out, judged together; or the part
    of another record to judge.
    """
    of: str | None = key(None, example='"record"')
    """The training record that the window is of, or whose own parameters another record takes where
    nothing tells its own; by default the first.
    """
    from_rest: bool = key(False, example="true")
    """Whether another record starts at rest, demagnetized."""
    estimate_offset: bool = key(True, example="false", called="own_offset")
    """Whether the sensor may have been set to zero again before another record."""
    lead_in: Positive | None = key(None, unit="s", example="2.0")
    """How long the beginning of another record, the lead-in, estimates its initial state and
    offset; by default a quarter of the record, and ten correlation times of the discrepancy at
    most.
    """
    lead_in_start: float | None = key(None, unit="s", example="0.5", called="lead_in_from")
    """Where the lead-in begins; by default with the record."""

    @model_validator(mode="after")
    def _one_source(self) -> ValidationConfig:
        two_sources = self.file is not None and self.signal is not None
        if two_sources or not (self.another or self.window is not None):
            raise ValueError("give one of window, file and signal")
        if not self.another and self.lead_in_start is not None:
            raise ValueError("lead_in_start is for another record; give file or signal with it")
        if self.another and self.window is not None and len(self.window) > 1:
            raise ValueError("of another record one window is judged; give one")
        return self

    @property
    def another(self) -> bool:
        """Whether this is another record, and no window of the training record."""
        return self.file is not None or self.signal is not None


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
    """The measurement as a certificate describes it."""
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

    def with_name(self, name: str, seed: int | None) -> Config:
        """Return the config with a name, if it has none, and another seed, if there is one."""
        changes = {"name": self.name or name} | ({} if seed is None else {"seed": seed})
        return self.model_copy(update=changes)

    def with_search(self, search: str | None) -> Config:
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
