"""Bouc-Wen hysteresis of any exponent, as a step: from one voltage straight to the next."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any, ClassVar

import numpy as np

from bwbayes.arrays import BoolArray, FloatArray
from bwbayes.model.elementwise import anywhere, look_up, select
from bwbayes.model.exponent import ExponentFlow
from bwbayes.model.operator import Span
from bwbayes.model.step import OneStateStep

__all__ = ["PowerStep"]

# Where the table begins among the numbers of a power's step; rounds of Newton's rule in a cell.
TABLE, NEWTON_ROUNDS = 7, 4

# By so much of itself h may be above its ceiling.
ROUNDED = 1e-9


@dataclass(frozen=True)
class PowerStep(OneStateStep):
    """w = d u − h with Bouc-Wen hysteresis h of any exponent n ≥ 1.

    Along a step of direction s, g = s h follows dg/dv = α − c gⁿ with c = β + γ from zero on; below
    zero −g follows the same with c = γ − β, backwards. In units of the ceiling it is on a curve
    that depends on n alone (:class:`~bwbayes.model.exponent.ExponentFlow`), whose time is looked up
    in a table; a step adds to that time, and the table says which g is there. It is remembered with
    its direction, so that it is looked up where the voltage turns.

    Parameters
    ----------
    d, alpha, beta, gamma, exponent
        (models,), um/V, um/V, um^(1−n)/V, um^(1−n)/V, and without unit.
    """

    lean: ClassVar[bool] = False

    d: FloatArray
    alpha: FloatArray
    beta: FloatArray
    gamma: FloatArray
    exponent: FloatArray

    @cached_property
    def rates(self) -> tuple[FloatArray, FloatArray]:
        """C over α for g below zero and above."""
        return (self.gamma - self.beta) / self.alpha, (self.beta + self.gamma) / self.alpha

    @cached_property
    def ceiling(self) -> FloatArray:
        """Largest |h|, (α / (β + γ))^(1/n), um; infinite where there is none."""
        with np.errstate(divide="ignore", over="ignore"):
            return np.asarray((1 / self.rates[1]) ** (1 / self.exponent))

    @cached_property
    def parameters(self) -> FloatArray:
        """d, α, c/α, scales and rates below zero and above, n, and the curves' table."""
        flow = ExponentFlow(self.alpha, self.beta, self.gamma, self.exponent)
        numbers = self.d, self.alpha, *self.rates, *flow.scales, self.exponent
        return np.column_stack([*numbers, flow.table().reshape(self.d.size, -1)])

    @staticmethod
    def move(parameters: Any, memory: Any, voltage: Any, after: Any) -> tuple[Any, Any]:
        """Return d u − h and its slope d − α + c gⁿ."""
        d, alpha, n = parameters[0], parameters[1], parameters[6]
        s = select(voltage < memory[0], -1.0, 1.0)
        g = s * memory[1]
        time = memory[3]
        if anywhere(s != memory[2]):
            scale = select(g < 0.0, parameters[4], parameters[5])
            turned = clock(parameters, g < 0.0, np.abs(g) / scale) * scale / alpha
            time = select(s != memory[2], select(g < 0.0, -turned, turned), time)
        time = time + np.abs(voltage - memory[0])
        scale = select(time < 0.0, parameters[4], parameters[5])
        height = scale * height_at(parameters, time < 0.0, np.abs(time) * alpha / scale)
        h = s * select(time < 0.0, -height, height)
        after[0], after[1], after[2], after[3] = voltage, h, s, time
        x = select(time < 0.0, parameters[2], parameters[3]) * height**n
        return d * voltage - h, d - alpha * (1 - x)

    def demagnetized(self) -> FloatArray:
        """Return zero volts, h = 0, no direction and no time."""
        return np.zeros((self.d.size, 4))

    def remembered(self, memory: Any) -> FloatArray:
        """Return voltage and h; the time on a curve follows from where the voltage goes."""
        return np.pad(super().remembered(memory), ((0, 0), (0, 2)))

    def begun(self, voltage: FloatArray, initial: FloatArray, span: Span) -> FloatArray:
        """Return voltage and h."""
        return np.pad(super().begun(voltage, initial, span), ((0, 0), (0, 2)))

    def holds(self, memory: FloatArray) -> BoolArray:
        """Tell which models' h is not above the ceiling, from where it would come down."""
        return np.asarray(np.abs(memory[:, 1]) <= self.ceiling * (1 + ROUNDED))

    def _x(self, g: FloatArray) -> FloatArray:
        """Return x with the sign that 1 − x = h′/α asks for, (models,)."""
        below, above = self.rates
        return np.where(g < 0, below, above) * np.abs(g) ** self.exponent

    def slopes(self, limits: Span) -> tuple[FloatArray, FloatArray]:
        """Return d − max(α, 2 α β / (β + γ)) and d: h is steepest just after a turn."""
        top = np.minimum(self.ceiling, self.alpha * (limits.high - limits.low))
        turned = self.alpha * np.maximum(1 - self._x(-top), 1.0)
        return self.d - turned, self.d

    def coefficients(self) -> dict[str, tuple[Any, str]]:
        """Return d, α, c/α below zero and above, and n."""
        below, above = (float(rate[0]) for rate in self.rates)
        slopes = {"d": (float(self.d[0]), "um/V"), "alpha": (float(self.alpha[0]), "um/V")}
        rates = {"below": (below, "um^-n"), "above": (above, "um^-n")}
        return {**slopes, **rates, "exponent": (float(self.exponent[0]), "-")}


