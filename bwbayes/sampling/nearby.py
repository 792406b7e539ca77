"""Steps from where a walker is, as wide as a proposal is there.

A proposal that was fitted to few draws covers little of a long, curved posterior in many
dimensions: walkers take one in twenty of its places, or fewer, and draws that hardly move give no
better fit. A :class:`Nearby` step goes a part of the way to such a place. It is taken far more
often, and follows the proposal's own bends and widths, where differential evolution would go
straight. So walkers spread over the posterior while it is still being learned.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from bwbayes.arrays import FloatArray, IntArray
from bwbayes.sampling.proposals import StudentMixture

__all__ = ["Nearby"]

# The shortest step, as a part of one that forgets where it started.
SHORTEST = 0.2


@dataclass(frozen=True)
class Nearby:
    """An autoregressive step within a component of a mixture q, in its straight coordinates.

    From z, with a component j drawn with the probability that z is its, its ν, μ and L, and p
    coordinates,

        z' = μ + √(1 − β²) (z − μ) + β √λ L ξ,   λ = (ν + |L⁻¹(z − μ)|²) / χ²(ν + p),

    ξ normal and log β uniform from log 0.2 to 0. Given j and λ, which are drawn from what z tells
    of them, the step leaves a normal distribution as it is, there and back alike; so the mixture
    is left as it is, and the log factor is that of an independent place, log q(x) − log q(x').

    Notes
    -----
    For one component: K. Kamatani, Efficient strategy for the Markov chain Monte Carlo in
    high-dimension with heavy-tailed target probability distribution, Bernoulli 24 (2018) 3711-3750.
    """

    mixture: StudentMixture

    def __call__(
        self, coordinates: FloatArray, random: np.random.RandomState
    ) -> tuple[FloatArray, FloatArray]:
        """Propose, as ``emcee.moves.MHMove`` asks: places and log q(old) − log q(new)."""
        count, free = coordinates.shape
        bend, components = self.mixture.bend, self.mixture.components
        z = coordinates if bend is None else bend.to_straight(coordinates)
        whose = self._drawn(z, random)
        squares = np.stack([component.squares(z) for component in components])[
            whose, np.arange(count)
        ]
        freedom = components[0].freedom
        spread = np.sqrt((freedom + squares) / random.chisquare(freedom + free, count))
        beta = SHORTEST ** random.random_sample(count)
        normal = random.standard_normal((count, free)) * (beta * spread)[:, np.newaxis]
        retained = np.sqrt(1 - beta**2)[:, np.newaxis]
        near = np.empty_like(z)
        for j, component in enumerate(components):
            rows = whose == j
            near[rows] = component.center + retained[rows] * (z[rows] - component.center)
            near[rows] += normal[rows] @ component.factor.T
        proposed = near if bend is None else bend.to_curved(near)
        old, new = np.split(self.mixture.log_density(np.concatenate([coordinates, proposed])), 2)
        return proposed, old - new

    def _drawn(self, z: FloatArray, random: np.random.RandomState) -> IntArray:
        """Draw the component (count,) that each of z (count, free) may be of."""
        parts = np.stack([component.log_density(z) for component in self.mixture.components])
        logs = np.log(self.mixture.weights)[:, np.newaxis] + parts
        ends = np.cumsum(np.exp(logs - np.max(logs, axis=0)), axis=0)
        drawn: IntArray = np.sum(random.random_sample(len(z)) * ends[-1] >= ends, axis=0)
        return drawn
