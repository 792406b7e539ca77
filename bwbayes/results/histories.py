"""Histories: which drive before a record left the state that it starts from.

Most operators' states are one number, ``initial``. Those that remember extrema have more: how far
earlier drives went leaves states of their own, and each such range is a history. What a lead-in
says of a history, and of the states in it, is computed on a grid that closes in on where it
allows them; every draw then chooses its own.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from bwbayes.arrays import FloatArray, IntArray
from bwbayes.inference.likelihood import Likelihood
from bwbayes.model.operator import narrower

__all__ = ["Histories", "States", "chosen", "uniform"]

# Nodes of the grid of hysteretic states, and how often it closes in at most.
NODES = 17
ROUNDS = 6

# A node less probable than the best by this much (nats) is outside of the next grid.
IMPROBABLE = 10.0

# The grid is fine enough when neighbours within two nats of the best node differ by less than this.
FINE = 1.5

# Draws that say which histories are possible at all: asking every draw about each takes long.
FEW = 50

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
            ask(one, theta[rows])
            for one, rows in zip(self.likelihoods, groups, strict=True)
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
            left = [operator.left(column, voltage, one) for one in ranges]
            self.ordered = np.sort(np.concatenate(left), axis=0)
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
    draws = np.arange(len(theta))
    alone = len(likelihoods) == 1
    likelihoods = _possible(likelihoods, theta)
    states = [States(one, theta, alone=alone) for one in likelihoods]
    if alone and not states[0].open:
        return Histories(likelihoods, np.zeros_like(draws)), states[0].at(np.zeros(draws.size))
    grids = [_grid(*both) for both in zip(likelihoods, states, strict=True)]
    which = np.zeros_like(draws)
    if len(grids) > 1:
        evidence = np.stack([grid.evidence for grid in grids])
        weight = np.cumsum(np.exp(evidence - np.max(evidence, axis=0)), axis=0)
        which = np.sum(weight < uniform(generator, draws.size) * weight[-1], axis=0)
    places, density = (np.stack([grid[i] for grid in grids])[which, :, draws].T for i in range(2))
    # In one of many histories a place is the part of states below, whichever of them it is.
    place = _drawn(places, _weights(states[0], places, density), uniform(generator, draws.size))
    state = np.stack([one.placed(place) for one in states])[which, draws]
    begun = likelihoods[0].table.replaced(theta, "initial", state)
    return Histories(likelihoods, which), begun


def _possible(likelihoods: tuple[Likelihood, ...], theta: FloatArray) -> tuple[Likelihood, ...]:
    """Leave out the histories that the lead-in rules out with each of a few of the draws."""
    few = theta[:: len(theta) // FEW] if len(theta) >= 2 * FEW else theta[:0]
    if len(likelihoods) == 1 or not few.size:
        return likelihoods
    told = np.stack([_grid(one, States(one, few, alone=False)).evidence for one in likelihoods])
    possible = np.any(told > np.max(told, axis=0) - IMPROBABLE, axis=1)
    return tuple(one for one, able in zip(likelihoods, possible, strict=True) if able)


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
        every = np.concatenate([states.at(place) for place in places])
        density = likelihood.log_density(every).reshape(NODES, draws)
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