def clock(parameters: Any, below: Any, height: Any) -> Any:
    """Return the time at which the curve below zero, or above, is at a height."""
    cells = (len(parameters) - TABLE) / 24
    cell = find_cell(parameters, below, 1, height)
    start, width = look_up(parameters, cell + 2 * cells), look_up(parameters, cell + 3 * cells)
    low = look_up(parameters, cell + 4 * cells)
    ends = 0.0 * low
    for order in range(1, 8):
        ends = ends + look_up(parameters, cell + (4 + order) * cells)
    fraction = (height - low) / select(ends == 0.0, 1.0, ends)
    for _ in range(NEWTON_ROUNDS):
        fraction = np.minimum(np.maximum(fraction, 0.0), 1.0)
        value, slope = 0.0 * low, 0.0 * low
        for order in range(7, -1, -1):
            slope = slope * fraction + value
            value = value * fraction + look_up(parameters, cell + (4 + order) * cells)
        fraction = fraction - (value - height) / select(slope == 0.0, 1.0, slope)
    return start + width * np.minimum(np.maximum(fraction, 0.0), 1.0)


def height_at(parameters: Any, below: Any, time: Any) -> Any:
    """Return the height at which the curve below zero, or above, is at a time."""
    cells = (len(parameters) - TABLE) / 24
    cell = find_cell(parameters, below, 0, time)
    fraction = (time - look_up(parameters, cell + 2 * cells)) / look_up(
        parameters, cell + 3 * cells
    )
    fraction, value = np.minimum(np.maximum(fraction, 0.0), 1.0), 0.0 * time
    for order in range(7, -1, -1):
        value = value * fraction + look_up(parameters, cell + (4 + order) * cells)
    return value


def find_cell(parameters: Any, below: Any, row: int, value: Any) -> Any:
    """Return where the cell of a curve begins in whose range a value of the row lies."""
    cells = (len(parameters) - TABLE) / 24
    first = select(below, 1.0 * TABLE + 12 * cells, 1.0 * TABLE)
    cell, half = first, np.floor(cells / 2)
    while half > 0:
        later = cell + half
        cell = select(look_up(parameters, later + row * cells) <= value, later, cell)
        half = np.floor(half / 2)
    return cell
