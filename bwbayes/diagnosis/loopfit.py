"""Regression of the displacement on the voltage alone, loops included.

A displacement follows the voltage with a lag and along hysteresis loops. :func:`fit_loop` fits a
sum of play operators of the lagged voltage, which approximates any closed loop, by least squares:
the fit has no physical meaning, but its residual is more than an actuator does by itself.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import scipy

from bwbayes.arrays import BoolArray, FloatArray, IntArray
from bwbayes.model.inputs import turning_points
from bwbayes.record.record import Record

# Half widths of the plays, as fractions of half the voltage's range; the state at the start of
# every other one is free.
WIDTHS = np.array([0.04, 0.1, 0.2, 0.35, 0.5, 0.7])
FREE_STARTS = slice(2, None, 2)

# Longest time of a decay, as a fraction of the record; a longer one is a drift.
LONG_DECAY = 0.13


@dataclass(frozen=True)
class LoopFit:
    """Dependence of a record's displacement on its voltage.

    Parameters
    ----------
    rows : array (rows,)
        The samples used in the fit, all with readings.
    residual : array (rows,), um
        Residual of loops, decay and trend.
    gain : float, um/V
        Displacement per volt of a large, slow drive.
    lag : float, s
        Time constant with which the displacement follows.
    decay, decay_time : float, um and s
        Transient that decays from the first reading on, whatever the voltage does.
    start : float, um
        Total deviation of the displacement at the start: the decay, and the effect of another state
        of the plays.
    decay_left : float
        Part of the sum of squares without the decay that is left with it.
    decay_share : float
        Part of the decay's variance that loops, creep and a trend do not imitate; if it is small,
        neither `decay` nor `start` means anything.
    trend : float, um
        Change of the displacement from the first reading to the last at equal voltages: a linear
        trend, and a decay that takes longer than `LONG_DECAY`.
    trend_share : float
        Part of the trend's variance that loops and creep do not imitate.
    explained : float
        Part of the displacement's variance that the voltage explains, at most 1.
    missed : float
        Part of the displacement's variance that is neither explained nor white noise.
    without_loops : float
        Probability (F test, for white noise) that a curve and a lag leave so much more than loops
        do if there are no loops.
    driven_decay, driven_trend : float, um
        Largest decay and trend that the voltage may cause, by creep and by small hysteresis loops
        that do not close.
    """

    rows: IntArray
    residual: FloatArray
    gain: float
    lag: float
    decay: float
    decay_time: float
    start: float
    decay_left: float
    decay_share: float
    trend: float
    trend_share: float
    explained: float
    missed: float
    without_loops: float
    driven_decay: float
    driven_trend: float


def fit_loop(record: Record) -> LoopFit:
    """Fit loops and creep to a record's readings."""
    assert record.displacement is not None
    rows = _rows(record.voltage, np.flatnonzero(record.has_reading))
    has_reading = record.has_reading[rows]
    displacement, time = record.displacement[rows[has_reading]], record.time[rows[has_reading]]
    centered, elapsed = displacement - displacement.mean(), time - time[0]
    trend_shape = elapsed / elapsed[-1] - 0.5
    times = np.geomspace(max(elapsed[1], 1e-5 * elapsed[-1]), elapsed[-1] / 6, 20)
    decays = np.exp(-elapsed[:, np.newaxis] / times)
    columns = np.column_stack([decays, centered])
    among_columns = _products(columns, columns)

    lags, fits = _lags(record), []
    lagged_voltages = [_lag_voltage(record.voltage, lag / record.interval)[rows] for lag in lags]
    for lag, loops in zip(lags, _bases(np.array(lagged_voltages), has_reading), strict=True):
        basis = np.column_stack([loops, trend_shape])
        fits.append((*_best_decay(basis, columns, among_columns), basis, float(lag)))
    remainder, _, basis, lag = min(fits, key=lambda fit: fit[0])
    creep, slow = _slow(_lag_voltage(record.voltage, lag / record.interval), rows[has_reading])
    design, which, coefficients = _with_creep(basis, creep, columns, among_columns)
    # A gain and a half is creep of 7% a decade: negative or larger creep is something else.
    slope = np.ptp(centered) / max(float(np.ptp(record.voltage)), 1e-300)
    if not 0 <= coefficients[1] < 1.5 * slope:
        nothing = np.zeros(creep.size)
        design, which, coefficients = _with_creep(basis, nothing, columns, among_columns)
    among = _products(design, design)
    imitated = np.abs(_inverse(among) @ _products(design, slow)).sum(axis=1)
    residual = centered - (design * coefficients).sum(axis=1)
    undriven = (design[:, -2:] * coefficients[-2:]).sum(axis=1)
    driven = centered - undriven
    drift = undriven if times[which] > LONG_DECAY * elapsed[-1] else coefficients[-2] * trend_shape
    alone = np.column_stack([design[:, :-2], drift])
    among_alone = _products(alone, alone)
    trend_share = _distinct(among_alone)
    followed = np.abs(_inverse(among_alone) @ _products(alone, slow)).sum(axis=1)
    lagged = basis[:, 1] - basis[:, 1].mean()

    def curved(samples: float) -> float:
        """Return the sum of squares that a curve without loops leaves behind a lag."""
        u = _lag_voltage(record.voltage, samples)[rows[has_reading]]
        u = (u - u.mean()) / max(float(np.ptp(u)), 1e-300)
        curve = np.column_stack([np.ones(u.size), u, u**2, trend_shape])
        return _best_decay(curve, columns, among_columns)[0]

    # Loops imitate the remaining error of a lag: search for the lag between those above.
    samples = lags / record.interval
    nearest = int(np.argmin([curved(lag) for lag in samples]))
    between = samples[max(nearest - 1, 0)], samples[min(nearest + 1, samples.size - 1)]
    optimum = scipy.optimize.minimize_scalar(curved, bounds=between, method="bounded")
    (loops,) = _bases(_lag_voltage(record.voltage, optimum.x)[np.newaxis, rows], has_reading)
    basis_behind = np.column_stack([loops, trend_shape])
    behind_lag = _best_decay(basis_behind, columns, among_columns)[0]
    remainder = min(remainder, behind_lag)
    added, degrees = basis.shape[1] - 4, max(centered.size - basis.shape[1] - 2, 1)
    ratio = (optimum.fun - remainder) / added / max(remainder / degrees, 1e-300)
    gain = float(lagged @ (driven - residual) / max(float(lagged @ lagged), 1e-300))
    # White noise, by the median of differences: that of χ² of one degree of freedom is 0.4549.
    white = float(np.median(np.diff(residual) ** 2)) / (2 * 0.4549)
    return LoopFit(
        rows[has_reading],
        residual,
        gain,
        lag,
        float(coefficients[-1]),
        float(times[which]),
        float(design[0, 4 + WIDTHS.size :] @ coefficients[4 + WIDTHS.size :])
        + coefficients[-2] / 2,
        _decay_left(residual, float(coefficients[-1]), among),
        _distinct(among),
        float(drift[-1] - drift[0]),
        trend_share,
        # A trend that loops imitate may be theirs, as where the voltage only rises.
        1
        - float(
            np.var(residual) / max(np.var(driven), (1 - trend_share) * np.var(centered), 1e-300)
        ),
        max(float(np.var(residual) - white), 0.0) / max(np.var(centered), 1e-300),
        float(scipy.stats.f.sf(ratio, added, degrees)),
        abs(gain) * float(imitated[-1]),
        abs(gain * (drift[-1] - drift[0])) * float(followed[-1]),
    )


