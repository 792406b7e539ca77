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
from bwbayes.inference.compiled import kernels, whitening
from bwbayes.inference.compiled.filter import PAIR, FilterState, Transition
from bwbayes.inference.compiled.kernels import RecordArrays, Unknowns
from bwbayes.inference.compiled.lanes import apart, read_only
from bwbayes.inference.compiled.motion import Motion, Shared, known_motion, physics
from bwbayes.inference.compiled.stages import CompiledDrive, Given, advance_of, prepare_drive
from bwbayes.inference.likelihood import Likelihood, batches
from bwbayes.inference.state_space import Noise
from bwbayes.model.compiled import compiling
from bwbayes.model.declaration import Values

if TYPE_CHECKING:
    from bwbayes.inference.posterior import Posterior

__all__ = ["products", "warm_up", "whiten"]


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
    # The lanes hold two states of the noise; :mod:`whitening` filters noise with more. If readings
    # are few, a pass over all samples takes longer than whitening the readings.
    if noise.states > 2 or (is_known and 2 * readings.rows.size < readings.samples):
        return likelihood.products_of_series(theta, np.empty((0, readings.rows.size)), displacement)
    record = RecordArrays(read_only(likelihood.inputs_read.voltage), likelihood.values, gaps)
    column = likelihood.table.columns(theta)
    sections, series = actuator.sections(column), 1 + likelihood.unknowns
    steps, filtering = _filtering(noise, likelihood.table.noise(theta), readings.gaps[0])
    unknowns, responses = _responses(likelihood, sections.recursions[0].free)
    second = True if noise.states > 1 else None
    # A displacement that is simulated beforehand only passes the filter here.
    simulates = bool(actuator.stages) or is_known
    core, make = (actuator.linear, known_motion) if simulates else (actuator, physics)
    shared = Shared.of(core, record.voltage)
    pairs, logs = np.empty((len(theta), series, series)), np.empty(len(theta))
    pair = PAIR[:series, :series]
    for rows, source in _stage_groups(likelihood, column, record.voltage, displacement):
        equilibrium = np.zeros(len(theta))
        equilibrium[rows] = source.models.equilibrium
        named = make(actuator, sections, column, equilibrium, record.voltage)
        over = Transition.filled(steps, rows, readings.gaps[0].size)
        filters = FilterState.filled(filtering | responses, rows)
        filters["step"] = over[:, 0]
        motions = Motion.filled(named, rows)
        with compiling(source.owner):
            kernels.sums(record, *source, shared, motions, filters, over, second, unknowns)
        models = source.models.equilibrium.size
        pairs[rows] = apart(filters["products"][:, pair], models)
        logs[rows] = apart(filters["log"], models)
    typical = readings.rows.size * np.log(steps["q"][:, 0, 0, 0] + filtering["sensor"])
    return pairs, typical + logs


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
    return whitening.whiten_series(
        transitions, gained, noise.stationary(theta), noise.observe,
        np.ascontiguousarray(theta[:, :1] ** 2 if sensor is None else sensor), gaps[1],
        np.ascontiguousarray(series),
    )  # fmt: skip


def _filtering(
    noise: Noise, theta: FloatArray, missing: FloatArray
) -> tuple[dict[str, FloatArray], dict[str, FloatArray]]:
    """Return the filter's steps (models, gaps), and its start (models,), by rows.

    The first step, for no missing reading, is from one to the next; others are those over what is
    missing. The lanes observe the first of two states alone, whose stationary covariance is a
    multiple of the unit matrix: other states x are turned into T x.
    """
    stationary, observe, states = noise.stationary(theta), noise.observe, noise.states
    variance = observe @ stationary @ observe
    unit = np.eye(states)
    plain = (observe == unit[:1]).all() and (stationary == np.multiply.outer(variance, unit)).all()
    turned = None if plain else _observed_first(stationary, observe)
    size = max(states, 1)
    f_matrices, gained = np.zeros((2, len(theta), missing.size, size, size))
    for gap, number in enumerate([1.0, *missing[1:].tolist()] if states else []):
        f, q = _step(noise, theta, number)
        if turned is not None:
            f = turned @ f @ np.linalg.inv(turned)
            q = turned @ q @ np.swapaxes(turned, 1, 2)
        f_matrices[:, gap], gained[:, gap] = f, q
    return {"f": f_matrices, "q": gained}, {"sensor": theta[:, 0] ** 2, "covariance": variance}


def _responses(likelihood: Likelihood, free: FloatArray) -> tuple[Unknowns, dict[str, FloatArray]]:
    """Return the numbers of unknowns, and the start of all series (models, series), by rows.

    ``free`` (models, unknowns, taps) are the dynamics' free responses.
    """
    offset, creep = int(likelihood.offset_sd > 0), likelihood.actuator.creep
    moving = likelihood.unknowns - offset
    slow = len(creep.times) if creep and moving else 0
    starts = np.zeros((2, len(free), 1 + likelihood.unknowns))
    starts[0, :, 1:] = 1.0
    if moving > slow:
        own = slice(1 + offset, 1 + offset + moving - slow)
        starts[: free.shape[2], :, own] = np.moveaxis(free, 2, 0)
    return Unknowns(offset, moving - slow, slow), {"response": starts[0], "response_2": starts[1]}


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
        # States that are one and the same but for rounding have nothing of their own.
        least = np.finfo(float).eps * np.trace(stationary, axis1=1, axis2=2)
        size = np.maximum(size, least + np.finfo(float).tiny)
        ratio = (observe @ stationary @ observe) / size
        turned[:, 1] = np.sqrt(ratio)[:, np.newaxis] * other
    return turned


def _step(noise: Noise, theta: FloatArray, readings: float) -> tuple[FloatArray, FloatArray]:
    """Return F and Q over so many readings, (models, states, states)."""
    return noise.transition(theta, readings), noise.process_covariance(theta, readings)


def _stage_groups(
    likelihood: Likelihood, column: Values, voltage: FloatArray, displacement: FloatArray | None
) -> Iterator[tuple[IntArray | slice, CompiledDrive]]:
    """Yield groups of models, and the stage that makes their drive.

    A known ``displacement`` takes the place of the drive.
    """
    actuator, from_rest = likelihood.actuator, likelihood.from_rest
    if displacement is not None:
        moved = np.zeros((len(displacement), voltage.size))
        moved[:, likelihood.readings.where] = displacement
        yield slice(None), CompiledDrive(None, Given.of(moved, column["offset"].size))
        return
    if actuator.stages:
        theta = np.stack([column[name] for name in actuator.parameters], axis=1)
        for batch in batches(len(theta), voltage.size):
            moved = likelihood.simulate(theta[batch], likelihood.inputs_read)
            yield batch, CompiledDrive(None, Given.of(moved))
        return
    operator, others = actuator.hysteresis, np.arange(column["offset"].size)
    memory = actuator.begin(column, voltage, from_rest=from_rest)
    stage = prepare_drive(operator, column, voltage, memory)
    if stage is not None:
        yield slice(None), stage
        return
    # Limit the elements (models x samples) of the drive that are worked out at a time.
    size = max((1 << 23) // voltage.size, 1)
    for rows in (others[i : i + size] for i in range(0, others.size, size)):
        values = {name: column[name][rows] for name in actuator.parameters}
        memory = actuator.begin(values, voltage, from_rest=from_rest)
        drive, _ = advance_of(operator)(operator, values, voltage, memory)
        yield rows, CompiledDrive(None, Given.of(drive))
