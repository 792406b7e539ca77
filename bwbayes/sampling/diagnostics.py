"""Convergence diagnostics, which a chain has to pass before the parameters are reported.

Ensembles are independent and start far apart; the walkers of one ensemble are not independent at
the start and hardly so later. So R-hat is the nested one, with an ensemble as the superchain, and
once more with the halves of each ensemble as superchains, which shows drift. The R-hat of single
walkers, much more lenient, shows walkers that never leave their mode. Effective draws are counted
with walkers as chains, and capped by the effective draws of the means of whole ensembles, which
include correlation between walkers. A walker that does not move prevents convergence by itself, and
nan never passes. This module alone uses arviz's statistics.
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

# The R-hat of walkers that mix is 1.01 after 50 autocorrelation times: √(1 + 1/50).
MAX_WALKER_RHAT = 1.05

# Above this limit a proposal does not cover the draws.
MAX_PARETO_K = 0.7

# Log weights that differ by less than this, nats, are equal: the proposal is the posterior itself.
EQUAL = 1e-6

# Least length of a chain, in autocorrelation times, for a reliable estimate of that time.
LENGTH = 50


@dataclass(frozen=True)
class ConvergenceDiagnostics:
    """The state of a sampling; arrays are (free,).

    ``rhat`` is the larger of nested and split nested R-hat; ``ess_bulk``, of the ranks, and
    ``ess_tail`` are totals, and so is ``ess_mean``, which determines the Monte Carlo error of the
    mean; ``autocorrelation`` is in steps; ``acceptance`` is the mean fraction of accepted moves;
    ``stuck`` is the number of walkers that do not move any more, from :func:`stuck`; ``pareto_k``
    is that of the proposal at these draws, None without a proposal; ``walker_rhat`` is the largest
    R-hat with each walker as a chain.
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
        """True if the proposal, if there is one, covers the draws."""
        return self.pareto_k is None or self.pareto_k < MAX_PARETO_K

    @property
    def lowest_ess(self) -> float:
        """The smallest number of effective draws of any parameter, in bulk or tail."""
        return float(np.min([self.ess_bulk, self.ess_tail]))

    @property
    def steps_needed(self) -> float:
        """Steps until walkers agree, to two digits, from their R-hat: R² − 1 ∝ 1/steps."""
        steps = self.steps * (self.walker_rhat**2 - 1) / (MAX_WALKER_RHAT**2 - 1)
        return float(f"{steps:.1e}")

    def steps_for(self, ess: float) -> float:
        """Return the steps for ``ess`` effective draws and :data:`LENGTH` autocorrelation times."""
        with np.errstate(divide="ignore"):
            draws = np.divide(self.steps * ess, self.lowest_ess)  # by zero if none moves
        return float(np.maximum(draws, LENGTH * np.max(self.autocorrelation)))

    def failures(self, ess: float, fraction: float = 1.0) -> list[str]:
        """Return the reasons against convergence with ``ess`` effective draws, if any.

        Reasons that more draws need not cure come first. A ``fraction`` of the effective draws, and
        of the autocorrelation times, is enough. Every comparison is written so that nan fails it.
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
        """Return the defects of the existing draws, if any.

        Numbers are rounded away from the limit that they violate.
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
    """Result of a sampling: ``converged`` or not, the reason, the last check, and remarks."""

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
    """Compute the convergence diagnostics of a sampling's draws.

    Parameters
    ----------
    draws
        (steps, ensembles, walkers, free), parameters in their own units.
    accepted
        (blocks, ensembles, walkers) accepted moves in each block.
    block
        Steps in a block.
    thin
        Thinning: the draws hold one of so many steps.
    autocorrelation
        Their autocorrelation times, if they are known.
    pareto_k
        Pareto k̂ of the proposal at these draws, if there is one.
    """
    if autocorrelation is None:
        autocorrelation = times(draws, thin)
    columns = np.moveaxis(draws, -1, 0)
    # Two threads help: sorting and transforms release Python's lock. If threads silence warnings at
    # the same time, as arviz does, the last to end may leave them silenced.
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
    """Compute the diagnostics of one parameter's draws (steps, ensembles, walkers).

    Returns R-hat, effective draws in bulk and tail and for the mean, and R-hat of the walkers. If
    the walkers of each ensemble divide themselves among modes in the same way and never change, the
    nested R-hat does not show it, and each counts as an effective draw.
    """
    steps, ensembles, _ = values.shape
    scores = _scores(values)
    half = steps // 2
    # The halves of all ensembles are superchains: first halves, then second ones.
    halves = [np.concatenate([s[:, :half], s[:, steps - half :]]) for s in scores]
    rhat = float(np.max([_rhat(scores, ensembles), _rhat(halves, 2 * ensembles)]))  # keeps a nan
    ranked = scores[0]
    with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
        between, within = np.var(np.mean(ranked, axis=1)), np.mean(np.var(ranked, axis=1))
        walker_rhat = float(np.sqrt(1 + between / within))
    return rhat, *_effective_draws(values, ranked), walker_rhat


