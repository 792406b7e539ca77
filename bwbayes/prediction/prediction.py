"""Prediction: from posterior draws to displacement bands, for any voltage.

Every draw simulates the record from its first sample; given a draw, a reading is normal around its
simulation, or has the heavy tails of its sensor's noise, and the bands are quantiles of the mixture
over all draws. The record is walked through in pieces, so memory does not grow with its length. But
for a forecast, the discrepancy enters by its marginal distribution, on training windows too, where
the smoothed one would promise more than a new record can keep.

Windows of the training record share its simulation and its offset. Another record has a start of
its own, see :mod:`bwbayes.prediction.initial_state`.

The predictive distribution at every sample is a normal mixture: given a draw a reading is normal,
with the draw's simulation as its mean. Standard normal scores that are kept along the record turn
means and sds into values of the mixture, and the bands are quantiles of these: as smooth along the
record as the simulations are. The scores are stratified, and a few draws get many of them each, so
that hardly any chance is left in a quantile. All but the scores works in the precision of its
arguments: a single one, of means less what they have in common, takes half the time.
"""

from __future__ import annotations

import math
from collections import defaultdict, deque
from collections.abc import Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import scipy

from bwbayes.arrays import ArrayLike, FloatArray, Floating
from bwbayes.errors import InputError
from bwbayes.inference.heavy_tails import scale_mixture, scale_of
from bwbayes.inference.posterior import Posterior
from bwbayes.inference.study import InitialConditions
from bwbayes.model.inputs import rate
from bwbayes.prediction.bands import KINDS, LEVELS, WIDTH_90, Bands, Kind
from bwbayes.prediction.initial_state import (
    InitialStates,
    continue_discrepancy,
    estimate_initial_states,
    training_initial_states,
)
from bwbayes.record.instruments import EXACT
from bwbayes.record.record import Record, Window
from bwbayes.watching import Watch, counted, part, unwatched

# Posterior draws in the mixture.
DRAWS = 1000

# Share of a prediction's time that goes into the states that it starts from, about.
STATES_SHARE = 0.4


class TailScales(NamedTuple):
    """How much larger than s² the variance of a sensor's noise with heavy tails may be.

    ``scales`` (scores, draws) is that of each score of a draw; ``values`` (draws, values) and their
    ``logs``, the logarithms of their shares, are those of :func:`scale_mixture`.
    """

    scales: FloatArray
    values: FloatArray
    logs: FloatArray


class SensorScale(NamedTuple):
    """Unsure conversion of readings into displacements: see :mod:`bwbayes.record.instruments`.

    ``scale`` (draws,) acts on what lies beyond the sensor's ``zero``, um, which says nothing of
    the actuator; ``curve_sd`` is the sd of the sensor's curve, um.
    """

    scale: FloatArray
    zero: float
    curve_sd: float

    def true(
        self, means: Floating, variance: FloatArray, mean: FloatArray, kind: Kind
    ) -> tuple[Floating, FloatArray]:
        """Return the displacements of draws (samples, draws) about a mean, and their variances."""
        scale = self.scale.astype(np.float32)
        moved = (mean - self.zero).astype(np.float32)[:, np.newaxis]
        curve = self.curve_sd if kind == "displacement" else 0.0
        scaled = variance * self.scale[:, np.newaxis] ** 2 + curve**2
        return scale * means + (scale - 1) * moved, scaled


def thin_draws(draws: FloatArray, generator: np.random.Generator, count: int = DRAWS) -> FloatArray:
    """Choose ``count`` of the draws (any, free) without repetition; all, if there are fewer."""
    if draws.shape[0] <= count:
        return draws
    return draws[generator.choice(draws.shape[0], count, replace=False)]


