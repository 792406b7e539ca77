"""What a config says of models: the parts of the one that is fitted, and of that on the stand."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from bwbayes.app.config.keys import ConfigTable, Positive, Texts, described

__all__ = ["ActuatorConfig", "ModelConfig", "StandConfig", "StandModelConfig"]


class ActuatorConfig(ConfigTable):
    """The parts of an actuator, by name or by import path, and their options.

    ``passive``, ``thresholds``, ``odd`` and ``terms`` are options of some operators only.
    """

    hysteresis: Annotated[
        str,
        described("The hysteresis operator.", example='"prandtl-ishlinskii"'),
    ] = "bouc-wen"
    gain: Annotated[
        Texts,
        described(
            "Terms of the voltage without memory, about the middle of its range: the asymmetry of "
            "measured loops.",
            example='["quadratic", "cubic"]',
        ),
    ] = Field(default_factory=list)
    creep: Annotated[
        bool | list[float],
        described(
            "Slow growth after a step: true for a lag per decade of time, or the lags' times in s.",
            example="true",
        ),
    ] = False
    creep_growth: Annotated[
        bool, described("Whether the creep grows with the voltage; needs creep.", example="true")
    ] = False
    dynamics: Annotated[
        str, described("The linear dynamics behind the hysteresis.", example='"second-order"')
    ] = "lag"
    passive: Annotated[
        bool | None,
        described(
            "For bouc-wen: whether |gamma| <= beta, not only beta + gamma >= 0 (default: true).",
            example="false",
        ),
    ] = None
    thresholds: Annotated[
        int | list[float] | None,
        described(
            "For plays and maxwell-slip: how many thresholds (default: 10), or which.",
            unit="V if a list",
            example="[5.0, 20.0, 60.0]",
        ),
    ] = None
    odd: Annotated[
        bool | None,
        described("For duhem: whether there are no even terms (default: true).", example="false"),
    ] = None
    terms: Annotated[
        Texts | None,
        described(
            "For bouc-wen-asymmetric: which of b2 to b6 are parameters (default: all).",
            example='["b4", "b5"]',
        ),
    ] = None


class ModelConfig(ActuatorConfig):
    """The model: an actuator, and what is read of it."""

    hold: Annotated[
        Literal["auto", "first", "zero"],
        described(
            "What the voltage does between samples: straight lines (first), held (zero), or held "
            "if it is a command (auto).",
            example='"zero"',
        ),
    ] = "auto"
    noise: Annotated[str, described("The model of the residual.", example='"white"')] = (
        "discrepancy"
    )
    per_record: Annotated[
        Texts,
        described(
            "Parameters that each of several records has of its own, besides initial and offset.",
            example='["sensor_sd"]',
        ),
    ] = Field(default_factory=list)
    shared: Annotated[
        Texts,
        described(
            "Of initial and offset, what all of several records share.", example='["offset"]'
        ),
    ] = Field(default_factory=list)
    outliers: Annotated[
        bool,
        described(
            "Whether readings far from what their neighbours predict are set aside.",
            example="true",
        ),
    ] = False


class StandModelConfig(ActuatorConfig):
    """The actuator on the stand, by default the paper's ring bender."""

    dynamics: Annotated[
        str, described("The linear dynamics of the stand's actuator.", example='"lag"')
    ] = "second-order"


class StandConfig(ConfigTable):
    """The virtual test stand that signals are run on."""

    discrepancy: Annotated[
        Literal["none", "process", "structural"],
        described(
            "How the stand's actuator departs from the model: not at all, by a random process, or "
            "by creep, drift and an even term.",
            example='"structural"',
        ),
    ] = "process"
    sample_rate: Annotated[
        Positive, described("Samples of a record per second.", unit="Hz", example="200.0")
    ] = 1000.0
    model: Annotated[StandModelConfig, described("The actuator on the stand, in parts.")] = (
        StandModelConfig()
    )
    parameters: Annotated[
        dict[str, float],
        described(
            "True values of its parameters; by default those of the paper's ring bender, or "
            "typical ones.",
            unit="the parameter's",
            example="{ d = 0.8 }",
        ),
    ] = Field(default_factory=dict)
