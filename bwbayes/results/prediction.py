"""Prediction: from posterior draws to displacement bands, for any voltage.

Every draw simulates the record from its first sample; given a draw, a reading is normal around its
simulation, and the bands are quantiles of the mixture over all draws, to 2e-4 of its standard
deviation. The record is walked through in pieces, so memory does not grow with its length. The
discrepancy enters by its marginal distribution, on training windows too, where the smoothed one
would promise more than a new record can keep.

Windows of the training record share its simulation and its offset. Another record brings two
unknowns of its own: the hysteretic state it starts from, and the sensor's offset. Both are drawn
anew for every draw, and a lead-in at the record's start, which is not judged later, narrows them.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import logsumexp

from bwbayes.arrays import FloatArray
from bwbayes.data.record import Record
from bwbayes.errors import InputError
from bwbayes.inference.posterior import Posterior
from bwbayes.model.actuator import Actuator
from bwbayes.model.boucwen import hysteresis
from bwbayes.results import mixture
from bwbayes.results.along import quantiles_and_spread
from bwbayes.results.bands import KINDS, LEVELS, Bands, Kind

__all__ = ["DRAWS", "Start", "predict_record", "predict_windows", "thinned"]

# Posterior draws in the mixture.
DRAWS = 1000

# Samples that are simulated and summarised at once. Not a power of two: rows of draws that far
# apart would take each other's place in the cache.
PIECE = 4000

# Threads that summarise pieces, while this one simulates the next.
THREADS = 2

# Earlier drives that a record's initial state may come from, and their most turning points.
EARLIER_DRIVES = 16
EARLIER_TURNS = 6


@dataclass(frozen=True)
class Start:
    """What is known of the start of another record.

    Parameters
    ----------
    from_rest
        The actuator starts demagnetised (h = 0). Otherwise h is a state that some earlier drive
        within the voltage range could have left.
    own_offset
        The sensor has an offset of its own, estimated from the lead-in. Otherwise it is that of
        the training record, as it is for a planned voltage without a measurement.
    lead_in
        Length of the lead-in, s.
    """

    from_rest: bool = False
    own_offset: bool = True
    lead_in: float = 1.0


@dataclass(frozen=True)
class _Draws:
    """Model parameters (draws, model parameters) and the sds (draws,) of what they leave over."""

    model: FloatArray
    discrepancy: FloatArray
    sensor: FloatArray
    offset: FloatArray

    def sds(self, kind: Kind) -> FloatArray:
        """Sd of a band's quantity, given a draw, um."""
        variance = self.offset**2
        if kind != "parameter":
            variance = variance + self.discrepancy**2
        if kind == "sensor":
            variance = variance + self.sensor**2
        return np.sqrt(variance)


def thinned(draws: FloatArray, generator: np.random.Generator, count: int = DRAWS) -> FloatArray:
    """Choose ``count`` of the draws (any, free) without repetition; all, if there are fewer."""
    if draws.shape[0] <= count:
        return draws
    return draws[generator.choice(draws.shape[0], count, replace=False)]


