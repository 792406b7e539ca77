"""Histories: which drive before a record left the state that it starts from.

Most operators' states are one number, ``initial``. Those that remember extrema have more: how far
earlier drives went leaves states of their own, and each such range is a history. What a lead-in
says of a history, and of the states in it, is computed on a grid that closes in on where it
allows them. There may be dozens of histories, and draws think much alike of them: then a few draws
are asked on grids, and the others choose among what these have drawn, by importance.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from scipy.special import logsumexp

from bwbayes.arrays import FloatArray, IntArray
from bwbayes.inference.likelihood import Likelihood
from bwbayes.model.operator import narrower

__all__ = ["Histories", "States", "chosen", "uniform"]

# Nodes of the grid of hysteretic states, and how often it closes in at most.
NODES = 17
ROUNDS = 6

# A node less probable than the best by this much (nats) is outside of the next grid.
IMPROBABLE = 10.0

# The grid is fine enough when neighbors within two nats of the best node differ by less than this.
FINE = 1.5

# Draws that are asked about each of many histories, and pairs of a history and a state that they
# draw from these; so many of them are proposed to each of the other draws.
FEW, POOL, PROPOSED = 50, 500, 64

# Proposals of which effectively fewer are left do not cover what a draw allows (of ten draws of a
# normal distribution one is beyond 1.6 sds).
COVERED = 4.0

# Cells between two nodes that a state is chosen from.
BETWEEN = 8


@dataclass(frozen=True)
class Histories:
    """A record's likelihood for each history, and ``which`` of them each draw has, (draws,)."""

    likelihoods: tuple[Likelihood, ...]
    which: IntArray

    def each(
        self, theta: FloatArray, ask: Callable[[Likelihood, FloatArray], tuple[FloatArray, ...]]
    ) -> tuple[FloatArray, ...]:
        """Ask every draw's own likelihood about it; return answers (draws, ...)."""
        groups = [np.flatnonzero(self.which == k) for k in range(len(self.likelihoods))]
        answers = [
            ask(likelihood, theta[rows])
            for likelihood, rows in zip(self.likelihoods, groups, strict=True)
            if rows.size
        ]
        back = np.argsort(np.concatenate(groups))
        return tuple(np.concatenate(each)[back] for each in zip(*answers, strict=True))


def uniform(generator: np.random.Generator, draws: int) -> FloatArray:
    """Uniform numbers (draws,), one from each of as many equal parts of 0 to 1, in any order."""
    parts: FloatArray = (generator.permutation(draws) + generator.uniform(size=draws)) / draws
    return parts


def edged(part: FloatArray) -> FloatArray:
    """Return how far a state of one of many histories is on its way, for an even part of 0 to 1.

    The last sweep of an earlier drive ends, as often as not, at the record's first voltage: a
    quarter of the states are the lowest, a quarter the highest, and half lie evenly between.
    """
    return np.clip(2 * part - 0.5, 0.0, 1.0)


class States:
    """Hysteretic states at a record's first sample, and how probable they are beforehand.

    Of one of many histories these are the states between the lowest and the highest that drives of
    its range leave (:func:`edged`). Where one number holds all states, and a history is ``alone``,
    they are what drives of any amplitude leave that were running when the record began, on the
    branches of their loops, the lowest and the highest as far out as any drive leaves them; between
    them are straight lines.
    """

    def __init__(self, likelihood: Likelihood, theta: FloatArray, *, alone: bool) -> None:
        self.table, self.theta, self.alone = likelihood.table, theta, alone
        if likelihood.from_rest:
            self.ordered = np.zeros((2, len(theta)))
            return
        actuator = likelihood.actuator
        assert actuator.span is not None
        column, voltage = self.table.columns(theta), float(likelihood.voltage[0])
        operator = actuator.hysteresis
        low, high = operator.reachable(column, voltage, actuator.span)
        self.ordered = np.stack([low, high])
        if alone:
            ranges = narrower(actuator.span, further=(1.0,))
            states = [operator.left(column, voltage, swept) for swept in ranges]
            self.ordered = np.sort(np.concatenate(states), axis=0)
            self.ordered[0] = np.minimum(self.ordered[0], low)
            self.ordered[-1] = np.maximum(self.ordered[-1], high)

    @property
    def open(self) -> bool:
        """Whether any draw has more than one."""
        return bool(np.any(self.ordered[-1] > self.ordered[0]))

    def at(self, place: FloatArray) -> FloatArray:
        """Return θ (draws, parameters) with the states at a place (draws,) from 0 to 1.

        That is how far they are on the way from the lowest to the highest; of one of many
        histories, which part of the states is lower.
        """
        return self._with(self.placed(place))

    def placed(self, place: FloatArray) -> FloatArray:
        """Return the states themselves, (draws,)."""
        low, high = self.ordered[0], self.ordered[-1]
        state: FloatArray = low + (place if self.alone else edged(place)) * (high - low)
        return state

    def below(self, places: FloatArray) -> FloatArray:
        """Return which part of the states is lower than those at places (any, draws)."""
        if not self.alone:
            return places
        low, high = self.ordered[0], self.ordered[-1]
        parts = np.linspace(0.0, 1.0, len(self.ordered))
        # A draw with a single state has it at all places.
        several = high > low
        ways = (self.ordered - low) / np.where(several, high - low, 1.0)
        ways[:, ~several] = parts[:, np.newaxis]
        every = [np.interp(*both, parts) for both in zip(places.T, ways.T, strict=True)]
        return np.stack(every, axis=1)

    def drawn(self, part: FloatArray) -> FloatArray:
        """Return θ (draws, parameters) with the states of which ``part`` (draws,) are lower."""
        if not self.alone:
            return self.at(part)
        last, draws = len(self.ordered) - 1, np.arange(part.size)
        place = part * last
        index = np.minimum(place.astype(np.int64), last - 1)
        lower = self.ordered[index, draws]
        return self._with(lower + (place - index) * (self.ordered[index + 1, draws] - lower))

    def _with(self, state: FloatArray) -> FloatArray:
        return self.table.replaced(self.theta, "initial", state)


