"""What the noise on a voltage's reading leaves unsure of the parameters.

The model is driven by an estimated path (:mod:`bwbayes.record.voltage_path`), and a posterior given
this path does not know that it is an estimate. How far the estimate is off is seen where it is made
again: of the path with new noise on it. Each such path moves the posterior's mode by one Newton
step, and the mean square of these steps adds to the posterior's covariance.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from bwbayes.arrays import FloatArray
from bwbayes.inference.map_estimate import PointFit
from bwbayes.inference.posterior import Posterior
from bwbayes.record.voltage_path import VoltagePath
from bwbayes.watching import Watch, unwatched, watched

COPIES = 16


def path_covariance(
    posterior: Posterior,
    paths: Mapping[str, VoltagePath],
    point: PointFit,
    generator: np.random.Generator,
    watch: Watch = unwatched,
) -> FloatArray:
    """Return the mean square (free, free) of what paths made again move the mode by.

    With C the posterior's covariance at the mode and ℓₖ its log density along path k, in
    unconstrained coordinates: mean of sₖ sₖᵀ, sₖ = C (∇ℓₖ − ∇ℓ), of the actuator's parameters. The
    ``paths`` are those of the records by name; ``watch`` is called with the share that is done.
    """
    physical = np.array([name in posterior.table.physical for name in posterior.names])

    def slopes(along: Posterior) -> FloatArray:
        sds = np.sqrt(np.diag(point.covariance))
        away = 1e-2 * np.diag(sds)
        sides = along.log_density(np.concatenate([point.mode + away, point.mode - away]))
        upper, lower = np.split(sides, 2)
        return np.where(physical, (upper - lower) / (2e-2 * sds), 0.0)

    here, steps = slopes(posterior), []
    for _ in watched(range(COPIES), watch):
        datasets = tuple(
            replace(dataset, voltage=paths[dataset.name].redrawn(generator))
            for dataset in posterior.datasets
        )
        steps.append(point.covariance @ (slopes(replace(posterior, datasets=datasets)) - here))
    moved = np.where(physical, steps, 0.0)
    return moved.T @ moved / COPIES


def widened(coordinates: FloatArray, covariance: FloatArray, more: FloatArray) -> FloatArray:
    """Return draws (..., free) of a posterior of a ``covariance`` C that has ``more`` now: C + M.

    Each moves linearly away from their mean, by L(C + M) L(C)⁻¹ with Cholesky's factors L, so that
    a chain stays one.
    """
    factor, wide = np.linalg.cholesky(covariance), np.linalg.cholesky(covariance + more)
    center = np.mean(coordinates.reshape(-1, coordinates.shape[-1]), axis=0)
    moved: FloatArray = center + (coordinates - center) @ np.linalg.solve(factor.T, wide.T)
    return moved
