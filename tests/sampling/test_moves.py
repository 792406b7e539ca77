"""The moves leave a distribution as it is, alone and together, and get everywhere.

How sure :func:`~tests.inference.problems.worst_score` is, and how rarely wrong, is told there. In
four repetitions with other seeds the right moves scored at most 3.3 here and the planted defects
at least 17, with the alarm at 7.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any

import emcee
import numpy as np
import pytest
from emcee.moves import DEMove, MHMove, Move
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats

from bwbayes.arrays import BoolArray, FloatArray, IntArray
from bwbayes.sampling.ensemble import advance, start
from bwbayes.sampling.moves import (
    MOVES,
    AmongPlaces,
    SnookerMove,
    pilot_moves,
    sampling_moves,
    spreading_moves,
)
from bwbayes.sampling.nearby import Nearby
from bwbayes.sampling.proposals import StudentMixture
from tests.inference.problems import ALARM, TARGETS, gaussian, target, worst_score

Moves = list[tuple[Move, float]]


def planted(move: Move, wrong: Callable[[FloatArray], FloatArray]) -> Move:
    """Return a move whose log factor, a part of its acceptance ratio, is wrong."""
    right = move.get_proposal

    def propose(*arguments: Any) -> tuple[FloatArray, FloatArray]:
        proposed, factor = right(*arguments)
        return proposed, wrong(factor)

    move.get_proposal = propose
    return move


def fitted(name: str) -> StudentMixture:
    return StudentMixture.fitted(TARGETS[name].draw(np.random.default_rng(21), 2000))


def forgotten(factor: FloatArray) -> FloatArray:
    """Return the log factor of a move that is symmetric."""
    return np.zeros_like(factor)


def eager(factor: FloatArray) -> FloatArray:
    """Return a log factor that accepts what is e times too bad."""
    return factor + 1


@pytest.mark.parametrize("name", TARGETS)
def test_differential_evolution_alone_leaves_the_right_distribution(name: str) -> None:
    assert worst_score(TARGETS[name], [(DEMove(), 1.0)], steps=60) < ALARM


@pytest.mark.parametrize("name", TARGETS)
def test_twin_differential_evolution_that_accepts_too_easily_is_found(name: str) -> None:
    moves = [(planted(DEMove(), eager), 1.0)]
    assert worst_score(TARGETS[name], moves, steps=60) > ALARM


@pytest.mark.parametrize("name", TARGETS)
def test_the_snooker_move_leaves_the_right_distribution(name: str) -> None:
    assert worst_score(TARGETS[name], [(SnookerMove(), 1.0)], steps=60) < ALARM


@pytest.mark.parametrize("name", TARGETS)
def test_twin_a_snooker_move_without_its_factor_is_found(name: str) -> None:
    moves = [(planted(SnookerMove(), forgotten), 1.0)]
    assert worst_score(TARGETS[name], moves, steps=60) > ALARM


class OneWay(SnookerMove):
    """A snooker move of splits with fixed roles, so that most of its steps have no way back."""

    def __init__(self) -> None:
        super().__init__()
        self.nsplits = 4

    def get_proposal(
        self, moving: FloatArray, others: list[FloatArray], random: Any
    ) -> tuple[FloatArray, FloatArray]:
        """Propose as :class:`SnookerMove` did once."""
        z, z1, z2 = (split[random.randint(len(split), size=len(moving))] for split in others)
        distance = np.linalg.norm(moving - z, axis=1, keepdims=True)
        direction = (moving - z) / distance
        along = np.sum(direction * (z1 - z2), axis=1, keepdims=True)
        proposed = distance + self.stretch * along
        factor = (moving.shape[1] - 1) * (np.log(np.abs(proposed)) - np.log(distance))
        return z + proposed * direction, factor[:, 0]


def spread_score(move: Move) -> float:
    """Return the t-score of the variance of an ensemble's mean: one coordinate, four walkers.

    Exact draws to start from, twelve ensembles of 1,500 steps. Four walkers are the fewest, and
    show best what is wrong between them; the variance must be a quarter.
    """
    normal = target(lambda x: -0.5 * np.sum(x**2, axis=1), 1)
    _, point = gaussian(1)
    variances = []
    for child in np.random.SeedSequence(5).spawn(12):
        generator = np.random.default_rng(child)
        state = start(normal, point, 0, 4, generator)
        draws = generator.standard_normal((4, 1))
        state = replace(state, coordinates=draws, log_density=normal.log_density(draws))
        chain = advance(normal, [(move, 1.0)], state, 1500).coordinates
        variances.append(np.mean(np.mean(chain, axis=(1, 2)) ** 2))
    error = np.std(variances, ddof=1) / np.sqrt(len(variances))
    return float((np.mean(variances) - 1 / 4) / error)


def test_the_snooker_move_leaves_the_spread_of_small_ensembles() -> None:
    """A t-score with 11 degrees of freedom: a false alarm in 40,000 runs at 7."""
    assert abs(spread_score(SnookerMove())) < ALARM


def test_twin_a_snooker_move_without_a_way_back_is_found() -> None:
    """It makes that variance 1.45 times too large."""
    assert spread_score(OneWay()) > ALARM


def test_twin_half_of_the_snooker_factor_is_found() -> None:
    """The move of emcee itself, up to 3.1.6, in nine dimensions."""
    halved = emcee.moves.DESnookerMove()
    assert worst_score(TARGETS["gaussian"], [(halved, 1.0)], steps=40) > ALARM


@pytest.mark.parametrize("name", TARGETS)
def test_the_moves_together_leave_the_right_distribution(name: str) -> None:
    assert worst_score(TARGETS[name], sampling_moves(fitted(name)), steps=60) < ALARM


@pytest.mark.parametrize("name", TARGETS)
def test_twin_a_wrong_ratio_of_the_mixture_is_found_among_the_other_moves(name: str) -> None:
    moves = sampling_moves(fitted(name))
    assert isinstance(moves[2][0], MHMove)
    planted(moves[2][0], forgotten)
    assert worst_score(TARGETS[name], moves, steps=30) > ALARM


@pytest.mark.parametrize("name", TARGETS)
def test_steps_to_one_of_several_places_leave_the_right_distribution(name: str) -> None:
    moves = [(AmongPlaces(TARGETS[name].proposal, 5), 1.0)]
    assert worst_score(TARGETS[name], moves, steps=60) < ALARM


class Eager(AmongPlaces):
    """Takes the place it has chosen, whatever place it leaves."""

    def choose(
        self, here: FloatArray, weight: FloatArray, chance: FloatArray
    ) -> tuple[IntArray, BoolArray, FloatArray]:
        """Choose as the move does, and always take."""
        one, taken, chosen = super().choose(here, weight, chance)
        return one, np.ones_like(taken), chosen


@pytest.mark.parametrize("name", TARGETS)
def test_twin_steps_that_take_every_chosen_place_are_found(name: str) -> None:
    """The best of two places is no draw of the target."""
    moves = [(Eager(TARGETS[name].proposal, 2), 1.0)]
    assert worst_score(TARGETS[name], moves, steps=60) > ALARM


@given(st.lists(st.floats(-30, 30), min_size=2, max_size=6))
def test_a_step_to_one_of_several_places_and_its_way_back_are_in_balance(logs: list[float]) -> None:
    """With the other places given, w₀ P(0 → 1) = w₁ P(1 → 0), by a fine grid of chances."""
    grid = (np.arange(100_000) + 0.5) / 100_000
    move = AmongPlaces(TARGETS["banana"].proposal, len(logs) - 1)
    flows = []
    for first, second in ((0, 1), (1, 0)):
        here = np.full(grid.size, logs[first])
        weight = np.repeat(np.array([[logs[second], *logs[2:]]]).T, grid.size, axis=1)
        one, taken, chosen = move.choose(here, weight, grid)
        assert (chosen == weight[one, np.arange(grid.size)]).all()
        flows.append(np.exp(logs[first] - max(logs)) * np.mean(taken & (one == 0)))
    assert flows[0] == pytest.approx(flows[1], abs=5e-5)


@pytest.mark.parametrize("name", TARGETS)
def test_nearby_steps_leave_the_right_distribution(name: str) -> None:
    assert worst_score(TARGETS[name], [(MHMove(Nearby(fitted(name))), 1.0)], steps=60) < ALARM


@pytest.mark.parametrize("name", TARGETS)
def test_twin_nearby_steps_without_their_factor_are_found(name: str) -> None:
    moves = [(planted(MHMove(Nearby(fitted(name))), forgotten), 1.0)]
    assert worst_score(TARGETS[name], moves, steps=60) > ALARM


def test_moves_that_spread_leave_the_right_distribution() -> None:
    assert worst_score(TARGETS["banana"], spreading_moves(fitted("banana")), steps=60) < ALARM


def test_nearby_steps_leave_their_own_mixture_as_it_is() -> None:
    """Ten times over: a false alarm in 10,000 runs, and a tail that is lost is found."""
    mixture = fitted("banana")
    random = np.random.RandomState(3)
    places = mixture.draw(random, 20_000)
    moved, factor = Nearby(mixture)(places, random)
    after = moved
    for _ in range(9):
        after, _ = Nearby(mixture)(after, random)
    density = [mixture.log_density(one) for one in (places, moved, after)]
    np.testing.assert_allclose(density[0] - density[1], factor, rtol=0, atol=1e-9)
    assert stats.ks_2samp(density[0], density[2]).pvalue > 1e-4
    score = (np.mean(moved, axis=0) - np.mean(places, axis=0)) / np.std(places, axis=0)
    assert (np.abs(score) < 5 / np.sqrt(10_000)).all()
    assert 0.4 < stats.spearmanr(places[:, 0], moved[:, 0]).statistic < 0.95


def test_nearby_steps_are_taken_where_independent_places_are_not() -> None:
    """In 15 coordinates, with a proposal whose centre is a sd off in each, 3.9 sds altogether."""
    posterior, _ = gaussian(15)
    draws = np.random.default_rng(4).standard_normal((4000, 15))
    mixture = StudentMixture.fitted(draws + 1.0)
    start_at = np.random.default_rng(5).standard_normal((500, 15))
    taken = []
    for propose in (mixture.__call__, Nearby(mixture).__call__):
        places, factor = propose(start_at, np.random.RandomState(6))
        ratio = posterior.log_density(places) - posterior.log_density(start_at) + factor
        taken.append(float(np.mean(np.exp(np.minimum(ratio, 0.0)))))
    independent, nearby = taken
    assert nearby > 2 * independent


def lower_share(moves: Moves, share: float) -> float:
    """Start a share of 100 walkers in the lower of the far modes; return that of 100 later steps.

    Of moves that go across it should be 0.3. Over five seeds it was within 0.022 of that, so that
    0.1 off is an alarm that is hardly ever false.
    """
    known, walkers = TARGETS["far modes"], 100
    generator = np.random.default_rng(6)
    coordinates = generator.standard_normal((walkers, 3))
    coordinates[:, 0] += np.where(np.arange(walkers) < share * walkers, -10, 10)
    flat, (_, point) = target(lambda x: np.zeros(len(x)), 3), gaussian(3)
    state = start(flat, point, 0, walkers, generator)
    state = replace(state, coordinates=coordinates, log_density=known.log_density(coordinates))
    chain = advance(target(known.log_density, 3), moves, state, 200).coordinates
    return float(np.mean(chain[100:, :, 0] < 0))


ACROSS: dict[str, Callable[[], Moves]] = {
    "differential evolution": lambda: [(DEMove(), 1.0)],
    "pilot": pilot_moves,
    "mixture": lambda: [(MHMove(fitted("far modes")), 1.0)],
    "together": lambda: sampling_moves(fitted("far modes")),
}


@pytest.mark.parametrize("name", ACROSS)
def test_far_modes_get_their_weights(name: str) -> None:
    """From 0.9 of the walkers in the mode that weighs 0.3."""
    assert 0.3 == pytest.approx(lower_share(ACROSS[name](), 0.9), abs=0.1)


def test_twin_steps_that_are_local_leave_far_modes_with_wrong_weights() -> None:
    local = [(emcee.moves.GaussianMove(0.5), 1.0)]
    assert 0.9 == lower_share(local, 0.9)


@pytest.mark.parametrize(("name", "expected"), [("pilot", 1.0), ("together", 0.3)])
def test_a_mode_without_walkers_is_reached_by_the_mixture_alone(name: str, expected: float) -> None:
    assert expected == pytest.approx(lower_share(ACROSS[name](), 1.0), abs=0.1)


def test_a_seventh_of_the_steps_stays_differential_evolution_and_snooker() -> None:
    proposal = TARGETS["banana"].proposal
    weights = {type(move).__name__: weight for move, weight in sampling_moves(proposal)}
    assert 1.0 == pytest.approx(sum(weights.values()))
    assert 0.15 == pytest.approx(weights["DEMove"] + weights["SnookerMove"])
    assert {"AmongPlaces", "DEMove", "SnookerMove"} == set(weights)


def test_without_a_proposal_the_pilots_moves_go_on() -> None:
    names = [(type(move).__name__, weight) for move, weight in pilot_moves()]
    assert {"DEMove", "SnookerMove"} == {name for name, _ in names}
    assert names == [(type(move).__name__, weight) for move, weight in sampling_moves(None)]


def test_half_of_the_pilots_steps_try_places_of_the_point_fits_guess() -> None:
    proposal = TARGETS["banana"].proposal
    weights = {type(move).__name__: weight for move, weight in pilot_moves(proposal)}
    assert {"AmongPlaces": 0.5, "DEMove": 0.4, "SnookerMove": 0.1} == weights


@pytest.mark.parametrize(
    "moves",
    [
        pilot_moves,
        partial(sampling_moves, TARGETS["banana"].proposal),
        lambda: spreading_moves(fitted("banana")),
    ],
)
def test_moves_come_in_the_order_of_their_names(moves: Callable[[], Moves]) -> None:
    kinds = {
        "differential evolution": DEMove,
        "snooker": SnookerMove,
        "mixture": AmongPlaces,
        "nearby": MHMove,
    }
    for name, (move, _) in zip(MOVES, moves(), strict=False):
        assert kinds[name] is type(move)