def stuck(accepted: IntArray, block: int, autocorrelation: FloatArray) -> int:
    """Count the walkers that have not moved for 25 autocorrelation times, or never.

    An independence sampler's longest rests, at places that it hardly proposes, are a third of that.
    Arguments are as in :func:`check`.
    """
    blocks = 25 * np.max(autocorrelation) / block
    last = max(int(np.ceil(blocks)), 1) if np.isfinite(blocks) else len(accepted)
    return int(np.sum(~accepted[-last:].any(axis=0)))


def pareto_k(log_weights: FloatArray) -> float:
    """Return Pareto k̂ of a proposal from log weights log p − log q (draws,) at draws of p.

    Above 0.7 the proposal q does not cover the posterior p. The k̂ of importance weights is defined
    at draws of q; at draws of p, where a weight w is w times as frequent, a tail of shape k has the
    shape k' = k / (1 − k), so k = k' / (1 + k'). Places count once, however long a walker stayed:
    else one walker at a large weight would make the tail by itself. Equal weights have no tail,
    k = 0: the proposal is the posterior. If weights are too few to show a tail, k is infinite.
    """
    with np.errstate(invalid="ignore"):
        if log_weights.size and np.ptp(log_weights) < EQUAL:
            return 0.0
    try:
        shape = float(_arviz().psislw(-np.unique(log_weights))[1])
    except (ValueError, IndexError):  # there are no weights
        return np.inf
    return shape / (1 + shape) if shape > 0 else shape


def smoothed_weights(log_weights: FloatArray) -> tuple[FloatArray, float]:
    """Return Pareto-smoothed importance weights (draws,), adding up to one, and their k̂.

    The largest weights are replaced by the order statistics of the generalized Pareto distribution
    fitted to them. Weights with k̂ above 0.7 are unreliable; k̂ is infinite if no tail can be
    fitted, or a weight is not a number.

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
    """Return nested R-hat (free,) of draws (steps, ensembles, walkers, free) by ensembles."""
    columns = np.moveaxis(draws, -1, 0)
    return np.array([_rhat(_scores(values), values.shape[1]) for values in columns])


def effective_draws(values: FloatArray) -> tuple[float, float]:
    """Return one parameter's effective draws (steps, ensembles, walkers), in bulk and tail.

    The walkers are arviz's chains, and the series of ensemble means sets an upper bound: a mean of
    W independent walkers has a W-th of the variance, so n effective means are worth n times the
    ratio of the variances.
    """
    bulk, tail, _ = _effective_draws(values, _scores(values)[0])
    return bulk, tail


def _effective_draws(values: FloatArray, scores: FloatArray) -> tuple[float, float, float]:
    """Return effective draws in bulk and tail and for the mean, given the draws' normal scores.

    Bulk and tail are arviz's: for the means of the scores and of the indicators of a tail; arviz
    itself would rank the draws three times more. The last number is for the mean of the draws as
    they are, which differs for a heavy tail.
    """
    # A comparison would count nan as a draw beyond the tail.
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
    """Return nested R-hat of two scores (chains, steps), with an ensemble's chains in a row.

    It is the larger of that of the scores, which shows the location, and that of the folded scores,
    which shows the width: arviz's method "rank", without ranking the draws once more.
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

    A score is Φ⁻¹((r − 3/8) / (N + 1/4)) with the mean rank r of equal draws among N; it is nan if
    any draw is. The second scores are those of the draws' distances from their median.
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
    """Return autocorrelation times (free,), steps, of draws (steps, ensembles, walkers, free)."""
    columns = np.moveaxis(draws, -1, 0)
    # A thinned series does not show times below its own step.
    return thin * np.array([autocorrelation_time(as_chains(values)) for values in columns])


def autocorrelation_time(chains: FloatArray) -> float:
    """Return the integrated autocorrelation time, steps, of one parameter's ``chains``.

    They are (chains, steps). The time is nan if it cannot be estimated, for instance if nothing
    moves.
    """
    from emcee.autocorr import auto_window  # noqa: PLC0415  # slow to load

    # This is emcee's ``integrated_time``, which transforms one chain after the other.
    with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
        sums = 2 * np.cumsum(np.mean(_arviz().autocorr(chains), axis=0)) - 1
        time = float(sums[auto_window(sums, 5)])
    return time if time > 0 else np.nan


def _arviz() -> Any:
    """Return arviz's statistics, which are slow to load."""
    from arviz_stats.base import array_stats  # noqa: PLC0415

    return array_stats
