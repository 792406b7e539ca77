"""Whether a fit has swallowed a switch-on transient: the start of its record tells.

A transient can drag the parameters far away while the noise model covers what is then missed
everywhere, so that neither bands nor innovations show it. So the same record is looked at with a
transient taken off its readings, A exp(−t/τ) from the first of them on: where parameters that fit
the rest of the record, with a transient at its start, are far more probable than any without one,
the fit belongs to the start.

Of another record a transient may go into its offset: in the lead-in it looks like one. There too
the readings are asked, those after the lead-in included.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from bwbayes.arrays import FloatArray
from bwbayes.data.record import Record
from bwbayes.errors import InputError
from bwbayes.inference import pointfit
from bwbayes.inference.likelihood import Likelihood
from bwbayes.inference.posterior import Posterior
from bwbayes.inference.readings import Readings
from bwbayes.results.bands import Switched
from bwbayes.results.histories import Histories, States
from bwbayes.results.moved import Moved, moved

__all__ = ["DECAYS", "Transient", "added", "swallowed", "switched"]

# Part of the readings that is left out to see what the rest says, and the time constants that are
# tried, as parts of how long that is.
PART = 0.2
DECAYS = (1.0, 1 / 2, 1 / 4, 1 / 8, 1 / 16, 1 / 32)

# Log density, nats, that a transient must add. A good record's adds half of a chi-squared of one
# degree of freedom, the largest of six that are alike, give or take a nat for the best of some
# hundred draws: in 171 good runs 4.2 at most, and once 7.0.
ADDED = 9.0

# Less is enough where the readings themselves show a switch-on transient, or where without the
# start a parameter is off by so many sds of both fits together: both would have to be wrong. In
# good runs one in forty moves so far, to another optimum.
SEEN_ADDED = 4.0
MOVED_ADDED, MOVED = 3.0, 3.0

# Log density, nats, that is enough for a doubt: odds of twenty to one, and more.
DOUBTED = 3.0

# Draws of the posterior, and of the Gaussian approximation without the start, that are compared.
COMPARED, DRAWS = 1000, 400

# A transient smaller than this part of the readings' range is left to the discrepancy, unless the
# readings themselves show it: no model follows the first branch of an actuator to the last percent.
SMALLEST = 0.05

# The transient with which the parabola in A is found, as a part of the readings' range.
TRIED = 0.05

# Fewer readings than this tell too little without their first part.
FEWEST = 200

# Of another record: draws that are asked, hysteretic states that each tries, and the samples that
# matter, for a start is soon over.
ASKED, STATES, LONGEST = 25, 9, 20_000


@dataclass(frozen=True)
class Transient:
    """A transient at a record's start, and the parameter that moves most without the start.

    ``size`` A in um, ``decay`` τ in s; it adds ``nats`` to the log density, and is not ``sure`` if
    these are few. ``until`` in s is where the start ends.
    """

    size: float
    decay: float
    nats: float
    until: float
    parameter: Moved
    sure: bool = True

    @property
    def line(self) -> str:
        """What it is, and what it has done, in one line."""
        chance = "" if self.sure else ", which may be chance"
        return (
            f"a transient of {self.size:.3g} um that decays within {self.decay:.2g} s explains its "
            f"start better, by {self.nats:.3g} nats{chance}; "
            f"without the start, up to {self.until:.4g} s, {self.parameter.line}"
        )


def swallowed(
    posterior: Posterior,
    draws: FloatArray,
    generator: np.random.Generator,
    begin: float = 0.0,
    *,
    record: str | None = None,
    seen: bool = False,
) -> Transient | None:
    """Return the transient at a record's start that its fit has swallowed, if any.

    For given parameters the log density is a parabola in A, of which three places tell the top;
    parameters are draws of the posterior, and of a second point fit that leaves out the start.

    Parameters
    ----------
    posterior
        The posterior that was sampled.
    draws
        (draws, free), parameters in their own units.
    generator
        Starts the point fit and draws from its approximation.
    begin
        Time of the record's first sample, s.
    record
        Its name; may be left out if there is one alone.
    seen
        The readings show a switch-on transient.
    """
    name = posterior.only.name if record is None else record
    one = posterior.alone(name).only
    rows = one.readings.rows
    if rows.size < FEWEST:
        return None
    first = int(rows[round(PART * rows.size)])
    later = tuple(slice(max(w.start, first), w.stop) for w in one.training if w.stop > first)
    windows = {other.name: other.training for other in posterior.datasets}
    rest = posterior.trained(windows | {name: later})
    try:
        point = pointfit.fit(rest, generator)
    except InputError:
        return None
    everywhere, without = pointfit.approximated(rest, point, generator, DRAWS)
    sampled = posterior.prior.unconstrain(draws[:COMPARED])
    length = one.actuator.interval * (first - int(rows[0]))
    nats, size, decay = added(posterior, name, np.concatenate([everywhere, sampled]), length)
    extent = float(np.ptp(one.displacement[rows]))
    if nats <= DOUBTED or not (seen or abs(size) > SMALLEST * extent):
        return None
    most = moved(posterior, one, draws, without)
    if most is None:
        return None
    sure = nats > (SEEN_ADDED if seen else ADDED) or (most.sds > MOVED and nats > MOVED_ADDED)
    return Transient(size, decay, nats, begin + one.actuator.interval * first, most, sure)


def added(
    posterior: Posterior, name: str, coordinates: FloatArray, length: float
) -> tuple[float, float, float]:
    """Return how many nats the best transient adds, its size A, um, and its time constant, s.

    To the best of all coordinates (draws, free) without one.
    """
    (one,) = (other for other in posterior.datasets if other.name == name)
    readings = {other.name: other.displacement for other in posterior.datasets}
    first = int(one.readings.rows[0])
    time = one.actuator.interval * np.maximum(np.arange(one.displacement.size) - first, 0)
    step = TRIED * float(np.ptp(one.displacement[one.readings.rows]))

    def without(size: float, decay: float) -> Posterior:
        return posterior.with_readings(
            readings | {name: one.displacement - size * np.exp(-time / decay)}
        )

    plain = posterior.log_density(coordinates)
    best = -np.inf, 0.0, length, 0
    for decay in length * np.array(DECAYS):
        both = [without(size, decay).log_density(coordinates) for size in (step, -step)]
        # Places that are not possible have no density with a transient either.
        with np.errstate(divide="ignore", invalid="ignore"):
            more, less = both[0] - plain, both[1] - plain
            bend = more + less
            sizes = np.where(bend < 0, step * (less - more) / (2 * bend), 0.0)
            top = plain - np.where(bend < 0, (more - less) ** 2 / (8 * bend), 0.0)
        row = int(np.nanargmax(np.where(np.isfinite(top), top, -np.inf)))
        best = max(best, (float(top[row]), float(sizes[row]), float(decay), row))
    _, size, decay, row = best
    # With heavy tails the parabola only leads there.
    reached = without(size, decay).log_density(coordinates[row : row + 1])
    return float(reached[0] - np.max(plain)), size, decay


def switched(
    histories: Histories, theta: FloatArray, record: Record, window: slice
) -> Switched | None:
    """Return the transient at another record's start that adds most to the log density.

    The state of the hysteresis is not known either, and goes with the transient: a drive forgets
    another state as a sensor forgets a transient.

    Parameters
    ----------
    histories
        The likelihoods of the lead-in.
    theta
        (draws, parameters).
    record, window
        The record, with readings, and what is asked of it, from the lead-in's first sample on.
    """
    assert record.displacement is not None
    first, stop, _ = window.indices(record.samples)
    readings = Readings.of(record.displacement, [slice(first, min(stop, first + LONGEST))])
    rows = readings.rows
    if rows.size < FEWEST:
        return None
    some = slice(None, None, -(-len(theta) // ASKED))
    likelihoods = tuple(replace(one, readings=readings) for one in histories.likelihoods)
    asked = Histories(likelihoods, histories.which[some])
    time = record.interval * (rows - rows[0])
    decays = time[round(PART * rows.size)] * np.array(DECAYS)
    shapes = np.exp(-time / decays[:, np.newaxis])

    def ask(one: Likelihood, few: FloatArray) -> tuple[FloatArray, ...]:
        states = States(one, few, alone=len(likelihoods) == 1)
        begun = [states.at(np.full(len(few), part)) for part in np.linspace(0, 1, STATES)]
        scores = [one.score(each, shapes) for each in begun]
        density = np.stack([one.log_density(each) for each in begun], axis=1)
        nats = np.stack([score.nats for score in scores], axis=1)
        sizes = np.stack([score.sizes for score in scores], axis=1)
        return density, density[:, :, np.newaxis] + nats, sizes

    without, with_one, sizes = asked.each(theta[some], ask)
    best = np.unravel_index(int(np.argmax(with_one)), with_one.shape)
    nats = float(with_one[best] - np.max(without))
    return Switched(float(sizes[best]), float(decays[best[-1]]), nats)
