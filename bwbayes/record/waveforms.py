"""The voltages that drive an actuator: the paper's signals, and parts to build others from.

A :class:`Waveform` is a carrier (:func:`sine`, :func:`triangle`, :func:`staircase`, or any function
of the time) whose amplitude may decay, switched on at a start time and sampled at a rate; a step is
a staircase of one level. The paper's own signals are made of these, and
:func:`signal` finds them by name. A value that is not finite, or not what its description says, is
an :class:`InputError`.
"""

from __future__ import annotations

import difflib
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import Literal

import numpy as np

from bwbayes.arrays import ArrayLike, FloatArray
from bwbayes.errors import InputError


def _require(where: str, value: float, kind: Literal["finite", "positive", "not negative"]) -> None:
    """Refuse a number that is not finite, or has the wrong sign."""
    if not math.isfinite(value):
        raise InputError(f"{where}: {value} is not finite; give a finite number")
    if (kind == "positive" and value <= 0) or (kind == "not negative" and value < 0):
        raise InputError(f"{where}: {value} is not {kind}; give a {kind} number")


def _require_wave(where: str, amplitude: float, frequency: float, phase: float) -> None:
    _require(f"{where}: amplitude", amplitude, "finite")
    _require(f"{where}: frequency", frequency, "positive")
    _require(f"{where}: phase", phase, "finite")


@dataclass(frozen=True)
class Carrier:
    """A voltage as a function of the time since its start.

    ``voltage`` (samples,), V, at times (samples,), s; sampling has to resolve the
    ``highest_frequency``, Hz.
    """

    voltage: Callable[[FloatArray], FloatArray]
    highest_frequency: float


def sine(amplitude: float, frequency: float, phase: float = 0.0) -> Carrier:
    """Return ``v = amplitude sin(2 pi frequency t + phase)``: equation (1) of the paper.

    The amplitude is in V, the frequency in Hz, above zero, the phase in rad; with pi the voltage
    goes down first.
    """
    _require_wave("sine", amplitude, frequency, phase)
    return Carrier(lambda t: amplitude * np.sin(2 * np.pi * frequency * t + phase), frequency)


def triangle(amplitude: float, frequency: float, phase: float = 0.0) -> Carrier:
    """Return a triangle with the zeros and peaks of the :func:`sine` of the same parameters.

    Its slope is ``+-4 amplitude frequency`` (V/s); the harmonics of its corners alias.
    """
    _require_wave("triangle", amplitude, frequency, phase)

    def voltage(t: FloatArray) -> FloatArray:
        cycles = frequency * t + phase / (2 * np.pi)
        return amplitude * (4 * np.abs((cycles + 0.75) % 1.0 - 0.5) - 1)

    return Carrier(voltage, frequency)


def staircase(levels: Sequence[float], dwell: float, rate: float = math.inf) -> Carrier:
    """Return levels, V, that are held one after the other; the last one stays.

    The time from one level to the next is the dwell, s, above zero; ``rate`` is how fast the
    voltage goes to the next level, V/s, by default at once.
    """
    if not levels:
        raise InputError("staircase: levels: there is none; give at least one voltage")
    for level in levels:
        _require("staircase: levels", level, "finite")
    _require("staircase: dwell", dwell, "positive")
    volts = np.asarray(levels, dtype=np.float64)

    def voltage(t: FloatArray) -> FloatArray:
        # A sample at the very end of a level belongs to the next one, whatever the rounding.
        index = np.minimum(np.floor(t / dwell + 1e-9), volts.size - 1).astype(np.int64)
        if math.isinf(rate):
            return volts[index]
        before, moved = volts[np.maximum(index - 1, 0)], rate * (t - dwell * index)
        return before + np.clip(volts[index] - before, -moved, moved)

    return Carrier(voltage, 0.5 / dwell if volts.size > 1 else 0.0)


