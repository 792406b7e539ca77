"""Advancing an ensemble is a pure function; starts are tight, far, and apart."""

from __future__ import annotations

import copy
from dataclasses import replace

import emcee
import numpy as np
import pytest
from emcee.moves import DEMove, MHMove

from bwbayes.arrays import FloatArray
from bwbayes.sampling.ensemble import (
    RANDOM_STATE_WORDS,
    EnsembleState,
    advance,
    autocorrelation_time,
    start,
)
from bwbayes.sampling.moves import pilot_moves, sampling_moves
from bwbayes.sampling.proposals import StudentProposal
from tests.inference.problems import gaussian, target

FREE, WALKERS = 3, 12
POSTERIOR, POINT = gaussian(FREE)
PROPOSAL = StudentProposal(np.zeros(FREE), np.eye(FREE))
MOVES = {"pilot": pilot_moves(), "sampling": sampling_moves(PROPOSAL)}


def begin(seed: int = 1) -> EnsembleState:
    return start(POSTERIOR, POINT, 0, WALKERS, np.random.default_rng(seed))


def assert_same_state(one: EnsembleState, two: EnsembleState) -> None:
    np.testing.assert_array_equal(one.coordinates, two.coordinates)
    np.testing.assert_array_equal(one.log_density, two.log_density)
    np.testing.assert_array_equal(one.random_state, two.random_state)


@pytest.mark.parametrize("phase", MOVES)
def test_the_same_input_gives_the_same_bits(phase: str) -> None:
    one, two = (advance(POSTERIOR, MOVES[phase], begin(), 40) for _ in range(2))
    np.testing.assert_array_equal(one.coordinates, two.coordinates)
    np.testing.assert_array_equal(one.log_density, two.log_density)
    np.testing.assert_array_equal(one.accepted, two.accepted)
    np.testing.assert_array_equal(one.moves, two.moves)
    assert_same_state(one.end, two.end)


@pytest.mark.parametrize("phase", MOVES)
def test_the_input_is_not_modified(phase: str) -> None:
    state = begin()
    before = copy.deepcopy(state)
    advance(POSTERIOR, MOVES[phase], state, 40)
    assert_same_state(before, state)


def test_the_global_generator_is_left_alone() -> None:
    before = np.random.get_state()  # noqa: NPY002  # the state that must not be touched
    advance(POSTERIOR, MOVES["sampling"], begin(), 10)
    after = np.random.get_state()  # noqa: NPY002
    np.testing.assert_array_equal(before[1], after[1])
    assert before[2:] == after[2:]


@pytest.mark.parametrize("phase", MOVES)
@pytest.mark.parametrize("cuts", [(30, 30), (1, 59), (7, 13, 40)])
def test_blocks_in_a_row_are_one_long_block(phase: str, cuts: tuple[int, ...]) -> None:
    whole = advance(POSTERIOR, MOVES[phase], begin(), 60)
    state, blocks = begin(), []
    for steps in cuts:
        blocks.append(advance(POSTERIOR, MOVES[phase], state, steps))
        state = blocks[-1].end
    joined = np.concatenate([block.coordinates for block in blocks])
    np.testing.assert_array_equal(whole.coordinates, joined)
    np.testing.assert_array_equal(
        whole.log_density, np.concatenate([block.log_density for block in blocks])
    )
    np.testing.assert_array_equal(whole.accepted, np.sum([b.accepted for b in blocks], axis=0))
    np.testing.assert_array_equal(whole.moves, np.sum([b.moves for b in blocks], axis=0))
    assert_same_state(whole.end, state)


def test_the_end_is_the_last_step() -> None:
    block = advance(POSTERIOR, MOVES["pilot"], begin(), 5)
    assert (5, WALKERS, FREE) == block.coordinates.shape
    assert (5, WALKERS) == block.log_density.shape
    np.testing.assert_array_equal(block.coordinates[-1], block.end.coordinates)
    np.testing.assert_array_equal(block.log_density[-1], block.end.log_density)
    np.testing.assert_array_equal(
        POSTERIOR.log_density(block.end.coordinates), block.end.log_density
    )


def test_accepted_counts_the_moves_of_each_walker() -> None:
    state = begin()
    block = advance(POSTERIOR, MOVES["sampling"], state, 30)
    path = np.concatenate([state.coordinates[np.newaxis], block.coordinates])
    moved = np.any(path[1:] != path[:-1], axis=2)
    np.testing.assert_array_equal(np.sum(moved, axis=0), block.accepted)


@pytest.mark.parametrize("phase", MOVES)
def test_every_step_and_every_acceptance_is_one_moves(phase: str) -> None:
    block = advance(POSTERIOR, MOVES[phase], begin(), 300)
    assert (len(MOVES[phase]), 2) == block.moves.shape
    proposed, accepted = np.sum(block.moves, axis=0)
    assert 300 * WALKERS == proposed
    assert np.sum(block.accepted) == accepted
    assert (block.moves[:, 0] > 0).all()
    assert (block.moves[:, 0] % WALKERS == 0).all()


def test_acceptance_is_told_of_each_move_by_itself() -> None:
    """A move that is never accepted between one that always is and one in between."""

    def nowhere(x: FloatArray, random: np.random.RandomState) -> tuple[FloatArray, FloatArray]:
        return x + random.standard_normal(x.shape), np.full(len(x), -np.inf)

    def stay(x: FloatArray, _: np.random.RandomState) -> tuple[FloatArray, FloatArray]:
        return x, np.zeros(len(x))

    moves = [(MHMove(stay), 0.3), (MHMove(nowhere), 0.4), (DEMove(), 0.3)]
    counts = advance(POSTERIOR, moves, begin(), 60).moves
    assert counts[0, 0] == counts[0, 1] > 0
    assert 0 == counts[1, 1] < counts[1, 0]
    assert 0 < counts[2, 1] < counts[2, 0]


