"""What a record cannot tell: combinations of hysteresis parameters that stay as the prior had them.

Every Bouc-Wen fit leaves a discrepancy of a percent of the range or so, and it comes back whenever
the voltage takes the same way again: a hundred periods of one sine show one loop, not a hundred.
So each distinct stretch of the voltage counts once here, under a discrepancy of that percent, and
a combination of parameters is named when a third of its prior sd or more would be left. The
posterior itself, which trusts the noise model, may look surer.
"""

from __future__ import annotations

import numpy as np
from scipy import linalg

from bwbayes.arrays import FloatArray, IntArray
from bwbayes.inference.noise import DiscrepancyNoise
from bwbayes.inference.parameters import POSITIVE, Parameter
from bwbayes.inference.pointfit import PointFit
from bwbayes.inference.posterior import Posterior
from bwbayes.model.boucwen import monotone_stretches

__all__ = ["spectrum", "undetermined"]

# Parameters that together make the loop. The others only have to be found beside them.
LOOP = ("d", "alpha", "beta", "gamma", "exponent")

# A model discrepancy that no Bouc-Wen fit of a piezo actuator is free of, part of the range.
DISCREPANCY = 0.01

# Stretches that start within this part of the voltage's range, and go the same way, are the same.
SAME_START = 0.01

# A combination is undetermined when this part of its prior sd or more is left.
LEFT_OPEN = 1 / 3


def undetermined(posterior: Posterior, point: PointFit) -> list[str]:
    """Name the combinations of loop parameters that the record does not determine.

    ``alpha with beta`` means that both may grow together, ``alpha against beta`` that one grows
    while the other falls.
    """
    names = [posterior.names[i] for i in _columns(posterior, LOOP)]
    if not names:
        return []
    parts, directions = spectrum(posterior, point)
    return [_combination(d, names) for d in directions.T[parts > LEFT_OPEN]]


def spectrum(posterior: Posterior, point: PointFit) -> tuple[FloatArray, FloatArray]:
    """Return the part of the prior sd that is left along each principal direction of the loop.

    The parts (loop parameters,), the largest first, and the directions as columns, in units of
    each parameter's prior sd: relative to its value for a positive one, to β for γ.
    """
    columns = _columns(posterior, posterior.actuator.parameters)
    slopes = _slopes(posterior, point.mode, columns)
    left = linalg.inv(np.eye(len(columns)) + _information(posterior, point, slopes))
    loop = [i for i, column in enumerate(columns) if posterior.names[column] in LOOP]
    variance, directions = linalg.eigh(left[np.ix_(loop, loop)])
    return np.sqrt(variance[::-1]), directions[:, ::-1]


def _columns(posterior: Posterior, names: tuple[str, ...]) -> list[int]:
    return [i for i, name in enumerate(posterior.names) if name in names]


def _slopes(posterior: Posterior, mode: FloatArray, columns: list[int]) -> FloatArray:
    """Change of the displacement per prior sd of each parameter, (physical, samples), um."""
    free, _ = posterior.prior.constrain(mode[np.newaxis])
    theta = posterior.prior.theta(free)[0]
    values = dict(zip(posterior.prior.names, theta, strict=True))
    scale = [_prior_sd(posterior.prior.free[column], values) for column in columns]
    step = 1e-5
    steps = np.zeros((len(columns), free.shape[1]))
    steps[np.arange(len(columns)), columns] = step * np.array(scale)
    plus, minus = np.split(
        posterior.simulate(posterior.prior.theta(np.concatenate([free + steps, free - steps]))), 2
    )
    slopes: FloatArray = (plus - minus) / (2 * step)
    return slopes


def _prior_sd(parameter: Parameter, values: dict[str, float]) -> float:
    """Return a parameter's prior sd around its value in ``values``."""
    assert parameter.prior is not None
    if parameter.name == "gamma":
        # What |γ| ≤ β leaves to a parameter of which nothing else is known.
        return values["beta"] / float(np.sqrt(3))
    # Half of the central 68 % stands for the sd: some distributions have none.
    low, high = (float(v) for v in parameter.prior.frozen.ppf([0.16, 0.84]))
    if parameter.name in POSITIVE:
        return float(values[parameter.name] * np.log(high / low) / 2)
    return (high - low) / 2


def _information(posterior: Posterior, point: PointFit, slopes: FloatArray) -> FloatArray:
    """Fisher information (physical, physical), each distinct stretch counted once."""
    windows = posterior.training
    rows = np.concatenate([np.arange(w.start, w.stop) for w in windows])
    theta = posterior.prior.theta(posterior.prior.constrain(point.mode[np.newaxis])[0])
    sds = posterior.noise.marginal_sd(theta[:, len(posterior.actuator.parameters) :])
    floor = DISCREPANCY * float(np.ptp(posterior.readings.values))
    weights, duration = _stretches(posterior.voltage, rows)
    # A discrepancy that belongs to the path changes over about half a stretch.
    noise = DiscrepancyNoise(1.0)
    values = np.array([[sds[1][0], floor, duration / 2]])
    total = np.zeros((slopes.shape[0], slopes.shape[0]))
    for window in windows:
        (white,), _ = noise.whiten(values, slopes[np.newaxis, :, window])
        total += (white * weights[window]) @ white.T
    return total


def _stretches(voltage: FloatArray, rows: IntArray) -> tuple[FloatArray, float]:
    """Weight of each sample, one over how often ``rows`` have its stretch; mean samples a stretch.

    A stretch that ends early, as a record's last one, counts as a part.
    """
    stretches = list(monotone_stretches(voltage))
    starts = np.array([[voltage[s.first], s.direction] for s in stretches])
    starts[:, 0] = np.round((starts[:, 0] - voltage.min()) / (SAME_START * np.ptp(voltage) or 1))
    _, kind = np.unique(starts, axis=0, return_inverse=True)
    used = np.bincount(rows, minlength=voltage.size)
    samples = np.array([np.sum(used[s.first + 1 : s.last + 1]) for s in stretches])
    longest = np.zeros(kind.max() + 1)
    np.maximum.at(longest, kind, samples)
    part = np.maximum(longest, 1) / np.maximum(np.bincount(kind, samples), 1)
    weights = np.empty(voltage.size)
    for stretch, weight in zip(stretches, part[kind], strict=True):
        weights[stretch.first : stretch.last + 1] = weight
    return weights, voltage.size / len(stretches)


def _combination(move: FloatArray, names: list[str]) -> str:
    move = move / move[np.argmax(np.abs(move))]
    order = np.argsort(-np.abs(move), kind="stable")
    first, *others = [i for i in order if abs(move[i]) > 0.2]
    parts = [f"{'with' if move[i] > 0 else 'against'} {names[i]}" for i in others]
    return " ".join([names[first], *parts])
