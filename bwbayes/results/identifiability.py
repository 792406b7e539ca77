"""What a record cannot tell: combinations of hysteresis parameters that stay as the prior had them.

Every Bouc-Wen fit leaves a discrepancy of a percent of the range or so, and it comes back whenever
the voltage takes the same way again: a hundred periods of one sine show one loop, not a hundred.
So each distinct stretch of the voltage counts once here, under a discrepancy of that percent, and
a combination of parameters is named when a third of its prior sd or more would be left. The
posterior itself, which trusts the noise model, may look surer.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
from scipy import linalg

from bwbayes.arrays import FloatArray, IntArray
from bwbayes.diagnosis.finding import Finding
from bwbayes.inference.parameters import JointPrior, Parameter
from bwbayes.inference.pointfit import PointFit
from bwbayes.inference.posterior import Dataset, Posterior
from bwbayes.inference.rough import DiscrepancyNoise
from bwbayes.model.drive import monotone_stretches, turning_points
from bwbayes.sampling.diagnostics import pareto_k

__all__ = [
    "LEFT_OPEN",
    "Sway",
    "combined",
    "percent",
    "spectrum",
    "stretches_once",
    "sway",
    "undetermined",
]

# A model discrepancy that no Bouc-Wen fit of a piezo actuator is free of, part of the range.
DISCREPANCY = 0.01

# Stretches that start within this part of the voltage's range, and go the same way, are the same.
SAME_START = 0.01

# A combination is undetermined when this part of its prior sd or more is left.
LEFT_OPEN = 1 / 3

# Members of a combination have this fraction of its largest component or more.
MEMBER = 0.2

# The prior decides where one twice as wide moves a mean by this part of its sd, or widens it so.
MOVED, WIDENED = 0.3, 1.2

# It decides, too, where the posterior is wider than this part of the prior's sd.
WIDE = 0.7

# Draws that priors are widened on, the Pareto k̂ (of weights at these draws) and the effective
# draws at which that is still believed.
DRAWS, BELIEVED_K, BELIEVED_DRAWS = 20_000, 0.7, 100

# Swings of a drive differ where the smallest of them is smaller by more than this part.
ALIKE = 0.2

# A part of its bounds' distance that is a parameter's sd where little but the bounds holds it.
ANYWHERE = 0.225

# Step of a slope, in prior sds.
STEP = 1e-5

# A loop closes where its opening is about one; below this it hardly opens.
SMALL = 0.3


class Sway(NamedTuple):
    """How far priors twice as wide move the posterior, or that this cannot be told.

    ``moved`` is the largest shift of a mean, in sds; ``widened`` the largest ratio of sds; ``name``
    the parameter that moves most; ``part`` the largest posterior sd, in prior sds. Unless ``told``,
    the draws do not reach as far as the wider prior leads.
    """

    name: str
    moved: float
    widened: float
    part: float
    told: bool

    @property
    def decides(self) -> bool:
        """Whether the prior decides."""
        return self.moved >= MOVED or self.widened >= WIDENED or self.part > WIDE


def undetermined(posterior: Posterior, point: PointFit, draws: FloatArray) -> Iterator[Finding]:
    """Yield combinations of loop parameters that the record does not determine.

    Each says how much of the prior's sd is left, what decides then, and what to measure.

    Parameters
    ----------
    posterior, point
        The posterior and its point fit.
    draws
        (draws, free), of the posterior or of its Gaussian approximation
        (:func:`bwbayes.diagnosis.conflict.around`).
    """
    names = [posterior.names[i] for i in _columns(posterior, posterior.table.loop)]
    if not names:
        return
    parts, directions = spectrum(posterior, point)
    for i in np.flatnonzero(parts > LEFT_OPEN):
        combination = combined(directions[:, i], names)
        text = f"{combination}: {percent(parts[i])} of the prior's SD remains"
        if i + 1 < parts.size:
            text += f" (next {combined(directions[:, i + 1], names)}: {percent(parts[i + 1])})"
        members = [name for name in names if name in combination.split()]
        decider = _decider(posterior.prior, draws, members)
        yield Finding("not identifiable", f"{text}; {decider}", _advice(posterior, draws, members))


def percent(left: float) -> str:
    """Write the part of a prior's sd that is left; a posterior may be wider than its prior."""
    return "all" if left >= 0.995 else f"{left:.0%}"


