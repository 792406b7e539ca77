"""Inputs of an actuator: the sampled voltage and further recorded columns.

A part of the model may see more than the voltage: the time, or a covariate, which is a further
column of the record (a temperature, a load). :class:`Inputs` hold all of them on one time grid.

A drive's own turns, times and speeds do not depend on the sampling rate. The voltage alone decides:
a record and its every k-th sample have the same turning points. Noise on a measured voltage makes
none, because a turn counts only where the voltage comes back by a part of its range.

The :class:`Limits` of an amplifier are its voltages and its slew rate: an actuator is a capacitance
to it, i = C du/dt, so that the current limits the speed of the voltage too.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import KW_ONLY, dataclass, field, replace
from typing import Any, Literal, NamedTuple, Self, get_args

import numpy as np
import scipy

from bwbayes.arrays import FloatArray, IntArray
from bwbayes.errors import InputError
from bwbayes.quantities import DEFAULT, Quantities
from bwbayes.shown import brief, rounded

Hold = Literal["first", "zero"]

# Names of a command's hold outside of the package.
HOLD_NAMES: Mapping[Hold, str] = {"zero": "zoh", "first": "foh"}


def parse_hold(name: str) -> Hold:
    """Return the hold called "zoh" (zero-order) or "foh" (first-order).

    Raises
    ------
    InputError
        Another name.
    """
    for hold, short in HOLD_NAMES.items():
        if name in (hold, short):
            return hold
    raise InputError(
        f"hold: {name!r} is unknown; give zoh (held until the next sample, as a DAC does) or foh "
        "(straight lines between samples)"
    )


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
        """Tell whether there is a column of that name."""
        return name in ("time", "voltage", *self.covariates)

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
            "record that has it, as a constant column if it stays the same, and name its column in "
            "covariates"
        )


class Span(NamedTuple):
    """The least and the largest voltage that earlier drives may have had, V."""

    low: float
    high: float

    @property
    def middle(self) -> float:
        """Its middle, V."""
        return (self.low + self.high) / 2

    @property
    def half(self) -> float:
        """Half of its width, V."""
        return (self.high - self.low) / 2


UNIT = Span(-1.0, 1.0)


# Part of the range by which the voltage must come back for a turn to count. A sensor's noise and a
# DAC's steps are well below it; the smallest loops of a decaying drive do not matter for a scale.
RETURN = 0.05

# Elements (models x samples) that one array expression handles: small enough for the cache.
PIECE = 65_536


class Stretch(NamedTuple):
    """Samples ``first`` to ``last`` (both included), along which the voltage goes one way."""

    first: int
    last: int
    direction: float


def monotone_stretches(voltage: FloatArray, longest: int | None = None) -> Iterator[Stretch]:
    """Cut a voltage (samples,) where it turns; each stretch starts at the last one's end.

    A plateau belongs to the stretch that leads to it. ``longest`` also cuts stretches of more
    samples than that, which changes nothing: the state at the cut carries over.
    """
    steps = np.sign(np.diff(voltage))
    moving = np.flatnonzero(steps)
    direction = float(steps[moving[0]]) if moving.size else 1.0
    # The voltage turns at these samples: the step from there on goes the other way.
    turns = moving[1:][np.diff(steps[moving]) != 0]
    ends = [*turns.tolist(), voltage.size - 1]
    for start, end in zip([0, *ends[:-1]], ends, strict=True):
        size = longest or max(end - start, 1)
        for first in range(start, end, size):
            yield Stretch(first, min(first + size, end), direction)
        direction = -direction


def turning_points(voltage: FloatArray, threshold: float | None = None) -> IntArray:
    """Return the samples (turns,) at which a voltage (samples,) turns by ``threshold`` V or more.

    By default a twentieth of the voltage's range.
    """
    threshold = RETURN * float(np.ptp(voltage)) if threshold is None else threshold
    if not threshold > 0:
        return np.array([], dtype=np.int64)
    # Only where the voltage turns at all can it turn by that much.
    ends = [stretch.last for stretch in monotone_stretches(voltage)]
    turns: list[int] = []
    direction, furthest = 1.0, 0
    for end, reached in zip(ends, voltage[ends].tolist(), strict=True):
        back = direction * (voltage[furthest] - reached)
        if back <= 0:
            furthest = end
        elif back >= threshold:
            turns.append(furthest)
            direction, furthest = -direction, end
    # A voltage that goes down first has turned nowhere yet.
    return np.array([turn for turn in turns if turn > 0], dtype=np.int64)


def time_between_turns(
    voltage: FloatArray, interval: float, windows: Sequence[slice] = (slice(None),)
) -> float:
    """Return the typical time between turning points, s: of a sine, half its period.

    For half of the time, the voltage is on a stretch that takes this long or longer; so a long rest
    before the drive does not count for more than it lasts. The borders of ``windows`` of a record
    cut stretches too. At rest, or without a turn, it is the length of the (longest) window.
    """
    threshold = RETURN * float(np.ptp(np.concatenate([voltage[window] for window in windows])))
    stretches = []
    for window in windows:
        segment = voltage[window]
        edges = np.concatenate([[0], turning_points(segment, threshold), [segment.size - 1]])
        stretches.append(np.diff(edges) * interval)
    times = np.sort(np.concatenate(stretches))
    times = times[times > 0]
    if times.size == 0:
        return interval
    passed = np.cumsum(times)
    return float(times[np.searchsorted(passed, passed[-1] / 2)])


def rate(voltage: FloatArray, interval: float) -> FloatArray:
    """Return how fast the voltage changes at each sample, (samples,), V/s.

    A measured voltage is noisy, and its change noisier: it is smoothed over a five-hundredth of
    the record.
    """
    slow = scipy.ndimage.uniform_filter1d(voltage, max(1, voltage.size // 500), mode="nearest")
    change: FloatArray = np.gradient(slow, interval) if slow.size > 1 else np.zeros_like(slow)
    return change


def fastest(
    voltage: FloatArray, interval: float, over: float, windows: Sequence[slice] = (slice(None),)
) -> float:
    """Return the largest speed, V/s, at which the voltage moves for ``over`` s (a sample, if less).

    A mean over that time, so that a measured voltage's noise counts for little.
    """
    lag = max(round(over / interval), 1)
    moved = [np.abs(v[lag:] - v[:-lag]) for v in (voltage[w] for w in windows) if v.size > lag]
    return max([float(np.max(movement)) for movement in moved], default=0.0) / (lag * interval)


@dataclass(frozen=True)
class Limits:
    """The limits of an amplifier.

    Parameters
    ----------
    low, high
        Lowest and highest voltage, V.
    slew
        Fastest change of the voltage, V/s.
    current
        Largest current, A, into the actuator's ``capacitance``, F; the two go together.

    Raises
    ------
    InputError
        No voltage in between, a limit that is not positive, or a current without a capacitance.
    """

    low: float = -math.inf
    high: float = math.inf
    slew: float = math.inf
    current: float | None = None
    capacitance: float | None = None

    def __post_init__(self) -> None:
        if not self.low < self.high:
            raise InputError(
                f"limits: no voltage from {self.low:g} to {self.high:g} V; give low before high"
            )
        if (self.current is None) != (self.capacitance is None):
            raise InputError("limits: give current (A) and capacitance (F) together, or neither")
        for name in ("slew", "current", "capacitance"):
            value = getattr(self, name)
            if value is not None and not value > 0:
                raise InputError(f"limits: {name} {value:g}; must be positive")

    @property
    def span(self) -> Span:
        """Lowest and highest voltage, V."""
        return Span(self.low, self.high)

    @property
    def numbers(self) -> dict[str, Any]:
        """The limits as files have them; None where there is none."""
        return {
            "limits_V": [self.low, self.high],
            "slew_V_per_s": self.slew if math.isfinite(self.slew) else None,
            "current_A": self.current,
            "capacitance_F": self.capacitance,
        }

    def __str__(self) -> str:
        speed = f"up to {rounded(self.rate, 4)} V/s" if math.isfinite(self.rate) else "at any speed"
        current = ""
        if self.current is not None:
            current = f", {self.current:.4g} A into {self.capacitance:.4g} F"
        return f"{self.low:.4g} to {self.high:.4g} V, {speed}{current}"

    @property
    def rate(self) -> float:
        """How fast the voltage may change, V/s."""
        if self.current is None or self.capacitance is None:
            return self.slew
        return min(self.slew, self.current / self.capacitance)

    def refuses(self, voltage: FloatArray, interval: float) -> str:
        """Say why the amplifier cannot make a voltage (samples,), V; empty if it can."""
        slack = 1e-9 * float(np.max(np.abs(voltage)))  # a part of rounding
        beyond = (voltage < self.low - slack) | (voltage > self.high + slack)
        if beyond.any():
            worst = voltage[np.argmax(np.where(beyond, np.abs(voltage), -1.0))]
            return (
                f"needs {worst:.6g} V, and from {np.argmax(beyond) * interval:.6g} s on it is "
                f"beyond the amplifier's {self.low:g} to {self.high:g} V"
            )
        speed = np.abs(np.diff(voltage)) / interval
        fast = speed > self.rate * (1 + 1e-9) + slack / interval
        if fast.any():
            return (
                f"needs {np.max(speed):.6g} V/s, and from {np.argmax(fast) * interval:.6g} s on it "
                f"is faster than the amplifier's {self.rate:.6g} V/s"
            )
        return ""
