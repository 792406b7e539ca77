"""The initial state of another record: its unknowns, and their estimate from the first readings.

A record that was not fitted brings unknowns of its own: the hysteretic state it starts from, how
the dynamics are moving then, and its sensor's offset. Each posterior draw gets its own values. The
readings of a lead-in, which is not judged later, choose them: offset and dynamics enter linearly
and are integrated out exactly; the hysteretic state comes from :mod:`bwbayes.prediction.histories`.
Whether the lead-in fits the model at all is tested.

Where the readings end, a part of the model discrepancy is known, too: by the filter of the noise
its state (:meth:`~bwbayes.inference.state_space.Noise.transition`) has the mean m and the
covariance P, given a draw. A process whose stationary covariance is P₀ goes on from there: a time t
later it is normal with

    mean F(t) m,   covariance P₀ − F(t) (P₀ − P) F(t)ᵀ.

So a forecast is narrower than any other prediction at first, and after a few correlation times as
wide as ever.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
import scipy

from bwbayes.arrays import FloatArray, IntArray
from bwbayes.inference.likelihood import Likelihood, LinearStart
from bwbayes.inference.parameters import Parameter
from bwbayes.inference.posterior import Posterior
from bwbayes.inference.state_space import Noise
from bwbayes.inference.study import InitialConditions
from bwbayes.model.inputs import Inputs, Span
from bwbayes.prediction.bands import LeadIn
from bwbayes.prediction.histories import (
    EarlierRange,
    Histories,
    Put,
    choose_histories,
    choose_together,
    earlier_ranges,
    pick,
    split_ranges,
    uniform,
)
from bwbayes.record.record import Record
from bwbayes.shown import brief
from bwbayes.watching import Watch, part, unwatched, watched


@dataclass(frozen=True)
class DiscrepancyState:
    """The discrepancy's state after the last reading, for each draw.

    ``last`` is the sample of the last reading; ``mean`` (draws, states) that of the states there,
    and ``gained`` (draws, states, states) by how much their covariance is less than the stationary
    one; ``noise`` is that for the interval between samples, and ``parameters`` (draws, parameters)
    are its own.
    """

    last: int
    mean: FloatArray
    gained: FloatArray
    noise: Noise
    parameters: FloatArray

    def after(self, first: int, samples: int) -> tuple[FloatArray, FloatArray]:
        """Return what is known of samples from one on, each (draws, samples).

        The discrepancy's mean, um, and the part of its variance that is known; before the last
        reading those there.
        """
        later = np.maximum(first + np.arange(samples) - self.last, 0).astype(np.float64)
        row = self.noise.observe @ self.noise.transition(self.parameters, later)
        known_variance = np.einsum("dtj,djk,dtk->dt", row, self.gained, row)
        always = self.noise.marginal_sd(self.parameters)[0][:, np.newaxis] ** 2
        share = np.divide(
            known_variance, always, out=np.zeros_like(known_variance), where=always > 0
        )
        return np.einsum("dtj,dj->dt", row, self.mean), np.minimum(share, 1.0)


def filter_discrepancy(
    likelihood: Likelihood, theta: FloatArray, simulated: FloatArray, watch: Watch = unwatched
) -> DiscrepancyState:
    """Return what the readings of a record leave at θ (draws, parameters).

    ``simulated`` (draws, readings), um, is the model's displacement at the readings. ``watch`` is
    called with the share that is done.
    """
    readings, noise = likelihood.readings, likelihood.spaced
    parameters = likelihood.table.noise(theta)
    mean, covariance = [], []
    # Some draws at a time: what is kept of all readings of all would not fit into memory.
    for rows in watched(np.array_split(np.arange(len(theta)), -(-len(theta) // 50)), watch):
        residual = (readings.values - simulated[rows])[:, np.newaxis]
        sensor = likelihood.sensor(parameters[rows])
        filtered = noise.filter(parameters[rows], residual, readings.skipped, sensor)
        mean.append(filtered.mean[:, 0])
        covariance.append(filtered.covariance)
    gained = noise.stationary(parameters) - np.concatenate(covariance)
    last = int(readings.rows[-1])
    return DiscrepancyState(last, np.concatenate(mean), gained, likelihood.noise, parameters)


@dataclass(frozen=True)
class InitialStates:
    """Each draw's initial state of a record.

    ``histories`` with the record's interval and hold, and which of them each draw has; ``model``
    (draws, parameters of the actuator) with initial state and offset; ``initial_transient`` (draws,
    unknowns) of the dynamics, um; ``offset_sd`` (draws,), um, what is unsure of the offset still;
    ``lead_in`` says how that went, if there is one, and ``scored_from`` is the first sample after
    it; ``discrepancy`` is what its readings leave of the discrepancy, for a forecast. ``rows`` are
    the draws, of those that were given, that these have come from.
    """

    __repr__ = brief

    histories: Histories
    model: FloatArray
    initial_transient: FloatArray
    offset_sd: FloatArray
    lead_in: LeadIn | None = None
    scored_from: int = 0
    discrepancy: DiscrepancyState | None = None
    rows: IntArray | slice = slice(None)

    @property
    def mean_offset(self) -> float:
        """The mean of the sensor's offset, um."""
        column = self.histories.likelihoods[0].actuator.parameters.index("offset")
        return float(np.mean(self.model[:, column]))

    def displacement(self, inputs: Inputs) -> FloatArray:
        """Displacement (draws, samples) along inputs, um."""
        return next(self.pieces(inputs, inputs.samples))

    def pieces(self, inputs: Inputs, size: int) -> Iterator[FloatArray]:
        """Yield displacements (draws, samples) along inputs, um, so many samples at a time."""
        walks = [
            (rows, likelihood.walk(self.model[rows], inputs, self.initial_transient[rows]))
            for likelihood, rows in self.histories.groups
        ]
        for first in range(0, inputs.samples, size):
            last = min(first + size, inputs.samples)
            parts = [(rows, walk(last)) for rows, walk in walks]
            if len(parts) == 1:
                yield parts[0][1]
                continue
            simulated = np.empty((len(self.model), last - first))
            for rows, displacement in parts:
                simulated[rows] = displacement
            yield simulated