def predict_windows(
    posterior: Posterior,
    draws: FloatArray,
    record: Record,
    windows: Mapping[str, slice],
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
        Slices of its samples, by name.
    """
    mixed = _draws(posterior, draws)
    bands = []
    for name, window in windows.items():
        training = any(w.start < window.stop and window.start < w.stop for w in posterior.training)
        found = _bands(name, posterior.actuator, mixed, record, window)
        bands.append(replace(found, training=training))
    return bands


def predict_record(
    posterior: Posterior,
    draws: FloatArray,
    record: Record,
    start: Start,
    generator: np.random.Generator,
    name: str = "prediction",
) -> Bands:
    """Predict another record, or a planned voltage without a measurement.

    Parameters
    ----------
    posterior, draws
        As in :func:`predict_windows`.
    record
        The other record, at any sampling interval: the model lives in continuous time.
    start
        What is known of its start.
    generator
        Draws the initial states.

    Raises
    ------
    InputError
        A lead-in that leaves nothing of the record.
    """
    posterior = replace(
        posterior,
        actuator=replace(posterior.actuator, interval=record.interval),
        noise=posterior.noise.at(record.interval),
    )
    mixed = _draws(posterior, draws)
    if not start.from_rest:
        states = _reachable(posterior, mixed.model, record.voltage, generator)
    else:
        states = np.zeros((1, draws.shape[0]))
    lead_in = 0
    if record.displacement is not None and start.own_offset:
        lead_in = round(start.lead_in / record.interval)
        if not 1 <= lead_in < record.samples:
            raise InputError(
                f"{record.origin}: a lead-in of {start.lead_in:g} s leaves nothing of "
                f"{record.duration:g} s; choose a shorter one"
            )
        mixed = _informed(posterior, mixed, states, draws, record, lead_in, generator)
    else:
        chosen = generator.integers(states.shape[0], size=draws.shape[0])
        mixed = _starting_at(posterior, mixed, states[chosen, np.arange(draws.shape[0])])
    whole = slice(0, record.samples)
    found = _bands(name, posterior.actuator, mixed, record, whole)
    return replace(found, scored_from=lead_in)


def _draws(posterior: Posterior, draws: FloatArray) -> _Draws:
    theta = posterior.prior.theta(draws)
    size = len(posterior.actuator.parameters)
    discrepancy, sensor = posterior.noise.marginal_sd(theta[:, size:])
    return _Draws(theta[:, :size], discrepancy, sensor, np.zeros(draws.shape[0]))


def _column(posterior: Posterior, name: str) -> int:
    return posterior.actuator.parameters.index(name)


def _starting_at(posterior: Posterior, mixed: _Draws, states: FloatArray) -> _Draws:
    model = mixed.model.copy()
    model[:, _column(posterior, "initial")] = states
    return replace(mixed, model=model)


def _reachable(
    posterior: Posterior, model: FloatArray, voltage: FloatArray, generator: np.random.Generator
) -> FloatArray:
    """Draw initial states (drives, draws): where earlier drives, from rest, leave each draw.

    A drive turns at random voltages within the range of this record and the training record, and
    ends at this record's first voltage.
    """
    low = min(float(np.min(voltage)), float(np.min(posterior.voltage)))
    high = max(float(np.max(voltage)), float(np.max(posterior.voltage)))
    column = dict(zip(posterior.actuator.parameters, model.T, strict=True))
    shape = {name: column[name] for name in ("alpha", "beta", "gamma", "exponent")}
    states = np.empty((EARLIER_DRIVES, model.shape[0]))
    for drive in range(EARLIER_DRIVES):
        turns = generator.uniform(low, high, generator.integers(1, EARLIER_TURNS + 1))
        path = np.concatenate([[0.0], turns, voltage[:1]])
        states[drive] = hysteresis(path, **shape)[:, -1]
    return states


def _informed(
    posterior: Posterior,
    mixed: _Draws,
    states: FloatArray,
    draws: FloatArray,
    record: Record,
    lead_in: int,
    generator: np.random.Generator,
) -> _Draws:
    """Let the lead-in choose every draw's initial state and tell its offset.

    Given a draw and a state, the lead-in's log density is quadratic in the offset, whose prior is
    normal around the lead-in's mean with the sd of the training record's range: so the offset's
    posterior is normal, and the state is drawn by its marginal density. The other parameters keep
    the posterior that the training record gave them.
    """
    assert record.displacement is not None
    reading = record.displacement[:lead_in]
    wide = float(np.ptp(posterior.displacement))
    noise = posterior.prior.theta(draws)[:, len(posterior.actuator.parameters) :]
    log_marginal, mean, variance = [], [], []
    for state in states:
        model = _starting_at(posterior, mixed, state).model
        model[:, _column(posterior, "offset")] = np.mean(reading)
        residual = reading - posterior.actuator.displacement(model, record.voltage[:lead_in])
        # Three points fix the quadratic.
        step = wide / 100
        below, here, above = (
            posterior.noise.log_density(noise, residual + shift) for shift in (step, 0.0, -step)
        )
        slope = (above - below) / (2 * step)
        precision = (2 * here - above - below) / step**2 + 1 / wide**2
        mean.append(np.mean(reading) + slope / precision)
        variance.append(1 / precision)
        log_marginal.append(here + 0.5 * slope**2 / precision - 0.5 * np.log(precision))
    columns = np.arange(draws.shape[0])
    weight = np.exp(log_marginal - logsumexp(log_marginal, axis=0))
    uniform = generator.uniform(size=draws.shape[0])
    chosen = np.minimum(np.sum(np.cumsum(weight, axis=0) < uniform, axis=0), len(states) - 1)
    informed = _starting_at(posterior, mixed, states[chosen, columns])
    informed.model[:, _column(posterior, "offset")] = np.array(mean)[chosen, columns]
    return replace(informed, offset=np.sqrt(np.array(variance)[chosen, columns]))


def _bands(name: str, actuator: Actuator, mixed: _Draws, record: Record, window: slice) -> Bands:
    """Walk through a record and summarise the mixture over a window."""
    pieces = _simulated(actuator, mixed.model, record.voltage, window)
    parts: list[dict[str, FloatArray]] = []
    pending: deque[Future[dict[str, FloatArray]]] = deque()
    with ThreadPoolExecutor(THREADS) as executor:
        for first, simulated in pieces:
            pending.append(executor.submit(_summarised, mixed, record, first, simulated))
            # A few pieces at a time: all of them would not fit into memory.
            if len(pending) > THREADS:
                parts.append(pending.popleft().result())
        parts += [one.result() for one in pending]
    joined = {key: np.concatenate([part[key] for part in parts]) for key in parts[0]}
    return Bands(
        name=name,
        time=record.time[window],
        voltage=record.voltage[window],
        measured=None if record.displacement is None else record.displacement[window],
        truth=None if record.truth is None else record.truth[window],
        mean=joined["mean"],
        lower={(k, level): joined[f"{k} {level} lower"] for k in KINDS for level in LEVELS},
        upper={(k, level): joined[f"{k} {level} upper"] for k in KINDS for level in LEVELS},
        pit=joined.get("pit"),
        crps=joined.get("crps"),
        interval=record.interval,
    )


def _simulated(
    actuator: Actuator, model: FloatArray, voltage: FloatArray, window: slice
) -> Iterator[tuple[int, FloatArray]]:
    """Yield first sample and simulations (draws, samples) of the pieces that make up a window."""
    state = None
    for first in range(0, window.stop, PIECE):
        piece = voltage[first : min(first + PIECE, window.stop)]
        simulated, state = actuator.advance(model, piece, state)
        skipped = max(window.start - first, 0)
        if skipped < piece.size:
            yield first + skipped, simulated[:, skipped:]


def _summarised(
    mixed: _Draws, record: Record, first: int, simulated: FloatArray
) -> dict[str, FloatArray]:
    """Mean, band edges, and the judgement of the readings, each (samples,)."""
    tails = np.array([(100 - level) / 200 for level in LEVELS])
    summarised = {"mean": np.mean(simulated, axis=0)}
    spread = {}
    for kind in KINDS:
        edges, spread[kind] = quantiles_and_spread(
            simulated, mixed.sds(kind), np.concatenate([tails, 1 - tails])
        )
        for i, level in enumerate(LEVELS):
            summarised[f"{kind} {level} lower"] = edges[i]
            summarised[f"{kind} {level} upper"] = edges[len(LEVELS) + i]
    if record.displacement is not None:
        reading = record.displacement[first : first + simulated.shape[1]]
        summarised["pit"], distance = mixture.judged(simulated, mixed.sds("sensor"), reading)
        summarised["crps"] = distance - spread["sensor"]
    return summarised
