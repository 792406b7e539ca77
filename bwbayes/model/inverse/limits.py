"""What an amplifier can do: its voltages, and how fast it changes them.

An actuator is a capacitance to its amplifier, i = C du/dt, so that the current limits the speed of
the voltage as a slew rate does.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from bwbayes.arrays import FloatArray
from bwbayes.errors import InputError

__all__ = ["Limits"]

# A voltage or a speed may be beyond its limit by rounding.
ROUNDED = 1e-9


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
    def rate(self) -> float:
        """How fast the voltage may change, V/s."""
        if self.current is None or self.capacitance is None:
            return self.slew
        return min(self.slew, self.current / self.capacitance)

    def refuses(self, voltage: FloatArray, interval: float) -> str:
        """Say why the amplifier cannot make a voltage (samples,), V; empty if it can."""
        low, high = float(np.min(voltage)), float(np.max(voltage))
        slack = ROUNDED * (self.high - self.low)
        if low < self.low - slack or high > self.high + slack:
            return f"goes from {low:.4g} to {high:.4g} V, beyond {self.low:g} to {self.high:g} V"
        fastest = float(np.max(np.abs(np.diff(voltage)), initial=0.0)) / interval
        if fastest > self.rate * (1 + ROUNDED):
            return f"changes by {fastest:.4g} V/s, more than {self.rate:.4g} V/s"
        return ""

    def require(self, voltage: FloatArray, displacement: FloatArray, interval: float) -> None:
        """Raise an InputError where voltages (samples,) for a displacement are out of reach."""
        slack = ROUNDED * float(np.max(np.abs(voltage)))
        beyond = (voltage < self.low - slack) | (voltage > self.high + slack)
        if beyond.any():
            worst = int(np.argmax(np.where(beyond, np.abs(voltage), -1.0)))
            first = int(np.argmax(beyond))
            raise InputError(
                f"reference: {displacement[worst]:.6g} um at {worst * interval:.6g} s needs "
                f"{voltage[worst]:.6g} V, and from {first * interval:.6g} s on it is beyond the "
                f"amplifier's {self.low:g} to {self.high:g} V; make it smaller, allow other "
                "voltages, or ask for the nearest command"
            )
        speed = np.abs(np.diff(voltage)) / interval
        fast = speed > self.rate * (1 + ROUNDED) + slack / interval
        if fast.any():
            worst, first = int(np.argmax(speed)), int(np.argmax(fast))
            raise InputError(
                f"reference: at {worst * interval:.6g} s it needs {speed[worst]:.6g} V/s, and from "
                f"{first * interval:.6g} s on it is faster than the amplifier's {self.rate:.6g} "
                "V/s; slow it down, smooth it, or ask for the nearest command"
            )
