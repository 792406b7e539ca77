"""Prandtl-Ishlinskii: plays in parallel, with few parameters or with a weight for every play.

A play with threshold r lags the voltage by r, like a rod in a slot of width 2r, and is left where
it is until the slot's other end takes it along: z = max(u − r, min(u + r, z)). A sum of plays with
weights that are not negative has loops that depend on how far the voltage went alone, wherever it
did; from a turn on its path is the first curve, twice as large (Masing's rules).

Maxwell-slip is Prandtl-Ishlinskii read from the other side, springs that slip, in parallel. A
spring that slips beyond a strain r (a stop) follows the voltage up to there, then stays: its strain
is s = u − z, with z the play of threshold r. The displacement that the springs hold back is the
hysteresis. A sum of stops is therefore a sum of plays with another linear part.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, ClassVar

import numpy as np

from bwbayes.arrays import ArrayLike, FloatArray, anywhere, gone, select
from bwbayes.errors import InputError
from bwbayes.model.declaration import Declaration, Values, positive, refuse, round_to_scale
from bwbayes.model.inputs import Span
from bwbayes.model.operator import HysteresisStep
from bwbayes.model.operators.extremum_memory import INITIAL, RemembersExtrema

SLOPE = positive(
    "d",
    "um/V",
    "d",
    "displacement per volt just after a turn",
    lambda ranges: 0.7 * ranges.slope,
    0.6,
)


@dataclass(frozen=True)
class PrandtlIshlinskii(RemembersExtrema):
    """Plays with exponentially distributed thresholds: three parameters, closed form.

    ::

        w = d u + ∫ (α / r₀) exp(−r / r₀) z_r dr

    with z_r the play of threshold r, V. The curve from the demagnetized state on is w = ± Φ(|u|),

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
            positive(
                "alpha",
                "um/V",
                r"\alpha",
                "displacement per volt that long sweeps add",
                lambda ranges: 0.7 * ranges.slope,
                reaches_floor=True,
            ),
            positive(
                "threshold",
                "V",
                "r_0",
                "scale of the plays' thresholds",
                lambda ranges: 0.6 * ranges.voltage,
            ),
            INITIAL,
        )

    def numbers(self, column: Values) -> FloatArray:
        """Return d + α, 2 α r₀ and 2 r₀."""
        width = 2 * column["threshold"]
        return np.column_stack([column["d"] + column["alpha"], column["alpha"] * width, width])

    @staticmethod
    def everett(numbers: Any, start: Any, voltage: Any) -> Any:
        """Return E = 2 Φ(|u − u_r| / 2)."""
        travel = np.abs(voltage - start)
        return numbers[0] * travel - numbers[1] * gone(travel / numbers[2])


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

    # A weight's name, its symbol, and its element.
    weight: ClassVar[tuple[str, str, str]] = ("weight", "w", "play")

    def __post_init__(self) -> None:
        if isinstance(self.thresholds, int):
            if self.thresholds < 1:
                raise InputError(f"thresholds: {self.thresholds} is too few; give 1 or more")
            return
        volts = tuple(float(threshold) for threshold in self.thresholds)
        rising = np.isfinite(volts).all() and (np.diff(volts, prepend=0.0) > 0).all()
        if not volts or not rising:
            raise InputError(
                f"thresholds: {list(volts)}; give positive volts, each larger than the one before"
            )
        object.__setattr__(self, "thresholds", volts)

    @property
    def parameters(self) -> tuple[Declaration, ...]:
        """d, the weights, the largest threshold if it is not given, and the start."""
        return (SLOPE, *self.elements(), INITIAL)

    def slope(self, column: Values) -> FloatArray:
        """Return the slope just after a turn (models,), um/V."""
        return column["d"]

    @property
    def count(self) -> int:
        """How many plays there are."""
        return self.thresholds if isinstance(self.thresholds, int) else len(self.thresholds)

    def elements(self) -> tuple[Declaration, ...]:
        """Declare a weight for each threshold, and the threshold that an even row ends at.

        The sum of the weights is about 0.4 Y/U by default, however many they are.
        """
        name, symbol, element = self.weight
        weights = tuple(
            positive(
                f"{name}_{j}",
                "um/V",
                rf"{symbol}_{{{j}}}",
                f"weight of {element} {j}",
                lambda ranges: 0.4 / self.count * ranges.slope,
                reaches_floor=True,
            )
            for j in range(1, self.count + 1)
        )
        last = Declaration(
            name="threshold",
            unit="V",
            label="U",
            description="voltage up to which the thresholds are spread",
            default=lambda context: round_to_scale(context.ranges.voltage),
            floor=0.0,
            loop=True,
        )
        return (*weights, last) if isinstance(self.thresholds, int) else weights

    def step(self, column: Values) -> PlaysStep:
        """Return the plays."""
        return PlaysStep(self.numbers(column))

    def numbers(self, column: Values) -> FloatArray:
        """Return d, all weights and all thresholds."""
        volts: Any = self.thresholds
        if isinstance(self.thresholds, int):
            even = np.arange(1, self.count + 1) / (self.count + 1)
            volts = column["threshold"][:, np.newaxis] * even
        weights = [column[f"{self.weight[0]}_{j}"] for j in range(1, self.count + 1)]
        weighed = np.column_stack([self.slope(column), *weights])
        return np.hstack([weighed, np.broadcast_to(volts, (len(weighed), self.count))])

    @staticmethod
    def everett(numbers: Any, start: Any, voltage: Any) -> Any:
        """Return E, whose thresholds rise."""
        travel, plays = np.abs(voltage - start), (len(numbers) - 1) // 2
        moved = numbers[0] * travel
        for j in range(plays):
            beyond = travel - 2.0 * numbers[1 + plays + j]
            if not anywhere(beyond > 0.0):
                break
            moved = moved + numbers[1 + j] * np.maximum(beyond, 0.0)
        return moved