@dataclass(frozen=True)
class Waveform:
    """A voltage that rests at its bias until a start time and then follows its carrier.

    ``V(t) = bias`` before the start and ``V(t) = bias + carrier(t - start) q(t)`` from then on:
    equations (1) and (3) of the paper, whose bias is zero. The amplitude decays to zero,
    ``q = max(0, 1 - decay max(0, t - decay_from))``: equations (3) and (4).

    Parameters
    ----------
    carrier : Carrier
        Voltage as a function of the time since the start.
    duration : float
        Length of the signal, s, above zero.
    start : float
        Time at which the carrier starts, s, not below zero and within the duration.
    decay : float
        Decay rate, 1/s, not below zero.
    decay_from : float
        Time from which the amplitude decays, counted from the first sample, s.
    bias : float
        V; it does not decay.
    """

    carrier: Carrier
    duration: float
    start: float = 0.0
    decay: float = 0.0
    decay_from: float = 0.0
    bias: float = 0.0

    def __post_init__(self) -> None:
        _require("waveform: duration", self.duration, "positive")
        _require("waveform: start", self.start, "not negative")
        _require("waveform: decay", self.decay, "not negative")
        _require("waveform: decay_from", self.decay_from, "finite")
        _require("waveform: bias", self.bias, "finite")
        if self.start >= self.duration:
            raise InputError(
                f"waveform: start: {self.start:g} s is not before the end at "
                f"{self.duration:g} s; start earlier or make the signal longer"
            )

    def __call__(self, time: ArrayLike) -> FloatArray:
        """Voltage (samples,) in V at the times (samples,) in s since the first sample."""
        times = np.asarray(time, dtype=np.float64)
        left = np.maximum(1.0 - self.decay * np.maximum(times - self.decay_from, 0.0), 0.0)
        driven = self.carrier.voltage(np.maximum(times - self.start, 0.0)) * left
        return self.bias + np.where(times >= self.start, driven, 0.0)

    def sample(self, rate: float) -> tuple[FloatArray, FloatArray]:
        """Sample the waveform at ``t_k = k / rate`` over its duration, the end left out.

        The rate, Hz, is more than twice the carrier's highest frequency. Returns times, s, and
        voltages, V, (samples,) each.

        Raises :class:`InputError` if the rate is not above zero or too low for the carrier, or the
        duration holds fewer than two samples or more than ten million.
        """
        _require("sampling: rate", rate, "positive")
        lowest = 2 * self.carrier.highest_frequency
        if rate <= lowest:
            raise InputError(
                f"sampling: rate: {rate:g} Hz cannot resolve {lowest / 2:g} Hz; "
                f"sample faster than {lowest:g} Hz"
            )
        limit = 10**7
        samples = round(min(self.duration * rate, limit + 1))
        if not 2 <= samples <= limit:
            bound = "fewer than two" if samples < 2 else f"more than {limit:,}"
            where = f"sampling: {self.duration:g} s at {rate:g} Hz is {bound} samples"
            raise InputError(f"{where}; give another rate or duration")
        time = np.arange(samples) / rate
        return time, self(time)


# The paper's signals. Two misprints are read as the text means them: equation (2) lost its sine, so
# it is 100 sin(2 pi t), whose phase at 0.5 s is pi, and the voltage goes down first; the factor 1
# - 0.1 (t - 4) of equations (3) and (4) turns negative after 14 s, where the text lets the
# amplitude be zero. ASSUMPTIONS, where the paper says nothing: the verification signal decays
# linearly, as in equation (3), at 0.05 per second, is 50 s long, and counts its phase from the
# first sample, as equation (2) does; a step is 11 s long, ten of them after the step.
SIGNALS: Mapping[str, Waveform] = MappingProxyType(
    {
        "identification": Waveform(
            sine(100.0, 1.0, phase=math.pi), 16.0, start=0.5, decay=0.1, decay_from=4.0
        ),
        "verification": Waveform(
            sine(100.0, 0.1, phase=math.pi), 50.0, start=5.0, decay=0.05, decay_from=25.0
        ),
        **{
            f"step{height}": Waveform(staircase((float(height),), dwell=10.0), 11.0, start=1.0)
            for height in (10, 50, 100)
        },
    }
)


def signal_names() -> tuple[str, ...]:
    """Return the names of all signals of :func:`signal`."""
    return tuple(SIGNALS)


def signal(name: str) -> Waveform:
    """Return one of the paper's signals by its name; :func:`signal_names` lists all names.

    ``identification``: rest for 0.5 s, then a sine of 100 V and 1 Hz whose amplitude decays from
    4 s on at 0.1 per second, 16 s long, equations (1)-(4). ``verification``: rest for 5 s, then a
    sine of 100 V and 0.1 Hz that decays from 25 s on, section 4.2. ``step10``, ``step50`` and
    ``step100``: a step from zero to so many volts at 1 s, Fig. 5.

    Raises :class:`InputError` for any other; the text lists the names and the nearest one.

    >>> signal("step50").duration  # s
    11.0
    """
    if name in SIGNALS:
        return SIGNALS[name]
    nearest = difflib.get_close_matches(name, SIGNALS, n=1, cutoff=0.0)[0]
    raise InputError(
        f"signal: no {name!r}; did you mean {nearest!r}? (known: {', '.join(SIGNALS)})"
    )
