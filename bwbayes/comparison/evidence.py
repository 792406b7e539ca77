"""How probable readings were under a model: evidence of a record, scores of its later readings.

The evidence is the likelihood averaged over the prior. It weighs a better fit against the freedom
that the model had to find it, but only as far as priors and noise are believed. It is estimated
between the posterior's draws and a distribution fitted to other draws of it, whose integral is
known: what both cover bridges the unknown integral to the known one.

A model's leave-future-out score on a part of a record is the joint density of the part's readings,
given all readings before. The noise model knows how each reading follows from the last, so that
correlation is counted once. That density is a ratio of evidences, log p(later | earlier) =
log Z(all) − log Z(earlier). Posteriors that differ by some readings share enough of their draws for
all the ratios on the way from one to the other. They are computed block by block, which tells how
sure the difference of two models is.
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
from bwbayes.inference.parameters import JointPrior
from bwbayes.inference.posterior import Posterior
from bwbayes.prediction.bands import Bands
from bwbayes.prediction.prediction import thin_draws
from bwbayes.sampling.chain import Phase, draws
from bwbayes.sampling.diagnostics import (
    ConvergenceDiagnostics,
    autocorrelation_time,
    effective_draws,
)
from bwbayes.sampling.plan import SamplingPlan
from bwbayes.sampling.proposals import StudentMixture
from bwbayes.sampling.sampler import init_chain, sample
from bwbayes.watching import Watch, WatchSteps, part, unwatched, watched


@dataclass(frozen=True)
class Evidence:
    """The log evidence log p(readings | model).

    Attributes
    ----------
    log_evidence
        Nats. The readings' density is per um to the power of their number, so that it compares
        models of the same readings alone.
    error
        Its standard error by Monte Carlo; infinite where the draws cannot tell.
    log_prior_mass
        Log of the part of the independent priors that meets the constraints, by which their
        product is divided.
    effective
        Effective draws at the bridge's posterior end.
    prior_share
        Cost of the priors' width in the evidence, nats: the mean log likelihood of the draws
        less the log evidence, which is how far the posterior is from the prior (Kullback-Leibler).
    max_log_likelihood
        The largest among the draws, nats.
    """

    log_evidence: float
    error: float
    log_prior_mass: float
    effective: float
    prior_share: float = np.nan
    max_log_likelihood: float = np.nan


def evidence(
    posterior: Posterior,
    draws: FloatArray,
    log_density: FloatArray,
    generator: np.random.Generator,
    watch: Watch = unwatched,
) -> Evidence:
    """Estimate the log evidence.

    In the coordinates z in which :class:`~bwbayes.inference.posterior.Posterior` gives its density,
    the integral of likelihood times φ(z) times the room that the bounds leave is the evidence times
    the prior's mass inside the constraints (:func:`log_prior_mass`); the Jacobian is in φ.

    Parameters
    ----------
    posterior
        The posterior that was sampled.
    draws
        (steps, ensembles, walkers, free), parameters in their own units. The mixture is fitted to
        half of the ensembles, and bridged to the other half: draws that it was fitted to would look
        better covered than they are.
    log_density
        (steps, ensembles, walkers), nats, as the chain has it.
    generator
        Draws from mixture and prior.
    watch
        Called with the share that is done.
    """
    free = draws.shape[-1]
    coordinates = posterior.prior.unconstrain(draws.reshape(-1, free))
    log_likelihood = log_density.ravel() - posterior.prior.constrain(coordinates)[1]
    coordinates = coordinates.reshape(draws.shape)
    half = draws.shape[1] // 2
    fitted = coordinates[:, :half].reshape(-1, free)
    max_draws = 20_000  # that the mixture is fitted to, and at the other end
    fitted = fitted[:: max(len(fitted) // max_draws, 1)]
    mass, mass_error = log_prior_mass(posterior.prior, generator)
    try:
        proposal = StudentMixture.fitted(fitted)
    except np.linalg.LinAlgError:  # too few draws
        highest = float(np.max(log_likelihood))
        return Evidence(np.nan, np.inf, mass, 0.0, max_log_likelihood=highest)
    thin = max(log_density[:, half:].size // max_draws, 1)
    sampled = coordinates[::thin, half:]
    at_draws = log_density[::thin, half:] - proposal.log_density(sampled)
    random = np.random.RandomState(generator.integers(2**32))
    places, proposed = proposal.evaluate(proposal.draw(random, 10_000))
    densities = [*map(posterior.log_density, watched(np.array_split(places, 20), watch))]
    at_places = np.concatenate(densities) - proposed
    log_integral, error, effective = bridge(at_draws, at_places)
    # The chain's density leaves out the constant of the standard normal φ.
    constant = -0.5 * free * np.log(2 * np.pi)
    log_evidence = log_integral + constant - mass
    return Evidence(
        log_evidence,
        float(np.hypot(error, mass_error)),
        mass,
        effective,
        float(np.mean(log_likelihood)) - log_evidence,
        float(np.max(log_likelihood)),
    )


def screening_evidence(
    posterior: Posterior, point: MAPEstimate, generator: np.random.Generator
) -> Evidence:
    """Return Laplace's approximation at a point fit, whose error nobody knows.

    log Z = log p(readings | z) − ½ |z|² + ½ log det C − log prior mass, with the covariance C at
    the mode z; the constants of the two normal densities cancel.
    """
    mass, _ = log_prior_mass(posterior.prior, generator)
    log_volume = 0.5 * float(np.linalg.slogdet(point.covariance)[1])
    log_likelihood = point.log_density - posterior.prior.constrain(point.mode[np.newaxis])[1][0]
    log_evidence = point.log_density + log_volume - mass
    share = float(log_likelihood) - log_evidence
    return Evidence(log_evidence, np.inf, mass, 0.0, share, float(log_likelihood))


def bridge(at_draws: FloatArray, at_places: FloatArray) -> tuple[float, float, float]:
    """Bridge from a known integral to an unknown one: the ratio r = ∫p / ∫q.

    With weights w = p/q at draws of p and at places from q, the optimal bridge solves

        r = mean over places of [w / (s w + (1 − s) r)] / mean over draws of [1 / (s w + (1 − s) r)]

    with s = n / (n + N), n effective draws and N places. The relative error follows from the
    variances of both means, that of the draws divided by their effective number. Returns log r,
    nats, its standard error, and the effective draws of p.

    Parameters
    ----------
    at_draws
        (steps, ensembles, walkers) log p − log q at draws of p.
    at_places
        (N,) log p − log q at independent draws of q; −∞ where p is zero.

    Notes
    -----
    X.-L. Meng and W. H. Wong, Statistica Sinica 6 (1996) 831-860; S. Frühwirth-Schnatter,
    Econometrics Journal 7 (2004) 143-167, for the error.
    """
    shift = float(np.median(at_draws))
    draws, places = at_draws - shift, at_places - shift
    effective = _effective(np.tanh(draws))
    log_r, ends = 0.0, (np.empty(0), np.empty(0))
    for _ in range(2):
        # The effective number is that of what is averaged, which is known once r is.
        share = effective / (effective + places.size)
        with np.errstate(divide="ignore"):
            from_posterior, from_reference = np.log(share), np.log1p(-share)
        for _ in range(1000):  # some ten where the two distributions overlap at all
            # The logs of what is averaged at draws and at places.
            ends = (
                -np.logaddexp(from_posterior + draws, from_reference + log_r),
                places - np.logaddexp(from_posterior + places, from_reference + log_r),
            )
            means = [scipy.special.logsumexp(end) - np.log(end.size) for end in ends]
            before, log_r = log_r, float(means[1] - means[0])
            if not abs(log_r - before) > 1e-10:  # nan too
                break
        effective = _effective(np.exp(ends[0] - np.max(ends[0])))
    scaled = [np.exp(end - np.max(end)) for end in ends]
    variances = [np.var(end) / np.mean(end) ** 2 for end in scaled]
    error = float(np.sqrt(variances[0] / effective + variances[1] / places.size))
    return log_r + shift, error if np.isfinite(error) else np.inf, effective


def _effective(values: FloatArray) -> float:
    """Return what draws (steps, ensembles, walkers) of a bounded quantity are worth."""
    if np.ptp(values) == 0:
        return float(values.size)
    bulk, _ = effective_draws(values)
    return bulk if np.isfinite(bulk) else 1.0


def log_prior_mass(prior: JointPrior, generator: np.random.Generator) -> tuple[float, float]:
    """Return the log of the part of the independent priors inside all bounds, and its error.

    Bounds that depend on other parameters leave each draw its own room: the product of
    F(u) − F(l) over the parameters, zero where a constraint does not hold. Its mean over standard
    normal coordinates is the mass.
    """
    coordinates = generator.standard_normal((100_000, prior.dimensions))
    log_prior = prior.constrain(coordinates)[1]
    room = np.exp(log_prior + 0.5 * np.sum(coordinates**2, axis=1))
    mean = float(np.mean(room))
    if not mean > 0:
        return -np.inf, np.inf
    return float(np.log(mean)), float(np.std(room) / mean / np.sqrt(room.size))


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
        earlier = _redraw(path[0], plan, flat, rng, executor, partial(watch, "earlier training"))
        if earlier is not None:
            scoring = partial(watch, FUTURE)
            parts[FUTURE] = _score_blocks(path, {0: earlier, BLOCKS: flat}, later, rng, scoring)
    for record, named in held_out.items():
        for name, windows in named.items():
            window_rows = np.concatenate([np.arange(w.start, w.stop) for w in windows])
            later = {record: window_rows[np.isfinite(datasets[record].displacement[window_rows])]}
            if not later[record].size:
                continue
            path = _path(posterior, training, {record: windows}, later)
            training = {dataset.name: dataset.training for dataset in path[-1].datasets}
            score = _score_blocks(path, {0: flat}, later, rng, partial(watch, name))
            # Too few draws are effective at the far end: that end is sampled too.
            if score.effective < 100:
                again = partial(watch, f"training and {name}")
                longer = _redraw(path[-1], plan, flat, rng, executor, part(again, 0.0, 0.8))
                if longer is not None:
                    drawn = {0: flat, BLOCKS: longer}
                    score = _score_blocks(path, drawn, later, rng, part(again, 0.8, 1.0))
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
        path.append(posterior.with_training(windows))
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


def _score_blocks(
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


def _redraw(
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

    def report_progress(_: Phase, check: ConvergenceDiagnostics | None) -> None:
        nonlocal share
        if check is not None:
            share = max(share, min(float(np.nan_to_num(check.lowest_ess)) / short.ess, 1.0))
        watch(share)

    if not sample(posterior, short, chain, executor, report_progress).converged:
        return None
    return draws(posterior, chain).reshape(-1, len(posterior.names))


def _correlation_time(residual: FloatArray) -> float:
    """Integrated autocorrelation time of residuals (readings,), in readings; at least 1."""
    time = autocorrelation_time(residual[np.newaxis])
    return max(time, 1.0) if np.isfinite(time) else 1.0