def estimate_initial_states(
    posterior: Posterior,
    theta: FloatArray,
    record: Record,
    start: InitialConditions,
    generator: np.random.Generator,
    watch: Watch = unwatched,
) -> InitialStates:
    """Give every draw θ (draws, parameters) a start of another record.

    ``watch`` is called with the share that is done.

    Raises
    ------
    InputError
        A lead-in that does not fit into the record.
    """
    training = posterior.single_record
    hold, inputs = start.hold or record.hold, record.inputs
    (low, high), voltage = training.span, inputs.voltage
    span = Span(min(float(np.min(voltage)), low), max(float(np.max(voltage)), high))
    actuator = replace(
        training.actuator, interval=record.interval, hold=hold, span=span, demagnetized=False
    )
    memory = training.noise.correlation_time(training.table.noise(theta))
    window = start.window(record, float(np.median(memory)))
    estimate_offset = start.estimate_offset and window is not None
    displacement = np.zeros(1) if window is None else record.displacement
    assert displacement is not None
    likelihood = Likelihood(
        inputs,
        displacement,
        (window or slice(0, 1),),
        actuator,
        training.noise,
        start.from_rest,
        engine=posterior.engine,
        # As wide as what was fitted: where this record's sensor was set to zero, nothing says.
        offset_sd=training.extent if estimate_offset else 0.0,
        half_range=span.half,
    )
    theta, unknowns = _of_new_record(posterior, theta, start)
    ranges = [EarlierRange(span)]
    if actuator.hysteresis.remembers_range and not start.from_rest:
        ranges = earlier_ranges(span, float(voltage[0]))

    history = partial(_after, likelihood)
    if window is None:
        for put in unknowns:
            theta = put(theta, generator.uniform(size=len(theta)))
        return _unseen(*_histories(ranges, history), theta, generator, settled=start.settled)
    if estimate_offset:
        assert record.displacement is not None
        level = np.full(len(theta), np.nanmean(record.displacement[window]))
        theta = likelihood.table.with_values(theta, "offset", level)
    elif len(ranges) > 1:
        # The mean is in the domain, which is convex; a median of each parameter need not be.
        typical = likelihood.table.actuator(np.mean(theta, axis=0)[np.newaxis])
        between = _between(ranges, history, typical)
        history = partial(_after, replace(likelihood, offset_sd=between))
    if len(ranges) > 1 and not unknowns:
        ranges = split_ranges(ranges, history, theta, part(watch, 0.0, 0.2))
    watch_start = part(watch, 0.2, 0.5)
    known = _histories(ranges, history)
    histories, start_theta, evidence = (
        choose_together(*known, theta, unknowns, generator, watch_start)
        if unknowns
        else choose_histories(*known, theta, generator, watch_start)
    )
    rows = resample(evidence, generator)
    theta, start_theta = theta[rows], start_theta[rows]
    histories = replace(histories, which=histories.which[rows])
    informed = _estimate_from_lead_in(histories, start_theta, record, window, generator)
    informed = replace(informed, rows=rows)
    if not start.after:
        return informed
    return continue_discrepancy(informed, likelihood, theta, generator, part(watch, 0.5, 1.0))


