"""Prandtl-Ishlinskii: plays in parallel, with few parameters or with a weight for every play.

A play with threshold r lags the voltage by r, like a rod in a slot of width 2r, and is left where
it is until the slot's other end takes it along: z = max(u − r, min(u + r, z)). A sum of plays with
weights that are not negative has loops that depend on how far the voltage went alone, wherever it
did; from a turn on its path is the first curve, twice as large (Masing's rules).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from bwbayes.arrays import FloatArray
from bwbayes.errors import InputError
from bwbayes.model.declaration import Context, Declaration, Values, lognormal, rounded
from bwbayes.model.distributions import Distribution
from bwbayes.model.operators.memory import INITIAL, Branch, RemembersExtrema

__all__ = [
    "SLOPE",
    "Lines",
    "Plays",
    "PrandtlIshlinskii",
    "checked_thresholds",
    "lines_branch",
    "numbered",
    "of_gain",
    "plays_lines",
    "threshold_volts",
]


def of_gain(part: float, sigma: float) -> Callable[[Context], Distribution]:
    """Return a lognormal default prior whose median is a part of Y/U."""
    return lambda context: lognormal(part * context.ranges.gain, sigma)


SLOPE = Declaration(
    name="d",
    unit="um/V",
    label="d",
    description="displacement per volt just after a turn",
    default=of_gain(0.7, 0.6),
    floor=0.0,
    loop=True,
)


@dataclass(frozen=True)
class PrandtlIshlinskii(RemembersExtrema):
    """Plays with exponentially distributed thresholds: three parameters, closed form.

    ::

        w = d u + ∫ (α / r₀) exp(−r / r₀) z_r dr

    with z_r the play of threshold r, V. The curve from the demagnetised state on is w = ± Φ(|u|),

        Φ(x) = (d + α) x − α r₀ (1 − exp(−x / r₀)),

    and a branch from an extremum (u_r, w_r) is w = w_r ± 2 Φ(|u − u_r| / 2): d is the slope just
    after a turn, d + α that of long sweeps, um/V. Along a branch the slope follows
    dw'/d|u| = (d + α − w') / (2 r₀): linear and exponential, as n = 1 Bouc-Wen.

    Sources: M. A. Krasnosel'skii and A. V. Pokrovskii, Systems with Hysteresis (Springer, 1989);
    M. Brokate and J. Sprekels, Hysteresis and Phase Transitions (Springer, 1996).
    """

    @property
    def parameters(self) -> tuple[Declaration, ...]:
        """d, α, the scale r₀ of the thresholds, and the start."""
        return (
            SLOPE,
            Declaration(
                name="alpha",
                unit="um/V",
                label=r"\alpha",
                description="displacement per volt that long sweeps add",
                default=of_gain(0.7, 1.0),
                floor=0.0,
                reaches_floor=True,
                loop=True,
            ),
            Declaration(
                name="threshold",
                unit="V",
                label="r_0",
                description="scale of the plays' thresholds",
                default=lambda context: lognormal(0.6 * context.ranges.voltage, 1.0),
                floor=0.0,
                loop=True,
            ),
            INITIAL,
        )

    def branch(self, column: Values) -> Branch:
        """Return E = 2 Φ(|u − u_r| / 2)."""
        steepest = (column["d"] + column["alpha"])[:, np.newaxis]
        width = 2 * column["threshold"][:, np.newaxis]
        short = column["alpha"][:, np.newaxis] * width

        def everett(start: float | FloatArray, voltage: FloatArray) -> FloatArray:
            travel = np.abs(voltage - start)
            moved: FloatArray = travel / -width
            np.expm1(moved, out=moved)
            moved *= short
            moved += steepest * travel
            return moved

        return everett


@dataclass(frozen=True)
class Plays(RemembersExtrema):
    """Plays with given thresholds r_j, V, and a weight w_j, um/V, for each.

    ::

        w = d u + Σ w_j z_j

    so that d is the slope just after a turn, and the slope grows by w_j where a branch gets longer
    than 2 r_j. Along a branch w is piecewise linear.

    Parameters
    ----------
    thresholds
        Volts, positive and increasing; or how many, for r_j = U j / (count + 1) with U the
        parameter ``threshold``, by default fixed at half the range of the record's voltage.

    Raises
    ------
    InputError
        No threshold, or thresholds that are not positive and increasing.

    Notes
    -----
    Sources: K. Kuhnen, Eur. J. Control 9 (2003) 407-418; M. Brokate and J. Sprekels, Hysteresis
    and Phase Transitions (Springer, 1996).
    """

    thresholds: int | tuple[float, ...] = 10

    def __post_init__(self) -> None:
        object.__setattr__(self, "thresholds", checked_thresholds(self.thresholds))

    @property
    def parameters(self) -> tuple[Declaration, ...]:
        """d, the weights, the largest threshold if it is not given, and the start."""
        return (SLOPE, *numbered(self.thresholds, "weight", "w", "of play"), INITIAL)

    def branch(self, column: Values) -> Branch:
        """Return E = d |u − u_r| + Σ w_j max(|u − u_r| − 2 r_j, 0)."""
        return lines_branch(self.lines(column))

    def lines(self, column: Values) -> Lines:
        """Return the lines that E is made of."""
        return plays_lines(self.thresholds, "weight", column["d"], column)


def checked_thresholds(thresholds: int | Sequence[float]) -> int | tuple[float, ...]:
    """Return thresholds, or their number; raise an InputError where they cannot be."""
    if isinstance(thresholds, int):
        if thresholds < 1:
            raise InputError(f"thresholds: {thresholds} is too few; give 1 or more")
        return int(thresholds)
    volts = tuple(float(threshold) for threshold in thresholds)
    rising = np.isfinite(volts).all() and (np.diff(volts, prepend=0.0) > 0).all()
    if not volts or not rising:
        raise InputError(
            f"thresholds: {list(volts)}; give positive volts, each larger than the one before"
        )
    return volts


def numbered(
    thresholds: int | tuple[float, ...], name: str, symbol: str, of: str
) -> tuple[Declaration, ...]:
    """Declare a weight for each threshold, and the threshold that an evenly spaced row ends at.

    The sum of the weights is about 0.7 Y/U by default, however many they are.
    """
    count = thresholds if isinstance(thresholds, int) else len(thresholds)
    weights = tuple(
        Declaration(
            name=f"{name}_{j}",
            unit="um/V",
            label=rf"{symbol}_{{{j}}}",
            description=f"weight {of} {j}",
            default=of_gain(0.4 / count, 1.0),
            floor=0.0,
            reaches_floor=True,
            loop=True,
        )
        for j in range(1, count + 1)
    )
    if not isinstance(thresholds, int):
        return weights
    last = Declaration(
        name="threshold",
        unit="V",
        label="U",
        description="voltage up to which the thresholds are spread",
        default=lambda context: rounded(context.ranges.voltage),
        floor=0.0,
        loop=True,
    )
    return (*weights, last)


def threshold_volts(thresholds: int | tuple[float, ...], column: Values) -> FloatArray:
    """Return the thresholds r_j, V, (models, thresholds), or (1, thresholds) if all are alike."""
    if not isinstance(thresholds, int):
        return np.array([thresholds], dtype=np.float64)
    last = column["threshold"]
    if last.size and (last == last[0]).all():
        last = last[:1]
    return last[:, np.newaxis] * (np.arange(1, thresholds + 1) / (thresholds + 1))


class Lines(NamedTuple):
    """What a branch of plays is between two thresholds: a straight line in its length v.

    ``corners`` are 2 r_j, V, (models, plays), or (1, plays) if all are alike; from as many corners
    on, the branch is ``steepness`` v + ``level``, um/V and um, both (models, plays + 1).
    """

    corners: FloatArray
    steepness: FloatArray
    level: FloatArray


def plays_lines(
    thresholds: int | tuple[float, ...], name: str, slope: FloatArray, column: Values
) -> Lines:
    """Return the lines d v + Σ w_j max(v − 2 r_j, 0), for a ``slope`` d (models,), um/V."""
    corners = 2 * threshold_volts(thresholds, column)
    weights = np.stack([column[f"{name}_{j + 1}"] for j in range(corners.shape[1])], axis=1)
    return Lines(
        corners,
        steepness=np.cumsum(np.column_stack([slope, weights]), axis=1),
        level=np.cumsum(np.column_stack([np.zeros_like(slope), -weights * corners]), axis=1),
    )


def lines_branch(lines: Lines) -> Branch:
    """Return the Everett function of lines; it costs the same whatever the number of plays."""
    corners, steepness, level = lines
    rows = np.arange(len(steepness))[:, np.newaxis]

    def everett(start: float | FloatArray, voltage: FloatArray) -> FloatArray:
        travel = np.atleast_2d(np.abs(voltage - start))
        if len(corners) == 1:
            passed = np.searchsorted(corners[0], travel)
        else:
            passed = sum(travel > corner[:, np.newaxis] for corner in corners.T)
        moved: FloatArray = steepness[rows, passed]
        moved *= travel
        moved += level[rows, passed]
        return moved

    return everett
