"""Slow and obvious operators: plays one by one, and extrema looked for anew each time."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from itertools import pairwise

import numpy as np

from bwbayes.arrays import FloatArray
from bwbayes.model.operator import Operator, Span

__all__ = [
    "Rows",
    "by_extrema",
    "by_plays",
    "history",
    "path",
    "rows",
    "run",
    "walk",
]

Rows = dict[str, FloatArray]
Everett = Callable[[float, float], float]


def rows(**columns: float | Sequence[float] | FloatArray) -> Rows:
    """Bring parameters to columns of one length."""
    size = max(np.size(values) for values in columns.values())
    return {name: np.resize(np.asarray(v, dtype=float), size) for name, v in columns.items()}


def walk(seed: int, turns: int = 25) -> FloatArray:
    """Go between random turning points with plateaus, steps of 1e-7 V and steps in one piece."""
    generator = np.random.default_rng(seed)
    corners = np.append(generator.normal(20.0, 60.0, turns), [50.0, 49.0, 50.0, -10.0, 50.0])
    parts = [np.zeros(1) + corners[0]]
    for start, end in pairwise(corners):
        count = int(generator.integers(1, 9))
        straight = np.linspace(start, end, count + 1)[1:]
        tiny = end + np.sign(end - start) * 1e-7 * np.arange(1, generator.integers(1, 4))
        parts += [straight, np.repeat(straight[-1], generator.integers(0, 3)), tiny]
    return np.concatenate(parts)


def history(initial: float, voltage: float, span: Span) -> list[float]:
    """Return the turning points from the demagnetized state to a record's first voltage."""
    high, low = max(span.high, voltage), min(span.low, voltage)
    return [0.0, high, low, voltage + (initial + 1) / 2 * (high - voltage), voltage]


def path(initial: float, voltage: FloatArray, span: Span | None) -> list[float]:
    """Return all voltages from the demagnetized state on, of which the record is the end."""
    before = [0.0] if span is None else history(initial, float(voltage[0]), span)[:-1]
    return before + [float(u) for u in voltage]


def by_extrema(everett: Everett, voltages: Sequence[float], samples: int) -> FloatArray:
    """Return w of the last samples: for each, its dominant extrema out of all voltages so far.

    The first is the largest |u|; then in turn the lowest and highest of what came after the last.
    """
    result = []
    for end in range(len(voltages) - samples + 1, len(voltages) + 1):
        so_far = list(voltages[:end])
        at = max(range(end), key=lambda k: (abs(so_far[k]), k))
        peak = so_far[at]
        w = math.copysign(everett(-abs(peak), abs(peak)) / 2, peak)
        sign = -1.0 if peak > 0 else 1.0
        while at < end - 1:
            ahead = max(range(at + 1, end), key=lambda k: (sign * so_far[k], k))
            w += sign * everett(so_far[at], so_far[ahead])
            at, sign = ahead, -sign
        result.append(w)
    return np.array(result)


def by_plays(
    slope: float, thresholds: FloatArray, weights: FloatArray, voltages: Sequence[float]
) -> FloatArray:
    """Update plays voltage by voltage, and return w at all voltages; the first must be zero."""
    z = np.zeros_like(thresholds)
    result = []
    for u in voltages:
        z = np.maximum(u - thresholds, np.minimum(u + thresholds, z))
        result.append(slope * u + float(weights @ z))
    return np.array(result)


def run(
    operator: Operator,
    column: Rows,
    voltage: FloatArray,
    span: Span | None,
    cuts: Sequence[int] = (),
) -> FloatArray:
    """Run an operator along a record, cut in pieces; without a span it starts from rest."""
    start = Span(0.0, 0.0) if span is None else span
    memory = operator.begin(column, float(voltage[0]), start, from_rest=span is None)
    parts = []
    for piece in np.split(voltage, sorted(cuts)):
        if piece.size:
            part, memory = operator.advance(column, piece, memory)
            parts.append(part)
    return np.concatenate(parts, axis=1)