def predict_windows(
    posterior: Posterior,
    draws: FloatArray,
    record: Record,
    windows: Mapping[str, slice | Sequence[slice]],
    generator: np.random.Generator,
    watch: Watch = unwatched,
) -> list[Bands]:
    """Predict windows of the training record: one simulation, one offset.

    Parameters
    ----------
    posterior
        The posterior that was sampled.
    draws
        (draws, free), parameters in their own units.
    record
        The training record, whole.
    windows
        Slices of its samples, by name: one, or several, which make one set of bands.
    generator
        Draws the state of the dynamics at the start, where that is unknown.
    watch
        Called with the share that is done.
    """
    theta = posterior.prior.theta(draws)
    if record.displacement is not None:
        # A reading that was not fitted says nothing of the fit.
        left_out = np.isnan(posterior.single_record.displacement)
        record = replace(record, displacement=np.where(left_out, np.nan, record.displacement))
    start_states = training_initial_states(posterior, theta, generator)
    several = {n: (parts,) if isinstance(parts, slice) else parts for n, parts in windows.items()}
    edges = [(window.start, window.stop) for parts in several.values() for window in parts]
    first = min(start for start, _ in edges)
    window = slice(first, max(stop for _, stop in edges))
    full_bands = _bands("", posterior, theta, start_states, record, window, watch)
    bands = []
    for name, parts in several.items():
        training = any(
            w.start < p.stop and p.start < w.stop
            for w in posterior.single_record.training
            for p in parts
        )
        moved = [slice(window.start - first, window.stop - first) for window in parts]
        bands.append(replace(full_bands.within(moved), name=name, training=training))
    return bands


def forecast(
    posterior: Posterior,
    draws: FloatArray,
    record: Record,
    voltage: ArrayLike,
    generator: np.random.Generator,
    name: str = "forecast",
    watch: Watch = unwatched,
    model_error_sd: float | None = None,
) -> Bands:
    """Predict what follows on the training record: its last sample goes on into a planned voltage.

    Hysteresis, dynamics and creep start from where the record leaves them, and the sensor keeps its
    offset. The discrepancy goes on from where the fitted readings leave it: the band is narrower at
    first, and as wide as ever later. Creep with a time longer than the record is known by its prior
    alone: the model needs times up to the forecast's length.

    Parameters are as in :func:`predict_record`; ``voltage`` is (samples,), V, at the record's
    sampling interval.

    Raises
    ------
    InputError
        A voltage that is not one finite row.
    """
    planned = np.asarray(voltage, dtype=np.float64)
    if planned.ndim != 1 or planned.size == 0 or not np.isfinite(planned).all():
        raise InputError(f"{name}: voltage of shape {planned.shape}; give one finite row, in V")
    longer = continue_record(record, planned)
    after = slice(record.samples, longer.samples)
    theta = posterior.prior.theta(draws)
    start_states = training_initial_states(posterior, theta, generator)
    start_states = continue_discrepancy(
        start_states, posterior.likelihood, theta, generator, part(watch, 0.0, STATES_SHARE)
    )
    predicting = part(watch, STATES_SHARE, 1.0)
    bands = _bands(
        name, posterior, theta, start_states, longer, after, predicting, model_error_sd or 0.0
    )
    return replace(bands, model_error_sd=model_error_sd)


def continue_record(record: Record, voltage: FloatArray) -> Record:
    """Return a record as it goes on into a planned voltage (samples,), V, without readings.

    Its covariates are unknown from there on.
    """
    # Corners are looked for anew.
    before = record.path.voltage if record.path.noise_sd else record.voltage
    full_voltage = np.concatenate([before, voltage])
    return replace(record, voltage=full_voltage, covariates={}, displacement=None, truth=None)


def predict_record(
    posterior: Posterior,
    draws: FloatArray,
    record: Record,
    start: InitialConditions,
    generator: np.random.Generator,
    name: str = "prediction",
    window: Window | None = None,
    watch: Watch = unwatched,
    model_error_sd: float | None = None,
) -> Bands:
    """Predict another record, or a planned voltage without a measurement.

    Parameters
    ----------
    posterior, draws, watch
        As in :func:`predict_windows`.
    record
        The other record, at any sampling interval: the model lives in continuous time.
    start
        Initial conditions of the record.
    generator
        Draws the starts.
    name
        Name of the bands.
    window
        Part of the record (start, stop) that is predicted, s; by default all. It is simulated from
        its first sample in any case.
    model_error_sd
        SD that displacement and sensor bands include besides, um.

    Raises
    ------
    InputError
        A lead-in or window that does not fit into the record.
    """
    predicted_window = slice(0, record.samples) if window is None else record.window_slice(*window)
    theta = posterior.prior.theta(draws)
    if record.displacement is not None:
        # Only those readings count that the draws can follow.
        actuator = replace(posterior.single_record.actuator, interval=record.interval)
        model = posterior.single_record.table.actuator(theta)
        usable = record.usable_displacement
        assert usable is not None
        known = actuator.known(model, usable, from_rest=start.from_rest)
        if known is not record.displacement:
            record = replace(record, displacement=known)
    start_states = estimate_initial_states(
        posterior, theta, record, start, generator, part(watch, 0.0, STATES_SHARE)
    )
    if predicted_window.stop <= start_states.scored_from:
        raise InputError(f"{name}: its lead-in leaves nothing of the window; choose another one")
    predicting = part(watch, STATES_SHARE, 1.0)
    bands = _bands(
        name,
        posterior,
        theta[start_states.rows],
        start_states,
        record,
        predicted_window,
        predicting,
        model_error_sd or 0.0,
        zero=0.0 if start.settled else None,
    )
    return replace(
        bands,
        scored_from=max(start_states.scored_from - predicted_window.start, 0),
        lead_in=start_states.lead_in,
        separate=True,
        model_error_sd=model_error_sd,
    )


