"""Bouc-Wen hysteresis whose loops need not be symmetric.

How fast h settles may depend on the signs of the voltage, of its rate and of h, as in the
generalized Bouc-Wen model of Song and Der Kiureghian. Between the places where one of them changes
its sign, that is plain Bouc-Wen hysteresis with a β and a γ of its own; the places are known in
closed form, so it is as exact.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from itertools import product

import numpy as np

from bwbayes.arrays import ArrayLike, BoolArray, FloatArray
from bwbayes.errors import InputError, suggestion
from bwbayes.model.declaration import Declaration, Values, normal, refuse
from bwbayes.model.operator import HysteresisStep
from bwbayes.model.operators.scalar_memory import (
    SLACK,
    OneState,
    RelaxingStep,
    alpha,
    beta,
    ceiling,
    d,
    gamma,
    initial,
)

# Variables of each term, in the order in which their bounds follow from each other.
TERMS = {
    "b4": "the voltage's direction",
    "b5": "the sign of h",
    "b2": "the voltage's sign and direction",
    "b6": "the voltage's sign",
    "b3": "the signs of voltage and h",
}

SIGNS = (1.0, -1.0)


@dataclass(frozen=True)
class BoucWenAsymmetric(OneState):
    """Generalized Bouc-Wen hysteresis with n = 1, w = d u − h, exact.

    The hysteretic displacement h in um follows the voltage u in V by

        dh = α du − |h| ψ du,
        ψ = γ + β [sgn(u̇ h) + b₂ sgn(u u̇) + b₃ sgn(u h) + b₄ sgn(u̇) + b₅ sgn(h) + b₆ sgn(u)],

    with α in um/V, β and γ in 1/V, and the b without unit: β b₂ to β b₆ are the β₂ to β₆ of the
    source, which has no γ. Where the voltage has sign x and goes in direction s, this is plain
    Bouc-Wen hysteresis with

        β' = β (1 + s b₅ + s x b₃),   γ' = γ + β (s b₄ + s x b₂ + x b₆).

    It is passive, never giving out more energy than it has taken in, where |γ'| ≤ β' for all four
    pairs of signs; this is enforced. A voltage that never changes its sign cannot tell b₂ from b₄,
    b₃ from b₅, and b₆ from γ: give two ``terms`` then.

    Parameters
    ----------
    terms
        Those of b2 to b6 that are parameters; the others are zero. Without any it is plain
        Bouc-Wen hysteresis.

    Raises
    ------
    InputError
        An unknown term.

    Notes
    -----
    J. Song, A. Der Kiureghian, Generalized Bouc-Wen model for highly asymmetric hysteresis,
    Journal of Engineering Mechanics 132 (2006).
    """

    terms: Sequence[str] = tuple(sorted(TERMS))

    def __post_init__(self) -> None:
        for term in self.terms:
            if term not in TERMS:
                raise InputError(f"terms: {term!r} is unknown; {suggestion(term, TERMS)}")

    @property
    def parameters(self) -> tuple[Declaration, ...]:
        """d, α, β, γ, the terms and the initial h."""
        tilt = gamma(
            lambda context: normal(0.0, 4.0 / context.ranges.voltage),
            lambda earlier: (-earlier["beta"], earlier["beta"]),
            "|gamma| <= beta",
        )
        start = initial(_initial_bounds)
        # |γ| ≤ β cuts the joint prior, which takes small β away, as for Bouc-Wen.
        shape = beta(0.15, lambda earlier: (np.abs(earlier["gamma"]), np.inf))
        asymmetry = (
            Declaration(
                name,
                "-",
                f"b_{name[1]}",
                f"hysteresis loop shape, by {signs}",
                lambda _: normal(0.0, 0.3),
                bounds=partial(_bounds, name),
                stated_bounds="the loop shape is passive",
                loop=True,
            )
            for name, signs in TERMS.items()
            if name in self.terms
        )
        return d(), alpha(), shape, tilt, *asymmetry, start

    def check(self, column: Values) -> None:
        """Raise an InputError where a parameter is not finite or |γ'| > β' for a pair of signs."""
        super().check(column)
        demand = "with beta and b2 to b6 the loop must be passive, |gamma'| <= beta'"
        refuse("gamma", ~_passive(column), column["gamma"], demand)

    def holds(self, column: Values) -> BoolArray:
        """Tell where α < d and, for all four pairs of signs, |γ'| ≤ β'."""
        inside = super().holds(column)
        if "beta" not in column or "gamma" not in column:
            return inside
        return inside & _passive(column)

    def step(self, column: Values) -> HysteresisStep:
        """Return plain Bouc-Wen hysteresis with the rates of each pair of signs."""
        pairs = [rates(column, s, x) for s, x in product(reversed(SIGNS), repeat=2)]
        slow, fast = np.stack(pairs, axis=1)
        return RelaxingStep.of([column["d"]], [column["alpha"]], slow - fast, slow + fast)


def rates(column: Values, s: float, x: float) -> tuple[FloatArray, FloatArray]:
    """Return β′ and γ′ (models,), 1/V, where the voltage goes in direction s and has the sign x."""
    slow, fast = _rates(column, s, x)
    slow = np.maximum(column["beta"] * slow, 0.0)
    # Rounding may have them beyond what is passive.
    return slow, np.clip(column["beta"] * fast + column["gamma"], -slow, slow)


def _rates(column: Values, s: float, x: float) -> tuple[FloatArray, FloatArray]:
    """Return β'/β and (γ' − γ)/β."""
    b = {name: column.get(name, np.zeros(1)) for name in TERMS}
    return 1 + s * b["b5"] + s * x * b["b3"], s * b["b4"] + s * x * b["b2"] + x * b["b6"]


def _passive(column: Values) -> BoolArray:
    inside = np.full(column["beta"].shape, fill_value=True)
    for signs in product(SIGNS, SIGNS):
        slow, fast = _rates(column, *signs)
        tilt = np.abs(column["gamma"] + column["beta"] * fast)
        inside &= tilt <= column["beta"] * (slow + SLACK)
    return inside


def _initial_bounds(earlier: Values) -> tuple[ArrayLike, ArrayLike]:
    """Return the ceilings of h, um: where it grows no further, with the slower of two rates."""
    tops = []
    for s in SIGNS:
        slowest = np.minimum(*(np.add(*rates(earlier, s, x)) for x in SIGNS))
        tops.append(ceiling(earlier["alpha"], slowest))
    return -tops[1], tops[0]


def _bounds(name: str, earlier: Values) -> tuple[ArrayLike, ArrayLike]:
    """Return where a term leaves others of those that come after it some room.

    For either direction s, G = γ/β + s b₄, B = 1 + s b₅ and K = b₆ + s b₂ must meet
    |G + x K| ≤ B + s x b₃ for either sign x of the voltage.
    """
    if "beta" not in earlier or "gamma" not in earlier:
        return -1.0, 1.0
    b = {term: earlier.get(term, np.zeros(1)) for term in TERMS}
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio = earlier["gamma"] / earlier["beta"]
    up, down = ratio + b["b4"], ratio - b["b4"]
    match name:
        case "b5":
            return np.abs(up) - 1, 1 - np.abs(down)
        case "b6":
            high, low = 1 + b["b5"], 1 - b["b5"]
            return np.maximum(-high - b["b2"], b["b2"] - low), np.minimum(
                high - b["b2"], low + b["b2"]
            )
        case "b3":
            high, low = 1 + b["b5"], 1 - b["b5"]
            to_up, to_down = b["b6"] + b["b2"], b["b6"] - b["b2"]
            return (
                np.maximum(np.abs(up + to_up) - high, np.abs(down - to_down) - low),
                np.minimum(high - np.abs(up - to_up), low - np.abs(down + to_down)),
            )
    return -1.0, 1.0
