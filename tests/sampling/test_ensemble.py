"""An ensemble moves as emcee moves it; starts are tight, far, and apart."""

from collections.abc import Callable

import emcee
import numpy as np
import pytest
from emcee.moves import DEMove, StretchMove

from bwbayes.arrays import FloatArray
from bwbayes.sampling.chain import Block, EnsembleState, pack_random_state, unpack_random_state
from bwbayes.sampling.moves import WeightedMoves, advance, pilot_moves, sampling_moves, start
from bwbayes.sampling.proposals import StudentMixture
from tests.sampling.targets import gaussian, target

FREE, WALKERS = 3, 12
POSTERIOR, POINT = gaussian(FREE)


def begin(seed: int = 1) -> EnsembleState:
    return start(POSTERIOR, POINT, 0, WALKERS, np.random.default_rng(seed))


def alone(moves: WeightedMoves, state: EnsembleState, steps: int) -> Block:
    return advance(POSTERIOR, [state], [moves], steps)[0]


PROPOSAL = StudentMixture.fitted(
    np.random.default_rng(5).multivariate_normal(np.zeros(FREE), POINT.covariance, 500)
)
MOVES: dict[str, Callable[[], WeightedMoves]] = {
    "pilot": pilot_moves,
    "sampling": lambda: sampling_moves(PROPOSAL, tries=2, ahead=5),
    "stretch": lambda: {"stretch": (StretchMove(), 1.0)},
    "walkers in order": lambda: {"DE": (DEMove(randomize_split=False), 1.0)},
}


@pytest.mark.parametrize("name", MOVES)
def test_anyone_may_use_the_moves_in_a_sampler_of_their_own(name: str) -> None:
    """From the same random state it makes the same steps, and counts what was accepted."""
    state, steps = begin(), 60
    sampler = emcee.EnsembleSampler(
        WALKERS, FREE, POSTERIOR.log_density, vectorize=True, moves=[*MOVES[name]().values()]
    )
    begun = emcee.State(state.coordinates, random_state=unpack_random_state(state.random_state))
    last = sampler.run_mcmc(begun, steps, skip_initial_state_check=True)
    block = alone(MOVES[name](), state, steps)
    np.testing.assert_array_equal(sampler.get_chain(), block.coordinates)
    np.testing.assert_array_equal(sampler.backend.accepted, block.accepted)
    np.testing.assert_array_equal(pack_random_state(last.random_state), block.end.random_state)
    proposed, accepted = np.sum([*block.moves.values()], axis=0)
    assert (steps * WALKERS, np.sum(block.accepted)) == (proposed, accepted)


def distance(point: FloatArray) -> float:
    inverse = np.linalg.inv(POINT.covariance)
    return float(np.sqrt(point @ inverse @ point))


def test_a_start_is_a_tight_cluster_far_from_the_optimum() -> None:
    state = begin()
    center = np.mean(state.coordinates, axis=0)
    assert 9 < distance(center) < 11
    assert all(distance(row - center) < 1.5 for row in state.coordinates)
    np.testing.assert_array_equal(POSTERIOR.log_density(state.coordinates), state.log_density)


def test_a_start_comes_nearer_where_the_density_is_zero() -> None:
    def walled(x: FloatArray) -> FloatArray:
        return np.where(np.max(np.abs(x), axis=1) < 2, 0.0, -np.inf)

    state = start(target(walled, FREE), POINT, 0, WALKERS, np.random.default_rng(4))
    assert np.isfinite(state.log_density).all()
    assert np.max(np.abs(state.coordinates)) < 2