def _bands(
    name: str,
    posterior: Posterior,
    theta: FloatArray,
    start: InitialStates,
    record: Record,
    window: slice,
    watch: Watch = unwatched,
    model_error_sd: float = 0.0,
    zero: float | None = None,
) -> Bands:
    """Walk through a record from every draw's start, and summarize the mixture over a window.

    The sensor's scale acts on what lies beyond its ``zero``, um, by default the mean offset.
    """
    # The same for all predictions: bands differ by what is predicted, not by chance.
    scores = stratified_scores(len(theta), np.random.default_rng(len(theta)))
    noise, parameters = posterior.single_record.noise, posterior.noise_of_new(theta)
    sds, tails = noise.marginal_sd(parameters), None
    if noise.tailed:
        inverse_df = noise.inverse_df(parameters)
        scales = stratified_scales(scores, inverse_df)
        tails = TailScales(scales, *scale_mixture(inverse_df))
    variances = [sd[:, np.newaxis] ** 2 for sd in (start.offset_sd, *sds)]
    variances.append(np.full((1, 1), model_error_sd**2))
    speed = np.abs(rate(record.inputs.voltage, record.interval))
    sensor = None
    if record.instruments != EXACT:
        drawn = record.instruments.scales(len(theta), np.random.default_rng([len(theta), 1]))
        curve = record.instruments.linearity_sd(posterior.single_record.extent)
        sensor = SensorScale(drawn.sensor, start.mean_offset if zero is None else zero, curve)
    samples = window.stop - window.start
    joined: defaultdict[str, FloatArray] = defaultdict(lambda: np.empty(samples))
    totals = np.zeros(len(theta))
    pending: deque[tuple[int, Future[dict[str, Floating]]]] = deque()
    more = counted(window.stop, watch)

    def put() -> None:
        first, future = pending.popleft()
        for key, values in future.result().items():
            joined[key][first : first + values.size] = values
        more(values.size)

    begin, threads = 0, 2  # that summarize pieces, while this one simulates the next
    with ThreadPoolExecutor(threads) as executor:
        # A piece is small enough for a core's own cache, and no power of two: rows of draws that
        # far apart would take each other's place in it.
        for simulated in start.pieces(record.inputs[: window.stop], 400):
            first, end = max(begin, window.start), begin + simulated.shape[1]
            more(min(first, end) - begin)
            begin = end
            if begin <= first:
                continue
            inside = simulated[:, first - begin :]
            if noise.paced:
                variances = [*variances]
                variances[2] = noise.sensor_variance(parameters, speed[first:end])
            work = executor.submit(
                _summarize, start, variances, scores, tails, sensor, record, first, inside
            )
            pending.append((first - window.start, work))
            totals += inside.sum(axis=1)
            # A few pieces at a time: all of them would not fit into memory.
            if len(pending) > threads:
                put()
        while pending:
            put()
    means = totals / samples
    common = float(np.var(means) + np.mean(start.offset_sd**2))
    return Bands(
        name=name,
        time=record.time[window],
        voltage=record.path.voltage[window],
        measured=None if record.displacement is None else record.displacement[window],
        truth=None if record.truth is None else record.truth[window],
        mean=joined["mean"],
        lower={(k, level): joined[f"{k} {level} lower"] for k in KINDS for level in LEVELS},
        upper={(k, level): joined[f"{k} {level} upper"] for k in KINDS for level in LEVELS},
        pit=joined.get("pit"),
        crps=joined.get("crps"),
        log_score=joined.get("log_score"),
        interval=record.interval,
        time_offset=record.time_offset,
        common_sd=float(np.sqrt(common)),
        read_sds=None if sensor is None else {k: joined[f"{k} read sd"] for k in KINDS[:2]},
    )


