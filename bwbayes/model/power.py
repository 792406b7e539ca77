"""Bouc-Wen hysteresis of any exponent, exact, as a step: from one voltage straight to the next.

Along a stretch of direction s, with v = |u − u₀|, g = s h obeys dg/dv = α − (β + γ) gⁿ from zero
on, and below it −g does the same with γ − β, backwards. In units of its ceiling g is then on one of
two curves that depend on n alone,

    dz/dτ = 1 − zⁿ  or, where γ < β below zero,  dz/dτ = 1 + zⁿ,

both through z = 0 at τ = 0. They are tabulated once, by quadrature; a step adds to the time on its
curve. No time stepping, and an error below 1e-9 of the largest |h|.
"""

from __future__ import annotations

from typing import Any, ClassVar, Self

import numpy as np

from bwbayes.arrays import FloatArray
from bwbayes.model.elementwise import anywhere, look_up, select
from bwbayes.model.operator import Span
from bwbayes.model.step import OneStateStep

# Where the tables of the two curves begin among the numbers of a step, and the rows of a table: the
# time at which each cell begins, how long it lasts, and the coefficients of its polynomial.
TABLE, ROWS = 7, 10

# Curves are followed to log zⁿ, or where they saturate log zⁿ/(1 − zⁿ), of so much: the rest is
# lost against one.
REACH = 36.0


