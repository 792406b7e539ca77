"""Whether what a model misses follows the drive: then another drive may be missed by more.

A disturbance of the sensor or of the room does not know the voltage; what a wrong model misses does
comes back wherever the drive does the same again. Each residual, less its mean over a period of the
drive, is held against the mean of those where the drive was most alike, at other times. The
correlation of both is compared with that of residuals drawn from the fitted noise, which has the
residual's size and memory and knows nothing of the drive.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy

from bwbayes.arrays import FloatArray, IntArray
from bwbayes.diagnosis.finding import Finding
from bwbayes.inference.defaults import rounding_sd
from bwbayes.inference.posterior import Posterior
from bwbayes.model.reversals import time_between_turns, turning_points

# Probability of a false alarm, of a residual that does not follow the drive; and the correlation
# from which on it matters: a twentieth of the residual's variance follows the drive then.
ALARM, MATTERS = 0.02, 0.1

# Nearest states of the drive that a residual is compared with, and readings that are looked at.
NEIGHBORS, READINGS = 4, 1_500

# Times over which the voltage is averaged, in parts of the time between reversals.
AVERAGES = (0.2, 0.6)

# Residuals that are drawn; draws whose mean is what the model does.
DRAWN, MEAN_OF = 200, 40


@dataclass(frozen=True)
class DriveLock:
    """How the residual goes with that at like states of the drive: correlation, and p value.

    ``p_value`` is the probability that noise which knows nothing of the drive has it as large.
    """

    correlation: float
    p_value: float

    @property
    def locked(self) -> bool:
        """Whether the residual follows the drive."""
        return self.p_value < ALARM and self.correlation > MATTERS

    @property
    def numbers(self) -> dict[str, object]:
        """What ``summary.json`` has of it."""
        return {
            "correlation": self.correlation,
            "p_value": self.p_value,
            "follows_the_drive": self.locked,
        }

    @property
    def findings(self) -> tuple[Finding, ...]:
        """What to know, and to do, of a residual that follows the drive."""
        if not self.locked:
            return ()
        text = (
            "what the model misses follows the drive "
            f"(correlation {self.correlation:.2g}, p = {max(self.p_value, 1e-6):.1g}): the bands "
            "hold for drives like the training record's; another drive may be missed"
        )
        fix = "train on a record with reversals at all voltages, such as a multisine"
        return (Finding("model error", text, fix),)


def drive_locks(
    posterior: Posterior, draws: FloatArray, rng: np.random.Generator
) -> dict[str, DriveLock]:
    """Tell of each record of a posterior whether what the model misses follows the drive."""
    each = posterior.each(draws)
    return {name: drive_lock(alone, own_draws, rng) for name, alone, own_draws in each}


def drive_lock(posterior: Posterior, draws: FloatArray, rng: np.random.Generator) -> DriveLock:
    """Tell whether what the model of a posterior of one record misses follows the drive.

    Of ``draws`` (draws, free), parameters in their own units, some hundred are used, and of long
    records some thousand readings.
    """
    record, readings = posterior.only, posterior.only.readings
    if readings.rows.size <= 10 * NEIGHBORS:
        return DriveLock(0.0, 1.0)  # they tell nothing
    theta = posterior.prior.theta(draws[rng.integers(len(draws), size=DRAWN)])
    rows = readings.rows[:: -(-readings.rows.size // READINGS)]
    missed = record.displacement[rows]
    missed = missed - np.mean(posterior.simulate(theta[:MEAN_OF], rows), axis=0)
    if float(np.std(missed)) < rounding_sd(readings.values):
        return DriveLock(0.0, 1.0)  # it rounds, which follows the drive as well
    # On a grid as coarse as the readings.
    step = int(np.gcd.reduce(np.diff(rows)))
    places = (rows - rows[0]) // step
    noise = record.noise.at(step * record.actuator.interval)
    discrepancy, sensor = noise.draw_all(record.table.noise(theta), int(places[-1]) + 1, rng)
    return compare(missed, (discrepancy + sensor)[:, places], record.voltage, rows)


def compare(
    residual: FloatArray, drawn: FloatArray, voltage: FloatArray, rows: IntArray
) -> DriveLock:
    """Compare how a residual (readings,) goes with like states of the drive with what chance does.

    Parameters
    ----------
    residual
        What the model misses, um.
    drawn
        Residuals (draws, readings) of noise that knows nothing of the drive.
    voltage
        The drive (samples,), V.
    rows
        The samples (readings,) of the readings.
    """
    turn_time = time_between_turns(voltage[: rows[-1] + 1], 1.0)
    like = like_states(voltage, rows, turn_time)
    series = np.concatenate([residual[np.newaxis], drawn])
    # What is slower than a period of the drive may be a drift, and hides the rest.
    first = np.searchsorted(rows, rows - turn_time)
    last = np.searchsorted(rows, rows + turn_time, side="right")
    sums = np.cumsum(np.pad(series, ((0, 0), (1, 0))), axis=1)
    series = series - (sums[:, last] - sums[:, first]) / (last - first)
    series -= series.mean(axis=1, keepdims=True)
    mean = series[:, like].mean(axis=2)
    mean -= mean.mean(axis=1, keepdims=True)
    norms = np.linalg.norm(series, axis=1) * np.linalg.norm(mean, axis=1)
    z, *chance = np.arctanh(np.sum(series * mean, axis=1) / np.maximum(norms, 1e-300))
    score = (z - np.mean(chance)) / np.std(chance)
    return DriveLock(float(np.tanh(z)), float(scipy.stats.norm.sf(score)))


def like_states(voltage: FloatArray, rows: IntArray, turn_time: float) -> IntArray:
    """Return the readings (readings, neighbors) where the drive was most alike.

    The drive's state is the voltage, its means over some times before, and its last reversal. They
    are at least the time between two reversals, in samples, away.
    """
    sums = np.concatenate([[0.0], np.cumsum(voltage)])
    columns = [voltage[rows]]
    for part in AVERAGES:
        first = np.maximum(rows + 1 - max(round(part * turn_time), 1), 0)
        columns.append((sums[rows + 1] - sums[first]) / (rows + 1 - first))
    turns = np.concatenate([[0], turning_points(voltage)])
    columns.append(voltage[turns[np.searchsorted(turns, rows, side="right") - 1]])
    state = np.stack(columns, axis=1)
    distance = scipy.spatial.distance.cdist(state, state)
    distance[np.abs(np.subtract.outer(rows, rows)) < turn_time] = np.inf
    like: IntArray = np.argpartition(distance, NEIGHBORS, axis=1)[:, :NEIGHBORS]
    return like
