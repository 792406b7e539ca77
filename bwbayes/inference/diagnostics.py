"""Has it converged? What is asked of a chain before anything is said about the parameters.

Ensembles are independent and start far apart; the walkers of one ensemble are not independent at
the start and hardly so later. So R-hat is the nested one, with an ensemble as the superchain, and
once more with the halves of each ensemble apart, which shows drift. Effective draws are counted
with walkers as chains, capped by what the means of whole ensembles show, which also sees
correlation between walkers. A walker that does not move blocks convergence by itself, and what is
not a number never passes. This module alone knows arviz's statistics.
"""

# mypy: allow-untyped-calls
# arviz_stats says that it has types, but its functions have none.

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from arviz_stats.base import array_stats  # type: ignore[attr-defined]  # not in an __all__

from bwbayes.arrays import FloatArray, IntArray
from bwbayes.inference.ensemble import autocorrelation_time

__all__ = ["Check", "as_chains", "check", "effective_draws", "nested_rhat", "pareto_k"]

LARGEST_RHAT = 1.01

# Steps in autocorrelation times, before which no estimate of it can be trusted.
LENGTH = 50

TAIL = (0.05, 0.95)


@dataclass(frozen=True)
class Check:
    """The state of a sampling; arrays are (free,).

    ``rhat`` is the larger of nested and split nested R-hat; ``ess_bulk`` and ``ess_tail`` are
    totals; ``autocorrelation`` is in steps; ``acceptance`` is the mean fraction of accepted moves;
    ``stuck`` counts the walkers without an accepted move in the last block.
    """

    steps: int
    rhat: FloatArray
    ess_bulk: FloatArray
    ess_tail: FloatArray
    autocorrelation: FloatArray
    acceptance: float
    stuck: int

    def shortcomings(self, ess: float) -> list[str]:
        """Say what is missing for ``ess`` effective draws of each parameter; empty if nothing is.

        Every comparison is written so that nan fails it.
        """
        found = []
        if not (self.rhat < LARGEST_RHAT).all():
            found.append(f"R-hat {np.max(self.rhat):.3f} is not below {LARGEST_RHAT}")
        fewest = np.min([self.ess_bulk, self.ess_tail])
        if not fewest >= ess:
            found.append(f"ESS {fewest:.0f} has not reached {ess:.0f}")
        times = self.steps / np.max(self.autocorrelation)
        if not times >= LENGTH:
            found.append(f"{times:.0f} autocorrelation times are fewer than {LENGTH}")
        if self.stuck:
            found.append(f"{self.stuck} walkers are stuck")
        return found


def check(draws: FloatArray, accepted: IntArray, block: int) -> Check:
    """Judge the draws of a sampling.

    Parameters
    ----------
    draws
        (steps, ensembles, walkers, free), parameters in their own units.
    accepted
        (blocks, ensembles, walkers) accepted moves in each block.
    block
        Steps in a block.
    """
    steps, ensembles, walkers, free = draws.shape
    bulk, tail = effective_draws(draws)
    half = steps // 2
    halves = np.concatenate([draws[:half], draws[steps - half :]], axis=1)
    return Check(
        steps=steps,
        # np.maximum keeps a nan of either.
        rhat=np.maximum(nested_rhat(draws), nested_rhat(halves)),
        ess_bulk=bulk,
        ess_tail=tail,
        autocorrelation=autocorrelation_time(draws.reshape(steps, ensembles * walkers, free)),
        acceptance=float(accepted.sum() / (accepted.size * block)),
        stuck=int(np.sum(accepted[-1] == 0)),
    )


def pareto_k(log_weights: FloatArray) -> float:
    """Pareto k̂ of a proposal from log weights log p − log q (draws,) at draws of the posterior p.

    Above 0.7 the proposal q does not cover p. Importance weights are judged at draws of q; at
    draws of p, where a weight w is w times as frequent, a tail of shape k has the shape
    k' = k / (1 − k), so k = k' / (1 + k'). It is infinite where the largest weights are all equal,
    as those of a walker that stays where the proposal hardly goes.
    """
    try:
        shape = float(array_stats.psislw(-log_weights)[1])
    except ValueError:
        return np.inf
    return shape / (1 + shape) if shape > 0 else shape


def as_chains(draws: FloatArray) -> FloatArray:
    """Return draws (steps, ensembles, walkers, free) as (ensembles x walkers, steps, free).

    Every walker is a chain. Folding walkers into one chain step by step instead would count
    neighbours at the same step as a long independent series and overstate the effective draws.
    """
    steps, ensembles, walkers, free = draws.shape
    return np.moveaxis(draws, 0, 2).reshape(ensembles * walkers, steps, free)


def nested_rhat(draws: FloatArray) -> FloatArray:
    """Nested R-hat (free,) of draws (steps, ensembles, walkers, free), an ensemble a superchain."""
    _, ensembles, walkers, _ = draws.shape
    superchain = np.repeat(np.arange(ensembles), walkers)
    with np.errstate(invalid="ignore", divide="ignore"):
        rhat = array_stats.rhat_nested(
            as_chains(draws), superchain_ids=superchain, chain_axis=0, draw_axis=1, method="rank"
        )
    return np.atleast_1d(rhat)


def effective_draws(draws: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Effective number of draws, bulk and tail, (free,) each.

    With walkers as arviz's chains, and no more than the series of ensemble means allow: a mean of
    W independent walkers has a W-th of the variance, so n effective means are worth n times the
    ratio of the variances.
    """
    chains = as_chains(draws)
    with np.errstate(invalid="ignore", divide="ignore"):
        cap = _ensemble_mean_ess(draws)
        bulk = array_stats.ess(chains, chain_axis=0, draw_axis=1, method="bulk")
        tail = array_stats.ess(chains, chain_axis=0, draw_axis=1, method="tail", prob=TAIL)
    return np.minimum(np.atleast_1d(bulk), cap), np.minimum(np.atleast_1d(tail), cap)


def _ensemble_mean_ess(draws: FloatArray) -> FloatArray:
    means = np.mean(draws, axis=2)
    ess = array_stats.ess(np.moveaxis(means, 0, 1), chain_axis=0, draw_axis=1, method="mean")
    ratio = np.var(draws, axis=(0, 1, 2)) / np.var(means, axis=(0, 1))
    worth: FloatArray = np.atleast_1d(ess) * ratio
    return worth
