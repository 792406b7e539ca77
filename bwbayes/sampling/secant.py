"""Coordinates that a record determines: a model's mean slope and its mean level.

Readings that do not determine the hysteresis still determine the amplitude and the center of the
motion: d less the slope of the hysteresis, the offset less its mean. With β far above 1/U that
slope is zero, with β far below it is α: so the posterior has legs along d, α, β and h₀, each a
thousand times as long as wide and around a corner from the next. With slope and level in place of d
and the offset, all other parameters are as free as the prior leaves them, and no leg has a corner.
A :class:`SecantMap` takes slope and level from a model's displacement, which costs a simulation for
each place. Any levels do that follow the record's: those of a long record are a thinned one's.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from bwbayes.arrays import FloatArray
from bwbayes.inference.parameters import JointPrior
from bwbayes.inference.thinning import thin_posterior

if TYPE_CHECKING:
    from bwbayes.inference.posterior import Posterior

# Parameters that the displacement of every operator with a gain is linear in.
LINEAR = "d", "offset"


@dataclass(frozen=True)
class SecantMap:
    """The map between coordinates x of the prior and those with secant gain and level, y.

    With the free parameters θ, the set L of those that are :data:`LINEAR`, and the displacement
    w(θ) at the readings,

        t = θ_L + B⁺ (w(θ with θ_L = c) − w₀),   B = ∂w/∂θ_L,

    with c, B and w₀ of the reference. y_L is t in the units of x there; other coordinates are
    scores of θ under its prior, without the bounds by other parameters on those measured in um. t
    minus θ_L depends on the other parameters alone: so this map keeps volumes, as far as priors do.

    Parameters
    ----------
    reference
        The coordinates of a place in the posterior, (free,).
    posterior
        The sampled posterior. A map from a file has none, and cannot map until it is given one.
    """

    reference: FloatArray
    posterior: Posterior | None = None

    def forward(self, bent: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return y (..., free) of x (..., free), and log |∂y/∂x| (...)."""
        x = bent.reshape(-1, bent.shape[-1])
        free, log_prior = self._prior.constrain(x)
        whitened = self._unbound.unconstrain(free)
        log_slope = log_prior - self._unbound.constrain(whitened)[1]
        log_slope += self._log_stretch(free, whitened)
        moved = free[:, self._rows] - self._center[self._rows] + self._levels(free)
        whitened[:, self._rows] = self.reference[self._rows] + moved / self._scale
        return whitened.reshape(bent.shape), log_slope.reshape(bent.shape[:-1])

    def inverse(self, whitened: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return x (..., free) of y (..., free), and log |∂x/∂y| (...).

        x is nan where no model exists, for instance with d below α.
        """
        y = whitened.reshape(-1, whitened.shape[-1]).copy()
        moved = (y[:, self._rows] - self.reference[self._rows]) * self._scale
        y[:, self._rows] = self.reference[self._rows]
        free = self._unbound.constrain(y)[0]
        free[:, self._rows] = self._center[self._rows] + moved - self._levels(free)
        impossible = ~np.isfinite(self._prior.log_density(free))
        free[impossible] = self._center
        x = self._prior.unconstrain(free)
        scores = self._unbound.unconstrain(free)
        log_slope = self._unbound.constrain(scores)[1] - self._prior.constrain(x)[1]
        log_slope -= self._log_stretch(free, scores)
        x[impossible] = np.nan
        return x.reshape(whitened.shape), log_slope.reshape(whitened.shape[:-1])

    @property
    def _known(self) -> Posterior:
        assert self.posterior is not None
        return self.posterior

    @property
    def _prior(self) -> JointPrior:
        return self._known.prior

    @cached_property
    def _rows(self) -> list[int]:
        """Indices of the free parameters that are linear."""
        return linear(self._known)

    @cached_property
    def _unbound(self) -> JointPrior:
        """The prior without bounds by other parameters on those measured in um."""
        return JointPrior(
            replace(p, declared=replace(p.declared, bounds=None)) if p.unit[:2] == "um" else p
            for p in self._prior.parameters
        )

    @cached_property
    def _center(self) -> FloatArray:
        """The free parameters (free,) at the reference."""
        center: FloatArray = self._prior.constrain(self.reference[np.newaxis])[0][0]
        return center

    @cached_property
    def _readout(self) -> tuple[FloatArray, FloatArray]:
        """The derivative's pseudoinverse B⁺ (linear, readings), the displacement w₀ (readings,)."""
        steps = 0.01 * self._scale
        places = np.repeat(self._center[np.newaxis], 1 + len(steps), axis=0)
        places[1 + np.arange(len(steps)), self._rows] += steps
        at, *beside = self._displacement(places)
        return np.linalg.pinv((np.array(beside) - at).T / steps), at

    @cached_property
    def _scale(self) -> FloatArray:
        """The derivative ∂θ_L/∂x (linear,) at the reference."""
        center = self._center[np.newaxis]
        log_slopes = self._log_slopes(center, self._unbound.unconstrain(center))
        scale: FloatArray = np.exp(log_slopes[0])
        return scale

    def _log_slopes(self, free: FloatArray, scores: FloatArray) -> FloatArray:
        """Return log ∂θ_L/∂x_L (models, linear) of free parameters and their scores."""
        densities = [
            self._prior.free[row].distribution.frozen.logpdf(free[:, row]) for row in self._rows
        ]
        log_normal = -0.5 * (scores[:, self._rows] ** 2 + np.log(2 * np.pi))
        slopes: FloatArray = log_normal - np.stack(densities, axis=1)
        return slopes

    def _log_stretch(self, free: FloatArray, scores: FloatArray) -> FloatArray:
        """Return log |∂y_L/∂x_L| (models,)."""
        log_slopes = self._log_slopes(free, scores) - np.log(self._scale)
        stretch: FloatArray = np.sum(log_slopes, axis=1)
        return stretch

    def _levels(self, free: FloatArray) -> FloatArray:
        """Return B⁺ (w − w₀) (models, linear) of free parameters, with the linear ones at c."""
        places = free.copy()
        places[:, self._rows] = self._center[self._rows]
        inverse, at = self._readout
        size = max(1, (1 << 22) // len(at))  # displacements take memory
        parts = [
            (self._displacement(places[i : i + size]) - at) @ inverse.T
            for i in range(0, len(places), size)
        ]
        return np.concatenate(parts)

    @cached_property
    def _thinned(self) -> Posterior:
        """The posterior whose displacement tells slope and level."""
        at_reference = self._prior.theta(self._center[np.newaxis])
        return thin_posterior(self._known, at_reference, samples=10_000)

    def _displacement(self, free: FloatArray) -> FloatArray:
        return self._thinned.displacement(self._prior.theta(free), np.zeros(len(free)))


def linear(posterior: Posterior) -> list[int]:
    """Return the indices of linear free parameters; none if the actuator has further stages."""
    rows = [row for row, p in enumerate(posterior.prior.free) if p.plain in LINEAR]
    if rows and any(dataset.actuator.stages for dataset in posterior.datasets):
        return []
    return rows