class PlaysStep(HysteresisStep):
    """w = d u + Σ w_j z_j with plays z_j = max(u − r_j, min(u + r_j, z_j)); the memory are these.

    ``parameters`` are d, all weights w_j, um/V, and all thresholds r_j, V, (models, 1 + 2 plays).
    """

    ROW: ClassVar = "d, all weights, and all thresholds"

    @staticmethod
    def move(parameters: Any, memory: Any, voltage: Any, after: Any) -> tuple[Any, Any]:
        """Return w, and the slope d + Σ w_j of those plays that are moved."""
        slope, plays = parameters[0], len(memory)
        w = slope * voltage
        for j in range(plays):
            weight, threshold = parameters[1 + j], parameters[1 + plays + j]
            play = np.maximum(voltage - threshold, np.minimum(voltage + threshold, memory[j]))
            slope = slope + select(play != memory[j], weight, 0.0)
            w = w + weight * play
            after[j] = play
        return w, slope

    @property
    def weights(self) -> FloatArray:
        """w_j, (models, plays), um/V."""
        return self.parameters[:, 1 : 1 + self.parameters.shape[1] // 2]

    def demagnetized(self) -> FloatArray:
        """Return all plays at zero, (models, plays)."""
        return np.zeros_like(self.weights)

    def slopes(self, limits: Span) -> tuple[FloatArray, FloatArray]:  # noqa: ARG002  # anywhere
        """Return d, and d + Σ w_j."""
        return self.parameters[:, 0], self.parameters[:, 0] + self.weights.sum(axis=1)

    def coefficients(self) -> dict[str, tuple[Any, str]]:
        """Return d, the weights and the thresholds."""
        rows = np.split(self.parameters[0], [1, 1 + self.weights.shape[1]])
        (d,), weights, thresholds = (row.tolist() for row in rows)
        return {
            "d": (d, "um/V"), "weights": (weights, "um/V"), "thresholds": (thresholds, "V"),
        }  # fmt: skip


ELEMENT = "alpha_"


@dataclass(frozen=True)
class MaxwellSlip(Plays):
    """Elements that slip at given strains r_j, V, each holding back α_j, um/V, until it does.

    ::

        w = d u − h,   h = Σ α_j s_j,   s_j = u − z_j,   |s_j| ≤ r_j

    with z_j the play of threshold r_j: the same as :class:`Plays
    <bwbayes.model.operators.prandtl_ishlinskii.Plays>` with weights α_j and the slope d − Σ α_j
    just after a turn, which must not be negative. As in the Bouc-Wen model, d is the slope of long
    sweeps and h the hysteretic displacement.

    Parameters
    ----------
    thresholds
        As in :class:`Plays <bwbayes.model.operators.prandtl_ishlinskii.Plays>`.

    Notes
    -----
    Source: M. Goldfarb and N. Celanovic, Modeling piezoelectric stack actuators for control of
    micromanipulation, IEEE Control Systems 17 (1997) 69-79.
    """

    weight = "alpha", r"\alpha", "element"

    @property
    def parameters(self) -> tuple[Declaration, ...]:
        """d, the α_j, the largest threshold if it is not given, and the start."""
        slope = positive(
            "d",
            "um/V",
            "d",
            "displacement per volt of long sweeps, when all elements slip",
            lambda ranges: 1.4 * ranges.slope,
            0.5,
            bounds=lambda earlier: (_sum_known(earlier), np.inf),
            stated_bounds="the sum of all alpha <= d",
        )
        return (slope, *(_below_d(element) for element in self.elements()), INITIAL)

    def check(self, column: Values) -> None:
        """Raise an InputError that names the parameter where a model is outside of the domain."""
        super().check(column)
        back = self.slope(column) < -1e-9 * column["d"]  # by rounding it may be below zero
        demand = "must not be less than the sum of all alpha, or the displacement turns back"
        refuse("d", back, column["d"], demand)

    def slope(self, column: Values) -> FloatArray:
        """Return the slope just after a turn, d − Σ α_j."""
        return np.asarray(column["d"] - _sum_known(column))


def _below_d(element: Declaration) -> Declaration:
    """Return a declaration that leaves room for the other elements; the threshold as it is."""
    if not element.name.startswith(ELEMENT):
        return element

    def bounds(earlier: Values) -> tuple[ArrayLike, ArrayLike]:
        others = {name: values for name, values in earlier.items() if name != element.name}
        return 0.0, others.get("d", np.array(np.inf)) - _sum_known(others)

    return replace(element, bounds=bounds)


def _sum_known(earlier: Values) -> FloatArray:
    """Return Σ α_j of those that are known."""
    return np.asarray(sum(values for name, values in earlier.items() if name.startswith(ELEMENT)))
