"""Whether a fit has swallowed a drift of its record's readings.

A hysteresis whose memory hardly fades can follow readings that drift all along, and leaves
residuals in which nothing drifts. So the drift is taken off the readings, as regression on voltage
and time tells it, and the rest is fitted by itself: where that is far more probable, with another
parameter, the fit belongs to the drift.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from bwbayes.arrays import FloatArray
from bwbayes.errors import InputError
from bwbayes.inference import pointfit
from bwbayes.inference.posterior import Dataset, Posterior
from bwbayes.results.moved import Moved, moved

__all__ = ["Drift", "drifted"]

# A drift smaller than this part of the readings' range is left to the discrepancy.
SMALLEST = 0.05

# Log density, nats, that readings without the drift must add, and sds by which a parameter moves.
ADDED, MOVED = 9.0, 3.0

# Draws of the posterior, and of the Gaussian approximation without the drift, that are compared.
COMPARED, DRAWS = 1000, 400


@dataclass(frozen=True)
class Drift:
    """A drift of the readings that were fitted, and the parameter that moves most without it.

    ``size`` in um from the first reading to the last; without it the log density is higher by
    ``nats``.
    """

    size: float
    nats: float
    parameter: Moved

    @property
    def line(self) -> str:
        """What it is, and what it has done, in one line."""
        return (
            f"a drift of {self.size:.3g} um explains its readings better, by {self.nats:.3g} nats; "
            f"without it {self.parameter.line}"
        )


def drifted(
    posterior: Posterior,
    draws: FloatArray,
    generator: np.random.Generator,
    *,
    record: str | None = None,
) -> Drift | None:
    """Return the drift that a fit has swallowed, if any.

    Parameters
    ----------
    posterior
        The posterior that was sampled.
    draws
        (draws, free), parameters in their own units.
    generator
        Starts the point fit without the drift, and draws from its approximation.
    record
        Its name; may be left out if there is one alone.
    """
    name = posterior.only.name if record is None else record
    one = posterior.alone(name).only
    trend = _trend(one)
    if trend is None:
        return None
    readings = {other.name: other.displacement for other in posterior.datasets}
    without = posterior.with_readings(readings | {name: one.displacement - trend})
    try:
        point = pointfit.fit(without, generator)
    except InputError:
        return None
    plain = posterior.log_density(posterior.prior.unconstrain(draws[:COMPARED]))
    nats = point.log_density - float(np.max(plain))
    if nats <= ADDED:
        return None
    _, places = pointfit.approximated(without, point, generator, DRAWS)
    most = moved(posterior, one, draws, places)
    if most is None or most.sds <= MOVED:
        return None
    return Drift(float(trend[-1]), nats, most)


def _trend(one: Dataset) -> FloatArray | None:
    """Return the drift (samples,), um, that regression on voltage and time tells, if it is large.

    Beside the voltage there is its rate, for a lag and a loop shift the readings against it.
    """
    rows = one.readings.rows
    first, last = int(rows[0]), int(rows[-1])
    if rows.size < 8 or first == last:
        return None
    place = np.clip((np.arange(one.displacement.size) - first) / (last - first), 0.0, 1.0)
    columns = np.ones_like(place), place, one.voltage, np.gradient(one.voltage)
    matrix = np.stack(columns, axis=1)[rows]
    weights, *_ = np.linalg.lstsq(matrix, one.displacement[rows], rcond=None)
    if abs(weights[1]) <= SMALLEST * float(np.ptp(one.displacement[rows])):
        return None
    trend: FloatArray = weights[1] * place
    return trend
