"""What is wrong with a record, as far as the record itself shows.

:func:`inspect` looks at a record before any model is fitted and returns a :class:`Finding` for
everything that a fit would stumble over, with the line of config that deals with it. It says
nothing about a good record.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from bwbayes.arrays import BoolArray, FloatArray, IntArray
from bwbayes.data.record import Record

__all__ = ["Finding", "inspect"]


@dataclass(frozen=True)
class Finding:
    """One thing that is wrong with a record.

    Parameters
    ----------
    kind : str
        What it is, in a word or two: "clipping", for instance.
    start, stop : float, s
        Where it is: start <= time < stop.
    text : str
        What was seen, in one line.
    remedy : str
        What to do about it: a line of config, or what to change in the file or the measurement.
    """

    kind: str
    start: float
    stop: float
    text: str
    remedy: str

    def __str__(self) -> str:
        return f"{self.kind}: {self.text}; {self.remedy}"


def inspect(record: Record) -> tuple[Finding, ...]:
    """Return what is wrong with a record, in the order in which to deal with it."""
    if record.displacement is None:
        return ()
    return tuple(_clipping(record))


def _clipping(record: Record) -> list[Finding]:
    """Find a displacement that stays at its largest or smallest value while the voltage moves on.

    A coarse sensor repeats its extreme value too, in two ways that are harmless. At rest the
    voltage stands still: only runs count in which its quartiles lie apart, by 1 % of its range and
    by what three steps of the sensor are worth. At a smooth peak the next level lasts as well: a
    parabola stays at its top level up to 2.4 times as long as at the next, a clipped one longer.
    """
    assert record.displacement is not None
    rows = np.flatnonzero(record.has_reading)
    voltage, displacement = record.voltage[rows], record.displacement[rows]
    levels = np.unique(displacement)
    if levels.size < 3:
        return []
    resolution = float(np.diff(levels).min() / (levels[-1] - levels[0]))
    travel = max(0.01, 3 * resolution) * float(np.ptp(voltage))
    findings = []
    for side, extreme, following in (("largest", -1, -2), ("smallest", 0, 1)):
        at_extreme = displacement == levels[extreme]
        first, lengths = _runs(at_extreme)
        stuck = (lengths >= 5) & (_quartile_distances(voltage[at_extreme], lengths) > travel)
        held = int(lengths[stuck].sum())
        if held >= 10 and held > 3 * np.count_nonzero(displacement == levels[following]):
            begin, length = first[stuck][0], lengths[stuck][0]
            start, stop = record.time[rows[[begin, begin + length - 1]]]
            text = (
                f"{held} readings stay at the {side} value {levels[extreme]:g} um while the "
                f"voltage moves, first at {start:.6g} s"
            )
            remedy = f"use a wider range, or leave such times out: {_excluded(start, stop)}"
            findings.append(Finding("clipping", start, stop + record.interval, text, remedy))
    return findings


def _excluded(start: float, stop: float) -> str:
    return f"exclude = [[{start:.6g}, {stop:.6g}]] under [record]"


def _runs(mask: BoolArray) -> tuple[IntArray, IntArray]:
    """Return the first index and the length of every run of true values."""
    edges = np.diff(mask.astype(np.int8), prepend=0, append=0)
    first = np.flatnonzero(edges == 1)
    return first, np.flatnonzero(edges == -1) - first


def _quartile_distances(values: FloatArray, lengths: IntArray) -> FloatArray:
    """Return third less first quartile of every run, where `values` holds run after run."""
    run = np.repeat(np.arange(lengths.size), lengths)
    ordered = values[np.lexsort((values, run))]
    first = np.cumsum(lengths) - lengths
    distances: FloatArray = ordered[first + 3 * lengths // 4] - ordered[first + lengths // 4]
    return distances
