"""Uncertainty of the parameters from noise on the voltage's readings.

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
from bwbayes.inference.map_estimate import MAPEstimate
from bwbayes.inference.mode_finding import value_and_jacobian
from bwbayes.inference.posterior import Posterior
from bwbayes.record.voltage_path import VoltagePath
from bwbayes.watching import Watch, unwatched, watched

COPIES = 16


def path_covariance(
    posterior: Posterior,
    paths: Mapping[str, VoltagePath],
    point: MAPEstimate,
    generator: np.random.Generator,
    watch: Watch = unwatched,
) -> FloatArray:
    """Return the mean square (free, free) of what paths made again move the mode by.

    With C the posterior's covariance at the mode and ℓₖ its log density along path k, in
    unconstrained coordinates: mean of sₖ sₖᵀ, sₖ = C (∇ℓₖ − ∇ℓ), of the actuator's parameters. The
    ``paths`` are those of the records by name; ``watch`` is called with the share that is done.
    """
    physical = np.flatnonzero([name in posterior.table.physical for name in posterior.names])

    def gradient(along: Posterior) -> FloatArray:
        (slopes,) = value_and_jacobian(along.log_density, point.mode[np.newaxis], physical)[1]
        return np.asarray(slopes)

    here, steps = gradient(posterior), []
    for _ in watched(range(COPIES), watch):
        datasets = tuple(
            replace(
                dataset,
                inputs=replace(dataset.inputs, voltage=paths[dataset.name].redrawn(generator)),
            )
            for dataset in posterior.datasets
        )
        change = gradient(replace(posterior, datasets=datasets)) - here
        steps.append(point.covariance[np.ix_(physical, physical)] @ change)
    added = np.zeros_like(point.covariance)
    added[np.ix_(physical, physical)] = np.transpose(steps) @ np.stack(steps) / COPIES
    return added


def widen_draws(coordinates: FloatArray, covariance: FloatArray, more: FloatArray) -> FloatArray:
    """Return draws (..., free) of a posterior of a ``covariance`` C that has ``more`` now: C + M.

    Each moves linearly away from their mean, by L(C + M) L(C)⁻¹ with Cholesky's factors L, so that
    a chain stays one.
    """
    factor, wide = np.linalg.cholesky(covariance), np.linalg.cholesky(covariance + more)
    center = np.mean(coordinates.reshape(-1, coordinates.shape[-1]), axis=0)
    moved: FloatArray = center + (coordinates - center) @ np.linalg.solve(factor.T, wide.T)
    return moved
