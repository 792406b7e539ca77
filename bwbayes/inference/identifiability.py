"""What a record cannot tell: combinations of parameters that stay as the prior had them.

Every Bouc-Wen fit leaves a discrepancy of a percent of the range or so, and it comes back whenever
the voltage takes the same way again: a hundred periods of one sine show one loop, not a hundred.
So each distinct stretch of the voltage counts once here, under a discrepancy of at least that
percent, and a combination of parameters is named when its sd would be nearly half
of what the prior had. The posterior itself, which trusts the noise model, may look surer.
"""

from __future__ import annotations

import numpy as np
from scipy import linalg

from bwbayes.arrays import FloatArray
from bwbayes.inference.noise import DiscrepancyNoise
from bwbayes.inference.pointfit import PointFit
from bwbayes.inference.posterior import Posterior
from bwbayes.model.boucwen import monotone_stretches

__all__ = ["undetermined"]

# A model discrepancy that no Bouc-Wen fit of a piezo actuator is free of, part of the range.
DISCREPANCY = 0.01

# Stretches whose ends agree within this part of the voltage's range are the same.
SAME_STRETCH = 0.01

# A combination is undetermined when this part of its prior sd or more is left.
LEFT_OPEN = 0.45


def undetermined(posterior: Posterior, point: PointFit) -> list[str]:
    """Name the combinations of physical parameters that the record does not determine.

    The information of the training windows on the model's parameters is compared with the prior's,
    both in unconstrained coordinates around the mode. ``alpha with beta`` means that both may grow
    together, ``alpha against beta`` that one grows while the other falls.
    """
    names = [posterior.names[i] for i in _physical(posterior)]
    if not names:
        return []
    parts, directions = spectrum(posterior, point)
    left_open = directions.T[parts > LEFT_OPEN]
    return [_combination(direction, names) for direction in left_open]


def spectrum(posterior: Posterior, point: PointFit) -> tuple[FloatArray, FloatArray]:
    """Return the part of the prior sd that is left along each principal direction.

    The parts (physical,), the largest first, and the directions as columns (physical, physical),
    in unconstrained coordinates over their prior sd.
    """
    columns = _physical(posterior)
    prior = point.prior_covariance[np.ix_(columns, columns)]
    scale = np.sqrt(np.diag(prior))
    slopes = _slopes(posterior, point.mode, columns, scale)
    gain, directions = linalg.eigh(
        _information(posterior, point, slopes), linalg.inv(prior / np.outer(scale, scale))
    )
    return 1 / np.sqrt(1 + np.maximum(gain, 0)), directions


def _physical(posterior: Posterior) -> list[int]:
    return [i for i, n in enumerate(posterior.names) if n in posterior.actuator.parameters]


def _slopes(
    posterior: Posterior, mode: FloatArray, columns: list[int], scale: FloatArray
) -> FloatArray:
    """Change of the displacement per prior sd of each coordinate, (physical, samples), um."""
    step = 1e-4
    steps = np.zeros((len(columns), mode.size))
    steps[np.arange(len(columns)), columns] = step * scale
    free, _ = posterior.prior.constrain(np.concatenate([mode + steps, mode - steps]))
    plus, minus = np.split(posterior.simulate(posterior.prior.theta(free)), 2)
    slopes: FloatArray = (plus - minus) / (2 * step)
    return slopes


def _information(posterior: Posterior, point: PointFit, slopes: FloatArray) -> FloatArray:
    """Fisher information (physical, physical), each distinct stretch counted once."""
    windows = posterior.training
    rows = np.concatenate([np.arange(w.start, w.stop) for w in windows])
    theta = posterior.prior.theta(posterior.prior.constrain(point.mode[np.newaxis])[0])
    sds = posterior.noise.marginal_sd(theta[:, len(posterior.actuator.parameters) :])
    floor = DISCREPANCY * float(np.ptp(posterior.displacement[rows]))
    weights, duration = _stretches(posterior.voltage)
    # A discrepancy that belongs to the path changes over about half a stretch.
    noise = DiscrepancyNoise(1.0)
    values = np.array([[sds[1][0], max(sds[0][0], floor), duration / 2]])
    total = np.zeros((slopes.shape[0], slopes.shape[0]))
    for window in windows:
        white = noise.whiten(values, slopes[:, window])
        total += (white * weights[window]) @ white.T
    return total


def _stretches(voltage: FloatArray) -> tuple[FloatArray, float]:
    """Weight of each sample, one over how often its stretch occurs; mean samples a stretch."""
    stretches = list(monotone_stretches(voltage))
    ends = np.array([[voltage[s.first], voltage[s.last]] for s in stretches])
    grid = np.round((ends - voltage.min()) / (SAME_STRETCH * max(np.ptp(voltage), 1e-300)))
    _, kind, count = np.unique(grid, axis=0, return_inverse=True, return_counts=True)
    weights = np.empty(voltage.size)
    for stretch, times in zip(stretches, count[kind], strict=True):
        weights[stretch.first : stretch.last + 1] = 1 / times
    return weights, voltage.size / len(stretches)


def _combination(move: FloatArray, names: list[str]) -> str:
    move = move / move[np.argmax(np.abs(move))]
    order = np.argsort(-np.abs(move), kind="stable")
    first, *others = [i for i in order if abs(move[i]) > 0.2]
    parts = [f"{'with' if move[i] > 0 else 'against'} {names[i]}" for i in others]
    return " ".join([names[first], *parts])