def _of_new_record(
    posterior: Posterior, theta: FloatArray, start: InitialConditions
) -> tuple[FloatArray, list[Put]]:
    """Give draws θ what stages know of a record that was not fitted.

    An event of the training record does not happen again. Beside θ comes what is not known.
    """
    alone, unknowns = posterior.single_record, list[Put]()
    for parameter in posterior.prior.parameters:
        declared, name = parameter.declared, parameter.name
        stands = declared.at_rest if declared.scope == "event" or start.from_rest else None
        if name in ("initial", "offset") or declared.scope == "actuator":
            continue
        if stands is not None:
            theta = alone.table.with_values(theta, name, np.full(len(theta), stands))
        elif parameter.fixed is None:
            unknowns.append(partial(_put_left, alone, parameter))
    return theta, unknowns


def _put_left(
    alone: Likelihood, parameter: Parameter, theta: FloatArray, probability: FloatArray
) -> FloatArray:
    """Return θ with quantiles (draws,) of what earlier drives leave of a parameter."""
    left = parameter.declared.left
    value = (
        parameter.at(probability)
        if left is None
        else left(alone.table.columns(theta), alone.extent, probability)
    )
    return alone.table.with_values(theta, parameter.name, value)


def _after(likelihood: Likelihood, span: Span) -> Likelihood:
    """Return the likelihood of a record after drives over a span."""
    return replace(likelihood, actuator=replace(likelihood.actuator, span=span))


def _histories(
    ranges: Sequence[EarlierRange], history: Callable[[Span], Likelihood]
) -> tuple[tuple[Likelihood, ...], FloatArray]:
    """Return the likelihoods of ranges, and their probabilities beforehand (ranges,)."""
    probability = np.array([earlier.probability for earlier in ranges])
    likelihoods = tuple(history(earlier.span) for earlier in ranges)
    return likelihoods, probability / np.sum(probability)


def _between(
    ranges: Sequence[EarlierRange], history: Callable[[Span], Likelihood], model: FloatArray
) -> float:
    """Return how far, um, a state may lie between those of two ranges that come next.

    States that a drive does not reach stay as they were left, as a part of the offset. It is half
    of the root-mean-square difference between ranges that have one end in common and come next at
    the other, of a ``model`` (1, parameters).
    """
    level = {}
    for earlier in ranges:
        likelihood = history(earlier.span)
        path = likelihood.simulate(model, likelihood.inputs_read)[0, likelihood.readings.rows]
        level[earlier.span] = float(np.mean(path))
    spans = sorted(level)
    levels = np.reshape([level[span] for span in spans], (len({s.low for s in spans}), -1))
    steps = [np.diff(levels, axis=axis).ravel() for axis in (0, 1)]
    return float(np.sqrt(np.mean(np.concatenate(steps) ** 2)) / 2)


