"""Has it converged? What is asked of a chain before anything is said about the parameters.

Ensembles are independent and start far apart; the walkers of one ensemble are not independent at
the start and hardly so later. So R-hat is the nested one, with an ensemble as the superchain, and
once more with the halves of each ensemble apart, which shows drift. That of single walkers, much
more lenient, shows those that never leave their mode. Effective draws are counted with walkers as
chains, capped by what the means of whole ensembles show, which also sees correlation between
walkers. A walker that does not move blocks convergence by itself, and what is not a number never
passes. This module alone knows arviz's statistics.
"""

# mypy: allow-untyped-calls
# arviz_stats says that it has types, but its functions have none.

from __future__ import annotations

import warnings
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy

from bwbayes.arrays import FloatArray, IntArray
from bwbayes.shown import brief

MAX_RHAT = 1.01

# Of walkers that mix it is 1.01 after 50 autocorrelation times: √(1 + 1/50).
MAX_WALKER_RHAT = 1.05

# Above this a proposal does not cover the draws.
MAX_PARETO_K = 0.7

# Log weights that differ by less than this, nats, are equal: the proposal is the posterior itself.
EQUAL = 1e-6

# Steps in autocorrelation times, before which no estimate of it can be trusted.
LENGTH = 50


@dataclass(frozen=True)
class ConvergenceDiagnostics:
    """The state of a sampling; arrays are (free,).

    ``rhat`` is the larger of nested and split nested R-hat; ``ess_bulk``, of the ranks, and
    ``ess_tail`` are totals, and so is ``ess_mean``, which the Monte Carlo error of the mean hangs
    on; ``autocorrelation`` is in steps; ``acceptance`` is the mean fraction of accepted moves;
    ``stuck`` counts the walkers that do not move any more, as :func:`stuck` does; ``pareto_k`` is
    that of the proposal at these draws, None if there is no proposal; ``walker_rhat`` is the
    largest R-hat with each walker a chain.
    """

    __repr__ = brief

    steps: int
    rhat: FloatArray
    ess_bulk: FloatArray
    ess_tail: FloatArray
    ess_mean: FloatArray
    autocorrelation: FloatArray
    acceptance: float
    stuck: int
    pareto_k: float | None = None
    walker_rhat: float = 1.0

    @property
    def covered(self) -> bool:
        """Whether the proposal, if there is one, covers the draws."""
        return self.pareto_k is None or self.pareto_k < MAX_PARETO_K

    @property
    def lowest_ess(self) -> float:
        """The effective draws of the parameter that has the fewest, of ranks or tails."""
        return float(np.min([self.ess_bulk, self.ess_tail]))

    @property
    def steps_needed(self) -> float:
        """Steps, to two digits, for walkers to agree, as they differ now: R² − 1 ∝ 1/steps."""
        steps = self.steps * (self.walker_rhat**2 - 1) / (MAX_WALKER_RHAT**2 - 1)
        return float(f"{steps:.1e}")

    def failures(self, ess: float, fraction: float = 1.0) -> list[str]:
        """Say what is missing for ``ess`` effective draws of each parameter; empty if nothing is.

        First what more draws need not cure. Of effective draws, and of autocorrelation times, a
        ``fraction`` is enough. Every comparison is written so that nan fails it.
        """
        reasons = self.disagreements()
        draws = fraction * ess
        if not self.lowest_ess >= draws:
            reasons.append(f"ESS {np.floor(self.lowest_ess):.0f} has not reached {draws:g}")
        times, length = self.steps / np.max(self.autocorrelation), fraction * LENGTH
        if not times >= length:
            reasons.append(f"{np.floor(times):.0f} autocorrelation times are fewer than {length:g}")
        return reasons

    def disagreements(self) -> list[str]:
        """Say what is wrong with the draws that there are; empty if nothing is.

        Numbers are rounded away from the limit that they miss.
        """
        reasons = []
        if not (self.rhat < MAX_RHAT).all():
            rhat = np.ceil(1e3 * np.max(self.rhat)) / 1e3
            reasons.append(f"R-hat {rhat:.3f} is not below {MAX_RHAT}")
        if not self.walker_rhat < MAX_WALKER_RHAT:
            rhat = np.ceil(1e3 * self.walker_rhat) / 1e3
            reasons.append(f"R-hat {rhat:.3f} of walkers is not below {MAX_WALKER_RHAT}")
        if self.stuck:
            reasons.append(f"{self.stuck} walkers are stuck")
        if self.pareto_k is not None and not self.covered:
            shape = np.ceil(100 * self.pareto_k) / 100
            reasons.append(f"Pareto k {shape:.2f} is not below {MAX_PARETO_K}")
        return reasons


@dataclass(frozen=True)
class SamplingResult:
    """How a sampling ended: ``converged`` or not, why, the last check, and what to know of it."""

    __repr__ = brief

    converged: bool
    stop_reason: str
    check: ConvergenceDiagnostics
    remarks: tuple[str, ...] = ()


