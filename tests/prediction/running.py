"""What running drives leave of Bouc-Wen hysteresis, by sweeping them one after the other."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from bwbayes.arrays import FloatArray
from bwbayes.model.operators.bouc_wen import hysteresis

__all__ = ["left_by_running_drives"]


def left_by_running_drives(
    model: Mapping[str, float], voltage: float, every: FloatArray, count: int
) -> FloatArray:
    """Return as many states h at a voltage, each as probable as the next, um.

    They are those of loops of 16 amplitudes about the middle of ``every`` voltage, left on either
    branch, the outermost as far out as none; between them are straight lines.
    """
    alpha, beta, gamma = (np.array([model[name]]) for name in ("alpha", "beta", "gamma"))
    middle, half = (np.max(every) + np.min(every)) / 2, np.ptp(every) / 2
    states: list[float] = []
    for reach in np.arange(1, 17) / 16:
        low, high = middle - reach * half, middle + reach * half
        for sweeps in ([0.0, high, low, high, low], [0.0, low, high, low, high]):
            h = hysteresis(np.array([*sweeps, voltage]), alpha, beta, gamma)
            states.append(float(h[0, -1]))
    states = sorted(states)
    states[0], states[-1] = min(states[0], 0.0), max(states[-1], 0.0)
    places = np.linspace(0.0, 1.0, len(states))
    parts = (np.arange(count) + 0.5) / count
    return np.asarray(np.interp(parts, places, states), dtype=np.float64)
