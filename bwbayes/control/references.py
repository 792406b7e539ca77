"""Displacements to be followed: the paper's signals at any frequency, in units of their amplitude.

The paper drives its actuator by a sine, a sine that decays, steps, and a staircase. Here these are
what the displacement is to be, each repeating with a frequency, so that one can see up to where a
controller follows.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np

from bwbayes.arrays import FloatArray
from bwbayes.data.waveforms import Triangle

__all__ = ["PERIODS", "SHAPES", "reference"]

# Periods of every signal; a signal is at least so long, s.
PERIODS, SHORTEST = 3, 1.0

# Levels of a staircase from the middle to an end.
LEVELS = 5

# How long it takes to get to the middle of a range that the rest is not in, s.
APPROACH = 1.0


def _decaying(turns: FloatArray) -> FloatArray:
    end = turns[-1] + (turns[-1] - turns[-2])
    decayed: FloatArray = np.sin(2 * np.pi * turns) * (1 - turns / end)
    return decayed


SHAPES: Mapping[str, Callable[[FloatArray], FloatArray]] = {
    "sine": lambda turns: np.sin(2 * np.pi * turns),
    "decaying sine": _decaying,
    "steps": lambda turns: np.where((turns + 1e-9) % 1.0 < 0.5, 1.0, -1.0),
    "staircase": lambda turns: np.round(LEVELS * Triangle(1.0, 1.0)(turns)) / LEVELS,
}

JUMPING = ("steps", "staircase")


def reference(
    frequency: float, interval: float, center: float, amplitude: float, rise: int = 1
) -> tuple[FloatArray, int]:
    """Return all signals of a frequency, (signals, samples), um, and where they begin.

    Parameters
    ----------
    frequency, interval
        Hz, s.
    middle, amplitude
        The signals swing by the amplitude about the middle, um. Before they begin the displacement
        goes smoothly from zero, its rest, to the middle.
    rise
        How many samples a jump takes: no actuator follows one that takes none.

    Notes
    -----
    There is a sample more than is judged.
    """
    periods = max(PERIODS, int(np.ceil(SHORTEST * frequency)))
    samples = max(round(periods / (frequency * interval)), 2)
    turns = frequency * interval * np.arange(samples + 1, dtype=np.float64)
    kernel = np.hanning(rise + 2)[1:-1]
    swung = np.stack(
        [
            np.convolve(shape(turns), kernel / kernel.sum())[: turns.size]
            if name in JUMPING
            else shape(turns)
            for name, shape in SHAPES.items()
        ]
    )
    swung = center + amplitude * swung
    if center == 0:
        return swung, 0
    lead = np.arange(round(APPROACH / interval)) * interval / APPROACH
    risen = center * (1 - np.cos(np.pi * lead)) / 2
    return np.hstack([np.tile(risen, (len(swung), 1)), swung]), risen.size
