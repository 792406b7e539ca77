"""Histories: which drive before a record left the state that it starts from.

Most operators' states are one number, ``initial``. Those that remember extrema have more: how far
earlier drives went leaves states of its own, and each such range is a history. Ranges are the finer
the more of them the lead-in rules out. The lead-in's likelihood of a history, and of the states in
it, is computed on a grid that closes in on the states that it allows. There may be dozens of
histories, which most draws rate alike: then a few draws have grids, and the others choose among
their states, by importance. Stages may remember earlier drives as well, and what is in a play makes
up for a state: then both are chosen together, by annealing.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import chain, combinations, pairwise, product
from typing import NamedTuple

import numpy as np
import scipy

from bwbayes.arrays import FloatArray, IntArray
from bwbayes.inference.likelihood import Likelihood
from bwbayes.model.inputs import Span
from bwbayes.watching import Watch, part, parts, unwatched, watched

Put = Callable[[FloatArray, FloatArray], FloatArray]
"""Puts quantiles of an unknown (draws,) into θ (draws, parameters), and returns it."""

# Draws that are asked about each of many histories.
FEW = 50

# Starts that each draw tries where they have several unknowns, and how often these move at a step.
TRIES, MOVES = 16, 5

# Intervals of the ends of earlier drives in half of a span; draws that split ranges, how often an
# interval is halved at most, and how many ranges each of these draws has split in one go.
INTERVALS, SPLITTING, SPLITS, SPLIT = 6, 8, 8, 4

# Probability below which a range is left out.
NEGLIGIBLE = 1e-9


class EarlierRange(NamedTuple):
    """Drives before a record whose lowest and highest voltages lie in two intervals.

    ``span`` are the middles of these, V, and ``sizes`` their lengths, V: zero for one voltage.
    ``probability`` is that of such drives, beforehand.
    """

    span: Span
    sizes: tuple[float, float] = (0.0, 0.0)
    probability: float = 1.0

    def split(self, ends: Sequence[bool]) -> Iterator[EarlierRange]:
        """Yield the ranges of both halves of the intervals of some ``ends``, lowest and highest."""
        below, above = (
            2 if size and cut else 1 for size, cut in zip(self.sizes, ends, strict=True)
        )
        sizes = self.sizes[0] / below, self.sizes[1] / above
        halves = [
            [end] if cut == 1 else [end - size / 2, end + size / 2]
            for end, size, cut in zip(self.span, sizes, (below, above), strict=True)
        ]
        for pair in product(*halves):
            yield EarlierRange(Span(*pair), sizes, self.probability / (below * above))


def earlier_ranges(span: Span, voltage: float) -> list[EarlierRange]:
    """Return ranges of drives within a span before a record that begins at a voltage, V.

    An earlier drive passed that voltage. Up and down it went anywhere within the span in one case
    of two; in one of four to its end, and in one of four nearly so, into the last interval.
    """

    def ends(last: float) -> Iterator[tuple[float, float, float]]:
        count = math.ceil(abs(last - voltage) / span.half * INTERVALS - 1e-6) if span.half else 0
        yield last, 0.0, 0.25 if count else 1.0
        for i in range(count):
            middle = voltage + (last - voltage) * (i + 0.5) / count
            probability = 0.5 / count + (0.25 if i == count - 1 else 0.0)
            yield middle, abs(last - voltage) / count, probability

    return [
        EarlierRange(Span(low, high), (below, above), p * q)
        for (low, below, p), (high, above, q) in product(ends(span.low), ends(span.high))
    ]


def split_ranges(
    ranges: Sequence[EarlierRange],
    history: Callable[[Span], Likelihood],
    theta: FloatArray,
    watch: Watch = unwatched,
) -> list[EarlierRange]:
    """Split ranges where a lead-in tells sharply how far earlier drives went.

    While a few of the draws θ (draws, parameters) give one end of the drives nearly all of the
    probability, the most probable ranges have the intervals of that end halved. Improbable ranges
    are left out in the end. ``history`` returns the likelihood of a range; ``watch`` is called with
    the share that is done.
    """
    few = theta[:: -(-len(theta) // SPLITTING)]
    evidence = dict[EarlierRange, FloatArray]()
    for number in watched(range(SPLITS + 1), watch):
        for earlier in ranges:
            if earlier not in evidence:
                likelihood = history(earlier.span)
                states = States(likelihood, few)
                log_evidence = _grid(likelihood, states, unwatched)[2]
                evidence[earlier] = log_evidence + math.log(earlier.probability)
        # A draw that is not possible after any drive leaves all as probable as any.
        log = np.maximum([evidence[earlier] for earlier in ranges], -1e300)
        share = np.exp(log - scipy.special.logsumexp(log, axis=0))
        lows, highs = zip(*(earlier.span for earlier in ranges), strict=True)
        sharp = _is_sharp(lows, share), _is_sharp(highs, share)
        if number == SPLITS or not any(sharp):
            break
        best = {*np.argsort(-log, axis=0)[:SPLIT].ravel().tolist()}
        cut = [
            earlier.split(sharp) if k in best else (earlier,) for k, earlier in enumerate(ranges)
        ]
        ranges = [*chain.from_iterable(cut)]
    likely = np.max(share, axis=1) > NEGLIGIBLE
    return [earlier for earlier, keep in zip(ranges, likely.tolist(), strict=True) if keep]


def _is_sharp(ends: Sequence[float], share: FloatArray) -> bool:
    """Tell whether any draw gives nearly all of its ``share`` (ranges, draws) to one of the ends.

    That is, to fewer than two in effect.
    """
    of_end = np.equal.outer(np.unique(ends), ends) @ share
    return bool((np.sum(of_end**2, axis=0) > 0.5).any())


@dataclass(frozen=True)
class Histories:
    """A record's likelihood for each history, and ``which`` of them each draw has, (draws,)."""

    likelihoods: tuple[Likelihood, ...]
    which: IntArray

    @property
    def groups(self) -> list[tuple[Likelihood, IntArray]]:
        """The histories that any draw has, and those draws."""
        rows = (np.flatnonzero(self.which == number) for number in range(len(self.likelihoods)))
        pairs = zip(self.likelihoods, rows, strict=True)
        return [(likelihood, draws) for likelihood, draws in pairs if draws.size]

    def each(
        self, theta: FloatArray, ask: Callable[[Likelihood, FloatArray], tuple[FloatArray, ...]]
    ) -> tuple[FloatArray, ...]:
        """Ask every draw's own likelihood about it; return answers (draws, ...)."""
        answers = [ask(likelihood, theta[rows]) for likelihood, rows in self.groups]
        order = np.argsort(np.concatenate([rows for _, rows in self.groups]))
        return tuple(np.concatenate(answer)[order] for answer in zip(*answers, strict=True))

    def with_states(self, theta: FloatArray, quantile: FloatArray) -> FloatArray:
        """Return θ (draws, parameters) with the states of its histories at quantiles (draws,)."""
        (start_theta,) = self.each(
            np.column_stack([theta, quantile]),
            lambda likelihood, rows: (States(likelihood, rows[:, :-1]).at(rows[:, -1]),),
        )
        return start_theta