def check(
    draws: FloatArray,
    accepted: IntArray,
    block: int,
    thin: int = 1,
    autocorrelation: FloatArray | None = None,
    pareto_k: float | None = None,
) -> ConvergenceDiagnostics:
    """Judge the draws of a sampling.

    Parameters
    ----------
    draws
        (steps, ensembles, walkers, free), parameters in their own units.
    accepted
        (blocks, ensembles, walkers) accepted moves in each block.
    block
        Steps in a block.
    thin
        Of how many steps the draws are one.
    autocorrelation
        Their autocorrelation times, if they are known.
    pareto_k
        That of the proposal at these draws, if there is one.
    """
    if autocorrelation is None:
        autocorrelation = times(draws, thin)
    columns = np.moveaxis(draws, -1, 0)
    # Two threads: sorting and transforms leave Python free. Where threads silence warnings side by
    # side, as arviz does, the last to end may leave them so.
    with warnings.catch_warnings(), ThreadPoolExecutor(2) as executor:
        statistics = executor.map(_one_parameter, columns)
        rhat, bulk, tail, mean, walker_rhat = np.array([*statistics]).T
    return ConvergenceDiagnostics(
        steps=len(accepted) * block,
        rhat=rhat,
        ess_bulk=bulk,
        ess_tail=tail,
        ess_mean=mean,
        autocorrelation=autocorrelation,
        acceptance=float(accepted.sum() / (accepted.size * block)),
        stuck=stuck(accepted, block, autocorrelation),
        pareto_k=pareto_k,
        walker_rhat=float(np.max(walker_rhat)),
    )


def _one_parameter(values: FloatArray) -> tuple[float, ...]:
    """Judge the draws (steps, ensembles, walkers) of one parameter.

    R-hat, effective draws in bulk and tail and for the mean, and R-hat of the walkers: walkers that
    share modes between them in the same way in each ensemble, and never change, look alike to the
    nested R-hat, and are worth as many effective draws as they are.
    """
    steps, ensembles, _ = values.shape
    scores = _scores(values)
    half = steps // 2
    # The halves of all ensembles are superchains of their own: first halves, then second ones.
    halves = [np.concatenate([s[:, :half], s[:, steps - half :]]) for s in scores]
    rhat = float(np.max([_rhat(scores, ensembles), _rhat(halves, 2 * ensembles)]))  # keeps a nan
    ranked = scores[0]
    with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
        between, within = np.var(np.mean(ranked, axis=1)), np.mean(np.var(ranked, axis=1))
        walker_rhat = float(np.sqrt(1 + between / within))
    return rhat, *_effective_draws(values, ranked), walker_rhat


def stuck(accepted: IntArray, block: int, autocorrelation: FloatArray) -> int:
    """Count the walkers that have not moved for 25 autocorrelation times, or never.

    The longest of an independence sampler's rests at a place where its proposal hardly goes are a
    third of that. Arguments as in :func:`check`.
    """
    blocks = 25 * np.max(autocorrelation) / block
    last = max(int(np.ceil(blocks)), 1) if np.isfinite(blocks) else len(accepted)
    return int(np.sum(~accepted[-last:].any(axis=0)))


def pareto_k(log_weights: FloatArray) -> float:
    """Pareto k̂ of a proposal from log weights log p − log q (draws,) at draws of the posterior p.

    Above 0.7 the proposal q does not cover p. Importance weights are judged at draws of q; at
    draws of p, where a weight w is w times as frequent, a tail of shape k has the shape
    k' = k / (1 − k), so k = k' / (1 + k'). Places count once, however long a walker stayed: else
    one walker at a large weight would make the tail by itself. Weights that are all equal have no
    tail to fear, k = 0: the proposal is the posterior. Too few of them to see a tail give infinity.
    """
    with np.errstate(invalid="ignore"):
        if log_weights.size and np.ptp(log_weights) < EQUAL:
            return 0.0
    try:
        shape = float(_arviz().psislw(-np.unique(log_weights))[1])
    except (ValueError, IndexError):  # nothing
        return np.inf
    return shape / (1 + shape) if shape > 0 else shape


def smoothed_weights(log_weights: FloatArray) -> tuple[FloatArray, float]:
    """Pareto-smoothed importance weights (draws,), adding up to one, and their k̂.

    The largest weights are replaced by the order statistics of the generalized Pareto distribution
    fitted to them. Above k̂ = 0.7 they cannot be trusted; infinity where no tail can be fitted, or
    a weight is not a number.

    Notes
    -----
    A. Vehtari, D. Simpson, A. Gelman, Y. Yao, J. Gabry, Pareto smoothed importance sampling,
    Journal of Machine Learning Research 25 (2024).
    """
    finite = np.isfinite(log_weights).all()
    if not finite or (log_weights.size and np.ptp(log_weights) < EQUAL):
        return np.full(log_weights.size, 1 / log_weights.size), 0.0 if finite else np.inf
    smoothed, shape = _arviz().psislw(-log_weights)
    weights = np.exp(smoothed - np.max(smoothed))
    return weights / np.sum(weights), float(shape) if np.isfinite(shape) else np.inf


