"""Likelihood on the compiled engine: the same numbers as with NumPy, ten times faster.

Coefficients of the dynamics and of the noise's filter come from the same functions that the NumPy
likelihood uses; :mod:`~bwbayes.inference.compiled.kernels` goes through the samples. Operators with
a compiled stage (:mod:`~bwbayes.inference.compiled.stages`) run on it; for others the drive comes
from NumPy, and the rest of the work is still compiled.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING

import numpy as np

from bwbayes.arrays import FloatArray, IntArray
from bwbayes.inference.compiled import kernels, lanes, whitening
from bwbayes.inference.compiled.motion import physics, shared, simulated
from bwbayes.inference.compiled.stages import CompiledDrive, advance_of, given, prepared
from bwbayes.inference.likelihood import Likelihood, batches
from bwbayes.inference.state_space import Noise
from bwbayes.model.declaration import Values

if TYPE_CHECKING:
    from bwbayes.inference.posterior import Posterior

__all__ = ["products", "warm_up", "whiten"]

# Largest number of noise states that the lanes hold; :mod:`whitening` filters noise with more.
LANE_STATES = 2


def warm_up(posterior: Posterior) -> None:
    """Simulate and whiten one model, to compile functions that :func:`products` does not need.

    Functions that one process has compiled are cached for others, such as one at the products.
    """
    prior, likelihood = posterior.prior, posterior.likelihoods[0]
    center, _ = prior.constrain(np.zeros((1, prior.dimensions)))
    theta = posterior.table.of(prior.theta(center), posterior.datasets[0].name)
    likelihood.simulate(likelihood.table.actuator(theta), likelihood.inputs[:2])
    series = np.zeros((1, 1, likelihood.readings.rows.size))
    likelihood.whiten(likelihood.table.noise(theta), series)


def products(
    likelihood: Likelihood, theta: FloatArray, displacement: FloatArray | None = None
) -> tuple[FloatArray, FloatArray]:
    """Return Σ zᵢ zⱼ of whitened series, and log determinants, as the NumPy likelihood does.

    They are (models, series, series) and (models,), at θ (models, parameters) inside the domain.
    ``displacement`` is as in :meth:`~bwbayes.inference.likelihood.Likelihood.score`.
    """
    actuator, noise, gaps = likelihood.actuator, likelihood.spaced, likelihood.gaps
    readings, is_known = likelihood.readings, displacement is not None
    # If readings are few, a pass over all samples takes longer than whitening the readings.
    if noise.states > LANE_STATES or (is_known and 2 * readings.rows.size < readings.samples):
        return likelihood.products_of_series(theta, np.empty((0, readings.rows.size)), displacement)
    voltage = likelihood.inputs_read.voltage
    offset = int(likelihood.offset_sd > 0)
    free = likelihood.unknowns - offset
    column = likelihood.table.columns(theta)
    parameters = likelihood.table.noise(theta)
    filtering, second, steps = _filtering(noise, parameters, likelihood.readings.gaps[0])
    slow = len(actuator.creep.times) if actuator.creep and free else 0
    unknowns = offset, free - slow, slow
    sums = np.empty((lanes.SUMS, len(theta)))
    record, sections = (voltage, likelihood.values, gaps), actuator.sections(column)
    # A displacement that is simulated beforehand only passes the filter here.
    simulates = bool(actuator.stages) or is_known
    core, make = (actuator.linear, simulated) if simulates else (actuator, physics)
    together = shared(core, voltage)
    for rows, stage in _staged(likelihood, column, voltage, displacement):
        equilibrium = np.zeros(len(theta))
        equilibrium[rows] = stage.equilibrium
        named = make(actuator, sections, column, equilibrium, voltage) | filtering
        result = kernels.sums(
            *record, lanes.in_lanes(lanes.by_rows(named)[rows]), _over_gaps(steps[rows]), second,
            stage.kind, lanes.in_lanes(stage.group), stage.plan, *together, *unknowns,
        )  # fmt: skip
        sums[:, rows] = result[:, : len(stage.group)]
    size = 1 + offset + free
    pairs = np.empty((len(theta), size, size))
    i, j = np.tril_indices(size)
    pairs[:, i, j] = pairs[:, j, i] = sums[: i.size].T
    typical = readings.rows.size * np.log(filtering["q_11"] + filtering["sensor"])
    return pairs, typical + sums[lanes.LOG_DETERMINANT]


def whiten(
    noise: Noise,
    theta: FloatArray,
    series: FloatArray,
    gaps: tuple[FloatArray, IntArray],
    sensor: FloatArray | None = None,
) -> tuple[FloatArray, FloatArray]:
    """Whiten as :meth:`~bwbayes.inference.state_space.Noise.whiten` does, for noise with states.

    The arguments are the same: θ (models, parameters) of the noise, series (models, series,
    readings), um; and the readings' gaps (:attr:`~bwbayes.inference.likelihood.Readings.gaps`).
    """
    steps = [_step(noise, theta, 1.0 + number) for number in gaps[0].tolist()]
    transitions, gained = (np.stack(matrices) for matrices in zip(*steps, strict=True))
    # Numba would compile the function for each layout of an array.
    return whitening.whitened(
        transitions, gained, noise.stationary(theta), noise.observe,
        np.ascontiguousarray(theta[:, :1] ** 2 if sensor is None else sensor), gaps[1],
        np.ascontiguousarray(series),
    )  # fmt: skip


def _filtering(
    noise: Noise, theta: FloatArray, missing: FloatArray
) -> tuple[dict[str, FloatArray], bool | None, FloatArray]:
    """Return the filter's usual step and the variances, (models,), by the names of ``PARAMETERS``.

    Also returns whether there is a second state, None for no, which leaves it out of the compiled
    code, and the steps over all gaps but the first, which misses no reading, side by side (models,
    gaps times rows).

    The lanes observe the first of two states alone, whose stationary covariance is a multiple of
    the unit matrix: other states x are turned into T x.
    """
    stationary, observe, states = noise.stationary(theta), noise.observe, noise.states
    variance = observe @ stationary @ observe
    plain = np.array_equal(observe, np.eye(states)[:1].ravel()) and np.array_equal(
        stationary, variance[:, np.newaxis, np.newaxis] * np.eye(states)
    )
    turned = None if plain else _observed_first(stationary, observe)

    def rows(readings: float) -> FloatArray:
        """Return the rows of a step over so many readings, (STEP, models)."""
        values = np.zeros((lanes.STEP, len(theta)))
        if states:
            f_matrices, gained = _step(noise, theta, readings)
            if turned is not None:
                f_matrices = turned @ f_matrices @ np.linalg.inv(turned)
                gained = turned @ gained @ np.swapaxes(turned, 1, 2)
            wide = np.zeros((2, len(theta), 2, 2))
            wide[0, :, :states, :states], wide[1, :, :states, :states] = f_matrices, gained
            values[:4] = wide[0].reshape(-1, 4).T
            values[4:] = wide[1, :, [0, 0, 1], [0, 1, 1]]
        return values

    named = dict(zip(lanes.PARAMETERS[lanes.F // lanes.LANES :], rows(1.0), strict=False))
    named["stationary"], named["sensor"] = variance, theta[:, 0] ** 2
    steps = [rows(number) for number in missing[1:].tolist()]
    over = np.concatenate([np.empty((0, len(theta))), *steps]).T
    return named, True if states > 1 else None, over


def _observed_first(stationary: FloatArray, observe: FloatArray) -> FloatArray:
    """Return T (models, states, states) for one or two states.

    Its first row is h, and T P Tᵀ = h P hᵀ times the unit matrix.
    """
    turned = np.empty_like(stationary)
    turned[:, 0] = observe
    if observe.size > 1:
        shared = stationary @ observe
        shared /= np.maximum(np.linalg.norm(shared, axis=1), np.finfo(float).tiny)[:, np.newaxis]
        other = np.stack([-shared[:, 1], shared[:, 0]], axis=1)
        size = np.einsum("mi,mij,mj->m", other, stationary, other)
        ratio = (observe @ stationary @ observe) / np.maximum(size, np.finfo(float).tiny)
        turned[:, 1] = np.sqrt(ratio)[:, np.newaxis] * other
    return turned


def _step(noise: Noise, theta: FloatArray, readings: float) -> tuple[FloatArray, FloatArray]:
    """Return F and Q over so many readings, (models, states, states)."""
    return noise.transition(theta, readings), noise.process_covariance(theta, readings)


def _over_gaps(steps: FloatArray) -> FloatArray:
    """Put steps over gaps side by side, (groups, gaps, rows times lanes)."""
    groups = lanes.in_lanes(steps)
    return groups.reshape(len(groups), -1, lanes.STEP * lanes.LANES)


def _staged(
    likelihood: Likelihood, column: Values, voltage: FloatArray, displacement: FloatArray | None
) -> Iterator[tuple[IntArray | slice, CompiledDrive]]:
    """Yield groups of models, and the stage that makes their drive.

    A known ``displacement`` takes the place of the drive.
    """
    actuator, from_rest = likelihood.actuator, likelihood.from_rest
    if displacement is not None:
        moved = np.zeros((len(displacement), voltage.size))
        moved[:, likelihood.readings.where] = displacement
        yield slice(None), given(moved, column["offset"].size)
        return
    if actuator.stages:
        theta = np.stack([column[name] for name in actuator.parameters], axis=1)
        for batch in batches(len(theta), voltage.size):
            yield batch, given(likelihood.simulate(theta[batch], likelihood.inputs_read))
        return
    operator, others = actuator.hysteresis, np.arange(column["offset"].size)
    memory = actuator.begin(column, voltage, from_rest=from_rest)
    stage = prepared(operator, column, voltage, memory)
    if stage is not None:
        yield slice(None), stage
        return
    # Limit the elements (models x samples) of the drive that are worked out at a time.
    size = max((1 << 23) // voltage.size, 1)
    for rows in (others[i : i + size] for i in range(0, others.size, size)):
        values = {name: column[name][rows] for name in actuator.parameters}
        memory = actuator.begin(values, voltage, from_rest=from_rest)
        yield rows, given(advance_of(operator)(operator, values, voltage, memory)[0])