def sway(prior: JointPrior, draws: FloatArray, names: Sequence[str]) -> Sway:
    """Widen the priors of some parameters to twice their sd, and see how far the draws move.

    By importance: a draw counts as much more as the wider prior thinks it more probable. Widened
    are the stated priors, in their normal scores; the constraints stay.
    """
    thinned = draws[:: max(draws.shape[0] // DRAWS, 1)]
    log_weights, parts = np.zeros(thinned.shape[0]), []
    for parameter in prior.free:
        if parameter.name in names:
            assert parameter.prior is not None
            low, high = (np.asarray(end) for end in parameter.support)
            column = thinned[:, prior.free_names.index(parameter.name)]
            scores = np.clip(parameter.prior.to_normal(column, low, high), -37, 37)
            # log N(z; 0, 2²) − log N(z; 0, 1), up to a constant.
            log_weights += 0.375 * scores**2
            parts.append(float(np.std(scores)))
    weights = np.exp(log_weights - np.max(log_weights))
    weights /= np.sum(weights)
    shape = pareto_k(log_weights)
    # That k̂ belongs to the way back; see there.
    told = shape < BELIEVED_K / (1 + BELIEVED_K) and 1 / np.sum(weights**2) > BELIEVED_DRAWS
    columns = thinned[:, [prior.free_names.index(name) for name in names]]
    mean, sd = np.mean(columns, axis=0), np.std(columns, axis=0) + 1e-300
    wider = weights @ columns
    widened = np.sqrt(weights @ (columns - wider) ** 2) / sd
    moved = np.abs(wider - mean) / sd
    return Sway(
        name=names[int(np.argmax(moved))],
        moved=float(moved.max()),
        widened=float(widened.max()),
        part=max(parts, default=0.0),
        told=bool(told),
    )


def _decider(prior: JointPrior, draws: FloatArray, names: Sequence[str]) -> str:
    """Say whether the prior decides about some parameters."""
    columns = dict(zip(prior.names, prior.theta(draws).T, strict=True))
    for parameter in prior.free:
        low, high = parameter.limits(prior.seen(columns, parameter.record))
        if parameter.name not in names or not (np.isfinite(low) & np.isfinite(high)).all():
            continue
        fraction = (columns[parameter.name] - low) / (high - low)
        # What may be anything between its bounds has a sd of 0.29 of their distance.
        if np.std(fraction) > ANYWHERE:
            assert parameter.declared is not None
            return f"only {parameter.declared.stated_bounds} bounds {parameter.name}"
    swayed = sway(prior, draws, names)
    if swayed.part > WIDE:
        return f"the prior decides there: the posterior has {percent(swayed.part)} of its sd"
    if not swayed.told:
        return "these draws cannot tell whether the prior decides there"
    if swayed.decides:
        return (
            f"the prior decides there: one twice as wide moves {swayed.name} by {swayed.moved:.1f} "
            f"of its sd and makes an interval {swayed.widened:.1f} times as wide"
        )
    return (
        f"what decides there is not the prior (one twice as wide moves {swayed.name} by "
        f"{swayed.moved:.2f} of its sd, and nothing by more) but the noise model, which may be "
        "too sure"
    )


def _advice(posterior: Posterior, draws: FloatArray, names: Sequence[str]) -> str:
    """Say what to measure instead."""
    swings, half = [], 0.0
    for dataset in posterior.datasets:
        for window in dataset.training:
            voltage = dataset.voltage[window]
            half = max(half, float(np.ptp(voltage)) / 2)
            swings += np.abs(np.diff(voltage[turning_points(voltage)])).tolist()
    first = posterior.datasets[0]
    _, alone, its = next(posterior.each(draws))
    columns = first.table.columns(alone.prior.theta(its))
    opening = first.actuator.hysteresis.opening(columns, half)
    if opening is not None and float(np.median(opening)) < SMALL:
        return f"drive over more than {2 * half:.3g} V peak to peak, if the actuator allows it"
    if len(swings) < 2:
        return "drive the actuator up and down several times, with decreasing amplitude"
    if min(swings) > (1 - ALIKE) * max(swings):
        return "vary the amplitude: let it decay to a tenth over ten periods"
    if any(_bounded(posterior, name) for name in names):
        return "turn at more voltages within the range, or come closer to zero amplitude"
    return "add larger and smaller amplitudes"


def _bounded(posterior: Posterior, name: str) -> bool:
    """Tell whether other parameters bound this one on both sides."""
    theta = posterior.prior.theta(posterior.prior.constrain(np.zeros((1, len(posterior.names))))[0])
    parameter = posterior.prior.free[posterior.names.index(name)]
    columns = posterior.prior.seen(posterior.table.columns(theta), parameter.record)
    low, high = parameter.limits(columns)
    return bool(np.isfinite(low).all() and np.isfinite(high).all())


def spectrum(posterior: Posterior, point: PointFit) -> tuple[FloatArray, FloatArray]:
    """Return the part of the prior sd that is left along each principal direction of the loop.

    The parts (loop parameters,), the largest first, and the directions as columns, in units of
    each parameter's prior sd: relative to its value for a positive one, to its bounds for γ.
    """
    columns = _columns(posterior, posterior.table.physical)
    steps = _steps(posterior, point.mode, columns)
    told = sum(_information(posterior, point, dataset, steps) for dataset in posterior.datasets)
    remaining = linalg.inv(np.eye(len(columns)) + told)
    loop = [
        i for i, column in enumerate(columns) if posterior.names[column] in posterior.table.loop
    ]
    variance, directions = linalg.eigh(remaining[np.ix_(loop, loop)])
    return np.sqrt(variance[::-1]), directions[:, ::-1]


def _columns(posterior: Posterior, names: tuple[str, ...]) -> list[int]:
    return [i for i, name in enumerate(posterior.names) if name in names]


def _steps(
    posterior: Posterior, mode: FloatArray, columns: list[int]
) -> tuple[FloatArray, FloatArray]:
    """Return θ (physical, parameters) with each parameter a step above and below the mode."""
    free, _ = posterior.prior.constrain(mode[np.newaxis])
    theta = posterior.prior.theta(free)[0]
    values = dict(zip(posterior.prior.names, theta, strict=True))
    parameters = [posterior.prior.free[column] for column in columns]
    scale = [_prior_sd(posterior.prior, parameter, values) for parameter in parameters]
    steps = np.zeros((len(columns), free.shape[1]))
    steps[np.arange(len(columns)), columns] = STEP * np.array(scale)
    return posterior.prior.theta(free + steps), posterior.prior.theta(free - steps)


def _prior_sd(prior: JointPrior, parameter: Parameter, values: dict[str, float]) -> float:
    """Return a parameter's prior sd around its value in ``values``."""
    assert parameter.prior is not None
    others = {name: np.array([value]) for name, value in values.items()}
    lowest, most = parameter.limits(prior.seen(others, parameter.record))
    if np.isfinite(lowest).all() and np.isfinite(most).all():
        # What the bounds leave to a parameter of which nothing else is known.
        return float(np.max(most) - np.min(lowest)) / float(np.sqrt(12))
    # Half of the central 68 % stands for the sd: some distributions have none.
    low, high = (float(v) for v in parameter.prior.frozen.ppf([0.16, 0.84]))
    if parameter.positive:
        return float(values[parameter.name] * np.log(high / low) / 2)
    return (high - low) / 2


def _information(
    posterior: Posterior, point: PointFit, dataset: Dataset, steps: tuple[FloatArray, FloatArray]
) -> FloatArray:
    """Fisher information (physical, physical) of a record, each distinct stretch counted once."""
    rows = np.concatenate([np.arange(w.start, w.stop) for w in dataset.training])
    # Change of the displacement per prior sd of each parameter, (physical, samples), um.
    plus, minus = np.split(posterior.simulate(np.concatenate(steps), record=dataset.name), 2)
    slopes = (plus - minus) / (2 * STEP)
    theta = posterior.prior.theta(posterior.prior.constrain(point.mode[np.newaxis])[0])
    sds = dataset.noise.marginal_sd(dataset.table.noise(posterior.table.of(theta, dataset.name)))
    weights, duration = stretches_once(dataset.voltage, rows)
    # A discrepancy that belongs to the path changes over about half a stretch.
    noise = DiscrepancyNoise(1.0)
    values = np.array([[sds[1][0], DISCREPANCY * dataset.extent, duration / 2]])
    total = np.zeros((slopes.shape[0], slopes.shape[0]))
    for window in dataset.training:
        (white,), _ = noise.whiten(values, slopes[np.newaxis, :, window])
        total += (white * weights[window]) @ white.T
    return total


def stretches_once(voltage: FloatArray, rows: IntArray) -> tuple[FloatArray, float]:
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
    share = np.maximum(longest, 1) / np.maximum(np.bincount(kind, samples), 1)
    weights = np.empty(voltage.size)
    for stretch, weight in zip(stretches, share[kind], strict=True):
        weights[stretch.first : stretch.last + 1] = weight
    return weights, voltage.size / len(stretches)


def combined(direction: FloatArray, names: Sequence[str]) -> str:
    """Name a direction (names,) in words, the largest component first.

    ``alpha with beta`` means that both may grow together, ``alpha against beta`` that one grows
    while the other falls; components below :data:`MEMBER` of the largest are left out.
    """
    shares = direction / direction[np.argmax(np.abs(direction))]
    first, *others = [
        i for i in np.argsort(-np.abs(shares), kind="stable") if abs(shares[i]) > MEMBER
    ]
    return " ".join(
        [names[first], *(f"{'with' if shares[i] > 0 else 'against'} {names[i]}" for i in others)]
    )