class _Grid(NamedTuple):
    """What a lead-in says of the states of one history.

    ``places`` (nodes, draws) of the states, the log ``density`` of the lead-in there up to a
    constant, and the log ``evidence`` (draws,) for the history.
    """

    places: FloatArray
    density: FloatArray
    evidence: FloatArray


def chosen(
    likelihoods: tuple[Likelihood, ...], theta: FloatArray, generator: np.random.Generator
) -> tuple[Histories, FloatArray]:
    """Choose every draw's history and state by what the lead-in says; return θ with the states.

    Beforehand all histories are equally probable, and in each all :class:`States`.
    """
    draws = len(theta)
    alone = len(likelihoods) == 1
    if alone and not States(likelihoods[0], theta, alone=True).open:
        which, place = np.zeros(draws, dtype=np.int64), np.zeros(draws)
    elif alone or draws < 2 * FEW:
        which, place, _ = _by_grids(likelihoods, theta, generator)
    else:
        which, place = _by_importance(likelihoods, theta, generator)
    histories = Histories(likelihoods, which)
    return histories, _begun(histories, theta, place)


def _begun(histories: Histories, theta: FloatArray, place: FloatArray) -> FloatArray:
    """Return θ (draws, parameters) with the states at places (draws,) of the draws' histories."""
    alone = len(histories.likelihoods) == 1
    (begun,) = histories.each(
        np.column_stack([theta, place]),
        lambda likelihood, rows: (States(likelihood, rows[:, :-1], alone=alone).at(rows[:, -1]),),
    )
    return begun


def _by_grids(
    likelihoods: tuple[Likelihood, ...],
    theta: FloatArray,
    generator: np.random.Generator,
    each: int = 1,
) -> tuple[IntArray, FloatArray, FloatArray]:
    """Draw histories and places, so many for each draw, and the log evidence (draws,) for all.

    Those of one draw follow one another, (draws * each,).
    """
    states = [States(likelihood, theta, alone=len(likelihoods) == 1) for likelihood in likelihoods]
    grids = [_grid(*pair) for pair in zip(likelihoods, states, strict=True)]
    evidence = np.stack([grid.evidence for grid in grids])
    rows = np.repeat(np.arange(len(theta)), each)
    best = np.max(evidence, axis=0)
    weight = np.cumsum(np.exp(evidence - best), axis=0)
    which = np.zeros(rows.size, dtype=np.int64)
    if len(grids) > 1:
        which = np.sum(weight[:, rows] < uniform(generator, rows.size) * weight[-1, rows], axis=0)
    places, density = (np.stack([grid[i] for grid in grids])[which, :, rows].T for i in range(2))
    # In one of many histories a place is the part of states below, whichever of them it is.
    cells = _weights(states[0], places, density)
    place = _drawn(places, cells, uniform(generator, rows.size))
    return which, place, best + np.log(weight[-1] / len(grids))