class PowerStep(OneStateStep):
    """w = d u − h with Bouc-Wen hysteresis h of any exponent n ≥ 1.

    Besides voltage and h it remembers the direction and the time on the curve, V, negative where g
    is; the time is looked up where the voltage turns.
    """

    ROW: ClassVar = "d, α, c/α, scales and rates below zero and above, n, and the curves' tables"
    remembers: ClassVar = 4

    @classmethod
    def of(
        cls,
        d: FloatArray,
        alpha: FloatArray,
        beta: FloatArray,
        gamma: FloatArray,
        exponent: FloatArray,
    ) -> Self:
        """Return the step of d, α, β, γ and n, (models,), as of Bouc-Wen hysteresis."""
        rates = (gamma - beta) / alpha, (beta + gamma) / alpha
        # Units of z below zero and above, |c/α|^(−1/n), um; kept finite.
        with np.errstate(divide="ignore"):
            logs = [-np.log(np.abs(rate)) / exponent for rate in rates]
        below, above = (np.exp(np.minimum(values, np.log(1e100))) for values in logs)
        exponents, row = np.unique(exponent, return_inverse=True)
        soft = gamma < beta
        # How far above one z may be on the soft curve.
        farthest = np.log(above / below)[soft] * exponent[soft]
        rising = tabulate(exponents, saturating=True)
        falling = tabulate(exponents, saturating=False, top=max(farthest, default=0.0))
        cells = 1 << (max(rising.shape[2], falling.shape[2]) - 1).bit_length()
        tables = np.full((2, d.size, ROWS, cells), np.inf)
        tables[:, :, :, : rising.shape[2]] = rising[row]
        tables[1, soft] = np.inf
        tables[1, soft, :, : falling.shape[2]] = falling[row[soft]]
        numbers = d, alpha, *rates, below, above, exponent
        return cls(np.column_stack([*numbers, tables.swapaxes(0, 1).reshape(d.size, -1)]))

    @staticmethod
    def move(parameters: Any, memory: Any, voltage: Any, after: Any) -> tuple[Any, Any]:
        """Return d u − h and its slope d − α + c gⁿ."""
        d, alpha, n = parameters[0], parameters[1], parameters[6]
        s, still = select(voltage < memory[0], -1.0, 1.0), voltage == memory[0]
        time = memory[3]
        if anywhere(s != memory[2]):
            time = select(s != memory[2], clock(parameters, s * memory[1]), time)
        time = time + np.abs(voltage - memory[0])
        scale = select(time < 0.0, parameters[4], parameters[5])
        height = scale * height_at(parameters, time < 0.0, np.abs(time) * alpha / scale)
        h = select(still, memory[1], s * select(time < 0.0, -height, height))
        after[0], after[1] = voltage, h
        after[2], after[3] = select(still, memory[2], s), select(still, memory[3], time)
        x = select(time < 0.0, parameters[2], parameters[3]) * height**n
        return d * voltage - h, d - alpha * (1 - x)

    def along(
        self, start: float, state: FloatArray, voltage: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Return w and h along voltages that go one way, as of :class:`OneStateStep`."""
        s = -1.0 if voltage[-1] < start else 1.0
        time = clock(self.parameters.T, s * state)
        memory = np.stack(np.broadcast_arrays(start, state, s, time))
        return self.gone_along(memory, voltage)

    def slopes(self, limits: Span) -> tuple[FloatArray, FloatArray]:
        """Return d − max(α, 2 α β / (β + γ)) and d: h is steepest just after a turn."""
        d, alpha, below, _, _, scale, n = self.parameters.T[:TABLE]
        top = np.minimum(scale, alpha * (limits.high - limits.low))
        return d - alpha * np.maximum(1 - below * top**n, 1.0), d

    def coefficients(self) -> dict[str, tuple[Any, str]]:
        """Return d, α, c/α below zero and above, and n."""
        d, alpha, below, above, _, _, n = self.parameters[0, :TABLE].tolist()
        slopes = {"d": (d, "um/V"), "alpha": (alpha, "um/V")}
        rates = {"below": (below, "um^-n"), "above": (above, "um^-n")}
        return {**slopes, **rates, "exponent": (n, "-")}


def clock(parameters: Any, g: Any) -> Any:
    """Return the time, V, at which the curves are at g, um."""
    scale = select(g < 0.0, parameters[4], parameters[5])
    time = time_at(parameters, g < 0.0, np.abs(g) / scale) * scale / parameters[1]
    return select(g < 0.0, -time, time)


def time_at(parameters: Any, below: Any, height: Any) -> Any:
    """Return the time at which the curve below zero, or above, is at a height."""
    cells = (len(parameters) - TABLE) / 20
    cell = find_cell(parameters, below, 2, height)
    rise = 0.0 * height
    for order in range(1, 8):
        rise = rise + look_up(parameters, cell + (2 + order) * cells)
    low = look_up(parameters, cell + 2 * cells)
    fraction = (height - low) / select(rise == 0.0, 1.0, rise)
    for _ in range(4):  # of Newton's rule
        fraction = np.minimum(np.maximum(fraction, 0.0), 1.0)
        value, slope = 0.0 * low, 0.0 * low
        for order in range(7, -1, -1):
            slope = slope * fraction + value
            value = value * fraction + look_up(parameters, cell + (2 + order) * cells)
        fraction = fraction - (value - height) / select(slope == 0.0, 1.0, slope)
    fraction = np.minimum(np.maximum(fraction, 0.0), 1.0)
    return look_up(parameters, cell + 0 * cells) + look_up(parameters, cell + cells) * fraction


def height_at(parameters: Any, below: Any, time: Any) -> Any:
    """Return the height at which the curve below zero, or above, is at a time."""
    cells = (len(parameters) - TABLE) / 20
    cell = find_cell(parameters, below, 0, time)
    fraction = (time - look_up(parameters, cell + 0 * cells)) / look_up(parameters, cell + cells)
    fraction, value = np.minimum(np.maximum(fraction, 0.0), 1.0), 0.0 * time
    for order in range(7, -1, -1):
        value = value * fraction + look_up(parameters, cell + (2 + order) * cells)
    return value


def find_cell(parameters: Any, below: Any, row: int, value: Any) -> Any:
    """Return where the cell of a curve begins in whose range a value of the row lies."""
    cells = (len(parameters) - TABLE) / 20
    cell, half = select(below, TABLE + 10.0 * cells, 1.0 * TABLE), np.floor(cells / 2)
    while half > 0:
        later = cell + half
        cell = select(look_up(parameters, later + row * cells) <= value, later, cell)
        half = np.floor(half / 2)
    return cell


def tabulate(exponent: FloatArray, *, saturating: bool, top: float = 0.0) -> FloatArray:
    """Return the cells (curves, ROWS, cells) of dz/dτ = 1 ∓ zⁿ, by rising time.

    The time to a node is the integral of dz / (1 ∓ zⁿ). In x = log zⁿ, or in x = log zⁿ/(1 − zⁿ)
    where the curve saturates, it is smooth, and quadrature on each cell is exact to rounding. One
    that grows on is followed to x = ``top``.
    """
    # Cells are wider outwards, as what they resolve fades like exp(−|x|).
    half = [0.0]
    while half[-1] < REACH:
        half.append(half[-1] + min(0.2 * np.exp(half[-1] / 8), 3.0))
    beyond = half[1:] if saturating else np.arange(0.0, min(max(top, 0.0), REACH) + 0.3, 0.15)[1:]
    x, n, sign = np.array([*-np.array(half[::-1]), *beyond]), exponent[:, None], 1 - 2 * saturating

    def log_power(x: FloatArray) -> FloatArray:
        return -np.logaddexp(0.0, -x) if saturating else x

    # In x, dτ is z/n dx where the curve saturates, and z / (1 + zⁿ) dx/n else.
    nodes, weights = np.polynomial.legendre.leggauss(8)
    inside = x[:-1, None] + np.diff(x)[:, None] * (nodes + 1) / 2
    rate = np.exp(log_power(inside) / n[..., None]) / n[..., None]
    rate /= 1.0 if saturating else 1 + np.exp(inside)
    z, power = np.exp(log_power(x) / n), np.exp(log_power(x))
    # Up to the first node zⁿ is lost against one: z is the time.
    widths = np.concatenate([z[:, :1], (rate @ weights) / 2 * np.diff(x)], axis=1)
    time = np.concatenate([np.zeros_like(n), np.cumsum(widths, axis=1)], axis=1)
    # z and its derivatives in time: zⁿ has n zⁿ/z, (n − 1)/z of that, ... by z.
    speed = np.exp(-np.logaddexp(0.0, x)) if saturating else 1 + power
    slope = sign * n * power / z
    curvature = (n - 1) * slope / z
    derivatives = z, speed + 0 * z, speed * slope, speed * (slope**2 + speed * curvature)
    ends = [
        np.diff(time)[:, 1:] ** order / factorial for order, factorial in enumerate((1, 1, 2, 6))
    ]
    a = [scale * values[:, :-1] for scale, values in zip(ends, derivatives, strict=True)]
    b = [scale * values[:, 1:] for scale, values in zip(ends, derivatives, strict=True)]
    # The error of the left end's cubic at the right end fixes the four upper coefficients.
    missed = (
        b[0] - a[0] - a[1] - a[2] - a[3],
        b[1] - a[1] - 2 * a[2] - 3 * a[3],
        b[2] - a[2] - 3 * a[3],
        b[3] - a[3],
    )
    hermite = ((35, -15, 5, -1), (-84, 39, -14, 3), (70, -34, 13, -3), (-20, 10, -4, 1))
    upper = [sum(m * gap for m, gap in zip(row, missed, strict=True)) for row in hermite]
    table = np.zeros((exponent.size, ROWS, widths.shape[1]))
    # None lasts no time, though it may stand still between the last nodes.
    table[:, 0], table[:, 1] = time[:, :-1], np.maximum(widths, 1e-290)
    table[:, 3, 0] = z[:, 0]
    table[:, 2:, 1:] = np.stack([*a, *upper], axis=1)
    return table