def test_counting_does_not_change_a_step() -> None:
    """The same steps as emcee's own, from the same random state."""
    state = begin()
    random = np.random.RandomState()
    words = state.random_state
    normal = float(words[626:].view(np.float64)[0])
    random.set_state(("MT19937", words[:624], int(words[624]), int(words[625]), normal))
    sampler = emcee.EnsembleSampler(
        WALKERS, FREE, POSTERIOR.log_density, vectorize=True, moves=sampling_moves(PROPOSAL)
    )
    begun = emcee.State(state.coordinates, random_state=random.get_state())
    sampler.run_mcmc(begun, 30, skip_initial_state_check=True)
    block = advance(POSTERIOR, MOVES["sampling"], state, 30)
    np.testing.assert_array_equal(sampler.get_chain(), block.coordinates)


def test_the_random_state_survives_a_round_trip() -> None:
    """Its words, a left-over normal number included, are all that the generator remembers."""
    state = begin()
    assert (RANDOM_STATE_WORDS,) == state.random_state.shape
    assert np.uint32 == state.random_state.dtype
    for _ in range(4):
        stored = np.frombuffer(state.random_state.tobytes(), dtype=np.uint32)
        one = advance(POSTERIOR, MOVES["sampling"], state, 3)
        two = advance(POSTERIOR, MOVES["sampling"], replace(state, random_state=stored), 3)
        assert_same_state(one.end, two.end)
        state = one.end


def test_other_random_states_go_other_ways() -> None:
    one = advance(POSTERIOR, MOVES["pilot"], begin(), 5)
    other = replace(begin(), random_state=begin(2).random_state)
    two = advance(POSTERIOR, MOVES["pilot"], other, 5)
    assert not np.array_equal(one.coordinates, two.coordinates)


def distance(point: FloatArray) -> float:
    inverse = np.linalg.inv(POINT.covariance)
    return float(np.sqrt(point @ inverse @ point))


def test_a_start_is_a_tight_cluster_far_from_the_optimum() -> None:
    state = begin()
    centre = np.mean(state.coordinates, axis=0)
    assert 9 < distance(centre) < 11
    assert all(distance(row - centre) < 1.5 for row in state.coordinates)
    np.testing.assert_array_equal(POSTERIOR.log_density(state.coordinates), state.log_density)


def test_starts_of_different_ensembles_lie_apart() -> None:
    """In nine dimensions random directions hardly ever agree."""
    posterior, point = gaussian(9)
    inverse = np.linalg.inv(point.covariance)
    centres = [
        np.mean(start(posterior, point, e, 18, seed).coordinates, axis=0)
        for e, seed in enumerate(np.random.default_rng(3).spawn(6))
    ]
    apart = [one - two for i, one in enumerate(centres) for two in centres[:i]]
    assert min(float(np.sqrt(way @ inverse @ way)) for way in apart) > 5


def test_optima_take_turns() -> None:
    optima = np.array([[0.0, 0.0, 0.0], [100.0, 0.0, 0.0]])
    point = replace(POINT, optima=optima)
    for number in range(4):
        state = start(POSTERIOR, point, number, WALKERS, np.random.default_rng(number))
        assert 100 * (number % 2) == pytest.approx(np.mean(state.coordinates[:, 0]), abs=15)


def test_a_start_comes_nearer_where_the_density_is_zero() -> None:
    def walled(x: FloatArray) -> FloatArray:
        return np.where(np.max(np.abs(x), axis=1) < 2, 0.0, -np.inf)

    state = start(target(walled, FREE), POINT, 0, WALKERS, np.random.default_rng(4))
    assert np.isfinite(state.log_density).all()
    assert np.max(np.abs(state.coordinates)) < 2


def test_a_start_is_tighter_where_the_optimum_lies_next_to_what_is_impossible() -> None:
    """Of 40 walkers as tight as usual one is impossible nearly always."""

    def bounded(x: FloatArray) -> FloatArray:
        return np.where(x[:, 0] > -0.02, -0.5 * np.sum(x**2, axis=1), -np.inf)

    for seed in range(5):
        state = start(target(bounded, FREE), POINT, 0, 40, np.random.default_rng(seed))
        assert np.isfinite(state.log_density).all()
        assert (state.coordinates.std(axis=0) > 1e-4).all()


def test_the_autocorrelation_time_is_that_of_a_known_process() -> None:
    """(1 + φ)/(1 − φ) for an AR(1) series, within a tenth."""
    generator = np.random.default_rng(5)
    draws = np.empty((4000, 40, 2))
    draws[0] = generator.standard_normal((40, 2))
    for step in range(1, 4000):
        shocks = generator.standard_normal((40, 2))
        kept = np.array([0.8, 0.0])
        draws[step] = kept * draws[step - 1] + np.sqrt(1 - kept**2) * shocks
    np.testing.assert_allclose([9.0, 1.0], autocorrelation_time(draws), rtol=0.1)


@pytest.mark.parametrize(("steps", "walkers"), [(50, 8), (301, 5)])
def test_the_autocorrelation_time_is_emcees(steps: int, walkers: int) -> None:
    series = np.cumsum(np.random.default_rng(6).standard_normal((steps, walkers, 3)), axis=0)
    expected = emcee.autocorr.integrated_time(series, tol=0, quiet=True)
    np.testing.assert_allclose(expected, autocorrelation_time(series), rtol=1e-9)


def test_the_autocorrelation_time_of_what_does_not_move_is_nan() -> None:
    assert np.isnan(autocorrelation_time(np.ones((100, 8, 2)))).all()