def pick(probability: FloatArray, quantile: FloatArray) -> IntArray:
    """Return the history at quantiles (any,) of histories of a ``probability`` (histories,)."""
    which: IntArray = np.searchsorted(np.cumsum(probability), quantile, side="right")
    return np.minimum(which, probability.size - 1)


def uniform(generator: np.random.Generator, draws: int) -> FloatArray:
    """Uniform numbers (draws,), one from each of as many equal parts of 0 to 1, in any order."""
    numbers: FloatArray = (generator.permutation(draws) + generator.uniform(size=draws)) / draws
    return numbers


class States:
    """Hysteretic states at a record's first sample, and how probable they are beforehand.

    ``ordered`` (nodes, draws) are states at ``quantiles`` (nodes,) of that distribution, which is
    even on straight lines between them. In one of many histories they lie between the lowest and
    the highest state that drives of its range leave. The last sweep of an earlier drive ends, as
    often as not, at the record's first voltage: a quarter of the states are the lowest, a quarter
    the highest. Where one number holds all states, whatever the range of a drive, they are what
    drives leave that were running when the record began, on the branches of their loops, the lowest
    and the highest as far out as any drive leaves them: half of the drives went over the whole
    range, half over any part of it. A drive over its lower part alone leaves states above those of
    the whole range: on the way up it has had less to make up for.

    Each θ (draws, parameters) is there ``tries`` times in a row: what its drives leave is the same.
    """

    def __init__(self, likelihood: Likelihood, theta: FloatArray, tries: int = 1) -> None:
        self.table, self.theta = likelihood.table, np.repeat(theta, tries, axis=0)
        self.quantiles, ordered = self._reached(likelihood, theta)
        self.ordered = np.repeat(ordered, tries, axis=1)

    @staticmethod
    def _reached(likelihood: Likelihood, theta: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return quantiles (nodes,) and the states (nodes, draws) there."""
        quantiles = np.array([0.0, 0.25, 0.75, 1.0])
        if likelihood.from_rest:
            return quantiles, np.zeros((4, len(theta)))
        actuator, span = likelihood.actuator, likelihood.actuator.range_of(likelihood.voltage)
        column, inputs = likelihood.table.columns(theta), likelihood.inputs
        # As the stages before the hysteresis pass it on: a delay may be a quarter of a period.
        memories = actuator.begin_inputs(column, inputs, from_rest=False)
        voltage = float(np.mean(actuator.pass_inputs(column, inputs[:1], memories)[0]))
        low, high = actuator.hysteresis.reachable(column, voltage, span)
        if actuator.hysteresis.remembers_range:
            return quantiles, np.stack([low, low, high, high])
        ends = np.linspace(*span, 9).tolist()
        ranges = [Span(*pair) for pair in combinations(ends, 2)]
        states = [actuator.hysteresis.left(column, voltage, swept) for swept in ranges]
        widest = [actuator.hysteresis.left(column, voltage, span)] * len(ranges)
        ordered = np.sort(np.concatenate(states + widest), axis=0)
        ordered[0] = np.minimum(ordered[0], low)
        ordered[-1] = np.maximum(ordered[-1], high)
        return np.linspace(0.0, 1.0, len(ordered)), ordered

    @property
    def open(self) -> bool:
        """Whether any draw has more than one."""
        return bool(np.any(self.ordered[-1] > self.ordered[0]))

    def at(self, quantile: FloatArray) -> FloatArray:
        """Return θ (draws, parameters) with the states at quantiles (draws,)."""
        last, rows = len(self.quantiles) - 2, np.arange(quantile.size)
        node = np.clip(np.searchsorted(self.quantiles, quantile, side="right") - 1, 0, last)
        before, after = self.quantiles[node], self.quantiles[node + 1]
        lower, upper = self.ordered[node, rows], self.ordered[node + 1, rows]
        state = lower + (quantile - before) / (after - before) * (upper - lower)
        return self.table.with_values(self.theta, "initial", state)


def choose_histories(
    likelihoods: tuple[Likelihood, ...],
    probability: FloatArray,
    theta: FloatArray,
    generator: np.random.Generator,
    watch: Watch = unwatched,
) -> tuple[Histories, FloatArray, FloatArray]:
    """Choose every draw's history and state by what the lead-in says; return θ with the states.

    Beforehand histories have a ``probability`` (histories,), and in each all :class:`States` are
    equally probable. Beside them comes the log evidence (draws,) of the lead-in for each draw,
    whatever its history and state.
    ``watch`` is called with the share that is done.
    """
    draws, single = len(theta), len(likelihoods) == 1
    if single and not States(likelihoods[0], theta).open:
        which, quantile = np.zeros(draws, dtype=np.int64), np.zeros(draws)
        evidence = np.nan_to_num(likelihoods[0].log_density(theta), nan=-np.inf)
    elif single or draws < 2 * FEW:
        which, quantile, evidence = _by_grids(
            likelihoods, probability, theta, generator, watch=watch
        )
    else:
        which, quantile, evidence = _by_importance(
            likelihoods, probability, theta, generator, watch
        )
    watch(1.0)
    histories = Histories(likelihoods, which)
    return histories, histories.with_states(theta, quantile), evidence


def choose_together(
    likelihoods: tuple[Likelihood, ...],
    probability: FloatArray,
    theta: FloatArray,
    unknowns: Sequence[Put],
    generator: np.random.Generator,
    watch: Watch = unwatched,
) -> tuple[Histories, FloatArray, FloatArray]:
    """Choose as :func:`choose_histories`, and together with them ``unknowns`` of stages.

    Every draw tries some starts, at first from what is known beforehand. The lead-in's likelihood L
    counts by a power that rises from zero to one: a step from p to q weighs tries by L^(q - p), as
    far as half of them count, and the mean weight is a factor of the draw's evidence; then tries
    are drawn by weight, and move along differences of others by Metropolis's rule. (P. Del Moral,
    A. Doucet and A. Jasra, J. R. Stat. Soc. B 68 (2006) 411-436; C. J. F. ter Braak, Stat. Comput.
    16 (2006) 239-249.)
    """
    draws = len(theta)
    states = [States(likelihood, theta, TRIES) for likelihood in likelihoods]
    every = np.arange(draws * TRIES)

    def draw_histories(scores: FloatArray) -> tuple[IntArray, FloatArray]:
        """Return histories and θ of normal scores (tries, 2 + unknowns)."""
        # Farther out a probability is one to rounding, and its quantile infinite.
        history, quantile, *others = scipy.special.ndtr(np.clip(scores.T, -8.0, 8.0))
        which = pick(probability, history)
        start_theta = np.stack([each.at(quantile) for each in states])[which, every]
        for put, at in zip(unknowns, others, strict=True):
            start_theta = put(start_theta, at)
        return which, start_theta

    def density(scores: FloatArray) -> FloatArray:
        which, start_theta = draw_histories(scores)
        (values,) = Histories(likelihoods, which).each(
            start_theta, lambda likelihood, rows: (likelihood.log_density(rows),)
        )
        return np.maximum(np.nan_to_num(values, nan=-np.inf, posinf=-np.inf), -1e300)

    scores = generator.standard_normal((every.size, 2 + len(unknowns)))
    log, evidence, power = density(scores), np.zeros(draws), 0.0
    while power < 1.0:
        away = log.reshape(draws, TRIES)
        best = np.max(away, axis=1, keepdims=True)
        step, low, high = 1.0 - power, 0.0, 1.0 - power
        for _ in range(50):
            weight = np.exp(step * (away - best))
            sums = weight.sum(axis=1)
            many = np.mean(sums**2 / np.sum(weight**2, axis=1)) > TRIES / 2
            if many and step == 1.0 - power:
                break
            low, high = (step, high) if many else (low, step)
            step = (low + high) / 2
        evidence += step * best[:, 0] + np.log(sums / TRIES)
        total = np.cumsum(weight, axis=1)
        level = (np.arange(TRIES) + generator.uniform(size=(draws, 1))) / TRIES * total[:, -1:]
        kept = np.sum(total[:, np.newaxis] < level[..., np.newaxis], axis=2)
        kept = (kept + TRIES * np.arange(draws)[:, np.newaxis]).ravel()
        scores, log, power = scores[kept], log[kept], power + step
        for _ in range(MOVES):
            one, other = generator.permutation(every), generator.permutation(every)
            length = generator.standard_normal((len(every), 1))
            moved = scores + length * (scores[one] - scores[other])
            log_moved = density(moved)
            gain = power * (log_moved - log) + np.sum(scores**2 - moved**2, axis=1) / 2
            taken = np.log(generator.uniform(size=len(every))) < gain
            scores[taken], log[taken] = moved[taken], log_moved[taken]
        watch(power)
    which, start_theta = draw_histories(scores)
    # Any of a draw's tries.
    rows = TRIES * np.arange(draws) + generator.integers(TRIES, size=draws)
    return Histories(likelihoods, which[rows]), start_theta[rows], evidence


def _by_grids(
    likelihoods: tuple[Likelihood, ...],
    probability: FloatArray,
    theta: FloatArray,
    generator: np.random.Generator,
    repeats: int = 1,
    watch: Watch = unwatched,
) -> tuple[IntArray, FloatArray, FloatArray]:
    """Draw histories and quantiles, so many for each draw, and the log evidence (draws,) for all.

    Those of one draw follow one another, (draws * repeats,).
    """
    grids = [
        _grid(likelihood, States(likelihood, theta), of_likelihood)
        for likelihood, of_likelihood in parts(likelihoods, watch)
    ]
    evidence = np.stack([grid[2] for grid in grids]) + np.log(probability)[:, np.newaxis]
    rows = np.repeat(np.arange(len(theta)), repeats)
    best = np.max(evidence, axis=0)
    weight = np.cumsum(np.exp(evidence - best), axis=0)
    which = np.zeros(rows.size, dtype=np.int64)
    if len(likelihoods) > 1:
        which = np.sum(weight[:, rows] < uniform(generator, rows.size) * weight[-1, rows], axis=0)
    nodes, density = (np.stack([grid[i] for grid in grids])[which, :, rows].T for i in range(2))
    middles, cells = _cells(nodes, density)
    total = np.cumsum(cells, axis=0)
    cell = np.sum(total < uniform(generator, rows.size) * total[-1], axis=0)
    quantile = middles[cell, np.arange(rows.size)]
    return which, quantile, best + np.log(weight[-1])


def _by_importance(
    likelihoods: tuple[Likelihood, ...],
    probability: FloatArray,
    theta: FloatArray,
    generator: np.random.Generator,
    watch: Watch,
) -> tuple[IntArray, FloatArray, FloatArray]:
    """Draw histories and quantiles (draws,) from those that a few draws would draw.

    With the likelihood Lⱼ and the evidence Zⱼ of J of the draws, pairs that these have drawn in
    equal numbers have the density Σ Lⱼ / (J Zⱼ) beside the prior. So a draw with the likelihood L
    takes one of those that are proposed to it with a weight of L / Σ (Lⱼ / Zⱼ), and its evidence is
    J times their mean. Draws that few proposals suit are asked on grids of their own.
    """
    draws = len(theta)
    few = np.arange(0, draws, draws // FEW)
    # 500 pairs or more, of which 64 are proposed to each draw.
    pool_which, pool_quantile, evidence = _by_grids(
        likelihoods, probability, theta[few], generator, -(-500 // few.size), part(watch, 0.0, 0.2)
    )
    pool = np.arange(pool_which.size)

    def density(rows: IntArray, proposed: IntArray) -> FloatArray:
        """Log density of the lead-in, of draws and proposals (any, any)."""
        histories = Histories(likelihoods, pool_which[proposed].ravel())
        start_theta = histories.with_states(theta[rows.ravel()], pool_quantile[proposed].ravel())
        (values,) = histories.each(
            start_theta, lambda likelihood, th: (likelihood.log_density(th),)
        )
        return np.nan_to_num(values.reshape(rows.shape), nan=-np.inf, posinf=-np.inf)

    of_few = density(*np.broadcast_arrays(few[:, np.newaxis], pool))
    watch(0.4)
    pooled = scipy.special.logsumexp(of_few - evidence[:, np.newaxis], axis=0)
    # Spread evenly over the pool, from another start for each draw.
    distance = pool.size * np.arange(64) // 64
    proposed = generator.permutation(pool)[
        (generator.integers(pool.size, size=draws) + distance[:, np.newaxis]) % pool.size
    ]
    rows = np.broadcast_to(np.arange(draws), proposed.shape)
    log_weight = density(rows, proposed) - pooled[proposed]
    watch(0.9)
    # Where none is possible all weights are zero.
    best = np.max(log_weight, axis=0, initial=-1e300)
    weight = np.exp(log_weight - best)
    total = np.cumsum(weight, axis=0)
    with np.errstate(divide="ignore"):
        evidence = best + np.log(few.size * total[-1] / len(weight))
    index = np.sum(total < uniform(generator, draws) * total[-1], axis=0)
    picked = proposed[index, np.arange(draws)]
    which, quantile = pool_which[picked], pool_quantile[picked]
    # With effectively fewer than four proposals, one in ten is beyond the states that a draw
    # allows.
    uncovered = np.flatnonzero(~(total[-1] ** 2 > 4 * np.sum(weight**2, axis=0)))
    if uncovered.size:
        which[uncovered], quantile[uncovered], evidence[uncovered] = _by_grids(
            likelihoods, probability, theta[uncovered], generator
        )
    return which, quantile, evidence


def _grid(
    likelihood: Likelihood, states: States, watch: Watch
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Close in on the states that a lead-in allows.

    Returns quantiles and log densities there, up to a constant, (nodes, draws), and the log
    evidence (draws,) for the history.
    """
    draws = len(states.theta)
    low, high, size = np.zeros(draws), np.ones(draws), 17
    if not states.open:
        nodes = np.zeros((size, draws))
        return nodes, nodes, np.nan_to_num(likelihood.log_density(states.at(low)), nan=-np.inf)
    for _ in watched(range(6), watch):
        nodes = np.linspace(low, high, size)
        theta = np.concatenate([states.at(quantile) for quantile in nodes])
        density = likelihood.log_density(theta).reshape(size, draws)
        density = np.nan_to_num(density, nan=-np.inf, posinf=-np.inf)
        best = np.max(density, axis=0)
        density = np.maximum(density - best, -1e3)
        # Fine enough where neighbors within two nats of the best differ by less than 1.5.
        if np.max(np.abs(np.diff(np.maximum(density, -2.0), axis=0))) < 1.5:
            break
        possible = density > -10.0
        first = np.maximum(np.argmax(possible, axis=0) - 1, 0)
        last = size - 1 - np.maximum(np.argmax(possible[::-1], axis=0) - 1, 0)
        low, high = (nodes[edge, np.arange(draws)] for edge in (first, last))
    return nodes, density, best + np.log(np.sum(_cells(nodes, density)[1], axis=0))


def _cells(nodes: FloatArray, density: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return eight cells between each two nodes: their middles and weights, (cells, draws).

    A cell weighs as much as it does beforehand, times what the lead-in says of its middle.
    """
    inside = (np.arange(8)[:, np.newaxis] + 0.5) / 8
    middles, logs = (
        np.concatenate([a + inside * (b - a) for a, b in pairwise(values)])
        for values in (nodes, density)
    )
    widths = np.repeat(np.diff(nodes, axis=0), 8, axis=0) / 8
    return middles, widths * np.exp(logs)
