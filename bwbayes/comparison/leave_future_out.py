"""Leave-future-out scores: how probable a model held later readings, given the earlier ones.

Readings that follow one another are no independent votes. A model's score on a part of a record is
the joint density of the part's readings, given all readings before. The noise model knows how each
reading follows from the last, so that correlation is counted once. That density is a ratio of
evidences, log p(later | earlier) = log Z(all) − log Z(earlier). Posteriors that differ by some
readings share enough of their draws for all the ratios on the way from one to the other. They are
computed block by block, which tells how sure the difference of two models is.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
import scipy

from bwbayes.arrays import FloatArray, IntArray
from bwbayes.inference.map_estimate import MAPEstimate
from bwbayes.inference.posterior import Posterior
from bwbayes.prediction.bands import Bands
from bwbayes.prediction.prediction import thin_draws
from bwbayes.sampling.chain import Phase, draws
from bwbayes.sampling.diagnostics import ConvergenceDiagnostics, autocorrelation_time
from bwbayes.sampling.plan import SamplingPlan
from bwbayes.sampling.sampler import init_chain, sample
from bwbayes.watching import Watch, WatchSteps, part, unwatched, watched

# The name of the later half of the training readings.
FUTURE = "later training"

# Blocks of a part.
BLOCKS = 10

# Draws of a posterior that enter the ratios.
DRAWS = 500


@dataclass(frozen=True)
class Part:
    """Later readings, and how probable a model held them.

    Attributes
    ----------
    log_scores
        (blocks,) log density of each block of readings, nats, given all readings before it; of
        another record the sum of its readings' own log densities.
    readings
        Their number.
    independent
        Independent readings that the residuals are worth: their number over their integrated
        autocorrelation time.
    joint
        Whether the densities are joint ones. If not, what they count is ``independent``.
    effective
        Effective draws behind the scores: their Monte Carlo variance is one over this.
    """

    log_scores: FloatArray
    readings: int
    independent: float
    joint: bool = True
    effective: float = np.inf


def leave_future_out(
    posterior: Posterior,
    plan: SamplingPlan,
    flat: FloatArray,
    held_out: Mapping[str, Mapping[str, tuple[slice, ...]]],
    rng: np.random.Generator,
    executor: Executor,
    *,
    future: bool = True,
    watch: WatchSteps = unwatched,
) -> dict[str, Part]:
    """Score the later half of the training readings, and the held-out windows of the same records.

    Parameters
    ----------
    posterior, plan, flat
        The fitted posterior, its sampling plan and draws (draws, free), in the parameters' units.
    held_out
        Windows by their names, by the names of the training records.
    rng, executor
        Starts fits, chooses draws; runs the ensembles.
    future
        Whether to score the later half of the training readings, given the earlier one, which
        takes a fit to the earlier one.
    watch
        Called with the name of a step and the share of it that is done.

    Returns
    -------
    dict[str, Part]
        By name, in order. Without the later half of the training readings if the fit to the
        earlier one has not converged, and without a part that has no readings.
    """
    parts: dict[str, Part] = {}
    datasets = {dataset.name: dataset for dataset in posterior.datasets}
    training = {name: dataset.training for name, dataset in datasets.items()}
    if future:
        rows = {name: dataset.readings.rows for name, dataset in datasets.items()}
        later = {name: readings[readings.size // 2 :] for name, readings in rows.items()}
        path = _path(posterior, dict.fromkeys(training, ()), training, later)
        earlier = _fitted(path[0], plan, flat, rng, executor, partial(watch, "earlier training"))
        if earlier is not None:
            scoring = partial(watch, FUTURE)
            parts[FUTURE] = _scored(path, {0: earlier, BLOCKS: flat}, later, rng, scoring)
    for record, named in held_out.items():
        for name, windows in named.items():
            window_rows = np.concatenate([np.arange(w.start, w.stop) for w in windows])
            later = {record: window_rows[np.isfinite(datasets[record].displacement[window_rows])]}
            if not later[record].size:
                continue
            path = _path(posterior, training, {record: windows}, later)
            training = {dataset.name: dataset.training for dataset in path[-1].datasets}
            score = _scored(path, {0: flat}, later, rng, partial(watch, name))
            # Too few draws are effective at the far end: that end is sampled too.
            if score.effective < 100:
                again = partial(watch, f"training and {name}")
                longer = _fitted(path[-1], plan, flat, rng, executor, part(again, 0.0, 0.8))
                if longer is not None:
                    drawn = {0: flat, BLOCKS: longer}
                    score = _scored(path, drawn, later, rng, part(again, 0.8, 1.0))
                    flat = longer
            parts[name] = score
    return parts


def _path(
    posterior: Posterior,
    training: Mapping[str, tuple[slice, ...]],
    added: Mapping[str, tuple[slice, ...]],
    rows: Mapping[str, IntArray],
) -> list[Posterior]:
    """Return the posteriors on the way from training windows to those and added ones.

    ``rows`` are the later readings in the added windows; each step adds a block of them.
    """
    path = []
    for k in range(BLOCKS + 1):
        windows = dict(training)
        for name, later in rows.items():
            end = int(later[k * later.size // BLOCKS]) if k < BLOCKS else added[name][-1].stop
            later_windows = [slice(w.start, min(w.stop, end)) for w in added[name] if w.start < end]
            fitted = [*training[name], *later_windows]
            windows[name] = tuple(sorted(fitted, key=lambda window: window.start))
        path.append(posterior.trained(windows))
    return path


def bands_part(bands: Bands) -> Part | None:
    """Return the part that another record is, from its bands; None without a reading to judge.

    Each draw has its own initial state, so the joint density of all readings would be that of the
    luckiest draw. The readings' own densities are taken instead, as if they were independent.
    """
    rows = bands.scored(bands.log_score)
    if bands.measured is None or bands.log_score is None or not rows.any():
        return None
    residual = (bands.measured - bands.mean)[rows]
    blocks = np.array_split(bands.log_score[rows], BLOCKS)
    sums = np.array([block.sum() for block in blocks])
    return Part(sums, residual.size, residual.size / _correlation_time(residual), joint=False)


def log_ratios(
    log_likelihood: FloatArray, counts: Mapping[int, int]
) -> tuple[FloatArray, FloatArray]:
    """Return log Z less that of the first of some posteriors with one prior, from draws of a few.

    With draws θ of the posteriors j, Nⱼ of each, and all their likelihoods Lₖ(θ):

        Zₖ = Σ over all θ of Lₖ(θ) / Σⱼ Nⱼ Lⱼ(θ) / Zⱼ,

    which is importance sampling if j is one alone, and Bennett's acceptance ratio between two.

    Parameters
    ----------
    log_likelihood
        (posteriors, draws), nats; the draws in the order of ``counts``.
    counts
        Draws of each posterior that was sampled, by its row.

    Returns
    -------
    tuple[FloatArray, FloatArray]
        (posteriors,) log ratios, and effective draws at each posterior, 1 / Σ w².

    Notes
    -----
    M. R. Shirts and J. D. Chodera, J. Chem. Phys. 129 (2008) 124105.
    """
    sampled = [*counts]
    logs = np.log([*counts.values()])[:, np.newaxis]
    log_z = np.zeros((len(sampled), 1))
    for _ in range(1000):
        mixture = scipy.special.logsumexp(logs + log_likelihood[sampled] - log_z, axis=0)
        before = log_z
        log_z = scipy.special.logsumexp(log_likelihood[sampled] - mixture, axis=1, keepdims=True)
        log_z -= log_z[0]
        if np.max(np.abs(log_z - before)) < 1e-8:
            break
    weights = log_likelihood - mixture
    ratios = scipy.special.logsumexp(weights, axis=1)
    effective = np.exp(2 * ratios - scipy.special.logsumexp(2 * weights, axis=1))
    return ratios - ratios[0], effective


def _scored(
    path: Sequence[Posterior],
    drawn: Mapping[int, FloatArray],
    rows: Mapping[str, IntArray],
    rng: np.random.Generator,
    watch: Watch,
) -> Part:
    """Score the blocks on the way from the first posterior to the last; ``drawn`` are draws."""
    chosen = {number: thin_draws(flat, rng, DRAWS) for number, flat in drawn.items()}
    theta = path[0].prior.theta(np.concatenate([*chosen.values()]))
    log_likelihood = np.stack([p.log_likelihood(theta) for p in watched(path, watch)])
    counts = {number: len(flat) for number, flat in chosen.items()}
    log_z, effective = log_ratios(log_likelihood, counts)
    likeliest = theta[np.argmax(log_likelihood[-1]), np.newaxis]
    size = 0.0
    for dataset in path[-1].datasets:
        if dataset.name in rows:
            simulated = path[-1].simulate(likeliest, rows[dataset.name], dataset.name)[0]
            residual = dataset.displacement[rows[dataset.name]] - simulated
            size += residual.size / _correlation_time(residual)
    readings = sum(record_rows.size for record_rows in rows.values())
    return Part(np.diff(log_z), readings, size, effective=float(np.min(effective)))


def _fitted(
    posterior: Posterior,
    plan: SamplingPlan,
    flat: FloatArray,
    rng: np.random.Generator,
    executor: Executor,
    watch: Watch,
) -> FloatArray | None:
    """Draw from the posterior of other readings, from draws of one nearby; None if that fails."""
    prior = posterior.prior
    coordinates = prior.unconstrain(thin_draws(flat, rng, DRAWS))
    density = posterior.log_density(coordinates)
    best = coordinates[np.argmax(density)]
    wide = np.atleast_2d(np.cov(prior.unconstrain(prior.draw(rng, DRAWS)), rowvar=False))
    # With less readings a posterior is wider.
    covariance = 2 * np.atleast_2d(np.cov(coordinates, rowvar=False))
    point = MAPEstimate(best, covariance, float(np.max(density)), best[np.newaxis], wide)
    short = replace(plan, ess=min(400.0, plan.ess), max_steps=min(4000, plan.max_steps))
    chain = init_chain(posterior, point, short, rng)
    share = 0.0

    def checked(_: Phase, check: ConvergenceDiagnostics | None) -> None:
        nonlocal share
        if check is not None:
            share = max(share, min(float(np.nan_to_num(check.lowest_ess)) / short.ess, 1.0))
        watch(share)

    if not sample(posterior, short, chain, executor, checked).converged:
        return None
    return draws(posterior, chain).reshape(-1, len(posterior.names))


def _correlation_time(residual: FloatArray) -> float:
    """Integrated autocorrelation time of residuals (readings,), in readings; at least 1."""
    time = autocorrelation_time(residual[np.newaxis])
    return max(time, 1.0) if np.isfinite(time) else 1.0
