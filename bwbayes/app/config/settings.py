"""What a config says, except for the model: the home of every key's type, default and description.

A key is a field here and nowhere else: its type is what is checked, its :func:`described` what
``bwbayes config`` prints. A new key is a new field, and a new table a model that
:class:`~bwbayes.app.config.config.Config` has a field for.
"""

from __future__ import annotations

from typing import Annotated, Literal, Self

from pydantic import Field, StringConstraints, field_validator, model_validator

from bwbayes.app.config.keys import ConfigTable, Positive, Texts, described
from bwbayes.inference.engine import EngineChoice

__all__ = [
    "Name",
    "ParameterConfig",
    "RecordConfig",
    "SamplingConfig",
    "SignalConfig",
    "ValidationConfig",
]

# Names go into file names.
Name = Annotated[str, StringConstraints(pattern=r"^[A-Za-z0-9_-]+$", max_length=100)]
NotNegative = Annotated[float, Field(ge=0)]
Window = Annotated[list[float], Field(min_length=2, max_length=2)]
Windows = Annotated[list[Window], Field(min_length=1)]


def _one_window(given: object) -> object:
    """Take a single window for a list of one."""
    alone = isinstance(given, list) and given and not any(isinstance(x, list) for x in given)
    return [given] if alone else given


class SignalConfig(ConfigTable):
    """A voltage for the virtual test stand: V, Hz, s."""

    shape: Annotated[
        Literal["sine", "triangle", "steps"],
        described("Shape of a period, or steps.", example='"triangle"'),
    ] = "sine"
    amplitude: Annotated[
        Positive | None, described("Amplitude; not for steps.", unit="V", example="100.0")
    ] = None
    frequency: Annotated[
        Positive | None, described("Frequency; not for steps.", unit="Hz", example="1.0")
    ] = None
    levels: Annotated[
        Annotated[list[float], Field(min_length=1)] | None,
        described("Voltages of steps.", unit="V", example="[10.0, 50.0, 0.0]"),
    ] = None
    dwell: Annotated[
        Positive | None,
        described(
            "How long each step lasts; the last one stays to the end.", unit="s", example="2.0"
        ),
    ] = None
    duration: Annotated[
        Positive, described("Length of the record, from zero.", unit="s", example="16.0")
    ]
    start: Annotated[
        NotNegative, described("When the voltage leaves zero.", unit="s", example="0.5")
    ] = 0.0
    decay: Annotated[
        NotNegative,
        described("Part of the amplitude that is lost every second.", unit="1/s", example="0.1"),
    ] = 0.0
    decay_from: Annotated[
        NotNegative, described("When the decay begins.", unit="s", example="4.0")
    ] = 0.0

    @model_validator(mode="after")
    def _of_its_shape(self) -> SignalConfig:
        own, other = (self.levels, self.dwell), (self.amplitude, self.frequency)
        if self.shape != "steps":
            own, other = other, own  # type: ignore[assignment]
        if None in own or other != (None, None):
            raise ValueError("give levels and dwell for steps, else amplitude and frequency")
        return self


class _Source(ConfigTable):
    """Where samples come from: a file, or a signal on the virtual test stand."""

    file: Annotated[
        str | None,
        described(
            "A record's file (text, HDF5, MATLAB, LVM or TDMS), relative to the config; this or "
            "signal.",
            example='"my_record.csv"',
        ),
    ] = None
    signal: Annotated[
        str | SignalConfig | None,
        described(
            "A voltage that the virtual test stand runs, by name or as a table.",
            example="{ amplitude = 100.0, frequency = 1.0, duration = 16.0, decay = 0.1 }",
        ),
    ] = None
    voltage_is: Annotated[
        Literal["command", "output"] | None,
        described(
            "Whether the voltage is the command that a DAC held, or the amplifier's measured "
            "output; by default what the file says, else the output.",
            example='"command"',
        ),
    ] = None
    columns: Annotated[
        dict[str, str] | None,
        described(
            "The file's columns by quantity, where their names are not like voltage_V: names, the "
            "ends of paths, or numbers counted from 1.",
            example='{ time = "t [ms]", voltage = "U_mV", displacement = "3" }',
        ),
    ] = None
    units: Annotated[
        dict[str, str] | None,
        described(
            "Units by quantity, where the file does not state them; a minus turns the sign.",
            example='{ displacement = "nm" }',
        ),
    ] = None
    fs: Annotated[
        Positive | None,
        described("The file's sampling rate, in place of a time column.", unit="Hz", example="1e3"),
    ] = None

    @model_validator(mode="after")
    def _naming(self) -> Self:
        from bwbayes.data.io.columns import Naming  # noqa: PLC0415  # --help need not wait for scipy

        Naming(self.columns or {}, self.units or {}, self.fs)
        return self