def _lags(record: Record) -> FloatArray:
    """Return the lags to try, s: none, and from half an interval to a part of a half turn."""
    turns = turning_points(record.voltage, 0.1 * float(np.ptp(record.voltage)))
    edges = np.concatenate([[0], turns, [record.samples - 1]])
    slowest = 0.3 * record.interval * float(np.median(np.diff(edges)))
    lagging = np.geomspace(0.5 * record.interval, max(slowest, record.interval), 9)
    return np.concatenate([[0.0], lagging])


def find_delay(record: Record, limit: float) -> tuple[float, float]:
    """Return the delay, s, behind which loops of the voltage fit best, and their mean square, um².

    The delay is within ``limit`` s of either sign; there is no lag. If the displacement falls with
    the voltage, nothing of it is fitted: half a period of a sine is another sign, not a delay.
    """
    assert record.displacement is not None
    rows = _rows(record.voltage, np.flatnonzero(record.has_reading))
    rows = rows[record.has_reading[rows]]
    time, begin = record.time, record.start
    rows = rows[(time[rows] >= begin + limit) & (time[rows] <= begin + record.duration - limit)]
    # Half a period, after which loops do not depend on the start, or half of a short record.
    is_fitted = time[rows] >= begin + min(3 * limit, record.duration / 2)
    displacement = record.displacement[rows[is_fitted]]
    centered = displacement - displacement.mean()
    trend = np.linspace(-0.5, 0.5, centered.size)

    def missed(delays: FloatArray) -> list[float]:
        voltages = np.interp(time[rows] - delays[:, np.newaxis], time, record.voltage)
        left = []
        for voltage, loops in zip(voltages, _bases(voltages, is_fitted), strict=True):
            basis = np.column_stack([loops, trend])
            products = _products(basis, centered[:, np.newaxis])[:, 0]
            fitted = (basis * (_inverse(_products(basis, basis)) @ products)).sum(axis=1)
            rises = voltage[is_fitted] @ centered > 0
            left.append(float(np.mean((centered - fitted * rises) ** 2)))
        return left

    # Loops imitate most of a delay: its own minimum is narrow.
    tried = np.linspace(-limit, limit, 81)
    nearest = int(np.argmin(missed(tried)))
    between = tried[max(nearest - 1, 0)], tried[min(nearest + 1, tried.size - 1)]
    optimum = scipy.optimize.minimize_scalar(
        lambda delay: missed(np.array([delay]))[0], bounds=between, method="bounded"
    )
    return float(optimum.x), float(optimum.fun)


