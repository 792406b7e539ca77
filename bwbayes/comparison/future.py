"""Leaving out the future: what a model fitted to the first part of a record says of the rest of it.

Leaving out single readings tells nothing in a series whose neighbours know each other. Here the
later half of the training readings is predicted a stretch at a time, each from the readings before
it alone. The first stretch takes a fit to the readings before; for the next one the draws of that
fit are weighted by what has come to be known since, and only where too few of them would be left
(Pareto k̂ above 0.7) is the model fitted again. Of several records the later half of each is
predicted from the earlier halves of all.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from bwbayes.arrays import FloatArray, IntArray
from bwbayes.data.record import Record
from bwbayes.inference import pointfit
from bwbayes.inference.posterior import Posterior
from bwbayes.results.prediction import DRAWS, predict_windows, thinned
from bwbayes.sampling.diagnostics import smoothed_weights
from bwbayes.sampling.plan import SamplingPlan
from bwbayes.sampling.sampler import draws, first_chain, sample

__all__ = ["BELIEVED_K", "Future", "cut", "future", "joint_log_score", "reweighted"]

# Where the stretches begin that are predicted, as parts of the training readings.
STARTS = (0.5, 0.75)

# Above this Pareto k̂ weighted draws do not stand for a posterior.
BELIEVED_K = 0.7

# Effective draws of a fit to a part, and its budget.
ESS, STEPS = 400.0, 4000

# Draws that are weighted.
WEIGHTED = 4000


@dataclass(frozen=True)
class Future:
    """How well a model foretold the later training readings from the earlier ones.

    Attributes
    ----------
    log_score
        (readings,) log density of each, given all before its stretch, nats, per um; record after
        record, in order of time.
    rows
        Their samples, (readings of the record,) by its name.
    pareto_k
        Of the weights of each stretch after the first.
    fits
        How often the model was fitted.
    converged
        Whether all those fits converged.
    """

    log_score: FloatArray
    rows: Mapping[str, IntArray]
    pareto_k: tuple[float, ...]
    fits: int
    converged: bool


def future(
    posterior: Posterior,
    plan: SamplingPlan,
    records: Mapping[str, Record],
    generator: np.random.Generator,
    executor: Executor,
) -> Future:
    """Predict the later half of each record's training readings in two stretches.

    Parameters
    ----------
    posterior, plan
        What was fitted, and how.
    records
        The training records, whole, by name.
    generator
        Starts the fits, chooses draws.
    executor
        Runs the ensembles.
    """
    stretches = {one.name: _stretches(one.readings.rows) for one in posterior.datasets}
    fits, converged, shapes = 0, True, []
    scores: dict[str, list[FloatArray]] = {name: [] for name in stretches}
    flat = np.empty((0, 0))
    before: Posterior | None = None
    for number in range(len(STARTS)):
        rows = {name: each[number] for name, each in stretches.items()}
        windows = {
            one.name: cut(one.training, int(rows[one.name][0])) for one in posterior.datasets
        }
        part = posterior.trained(windows)
        weighted = None
        if before is not None:
            weighted, shape = reweighted(before, part, flat, generator)
            shapes.append(shape)
        if weighted is None:
            flat, good = _fitted(part, plan, generator, executor)
            fits, converged, before = fits + 1, converged and good, part
            weighted = flat
        for name, alone, its in part.each(thinned(weighted, generator)):
            window = slice(int(rows[name][0]), int(rows[name][-1]) + 1)
            bands = predict_windows(alone, its, records[name], {"future": window}, generator)[0]
            assert bands.log_score is not None
            scores[name].append(bands.log_score[rows[name] - window.start])
    every = np.concatenate([score for parts in scores.values() for score in parts])
    later = {name: np.concatenate(parts) for name, parts in stretches.items()}
    return Future(every, later, tuple(shapes), fits, converged)


def _stretches(rows: IntArray) -> list[IntArray]:
    """Cut a record's training readings into the stretches that are predicted."""
    edges = [round(part * rows.size) for part in STARTS] + [rows.size]
    return [rows[first:last] for first, last in pairwise(edges)]


def cut(windows: tuple[slice, ...], end: int) -> tuple[slice, ...]:
    """Return what windows have of the samples before ``end``."""
    return tuple(slice(w.start, min(w.stop, end)) for w in windows if w.start < end)


def reweighted(
    before: Posterior, after: Posterior, flat: FloatArray, generator: np.random.Generator
) -> tuple[FloatArray | None, float]:
    """Turn draws of one posterior into draws of one that knows more readings.

    A draw counts as much as it foretold what is new,
    p(readings after | θ) / p(readings before | θ).

    Returns
    -------
    tuple[FloatArray | None, float]
        (draws, free), chosen with those weights; None where too few would be left. And Pareto k̂.
    """
    some = thinned(flat, generator, WEIGHTED)
    theta = after.prior.theta(some)
    weights, shape = smoothed_weights(after.log_likelihood(theta) - before.log_likelihood(theta))
    if not shape <= BELIEVED_K:
        return None, shape
    chosen = generator.choice(len(some), DRAWS, p=weights)
    return some[chosen], shape


def _fitted(
    posterior: Posterior, plan: SamplingPlan, generator: np.random.Generator, executor: Executor
) -> tuple[FloatArray, bool]:
    """Fit a part of the readings, shortly: draws (draws, free), and whether they have converged."""
    short = replace(plan, ess=min(ESS, plan.ess), most_steps=min(STEPS, plan.most_steps))
    chain = first_chain(posterior, pointfit.fit(posterior, generator), short, generator)
    outcome = sample(posterior, short, chain, executor)
    return draws(posterior, chain).reshape(-1, len(posterior.names)), outcome.converged


def joint_log_score(
    posterior: Posterior,
    flat: FloatArray,
    windows: Mapping[str, Sequence[slice]],
    generator: np.random.Generator,
) -> tuple[float, float]:
    """Log density of all held-out readings of the training records together, given the fitted ones.

    log (1/S) Σ p(all readings | θ) / p(fitted readings | θ) over the draws θ, the discrepancy
    carried on from reading to reading. The windows that were held out go by their record's name.

    Returns
    -------
    tuple[float, float]
        Nats, and Pareto k̂ of the ratios: above 0.7 a few draws carry the sum.
    """
    theta = posterior.prior.theta(thinned(flat, generator, WEIGHTED))
    every = {
        one.name: tuple(sorted((*one.training, *windows.get(one.name, ())), key=lambda w: w.start))
        for one in posterior.datasets
    }
    longer = posterior.trained(every)
    gains = longer.log_likelihood(theta) - posterior.log_likelihood(theta)
    top = float(np.max(gains))
    if not np.isfinite(top):
        return top, np.inf
    return top + float(np.log(np.mean(np.exp(gains - top)))), smoothed_weights(gains)[1]