def continue_discrepancy(
    start: InitialStates,
    likelihood: Likelihood,
    theta: FloatArray,
    generator: np.random.Generator,
    watch: Watch = unwatched,
) -> InitialStates:
    """Let the discrepancy go on from where the readings of a likelihood leave it.

    The offset is drawn from what the readings leave open, because the discrepancy depends on it.
    ``watch`` is called with the share that is done.
    """
    column = likelihood.actuator.parameters.index("offset")
    model = start.model.copy()
    if start.offset_sd.any():
        model[:, column] += start.offset_sd * scipy.special.ndtri(uniform(generator, len(model)))
    matched = replace(start, model=model, offset_sd=np.zeros(len(model)))
    rows = likelihood.readings.rows
    simulated = matched.displacement(likelihood.inputs_read)[:, rows]
    filtered = filter_discrepancy(likelihood, theta, simulated, part(watch, 0.2, 1.0))
    return replace(matched, discrepancy=filtered)


def training_initial_states(
    posterior: Posterior, theta: FloatArray, generator: np.random.Generator
) -> InitialStates:
    """Give every draw θ (draws, parameters) the start that the training record tells."""
    likelihood = posterior.likelihood
    initial_transient = np.empty((len(theta), 0))
    if likelihood.unknowns:
        start = likelihood.start(theta)
        initial_transient = _normal(start.mean, start.covariance, generator)
    histories = Histories((likelihood,), np.zeros(len(theta), dtype=np.int64))
    return InitialStates(
        histories, likelihood.table.actuator(theta), initial_transient, np.zeros(len(theta))
    )


def _unseen(
    likelihoods: tuple[Likelihood, ...],
    probability: FloatArray,
    theta: FloatArray,
    generator: np.random.Generator,
    *,
    settled: bool,
) -> InitialStates:
    """Draw the start from what is known of it beforehand."""
    draws, first = len(theta), likelihoods[0]
    which = np.zeros(draws, dtype=np.int64)
    if len(likelihoods) > 1:
        which = pick(probability, uniform(generator, draws))
    histories = Histories(likelihoods, which)
    (sd,) = histories.each(theta, lambda likelihood, rows: (likelihood.start_sd(rows),))
    if settled:
        sd[:, : first.actuator.filter.unknowns(first.actuator.hold)] = 0.0
    initial_transient = _normal(
        np.zeros_like(sd), sd[:, :, np.newaxis] ** 2 * np.eye(sd.shape[1]), generator
    )
    start_theta = histories.with_states(theta, uniform(generator, draws))
    model = first.table.actuator(start_theta)
    start = InitialStates(histories, model, initial_transient, np.zeros(draws))
    if settled:
        offset = first.actuator.parameters.index("offset")
        model[:, offset] -= start.displacement(first.inputs[:1])[:, 0]
    return start