def _rows(voltage: FloatArray, readings: IntArray) -> IntArray:
    """Return the samples to use: the voltage's extremes, and readings, more of the early ones."""
    max_terms = 3000  # samples of each kind
    evenly = readings[:: -(-readings.size // max_terms)]
    early = readings[np.geomspace(1, readings.size, 400).astype(np.int64) - 1]
    size = -(-2 * voltage.size // max_terms)
    blocks = voltage[: voltage.size // size * size].reshape(-1, size)
    first = size * np.arange(len(blocks))
    extremes = np.concatenate([first + blocks.argmin(axis=1), first + blocks.argmax(axis=1)])
    return np.unique(np.concatenate([[0], evenly, early, extremes]))


def _lag_voltage(voltage: FloatArray, samples: float) -> FloatArray:
    """Return the voltage behind a first-order lag that is settled at its start."""
    if samples == 0:
        return voltage
    decay = np.exp(-1 / samples)
    follow = scipy.signal.lfilter([1 - decay], [1.0, -decay], voltage - voltage[0])
    return np.asarray(voltage[0] + follow)


def _bases(voltages: FloatArray, has_reading: BoolArray) -> Iterator[FloatArray]:
    """Yield columns that span the loops of each of some voltages (lags, rows), at readings."""
    low, high = voltages.min(axis=1), voltages.max(axis=1)
    half = np.maximum((high - low) / 2, 1e-300)
    scaled = (voltages - ((low + high) / 2)[:, np.newaxis]) / half[:, np.newaxis]
    widths = np.concatenate([WIDTHS, WIDTHS[FREE_STARTS]])
    state = scaled[:, :1] + np.concatenate([np.zeros(WIDTHS.size), WIDTHS[FREE_STARTS]])
    # Go row by row, with all lags side by side.
    lower = scaled.T[:, :, np.newaxis] - widths
    upper = scaled.T[:, :, np.newaxis] + widths
    plays = np.empty((scaled.shape[1], *state.shape))
    for row in range(len(plays)):
        state = np.minimum(np.maximum(state, lower[row]), upper[row], out=plays[row])
    for outputs, x, size in zip(plays.swapaxes(0, 1), scaled, half, strict=True):
        # The effect of another initial state, until the drive has erased it.
        unknown = outputs[:, WIDTHS.size :] - outputs[:, : WIDTHS.size][:, FREE_STARTS]
        shown = size * outputs[:, : WIDTHS.size]
        yield np.column_stack([np.ones(x.size), size * x, shown, x**2, unknown])[has_reading]


def _slow(voltage: FloatArray, rows: IntArray) -> tuple[FloatArray, FloatArray]:
    """Return slow responses to a voltage (samples,) beside closed loops, at rows, for a gain of 1.

    Returns creep of 5% of the gain in each decade of the time from ten samples on, (rows,); and the
    creep of each decade, with the states of two Bouc-Wen models, h' = 0.4 u' - b (|u'| h + u' |h| /
    2), whose small loops do not close, and the effect of their largest initial state, (rows,
    decades + 4).
    """
    times = 10.0 ** np.arange(1.0, max(np.log10(voltage.size), 1.1))
    decades = 0.05 * np.stack([_lag_voltage(voltage, time)[rows] for time in times], axis=1)
    half = max(float(np.ptp(voltage)) / 2, 1e-300)
    rates = np.array([1.0, 3.0])
    h = np.stack([np.zeros(2), 0.4 / (1.5 * rates)])
    states = np.zeros((rows.size, 2, 2))
    states[0] = h
    for row, step in enumerate(np.diff(voltage[rows] / half).tolist(), 1):
        h = (h + 0.4 * step) / (1 + rates * (abs(step) + step * np.sign(h) / 2))  # stable
        states[row] = h
    begun = states[:, 1] - states[:, 0]
    return decades.sum(axis=1), np.column_stack([decades, half * states[:, 0], half * begun])


def _best_decay(
    basis: FloatArray, columns: FloatArray, among_columns: FloatArray
) -> tuple[float, int]:
    """Return the least sum of squares with the basis and one decay, and which decay that is.

    ``columns`` are the decays and the values; ``among_columns`` are their products.
    """
    among = _products(basis, columns)
    remainder = among_columns - among.T @ _inverse(_products(basis, basis)) @ among
    power = np.diag(remainder)[:-1]
    distinct = power > 1e-3 * np.diag(among_columns)[:-1]
    gained = np.where(distinct, remainder[-1, :-1] ** 2 / np.maximum(power, 1e-300), 0.0)
    which = int(np.argmax(gained))
    return float(remainder[-1, -1] - gained[which]), which


def _with_creep(
    basis: FloatArray, creep: FloatArray, columns: FloatArray, among_columns: FloatArray
) -> tuple[FloatArray, int, FloatArray]:
    """Fit the basis with creep (readings,) and the best decay to the last of the columns.

    Returns the design, (readings, n), with creep second and the decay last, which decay that is,
    and the coefficients (n,).
    """
    full = np.column_stack([basis[:, 0], creep, basis[:, 1:]])
    _, which = _best_decay(full, columns, among_columns)
    design = np.column_stack([full, columns[:, which]])
    return (
        design,
        which,
        _inverse(_products(design, design)) @ _products(design, columns[:, -1:])[:, 0],
    )


def _decay_left(residual: FloatArray, decay: float, among: FloatArray) -> float:
    """Return the part of the sum of squares without a decay, the last column, that is left."""
    squares = float(residual @ residual)
    return squares / max(squares + decay**2 / max(float(_inverse(among)[-1, -1]), 1e-300), 1e-300)


def _products(first: FloatArray, second: FloatArray) -> FloatArray:
    """Return ``left.T @ right`` of tall matrices, without the threads of a linear algebra library.

    Their start takes many times longer than the work.
    """
    result: FloatArray = np.einsum("ni,nj->ij", first, second)
    return result


def _distinct(products: FloatArray) -> float:
    """Return the part of the last column's variance that the others do not imitate.

    The first of the columns whose products these are is constant.
    """
    shared = products[:-1, -1]
    total = products[-1, -1] - shared[0] ** 2 / products[0, 0]
    remainder = products[-1, -1] - shared @ _inverse(products[:-1, :-1]) @ shared
    return float(remainder / max(total, 1e-300))


def _inverse(products: FloatArray) -> FloatArray:
    """Return the inverse of a matrix of products, without directions that are nearly dependent."""
    scale = np.sqrt(np.maximum(np.diag(products), 1e-300))
    scales = np.outer(scale, scale)
    result: FloatArray = np.linalg.pinv(products / scales, rcond=1e-9, hermitian=True) / scales
    return result
