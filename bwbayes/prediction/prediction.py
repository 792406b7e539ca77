"""Prediction: from posterior draws to displacement bands, for any voltage.

Every draw simulates the record from its first sample; given a draw, a reading is normal around its
simulation, or has the heavy tails of its sensor's noise, and the bands are quantiles of the mixture
over all draws. The record is walked through in pieces, so memory does not grow with its length. But
for a forecast, the discrepancy enters by its marginal distribution, on training windows too, where
the smoothed one would promise more than a new record can keep.

Windows of the training record share its simulation and its offset. Another record has a start of
its own, see :mod:`bwbayes.prediction.initial_state`.
"""

from __future__ import annotations

from collections import defaultdict, deque
from collections.abc import Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from bwbayes.arrays import ArrayLike, FloatArray, Floating
from bwbayes.errors import InputError
from bwbayes.inference.heavy_tails import scale_mixture
from bwbayes.inference.posterior import Posterior
from bwbayes.inference.study import InitialConditions
from bwbayes.model.inputs import rate
from bwbayes.prediction import mixture
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
        # What no fit has followed says nothing of it.
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
    longer = continued(record, planned)
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


def continued(record: Record, voltage: FloatArray) -> Record:
    """Return a record as it goes on into a planned voltage (samples,), V, without readings.

    Its covariates are unknown from there on.
    """
    full_voltage = np.concatenate([record.path.voltage, voltage])
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
    record = _known(record, posterior, theta, from_rest=start.from_rest)
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


def _known(record: Record, posterior: Posterior, theta: FloatArray, *, from_rest: bool) -> Record:
    """Return a record with those of its readings that draws θ (draws, parameters) can follow."""
    if record.displacement is None:
        return record
    actuator = replace(posterior.single_record.actuator, interval=record.interval)
    model = posterior.single_record.table.actuator(theta)
    known = actuator.known(model, record.displacement, from_rest=from_rest)
    return record if known is record.displacement else replace(record, displacement=known)


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
    scores = mixture.stratified_scores(len(theta), np.random.default_rng(len(theta)))
    noise, parameters = posterior.single_record.noise, posterior.noise_of_new(theta)
    sds, tails = noise.marginal_sd(parameters), None
    if noise.tailed:
        inverse_df = noise.inverse_df(parameters)
        scales = mixture.stratified_scales(scores, inverse_df)
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
                _summarized, start, variances, scores, tails, sensor, record, first, inside
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


def _summarized(
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
            read = mixture.ranked_values(means, np.sqrt(variance).astype(np.float32).T, scores)
            width = mixture.quantile(read, 0.95) - mixture.quantile(read, 0.05)
            summarized[f"{kind} read sd"] = width / WIDTH_90
            means, variance_in_um = sensor.true(means, variance, mean, kind)
        sds = np.sqrt(variance_in_um).astype(np.float32).T
        heavy = tails if kind == "sensor" else None
        if heavy is not None:
            sds = np.sqrt(rest.T[:, np.newaxis] + white.T * heavy.scales).astype(np.float32)
        ranked = mixture.ranked_values(means, sds, scores)
        for level in LEVELS:
            tail = (100 - level) / 200
            summarized[f"{kind} {level} lower"] = mean + mixture.quantile(ranked, tail)
            summarized[f"{kind} {level} upper"] = mean + mixture.quantile(ranked, 1 - tail)
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
            summarized["pit"] = mixture.probability(ranked, reading)
            summarized["crps"] = mixture.crps(ranked, reading)
            summarized["log_score"] = mixture.log_density(z / sds, sds, log_weights)
    return summarized
