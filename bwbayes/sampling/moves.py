"""How the walkers move.

Differential evolution steps along the difference of two other walkers, so it follows any ridge the
ensemble lies on; a snooker step now and then helps between modes. Neither needs tuning, and they
bring the pilot to the posterior, where half of its steps try places of the point fit's own guess.
Once the pilot is there, a mixture of Student-t distributions fitted to its draws, and bent as they
are, proposes places independently of where a walker is, which mixes about ten times faster. The fit
is frozen before the draws that count, and a seventh of the steps remain differential evolution and
snooker, so that whatever the fit does not cover is reached, and left again.
"""

from __future__ import annotations

import numpy as np
from emcee import moves

from bwbayes.arrays import BoolArray, FloatArray, IntArray
from bwbayes.sampling.proposals import StudentMixture

Weighted = list[tuple[moves.Move, float]]


class SnookerMove(moves.RedBlueMove):  # type: ignore[misc]  # emcee has no types
    """A step along the line through another walker, as long as two more are apart on that line.

    With e the unit vector from walker z to x, and walkers z₁, z₂, all of the half that rests,

        x' = x + 1.7 e (e·z₁ − e·z₂),   log factor (p − 1) log(|x' − z| / |x − z|),

    after ter Braak and Vrugt (2008), Statistics and Computing 18, 435-446. The way back swaps z₁
    and z₂, and is as likely as the way there. It stands in for ``emcee.moves.DESnookerMove``, which
    in emcee up to 3.1.6 takes half of the logarithm and makes a posterior of nine parameters a
    fifth too narrow.
    """

    def get_proposal(
        self, moving: FloatArray, others: list[FloatArray], random: np.random.RandomState
    ) -> tuple[FloatArray, FloatArray]:
        """Propose for ``moving`` (walkers, free), given the walkers of the other half."""
        resting, count = np.concatenate(others), len(moving)
        number, first = random.randint(len(resting), size=(2, count))
        second = (first + random.randint(1, len(resting), size=count)) % len(resting)
        z, z1, z2 = resting[number], resting[first], resting[second]
        away = moving - z
        distance = np.linalg.norm(away, axis=1, keepdims=True)
        direction = away / distance
        along = np.sum(direction * (z1 - z2), axis=1, keepdims=True)
        # On the line through z the new distance is known up to its sign.
        proposed = distance + 1.7 * along
        factor = (moving.shape[1] - 1) * (np.log(np.abs(proposed)) - np.log(distance))
        return z + proposed * direction, factor[:, 0]


class AmongPlaces(moves.Move):  # type: ignore[misc]  # emcee has no types
    """A step to one of several places that a proposal q proposes independently of the walker.

    With w = π/q, places x₁ … xₙ drawn from q, and the walker at x₀, one of them is chosen with the
    probability wᵢ / (w₁ + … + wₙ), and taken with

        min(1, (w₁ + … + wₙ) / (w₀ + … + wₙ − wᵢ)),

    after Liu (1996), Biometrika 83, 681-682. A walker where q is too small by a factor leaves n
    times as soon. One place is a Metropolis step, as ``emcee.moves.MHMove`` makes it.
    """

    def __init__(self, proposal: StudentMixture, places: int = 1) -> None:
        self.proposal, self.places = proposal, places

    def choose(
        self, here: FloatArray, weight: FloatArray, chance: FloatArray
    ) -> tuple[IntArray, BoolArray, FloatArray]:
        """Choose for each walker, at log w₀ (walkers,), one of log wᵢ (places, walkers).

        Return which, whether it is taken, and its log weight, each (walkers,). One number from 0 to
        1 does both: it falls into the part of the range that belongs to a place, and where in that
        part it falls is again such a number.
        """
        rows = np.arange(here.size)
        largest = np.maximum(np.max(weight, axis=0), here)
        parts = np.exp(weight - largest)
        ends = np.cumsum(parts, axis=0)
        point = chance * ends[-1]
        which = np.minimum(np.sum(point >= ends, axis=0), len(weight) - 1)
        share, chosen = parts[which, rows], weight[which, rows]
        others = ends[-1] - share + np.exp(here - largest)
        accepted = (point - (ends[which, rows] - share)) * others < share * ends[-1]
        return which, accepted, chosen


def pilot_moves(proposal: StudentMixture | None = None) -> Weighted:
    """Return moves and weights for the pilot: half of its steps are a first guess's, if any."""
    if proposal is None:
        return [(moves.DEMove(), 0.8), (SnookerMove(), 0.2)]
    return [(moves.DEMove(), 0.4), (SnookerMove(), 0.1), (AmongPlaces(proposal), 0.5)]


def sampling_moves(proposal: StudentMixture | None, places: int = 1) -> Weighted:
    """Return moves and weights for the draws that count; as the pilot's without a proposal."""
    if proposal is None:
        return pilot_moves()
    return [(moves.DEMove(), 0.12), (SnookerMove(), 0.03), (AmongPlaces(proposal, places), 0.85)]
