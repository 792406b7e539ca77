"""Creep: the displacement goes on growing for long after a step of the voltage.

A piezo actuator's creep is nearly linear in the drive and in the logarithm of the time: after a
step it grows by about a percent of it per decade. A sum of first-order lags with log-spaced times
does just that, one lag per decade here, each with a strength of its own; equal strengths c give
c log₁₀(t) between the shortest and the longest of the times. The lags stand beside the dynamics,
not behind them: their times are so much longer that the order does not show.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from bwbayes.arrays import FloatArray
from bwbayes.errors import InputError
from bwbayes.model.declaration import Declaration, Values, normal
from bwbayes.model.distributions import Distribution
from bwbayes.model.linear import Hold, Recursion, first_order_lag
from bwbayes.model.operator import UNIT, Span

# Times that a model may have.
MOST_TIMES = 8


@dataclass(frozen=True)
class Creep:
    """Creep: slow lags beside the dynamics, one for each of the given times.

    Creep adds to the output of the dynamics, driven by w in um,

        x_creep = Σ cᵢ Lᵢ,   Tᵢ Lᵢ′ + Lᵢ = w (1 + κ |u| / U),

    with strengths cᵢ and κ without unit, times Tᵢ in s, and U the largest voltage.

    Parameters
    ----------
    times
        Tᵢ, s, rising.
    growing
        Whether the creep grows with the voltage by κ.
    reference
        The range of the voltage that κ is for: that of the record that is fitted.

    Raises
    ------
    InputError
        Times that are not positive and rising, none or too many.
    """

    times: tuple[float, ...]
    growing: bool = False
    reference: Span = UNIT

    def __post_init__(self) -> None:
        rising = all(earlier < later for earlier, later in pairwise((0.0, *self.times)))
        if not rising or not 0 < len(self.times) <= MOST_TIMES or not math.isfinite(self.times[-1]):
            raise InputError(
                f"creep: {list(self.times)} are not valid times; give up to {MOST_TIMES} positive "
                "ones in s that rise, or true"
            )

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the strengths."""
        return tuple(f"creep_{number}" for number in range(1, len(self.times) + 1))

    @property
    def parameters(self) -> tuple[Declaration, ...]:
        """The strengths cᵢ, and κ if the creep grows with the voltage."""
        strengths = tuple(
            Declaration(
                name,
                "-",
                rf"c_{number}",
                f"creep with a time of {time:g} s, as a part of the drive",
                lambda _: self.strength,
            )
            for number, (name, time) in enumerate(zip(self.names, self.times, strict=True), 1)
        )
        if not self.growing:
            return strengths
        growth = Declaration(
            "creep_growth",
            "-",
            r"\kappa",
            "growth of the creep from no voltage to the largest, as a part of it",
            lambda _: Distribution("halfnormal", {"scale": 1.0}),
            floor=0.0,
            limit_at_floor=True,
        )
        return (*strengths, growth)

    @property
    def strength(self) -> Distribution:
        """The default prior of each strength, by how many decades of time a lag stands for."""
        decades = 1.0
        if len(self.times) > 1:
            decades = math.log10(self.times[-1] / self.times[0]) / (len(self.times) - 1)
        # Published are 0.5 to 3% a decade. A normal prior, of which one in twenty-five is below
        # zero: strengths are linear in the displacement, and so their posterior is nearly normal.
        return normal(0.0175 * decades, 0.01 * decades)

    def reach(self, column: Values) -> FloatArray:
        """Return how much of a drive each lag may have kept from before a record, (models, lags).

        √(cᵢ² + c²) with a published strength c. Were it cᵢ alone, a strength next to zero would
        stand for a known start: the posterior would have a narrow ridge there, and the start be
        taken for a measurement of the strengths.
        """
        strengths = np.stack([column[name] for name in self.names], axis=1)
        return np.hypot(strengths, self.strength.arguments["mean"])

    def drive(self, column: Values, drive: FloatArray, voltage: FloatArray) -> FloatArray:
        """Return what creeps, w (1 + κ |u| / U) (models, samples), um, as a new array."""
        if not self.growing:
            return drive.copy()
        size = self.size(voltage)
        crept: FloatArray = drive * (1 + column["creep_growth"][:, np.newaxis] * size)
        return crept

    def size(self, voltage: FloatArray) -> FloatArray:
        """Return |u| / U (samples,), with U the largest voltage of the reference."""
        largest = max(abs(self.reference.low), abs(self.reference.high))
        return np.abs(voltage) / largest if largest > 0 else np.zeros_like(voltage)

    def recursions(self, models: int, interval: float, hold: Hold) -> tuple[Recursion, ...]:
        """Return the lags Lᵢ, the same for all of a number of models."""
        return tuple(first_order_lag(np.full(models, time), interval, hold) for time in self.times)


def creep_times(interval: float, duration: float) -> Sequence[float]:
    """Return powers of ten in s, from ten samples to three lengths of a record.

    At least one: that next to the record's length.
    """
    first = math.ceil(math.log10(10 * interval))
    last = max(math.floor(math.log10(3 * duration)), first)
    return [10.0**power for power in range(max(first, last - MOST_TIMES + 1), last + 1)]
