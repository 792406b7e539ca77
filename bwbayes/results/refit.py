"""Whether a fit depends on the start of its record: a second point fit without it tells.

A switch-on transient, or a first part that belongs to something else, can drag the parameters far
away while the noise model covers what is then missed everywhere, so that neither bands nor
innovations show it. Parameters that many readings tell do not move by many standard deviations
when the first fifth of the readings is left out. Where they do, the fit belongs to the start.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from bwbayes.arrays import FloatArray
from bwbayes.errors import InputError
from bwbayes.inference import pointfit
from bwbayes.inference.posterior import Posterior

__all__ = ["Moved", "without_start"]

# Part of the readings that is left out.
PART = 0.2

# A parameter has moved when it is off by so many sds of both fits together. Independent errors
# are off by as much once in a million; those of nested fits are less apart.
MOVED = 5.0

# Log density, nats, that the draws must lack on the rest of the readings; draws compared. The best
# of a hundred draws of a good fit lacks one to three: draws in ten dimensions miss any optimum. In
# 221 good runs it lacked more than this, with a parameter moved, once; eight would miss transients.
WORSE = 5.0
COMPARED = 100

# Where the readings themselves show a switch-on transient, less evidence is enough: both would have
# to be wrong.
SEEN_MOVED, SEEN_WORSE = 1.5, 3.0

# Draws of the Gaussian approximation.
DRAWS = 400

# Fewer readings than this tell too little without their first part.
FEWEST = 200


@dataclass(frozen=True)
class Moved:
    """The parameter that moves most when a record's start is left out.

    ``until`` in s is where the start ends; ``whole`` and ``rest`` are mean and sd with it and
    without it.
    """

    name: str
    unit: str
    until: float
    whole: tuple[float, float]
    rest: tuple[float, float]


def without_start(
    posterior: Posterior,
    draws: FloatArray,
    generator: np.random.Generator,
    begin: float = 0.0,
    *,
    record: str | None = None,
    seen: bool = False,
) -> Moved | None:
    """Fit again without a record's first readings; return the parameter that moves most, if any.

    Parameters
    ----------
    posterior
        The posterior that was sampled.
    draws
        (draws, free), parameters in their own units.
    generator
        Starts the point fit and draws from its approximation.
    begin
        Time of the record's first sample, s.
    record
        Its name; may be left out if there is one alone.
    seen
        The readings show a switch-on transient.
    """
    name = posterior.only.name if record is None else record
    one = posterior.alone(name).only
    rows = one.readings.rows
    if rows.size < FEWEST:
        return None
    first = int(rows[round(PART * rows.size)])
    later = [slice(max(w.start, first), w.stop) for w in one.training if w.stop > first]
    cut = replace(one, training=tuple(later))
    rest = replace(
        posterior, datasets=tuple(cut if o.name == name else o for o in posterior.datasets)
    )
    try:
        point = pointfit.fit(rest, generator)
    except InputError:
        return None
    # Only where the rest is told far worse by what was sampled: else it has two optima.
    sampled = rest.log_density(posterior.prior.unconstrain(draws[:COMPARED]))
    if point.log_density - float(np.max(sampled)) <= (SEEN_WORSE if seen else WORSE):
        return None
    coordinates = generator.multivariate_normal(point.mode, point.covariance, size=DRAWS)
    free, density = posterior.prior.constrain(coordinates)
    free = free[np.isfinite(density)]
    physical = [
        i
        for i, p in enumerate(posterior.prior.free)
        if p.plain in one.actuator.parameters and p.plain not in one.table.of_scope("record")
    ]
    if not physical or len(free) < DRAWS // 4:
        return None
    (mean, sd), (other, its_sd) = (_middle(some[:, physical]) for some in (draws, free))
    moved = np.abs(other - mean) / np.sqrt(sd**2 + its_sd**2 + np.finfo(float).tiny)
    worst = int(np.argmax(moved))
    if moved[worst] <= (SEEN_MOVED if seen else MOVED):
        return None
    parameter = posterior.prior.free[physical[worst]]
    until = begin + one.actuator.interval * first
    whole = float(mean[worst]), float(sd[worst])
    return Moved(
        parameter.name, parameter.unit, until, whole, (float(other[worst]), float(its_sd[worst]))
    )


def _middle(draws: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Median and half the width of the middle 68 % of draws (draws, parameters)."""
    low, middle, high = np.quantile(draws, [0.16, 0.5, 0.84], axis=0)
    return middle, (high - low) / 2
