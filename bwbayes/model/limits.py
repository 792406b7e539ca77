"""Limits of an amplifier: voltage range and slew rate.

An actuator is a capacitance to its amplifier, i = C du/dt, so that the current limits the speed of
the voltage as a slew rate does.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from bwbayes.arrays import FloatArray
from bwbayes.errors import InputError
from bwbayes.model.operator import Span


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
        speed = f"up to {self.rate:.4g} V/s" if math.isfinite(self.rate) else "at any speed"
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