def nested_rhat(draws: FloatArray) -> FloatArray:
    """Nested R-hat (free,) of draws (steps, ensembles, walkers, free), an ensemble a superchain."""
    columns = np.moveaxis(draws, -1, 0)
    return np.array([_rhat(_scores(values), values.shape[1]) for values in columns])


def effective_draws(values: FloatArray) -> tuple[float, float]:
    """Effective number of draws (steps, ensembles, walkers) of one parameter, bulk and tail.

    With walkers as arviz's chains, and no more than the series of ensemble means allow: a mean of
    W independent walkers has a W-th of the variance, so n effective means are worth n times the
    ratio of the variances.
    """
    bulk, tail, _ = _effective_draws(values, _scores(values)[0])
    return bulk, tail


def _effective_draws(values: FloatArray, scores: FloatArray) -> tuple[float, float, float]:
    """Effective draws in bulk and tail and for the mean, given the draws' normal scores too.

    Of the means of the scores and of being in a tail: what arviz calls bulk and tail, which would
    rank the draws three times more. And of the mean of the draws as they are: those of a heavy
    tail are worth another number.
    """
    # A comparison would take what is not a number for a draw beyond the tail.
    tails = [
        np.where(np.isnan(scores), np.nan, scores <= scipy.special.ndtri(p)) for p in (0.05, 0.95)
    ]
    means = np.mean(values, axis=2)
    series = (scores, *tails, as_chains(values), means.T)
    with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
        bulk, low, high, mean, cap = (_arviz().ess(s, method="mean") for s in series)
        cap *= np.var(values) / np.var(means)
    # np.minimum keeps a nan of either.
    capped: list[float] = np.minimum([bulk, np.minimum(low, high), mean], cap).tolist()
    return capped[0], capped[1], capped[2]


def _rhat(scores: Sequence[FloatArray], ensembles: int) -> float:
    """Nested R-hat of two scores (chains, steps), an ensemble's chains in a row.

    Of the scores and the folded ones, which show a place and a width, it is the larger: what arviz
    calls rank, which would rank the draws once more.
    """
    superchain = np.repeat(np.arange(ensembles), len(scores[0]) // ensembles)
    with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
        rhats = [
            _arviz().rhat_nested(ranked, superchain_ids=superchain, method="split")
            for ranked in scores
        ]
    return float(np.max(rhats))


def as_chains(values: FloatArray) -> FloatArray:
    """Return draws (steps, ensembles, walkers) as (ensembles x walkers, steps).

    Every walker is a chain. Folding walkers into one chain step by step instead would count
    neighbors at the same step as a long independent series and overstate the effective draws.
    """
    return np.ascontiguousarray(np.moveaxis(values, 0, -1)).reshape(-1, len(values))


def _scores(values: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Rank draws (steps, ensembles, walkers) into two normal scores (chains, steps).

    With the mean rank r of equal draws among N, Φ⁻¹((r − 3/8) / (N + 1/4)); nan if any draw is.
    The second ones are those of the draws' distances from their median.
    """
    chains = as_chains(values)
    with np.errstate(invalid="ignore"):
        folded = np.abs(chains - np.median(chains))
    scores, folded_scores = (
        scipy.special.ndtri(
            (scipy.stats.rankdata(draws).reshape(chains.shape) - 3 / 8) / (chains.size + 1 / 4)
        )
        for draws in (chains, folded)
    )
    return scores, folded_scores


def times(draws: FloatArray, thin: int = 1) -> FloatArray:
    """Autocorrelation times (free,), in steps, of draws (steps, ensembles, walkers, free)."""
    columns = np.moveaxis(draws, -1, 0)
    # A thinned series does not tell times below its own step.
    return thin * np.array([autocorrelation_time(as_chains(values)) for values in columns])


def autocorrelation_time(chains: FloatArray) -> float:
    """Integrated autocorrelation time, in steps, of chains (chains, steps) of one parameter.

    It is nan where it cannot be told, for instance where nothing moves.
    """
    from emcee.autocorr import auto_window  # noqa: PLC0415  # slow to load

    # As emcee's ``integrated_time`` does it, which transforms one chain after the other.
    with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
        sums = 2 * np.cumsum(np.mean(_arviz().autocorr(chains), axis=0)) - 1
        time = float(sums[auto_window(sums, 5)])
    return time if time > 0 else np.nan


def _arviz() -> Any:
    """Return arviz's statistics, which are slow to load."""
    from arviz_stats.base import array_stats  # noqa: PLC0415

    return array_stats