def _summarize(
    start: InitialStates,
    variances: Sequence[FloatArray],
    scores: FloatArray,
    tails: TailScales | None,
    sensor: SensorScale | None,
    record: Record,
    first: int,
    simulated: FloatArray,
) -> dict[str, Floating]:
    """Mean, band edges, and the judgment of the readings, each (samples,).

    ``variances`` (draws, 1 or samples), um², of offset, discrepancy, sensor and the model's error
    are added to the draws with ``scores`` (scores, draws), the same along the whole record, and the
    sensor's with its tails.
    """
    samples, unknown = simulated.shape[1], np.ones(1)
    expected = simulated
    if start.discrepancy is not None:
        remembered, explained = start.discrepancy.after(first, samples)
        expected, unknown = simulated + remembered, 1 - explained
    mean = np.mean(expected, axis=0)
    summarized: dict[str, Floating] = {"mean": mean}
    scores = scores.astype(np.float32)

    def about_mean(paths: FloatArray) -> Floating:
        """Return what draws are off their mean: single precision is then one of the band's width.

        A sample's are side by side, (samples, draws), to be sorted.
        """
        return (paths - mean).T.astype(np.float32, order="C")

    away = about_mean(expected)
    apart = away if expected is simulated else about_mean(simulated)
    offset, slow, white, error = variances
    variance = np.zeros(1)
    for kind, added in zip(KINDS, (offset, slow * unknown + error, white), strict=True):
        means = apart if kind == "parameter" else away
        rest, variance = variance, variance + added
        variance_in_um = variance
        if sensor is not None and kind != "sensor":
            read = ranked_values(means, np.sqrt(variance).astype(np.float32).T, scores)
            width = quantile(read, 0.95) - quantile(read, 0.05)
            summarized[f"{kind} read sd"] = width / WIDTH_90
            means, variance_in_um = sensor.true(means, variance, mean, kind)
        sds = np.sqrt(variance_in_um).astype(np.float32).T
        heavy = tails if kind == "sensor" else None
        if heavy is not None:
            sds = np.sqrt(rest.T[:, np.newaxis] + white.T * heavy.scales).astype(np.float32)
        ranked = ranked_values(means, sds, scores)
        for level in LEVELS:
            tail = (100 - level) / 200
            summarized[f"{kind} {level} lower"] = mean + quantile(ranked, tail)
            summarized[f"{kind} {level} upper"] = mean + quantile(ranked, 1 - tail)
        if kind == "sensor" and record.displacement is not None:
            reading = (record.displacement[first : first + samples] - mean).astype(np.float32)
            z, log_weights = reading[:, np.newaxis] - means, np.zeros(1, dtype=np.float32)
            if heavy is not None:
                # Every draw as often as its noise has values, which hold all of the tails.
                n_values = heavy.values.shape[1]
                parts = rest.T[..., np.newaxis] + white * heavy.values
                sds = np.sqrt(parts).astype(np.float32).reshape(len(parts), -1)
                z = np.repeat(z, n_values, axis=1)
                log_weights = (heavy.logs.ravel() + np.log(n_values)).astype(np.float32)
            summarized["pit"] = probability(ranked, reading)
            summarized["crps"] = crps(ranked, reading)
            summarized["log_score"] = log_density(z / sds, sds, log_weights)
    return summarized