def _by_importance(
    likelihoods: tuple[Likelihood, ...], theta: FloatArray, generator: np.random.Generator
) -> tuple[IntArray, FloatArray]:
    """Draw histories and places (draws,) from those that a few draws would draw.

    With the likelihood Lⱼ and the evidence Zⱼ of J of the draws, pairs that these have drawn in
    equal numbers have the density Σ Lⱼ / (J Zⱼ) beside the prior. So a draw with the likelihood L
    takes one of those that are proposed to it with a weight of L / Σ (Lⱼ / Zⱼ). Draws that few
    proposals suit are asked on grids of their own.
    """
    draws = len(theta)
    few = np.arange(0, draws, draws // FEW)
    each = -(-POOL // few.size)
    pool_which, pool_place, evidence = _by_grids(likelihoods, theta[few], generator, each)
    pool = np.arange(pool_which.size)

    def density(rows: IntArray, proposed: IntArray) -> FloatArray:
        """Log density of the lead-in, of draws and proposals (any, any)."""
        histories = Histories(likelihoods, pool_which[proposed].ravel())
        start = _begun(histories, theta[rows.ravel()], pool_place[proposed].ravel())
        (values,) = histories.each(start, lambda likelihood, its: (likelihood.log_density(its),))
        return np.nan_to_num(values.reshape(rows.shape), nan=-np.inf, posinf=-np.inf)

    asked = density(*np.broadcast_arrays(few[:, np.newaxis], pool))
    pooled = logsumexp(asked - evidence[:, np.newaxis], axis=0)
    # Spread evenly over the pool, from another place for each draw.
    apart = pool.size * np.arange(PROPOSED) // PROPOSED
    proposed = generator.permutation(pool)[
        (generator.integers(pool.size, size=draws) + apart[:, np.newaxis]) % pool.size
    ]
    rows = np.broadcast_to(np.arange(draws), proposed.shape)
    log_weight = density(rows, proposed) - pooled[proposed]
    # Where none is possible all weights are zero.
    weight = np.exp(log_weight - np.max(log_weight, axis=0, initial=-1e300))
    total = np.cumsum(weight, axis=0)
    index = np.sum(total < uniform(generator, draws) * total[-1], axis=0)
    pick = proposed[index, np.arange(draws)]
    which, place = pool_which[pick], pool_place[pick]
    alone = np.flatnonzero(~(total[-1] ** 2 > COVERED * np.sum(weight**2, axis=0)))
    if alone.size:
        which[alone], place[alone], _ = _by_grids(likelihoods, theta[alone], generator)
    return which, place


def _grid(likelihood: Likelihood, states: States) -> _Grid:
    """Close in on the states that a lead-in allows."""
    draws = len(states.theta)
    low, high = np.zeros(draws), np.ones(draws)
    if not states.open:
        # A single state.
        nodes = np.zeros((NODES, draws))
        return _Grid(
            nodes, nodes, np.nan_to_num(likelihood.log_density(states.at(low)), nan=-np.inf)
        )
    for _ in range(ROUNDS):
        places = np.linspace(low, high, NODES)
        nodes = np.concatenate([states.at(place) for place in places])
        density = likelihood.log_density(nodes).reshape(NODES, draws)
        density = np.nan_to_num(density, nan=-np.inf, posinf=-np.inf)
        best = np.max(density, axis=0)
        density = np.maximum(density - best, -1e3)
        if np.max(np.abs(np.diff(np.maximum(density, -2.0), axis=0))) < FINE:
            break
        possible = density > -IMPROBABLE
        first = np.maximum(np.argmax(possible, axis=0) - 1, 0)
        last = NODES - 1 - np.maximum(np.argmax(possible[::-1], axis=0) - 1, 0)
        columns = np.arange(draws)
        low, high = places[first, columns], places[last, columns]
    evidence = best + np.log(np.sum(_weights(states, places, density), axis=0))
    return _Grid(places, density, evidence)


def _weights(states: States, places: FloatArray, density: FloatArray) -> FloatArray:
    """Return how probable the states of the cells between nodes (nodes, draws) are, (any, draws).

    A cell has as much as it has beforehand, times what the lead-in says of its middle.
    """
    inside = np.arange(BETWEEN)[:, np.newaxis] / BETWEEN
    edges = [a + inside * (b - a) for a, b in pairwise(places)]
    beforehand = np.diff(states.below(np.concatenate([*edges, places[-1:]])), axis=0)
    weights: FloatArray = beforehand * np.exp(_between(density))
    return weights


def _between(nodes: FloatArray) -> FloatArray:
    """Return the middles (any, draws) of cells between nodes (nodes, draws), on straight lines."""
    inside = (np.arange(BETWEEN)[:, np.newaxis] + 0.5) / BETWEEN
    return np.concatenate([a + inside * (b - a) for a, b in pairwise(nodes)])


def _drawn(places: FloatArray, weights: FloatArray, uniform_: FloatArray) -> FloatArray:
    """Draw places (draws,) from cells between nodes (nodes, draws), by their weights."""
    weight = np.cumsum(weights, axis=0)
    index = np.sum(weight < uniform_ * weight[-1], axis=0)
    drawn: FloatArray = _between(places)[index, np.arange(uniform_.size)]
    return drawn