def _estimate_from_lead_in(
    histories: Histories,
    theta: FloatArray,
    record: Record,
    window: slice,
    generator: np.random.Generator,
) -> InitialStates:
    """Estimate offset and initial transient of draws θ, given their initial states."""
    likelihood = histories.likelihoods[0]
    posterior = LinearStart(*histories.each(theta, Likelihood.start))
    offsets = int(likelihood.offset_sd > 0)
    mean, covariance = posterior.mean, posterior.covariance
    initial_transient = _normal(mean[:, offsets:], covariance[:, offsets:, offsets:], generator)
    start_theta, sd = theta, np.zeros(len(theta))
    if offsets:
        # Given the initial transient the offset is normal still.
        pull = np.linalg.pinv(covariance[:, 1:, 1:], hermitian=True) @ covariance[:, 1:, :1]
        shift = np.einsum("mij,mi->mj", pull, initial_transient - mean[:, 1:])[:, 0]
        variance = covariance[:, 0, 0] - np.sum(covariance[:, 1:, 0] * pull[..., 0], axis=1)
        level = likelihood.table.columns(theta)["offset"] + mean[:, 0] + shift
        start_theta = likelihood.table.with_values(theta, "offset", level)
        sd = np.sqrt(np.maximum(variance, 0.0))
    lead_in = LeadIn(
        float(record.time[window.start]),
        float(record.time[window.stop]),
        likelihood.readings.rows.size,
        _p_value(histories, theta, posterior.squares),
        bool(offsets),
    )
    model = likelihood.table.actuator(start_theta)
    return InitialStates(histories, model, initial_transient, sd, lead_in, window.stop)


def _p_value(histories: Histories, theta: FloatArray, squares: FloatArray) -> float:
    """Test whether the lead-in fits the models θ at all.

    Two tests, either of which may object: the sum of all squared innovations, which sees any large
    departure, and a score test of slow ones (drift, a transient), which many readings would hide.
    """
    readings = histories.likelihoods[0].readings.rows
    p = scipy.stats.chi2.sf(squares, readings.size)
    if readings.size > 20:
        # As polynomials of the time up to the third degree, of a few draws.
        few = slice(None, None, -(-len(theta) // 25))
        relative_time = 2 * (readings - readings[0]) / (readings[-1] - readings[0]) - 1
        shapes = np.polynomial.legendre.legvander(relative_time, 3).T[1:]
        tested = replace(histories, which=histories.which[few])
        (taken,) = tested.each(
            theta[few], lambda likelihood, rows: (likelihood.score(rows, shapes).together,)
        )
        p = np.minimum(2 * np.minimum(p[few], scipy.stats.chi2.sf(taken, 3)), 1.0)
    return float(np.mean(p))


def _normal(mean: FloatArray, covariance: FloatArray, generator: np.random.Generator) -> FloatArray:
    """Draw (draws, n) from normal distributions, one a draw, which may be singular."""
    values, vectors = np.linalg.eigh(covariance)
    score = np.zeros_like(mean)
    for i in range(mean.shape[1]):
        score[:, i] = scipy.special.ndtri(uniform(generator, len(mean)))
    spread = np.sqrt(np.maximum(values, 0.0)) * score
    drawn: FloatArray = mean + np.einsum("mij,mj->mi", vectors, spread)
    return drawn


# Draws that are left at least, in effect.
MIN_EFFECTIVE = 100


def resample(evidence: FloatArray, generator: np.random.Generator) -> IntArray:
    """Choose as many draws by their log evidence (draws,), some several times; return their rows.

    Evidence may single out a few draws: then it counts by a power below one, with which the weights
    w leave (Σ w)² / Σ w² = :data:`MIN_EFFECTIVE` draws, or all of fewer. So bands have enough of
    them, and are rather too wide.
    """
    draws, best = evidence.size, np.max(evidence)
    if draws <= MIN_EFFECTIVE or not np.isfinite(best):
        return np.arange(draws)

    def effective(power: float) -> float:
        weights = np.exp(power * (evidence - best))
        return float(np.sum(weights) ** 2 / np.sum(weights**2))

    low, power = 0.0, 1.0
    if effective(power) < MIN_EFFECTIVE:
        # Draws that are not possible never count.
        high = power
        for _ in range(50):
            power = (low + high) / 2
            low, high = (power, high) if effective(power) > MIN_EFFECTIVE else (low, power)
    total = np.cumsum(np.exp(power * (evidence - best)))
    # Evenly: of equal weights, each draw once.
    levels = (np.arange(draws) + generator.uniform()) / draws
    rows: IntArray = np.minimum(np.searchsorted(total, levels * total[-1]), draws - 1)
    return rows