def stratified_scores(draws: int, rng: np.random.Generator) -> FloatArray:
    """Draw standard normal scores for posterior draws, (scores, draws).

    With S draws and the least number K of scores that makes S K values 1,000 or more, draw i gets
    Φ⁻¹((j + (π_j(i) + 1/2) / S) / K) for j = 0 ... K - 1, each π_j a random permutation of
    0 ... S - 1. So each draw has a score in each of K equal parts of the probability, and all
    together have one in each of S K.
    """
    # One value of each of as many draws as predictions take: quantiles are as sure as the draws.
    n_scores = -(-1000 // draws)
    ranks = rng.permuted(np.tile(np.arange(draws), (n_scores, 1)), axis=1)
    below = (np.arange(n_scores)[:, np.newaxis] + (ranks + 0.5) / draws) / n_scores
    scores: FloatArray = scipy.special.ndtri(below)
    return scores


def ranked_values(means: Floating, sds: Floating, scores: Floating) -> Floating:
    """Return values of the mixture in ascending order, (samples, values), um.

    Parameters
    ----------
    means
        (samples, draws) mean given a draw, um.
    sds
        (samples, draws) or (1, draws) standard deviation given a draw, um, or (samples or 1,
        scores, draws) of each score. If all are zero the values are the means.
    scores
        (scores, draws) from :func:`stratified_scores`.
    """
    if not sds.any():
        return np.sort(means, axis=1)
    sds = sds if sds.ndim == 3 else sds[:, np.newaxis]
    values = (means[:, np.newaxis] + sds * scores).reshape(len(means), -1)
    values.sort(axis=1)
    return values


def stratified_scales(scores: FloatArray, inverse_df: FloatArray) -> FloatArray:
    """Return values of u (scores, draws) for normal scores: √u z has a Student t distribution.

    With 1/ν (draws,) of each draw, scaled as in :mod:`~bwbayes.inference.heavy_tails`. The i-th of
    the scores in ascending order gets the quantile of the golden ratio's i-th multiple, less its
    whole part: so any part of the plane of both probabilities holds its share of them, and
    quantiles of the products are as sure as those of the scores.
    """
    ranks = np.argsort(np.argsort(scores, axis=None)).reshape(scores.shape)
    probability = (0.5 + (np.sqrt(5) - 1) / 2 * ranks) % 1
    half = 0.5 / np.maximum(inverse_df, 1e-9)
    scales: FloatArray = (
        scale_of(inverse_df) ** 2 * half / scipy.special.gammaincinv(half, probability)
    )
    return scales


def quantile(ranked: Floating, probability: float) -> Floating:
    """Return a quantile (samples,), um, of values ranked along the last axis.

    The i-th of N values is the quantile of (i + 1/2) / N, with straight lines in between.
    """
    count = ranked.shape[1]
    rank = min(max(probability * count - 0.5, 0.0), count - 1.0)
    below, above = ranked[:, math.floor(rank)], ranked[:, math.ceil(rank)]
    line: Floating = below + (rank % 1) * (above - below)
    return line


def probability(ranked: Floating, values: Floating) -> FloatArray:
    """Return the probability (samples,) that a reading is below a value (samples,), um.

    The share of the ranked values that are, as the i-th of N is the quantile of (i + 1/2) / N; nan
    where a value is missing.
    """
    share: FloatArray = np.mean(ranked < values[:, np.newaxis], axis=1, dtype=np.float64)
    return np.where(np.isnan(values), np.nan, share)


def crps(ranked: Floating, values: Floating) -> Floating:
    """Return the continuous ranked probability score of values y (samples,), um.

    E|X - y| - E|X - X'| / 2 over the N ranked x: (2/N) Σ (x_i - y) (1{y < x_i} - (i + 1/2) / N).
    nan where a value is missing.

    Notes
    -----
    T. Gneiting and A. E. Raftery, J. Am. Stat. Assoc. 102 (2007) 359-378, section 4.2.
    """
    away = ranked - values[:, np.newaxis]
    count = ranked.shape[1]
    below = (np.arange(count, dtype=ranked.dtype) + 0.5) / count
    score: Floating = 2 * np.mean(away * ((away > 0) - below), axis=1)
    return score


def log_density(z: Floating, sds: Floating, log_weights: Floating | float = 0.0) -> Floating:
    """Return the log density (samples,), nats, per um: log (1/S) Σ a φ(z) / sd over the S draws.

    ``z`` (samples, draws) is (value - mean) / sd, and ``sds``, all above zero, as in
    :func:`ranked_values`; ``log_weights`` (draws,) are log a. nan where a value is missing.
    """
    by_draw = -0.5 * z**2 - np.log(sds) + log_weights
    largest = np.max(by_draw, axis=1)
    mean = np.mean(np.exp(by_draw - largest[:, np.newaxis]), axis=1)
    density: Floating = largest + np.log(mean) - 0.5 * math.log(2 * math.pi)
    return density
