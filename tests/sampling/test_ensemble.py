"""An ensemble moves as emcee moves it; starts are tight, far, and apart."""

from __future__ import annotations

from collections.abc import Callable

import emcee
import numpy as np
import pytest
from emcee.moves import DEMove, StretchMove

from bwbayes.arrays import FloatArray
from bwbayes.sampling.chain import Block, EnsembleState
from bwbayes.sampling.ensemble import advance, start
from bwbayes.sampling.moves import Weighted, pilot_moves
from tests.sampling.targets import gaussian, target

FREE, WALKERS = 3, 12
POSTERIOR, POINT = gaussian(FREE)


def begin(seed: int = 1) -> EnsembleState:
    return start(POSTERIOR, POINT, 0, WALKERS, np.random.default_rng(seed))


def alone(moves: Weighted, state: EnsembleState, steps: int) -> Block:
    return advance(POSTERIOR, [moves], [state], steps)[0]


EMCEES: dict[str, Callable[[], Weighted]] = {
    "pilot": pilot_moves,
    "stretch": lambda: [(StretchMove(), 1.0)],
    "walkers in order": lambda: [(DEMove(randomize_split=False), 1.0)],
}


@pytest.mark.parametrize("name", EMCEES)
def test_the_steps_are_emcees_own(name: str) -> None:
    state, steps = begin(), 60
    words = state.random_state
    normal = float(words[626:].view(np.float64)[0])
    random = np.random.RandomState()
    random.set_state(("MT19937", words[:624], int(words[624]), int(words[625]), normal))
    sampler = emcee.EnsembleSampler(
        WALKERS, FREE, POSTERIOR.log_density, vectorize=True, moves=EMCEES[name]()
    )
    begun = emcee.State(state.coordinates, random_state=random.get_state())
    last = sampler.run_mcmc(begun, steps, skip_initial_state_check=True)
    block = alone(EMCEES[name](), state, steps)
    np.testing.assert_array_equal(sampler.get_chain(), block.coordinates)
    np.testing.assert_array_equal(sampler.backend.accepted, block.accepted)
    np.testing.assert_array_equal(last.random_state[1], block.end.random_state[:624])


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
