"""Inputs of an actuator: the sampled voltage and further recorded columns.

A part of the model may see more than the voltage: the time, or a covariate, which is a further
column of the record (a temperature, a load). :class:`Inputs` hold all of them on one time grid.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import KW_ONLY, dataclass, field, replace
from typing import Any, Literal, Self, get_args

import numpy as np

from bwbayes.arrays import FloatArray
from bwbayes.errors import InputError
from bwbayes.model.linear import Hold
from bwbayes.quantities import DEFAULT, Quantities
from bwbayes.shown import brief

VoltageIs = Literal["command", "output"]
"""Kind of a voltage column: the command that a DAC holds, or the amplifier's output."""


def require_voltage_is(text: str) -> VoltageIs:
    """Return `text` if it says what a voltage column is, else raise an `InputError`."""
    for kind in get_args(VoltageIs):
        if text == kind:
            return kind  # type: ignore[no-any-return]
    raise InputError(f"voltage_is: {text!r} is unknown; write 'command' or 'output'")


@dataclass(frozen=True, eq=False)
class Inputs:
    """Inputs of an actuator on the uniform time grid ``start + interval * arange(samples)``.

    Parameters
    ----------
    voltage
        (samples,), V.
    interval
        Sampling interval, s.
    start
        Time of the first sample, s.
    voltage_is
        Kind of voltage: ``"command"``, which is held until the next sample, or ``"output"``,
        which goes straight to it.
    covariates
        Further columns (samples,) by name.
    quantities
        Quantities of voltage and displacement, and whether there is a clock; all numbers are in
        their units.
    """

    __repr__ = brief

    voltage: FloatArray
    _: KW_ONLY
    interval: float
    start: float = 0.0
    voltage_is: VoltageIs = "output"
    covariates: Mapping[str, FloatArray] = field(default_factory=dict)
    quantities: Quantities = field(default=DEFAULT, repr=False)
    _around: tuple[FloatArray, int] | None = field(default=None, init=False, repr=False)

    @property
    def around(self) -> tuple[FloatArray, int]:
        """The voltage, V, of which this one is a part, and the first sample of that part.

        A slice knows what goes before it and behind it; other inputs are all that there is.
        """
        return self._around or (self.voltage, 0)

    @property
    def samples(self) -> int:
        """Number of samples."""
        return self.voltage.size

    @property
    def time(self) -> FloatArray:
        """Times of the samples, (samples,), s."""
        return self.start + self.interval * np.arange(self.samples, dtype=np.float64)

    @property
    def duration(self) -> float:
        """Length in s: samples times interval, the last one's included."""
        return self.samples * self.interval

    @property
    def hold(self) -> Hold:
        """The hold of the voltage between samples."""
        return "zero" if self.voltage_is == "command" else "first"

    def range_of(self, name: str, windows: Sequence[slice]) -> tuple[float, float]:
        """Return the least and the largest value of a column within windows."""
        values = np.concatenate([self.column(name)[window] for window in windows])
        return float(np.min(values)), float(np.max(values))

    def __getitem__(self, samples: slice) -> Self:
        """Return some of the samples, on the same clock."""
        first, _, step = samples.indices(self.samples)
        selected = replace(
            self,
            **self.each_series(lambda values: values[samples]),
            interval=self.interval * step,
            start=self.start + self.interval * first,
        )
        if step == 1:
            full_voltage, begin = self.around
            object.__setattr__(selected, "_around", (full_voltage, begin + first))
        return selected

    def followed_by(self, other: Inputs) -> Self:
        """Return these samples and then those of others, which are as far apart.

        Raises
        ------
        InputError
            The others lack a covariate.
        """
        return replace(self, **self.each_series(lambda *parts: np.concatenate(parts), other))

    def each_series(self, change: Callable[..., FloatArray], *others: Inputs) -> dict[str, Any]:
        """Return what a change makes of every series, and of the same one of others, by field."""
        covariates = {
            name: change(values, *(other.column(name) for other in others))
            for name, values in self.covariates.items()
        }
        voltage = change(self.voltage, *(other.voltage for other in others))
        return {"voltage": voltage, "covariates": covariates}

    def has(self, name: str) -> bool:
        """Tell whether there is a column of that name; whatever has none sees nothing."""
        return name in ("", "time", "voltage", *self.covariates)

    def column(self, name: str) -> FloatArray:
        """Return what a part of the model sees, (samples,): time, voltage or a covariate.

        Raises
        ------
        InputError
            There is no such covariate.
        """
        if name == "time":
            return self.time
        if name == "voltage":
            return self.voltage
        if name in self.covariates:
            return self.covariates[name]
        raise InputError(
            f"{name}: the model needs it at every sample, and this voltage comes without; give a "
            "record that has it, and name its column in covariates"
        )
