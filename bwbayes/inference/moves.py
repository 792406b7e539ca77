"""How the walkers move.

Differential evolution steps along the difference of two other walkers, so it follows any ridge the
ensemble lies on; a snooker step now and then helps between modes. Neither needs tuning, and they
bring the pilot to the posterior. Once the pilot is there, a Student-t distribution fitted to
its draws proposes places independently of where a walker is, which mixes about ten times faster.
The fit is frozen before the draws that count, and at least a fifth of the steps remain
differential evolution and snooker, so that whatever the fit does not cover stays reachable.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from emcee import moves

from bwbayes.arrays import FloatArray

__all__ = ["SnookerMove", "StudentProposal", "pilot_moves", "sampling_moves"]

Weighted = list[tuple[moves.Move, float]]


@dataclass(frozen=True)
class StudentProposal:
    """A multivariate Student-t distribution as an independence proposal.

    With ν degrees of freedom, centre μ and covariance-like scale LLᵀ over p coordinates,

        log q(x) = −(ν + p)/2 log(1 + |L⁻¹(x − μ)|² / ν) + constant.

    Parameters
    ----------
    centre
        μ, (free,).
    factor
        L, lower triangular, (free, free).
    freedom
        ν; small enough for tails heavier than the posterior's.
    """

    centre: FloatArray
    factor: FloatArray
    freedom: float = 5.0

    @classmethod
    def fitted(cls, draws: FloatArray) -> StudentProposal:
        """Fit to draws (count, free) by their mean and covariance.

        The scale is the covariance itself, a little wider than the t of that covariance: a
        proposal that is too wide costs acceptance, one that is too narrow costs mixing.
        """
        covariance = np.atleast_2d(np.cov(draws, rowvar=False))
        return cls(np.mean(draws, axis=0), np.linalg.cholesky(covariance))

    def log_density(self, coordinates: FloatArray) -> FloatArray:
        """Log density (count,) at coordinates (count, free), up to a constant."""
        white = np.linalg.solve(self.factor, (coordinates - self.centre).T)
        size = self.centre.size
        squares = np.sum(white * white, axis=0)
        density: FloatArray = -0.5 * (self.freedom + size) * np.log1p(squares / self.freedom)
        return density

    def draw(self, random: np.random.RandomState, count: int) -> FloatArray:
        """Draw coordinates (count, free) with emcee's generator."""
        normal = random.standard_normal((count, self.centre.size))
        spread = np.sqrt(self.freedom / random.chisquare(self.freedom, count))
        coordinates: FloatArray = self.centre + (normal * spread[:, np.newaxis]) @ self.factor.T
        return coordinates

    def __call__(
        self, coordinates: FloatArray, random: np.random.RandomState
    ) -> tuple[FloatArray, FloatArray]:
        """Propose, as ``emcee.moves.MHMove`` asks: places and log q(old) − log q(new)."""
        proposed = self.draw(random, coordinates.shape[0])
        return proposed, self.log_density(coordinates) - self.log_density(proposed)


class SnookerMove(moves.RedBlueMove):  # type: ignore[misc]  # emcee has no types
    """A step along the line through another walker, as long as two more are apart on that line.

    With e the unit vector from walker z to x, and walkers z₁, z₂ from two other splits,

        x' = x + 1.7 e (e·z₁ − e·z₂),   log factor (p − 1) log(|x' − z| / |x − z|),

    after ter Braak and Vrugt (2008), Statistics and Computing 18, 435-446. It stands in for
    ``emcee.moves.DESnookerMove``, which in emcee up to 3.1.6 takes half of the logarithm and makes
    a posterior of nine parameters a fifth too narrow.
    """

    def __init__(self, stretch: float = 1.7) -> None:
        super().__init__(nsplits=4)
        self.stretch = stretch

    def get_proposal(
        self, moving: FloatArray, others: list[FloatArray], random: np.random.RandomState
    ) -> tuple[FloatArray, FloatArray]:
        """Propose for ``moving`` (walkers, free), given the walkers of the other three splits."""
        z, z1, z2 = (split[random.randint(len(split), size=len(moving))] for split in others)
        away = moving - z
        distance = np.linalg.norm(away, axis=1, keepdims=True)
        direction = away / distance
        along = np.sum(direction * (z1 - z2), axis=1, keepdims=True)
        # On the line through z the new distance is known up to its sign.
        proposed = distance + self.stretch * along
        factor = (moving.shape[1] - 1) * (np.log(np.abs(proposed)) - np.log(distance))
        return z + proposed * direction, factor[:, 0]


def pilot_moves() -> Weighted:
    """Return moves and weights for the pilot, when nothing about the posterior is known yet."""
    return [(moves.DEMove(), 0.8), (SnookerMove(), 0.2)]


def sampling_moves(proposal: StudentProposal | None) -> Weighted:
    """Return moves and weights for the draws that count; as the pilot's without a proposal."""
    if proposal is None:
        return pilot_moves()
    return [(moves.MHMove(proposal), 0.75), (moves.DEMove(), 0.2), (SnookerMove(), 0.05)]