class RecordConfig(_Source):
    """A training record: its source, the readings to use, and the windows to fit.

    ``start``, ``exclude`` and ``decimate`` leave out readings, never the voltage: the simulation
    runs from the file's first sample.
    """

    from_rest: Annotated[
        bool,
        described("Whether the record starts at rest, demagnetised.", example="true"),
    ] = False
    continues: Annotated[
        Name | None,
        described(
            "Of several records, the one that this one goes on from at once: state, offset and "
            "discrepancy carry over, and the two are fitted as one record of that name.",
            example='"first"',
        ),
    ] = None
    start: Annotated[
        float | None,
        described(
            "Readings before are left out; the voltage is not, because the hysteresis remembers "
            "it.",
            unit="s",
            example="2.0",
        ),
    ] = None
    stop: Annotated[
        float | None, described("The record is cut here.", unit="s", example="14.0")
    ] = None
    exclude: Annotated[
        Windows | None,
        described("Stretches whose readings are left out.", unit="s", example="[[3.1, 3.2]]"),
    ] = None
    outliers: Annotated[
        list[float] | None,
        described(
            "Times of single readings that are left out; a run with model.outliers writes them.",
            unit="s",
            example="[3.105, 7.42]",
        ),
    ] = None
    remarks: Annotated[
        Texts | None,
        described(
            "What was noted when the record's files were read; a run writes it and shows it again.",
            example='["my_record.csv:1: ignored columns: temperature_C"]',
        ),
    ] = None
    decimate: Annotated[
        int, Field(ge=1), described("Of so many readings one is used.", example="5")
    ] = 1
    train: Annotated[
        Windows | None,
        described(
            "Windows to fit, [start, stop]; by default the whole record.",
            unit="s",
            example="[[0.0, 12.0]]",
        ),
    ] = None

    @field_validator("train", "exclude", mode="before")
    @classmethod
    def _several(cls, given: object) -> object:
        return _one_window(given)

    @model_validator(mode="after")
    def _one_source(self) -> RecordConfig:
        if (self.file is None) == (self.signal is None):
            raise ValueError("give either file or signal")
        return self


class ParameterConfig(ConfigTable):
    """A parameter's prior or fixed value, bounds, and names for people."""

    prior: Annotated[
        dict[str, float | str] | None,
        described(
            "Its prior: a distribution and its arguments.",
            example='{ distribution = "normal", mean = 0.7, sd = 0.07 }',
        ),
    ] = None
    fixed: Annotated[
        float | None,
        described("Its value, if it is not fitted.", unit="the parameter's", example="0.7"),
    ] = None
    lower: Annotated[
        float | None, described("Lower bound.", unit="the parameter's", example="0.5")
    ] = None
    upper: Annotated[
        float | None, described("Upper bound.", unit="the parameter's", example="0.9")
    ] = None
    unit: Annotated[
        str | None,
        described("Its unit, to be checked; no other can be chosen.", example='"um/V"'),
    ] = None
    label: Annotated[
        str | None, described("Its symbol in figures, in LaTeX.", example='"d_{33}"')
    ] = None
    description: Annotated[
        str | None, described("What it is, for the report.", example='"gain of the bender"')
    ] = None

    @model_validator(mode="after")
    def _prior_or_value(self) -> ParameterConfig:
        if self.prior is not None and self.fixed is not None:
            raise ValueError("give prior or fixed, not both")
        if self.prior is not None and not isinstance(self.prior.get("distribution"), str):
            raise ValueError('prior needs a name: distribution = "normal", for instance')
        return self


class SamplingConfig(ConfigTable):
    """When to stop and how to sample; see :class:`bwbayes.sampling.plan.SamplingPlan`."""

    engine: Annotated[
        EngineChoice,
        described("What evaluates the likelihood; auto: numba if installed.", example='"numpy"'),
    ] = "auto"
    ess: Annotated[
        Positive,
        described("Effective draws of every parameter at which to stop.", example="4000"),
    ] = 2000.0
    ensembles: Annotated[
        int, Field(ge=4), described("Independent ensembles of walkers.", example="8")
    ] = 4
    walkers: Annotated[
        Annotated[int, Field(ge=4, multiple_of=2)] | None,
        described(
            "Walkers of each ensemble; by default 64 (numba) or 32 (NumPy), or more for many "
            "parameters.",
            example="40",
        ),
    ] = None
    block: Annotated[
        int, Field(ge=10), described("Steps between two looks at convergence.", example="25")
    ] = 50
    steps: Annotated[
        int, Field(ge=1), described("Largest number of steps that count.", example="40_000")
    ] = 20_000
    pilot_steps: Annotated[
        int,
        Field(ge=1),
        described("Largest number of steps until the ensembles have met.", example="6_000"),
    ] = 3_000


class ValidationConfig(_Source):
    """Held-out data: a window of the training record, or another record."""

    window: Annotated[
        Windows | None,
        described(
            "Windows [start, stop] of the training record that are held out, judged together; or "
            "the part of another record to judge.",
            unit="s",
            example="[[6.0, 8.0], [14.0, 16.0]]",
        ),
    ] = None
    of: Annotated[
        str | None,
        described(
            "Of several training records, the one that the window is of, or whose own parameters "
            "another record takes where nothing tells its own; by default the first.",
            example='"record"',
        ),
    ] = None
    from_rest: Annotated[
        bool,
        described("Whether another record starts at rest, demagnetised.", example="true"),
    ] = False
    own_offset: Annotated[
        bool,
        described(
            "Whether the sensor may have been set to zero again before another record.",
            example="false",
        ),
    ] = True
    lead_in: Annotated[
        Positive | None,
        described(
            "How long the beginning of another record, the lead-in, estimates its initial state "
            "and offset; by default a quarter of the record, and ten correlation times of the "
            "discrepancy at most.",
            unit="s",
            example="2.0",
        ),
    ] = None
    lead_in_from: Annotated[
        float | None,
        described("Where the lead-in begins; by default with the record.", unit="s", example="0.5"),
    ] = None

    @field_validator("window", mode="before")
    @classmethod
    def _several(cls, given: object) -> object:
        return _one_window(given)

    @model_validator(mode="after")
    def _one_source(self) -> ValidationConfig:
        both = self.file is not None and self.signal is not None
        if both or not (self.another or self.window is not None):
            raise ValueError("give one of window, file and signal")
        if not self.another and self.lead_in_from is not None:
            raise ValueError("lead_in_from is for another record; give file or signal with it")
        if self.another and self.window is not None and len(self.window) > 1:
            raise ValueError("of another record one window is judged; give one")
        return self

    @property
    def another(self) -> bool:
        """Whether this is another record, and no window of the training record."""
        return self.file is not None or self.signal is not None
