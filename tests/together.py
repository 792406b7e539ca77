"""Calibrations: a test of all parameters together, one of the bands, and defects to plant.

Ranks of a replicate's whitened coordinates are nearly independent, so that replicates tell as much
as many more of a single parameter would. Its errors come from the spread between replicates.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy import linalg, stats

from bwbayes.app.running.workers import one_thread
from bwbayes.arrays import FloatArray
from bwbayes.calibration.calibration import CalibrationSetup, Replicate, replicate
from bwbayes.inference.noise import DiscrepancyNoise
from bwbayes.inference.parameters import JointPrior

# Level at which the test is used.
LEVEL = 0.01

SEED = 1

Plant = Callable[[FloatArray], FloatArray]


def made(common: CalibrationSetup, count: int, seed: int = SEED) -> list[Replicate]:
    with one_thread():
        return [replicate(common, seed, number) for number in range(count)]


@dataclass(frozen=True)
class WrongCorrelation(DiscrepancyNoise):
    """Noise that takes readings to be so many times as far apart as they are."""

    apart: float = 1.0

    def transition(self, theta: FloatArray, readings: float | FloatArray = 1.0) -> FloatArray:
        """Return that of more readings."""
        return super().transition(theta, self.apart * np.asarray(readings))

    def process_covariance(self, theta: FloatArray, readings: float = 1.0) -> FloatArray:
        """Return that of more readings."""
        return super().process_covariance(theta, self.apart * readings)


def nothing(draws: FloatArray) -> FloatArray:
    return draws


def narrowed(draws: FloatArray, by: float = 0.2) -> FloatArray:
    """Make the sds of draws (draws, free) smaller by a part."""
    middle = np.mean(draws, axis=0)
    return middle + (1 - by) * (draws - middle)


def shifted(draws: FloatArray, sds: float = 0.3) -> FloatArray:
    return draws + sds * np.std(draws, axis=0)


def whitened_positions(result: Replicate, prior: JointPrior, plant: Plant) -> FloatArray:
    """Where the truth lies among the draws, along each whitened coordinate: (free,) in (0, 1).

    The axes are those of the covariance of truth and draws together, by its symmetric root, so
    that they do not tell one from the other, and a bias of one sign keeps it.
    """
    free = prior.dimensions
    draws = plant(prior.unconstrain(result.draws[:, :free]))
    truth = np.array([[*result.entry["truth"].values()][:free]])
    both = np.concatenate([prior.unconstrain(truth), draws])
    both = (both - np.mean(both, axis=0)) / np.std(both, axis=0)
    variances, axes = linalg.eigh(np.atleast_2d(np.corrcoef(both.T)))
    white = both @ (axes / np.sqrt(variances)) @ axes.T
    jitter = np.random.default_rng([SEED, result.entry["number"]]).uniform(size=free)
    positions: FloatArray = (np.sum(white[1:] < white[0], axis=0) + jitter) / len(both)
    return positions


def together_test(result: list[Replicate], prior: JointPrior, plant: Plant = nothing) -> float:
    """P-value of the smooth test of all parameters together.

    A replicate gives the means of b₁ and b₂ over its whitened coordinates; Hotelling's test asks
    whether both means over replicates are zero, with the covariance that replicates show.
    """
    u = np.stack([whitened_positions(one, prior, plant) for one in result])
    b = np.stack([np.sqrt(3) * (2 * u - 1), np.sqrt(5) * (6 * u**2 - 6 * u + 1)], axis=-1)
    each = np.mean(b, axis=1)
    count = len(result)
    mean = np.mean(each, axis=0)
    squared = count * mean @ linalg.solve(np.cov(each.T), mean)
    return float(stats.f.sf(squared * (count - 2) / (2 * (count - 1)), 2, count - 2))


def errors_off(results: list[Replicate]) -> dict[str, float]:
    """How far each band's mean coverage is off, in standard errors between replicates."""
    bands = [result.entry["covered"] for result in results if result.entry["covered"]]
    off = {}
    for name in bands[0]:
        covered = np.array([covered[name] for covered in bands])
        error = np.std(covered, ddof=1) / np.sqrt(covered.size)
        off[name] = float((np.mean(covered) - int(name.split()[-1]) / 100) / error)
    return off
