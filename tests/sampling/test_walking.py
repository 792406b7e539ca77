"""A walk is emcee's own, bit for bit, and the same one whether it is alone or one of several."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import emcee
import numpy as np
import pytest
from emcee.moves import DEMove, Move, StretchMove

from bwbayes.inference import pointfit
from bwbayes.inference.engine import Engine
from bwbayes.inference.pointfit import PointFit
from bwbayes.inference.posterior import Posterior
from bwbayes.sampling.chain import EnsembleState
from bwbayes.sampling.ensemble import advance, advance_together, start
from bwbayes.sampling.moves import pilot_moves, sampling_moves
from bwbayes.sampling.proposals import StudentMixture
from tests.inference.problems import gaussian, short_posterior

FREE, WALKERS, STEPS = 3, 12, 60
POSTERIOR, POINT = gaussian(FREE)
MIXTURE = StudentMixture.fitted(np.random.default_rng(1).standard_normal((500, FREE)))

Moves = list[tuple[Move, float]]

MOVES: dict[str, Callable[[], Moves]] = {
    "pilot": pilot_moves,
    "sampling": lambda: sampling_moves(MIXTURE),
    "stretch": lambda: [(StretchMove(), 1.0)],
    "walkers in order": lambda: [(DEMove(randomize_split=False), 1.0)],
}


def begin(number: int, posterior: Posterior = POSTERIOR, point: PointFit = POINT) -> EnsembleState:
    walkers = max(WALKERS, 2 * posterior.prior.dimensions)
    return start(posterior, point, number, walkers, np.random.default_rng(number))


@pytest.mark.parametrize("name", MOVES)
def test_a_walk_is_emcees_own(name: str) -> None:
    state = begin(1)
    words = state.random_state
    normal = float(words[626:].view(np.float64)[0])
    random = np.random.RandomState()
    random.set_state(("MT19937", words[:624], int(words[624]), int(words[625]), normal))
    sampler = emcee.EnsembleSampler(
        WALKERS, FREE, POSTERIOR.log_density, vectorize=True, moves=MOVES[name]()
    )
    begun = emcee.State(state.coordinates, random_state=random.get_state())
    last = sampler.run_mcmc(begun, STEPS, skip_initial_state_check=True)
    block = advance(POSTERIOR, MOVES[name](), state, STEPS)
    np.testing.assert_array_equal(sampler.get_chain(), block.coordinates)
    np.testing.assert_array_equal(sampler.backend.accepted, block.accepted)
    np.testing.assert_array_equal(last.random_state[1], block.end.random_state[:624])


@pytest.mark.parametrize("engine", ["numpy", "numba"])
@pytest.mark.parametrize("phase", ["pilot", "sampling"])
def test_ensembles_that_move_together_move_as_alone(phase: str, engine: Engine) -> None:
    """On a record. Compiled code works in groups of models, and tells densities to rounding."""
    if engine == "numba":
        pytest.importorskip("numba")
    posterior = replace(short_posterior(samples=120, dynamics="lag"), engine=engine)
    generator = np.random.default_rng(2)
    point = pointfit.fit(posterior, generator)
    draws = generator.multivariate_normal(point.mode, point.covariance, 400)
    proposal = StudentMixture.fitted(draws) if phase == "sampling" else None
    states = [begin(number, posterior, point) for number in range(3)]
    together = advance_together(posterior, [sampling_moves(proposal) for _ in states], states, 20)
    for state, block in zip(states, together, strict=True):
        alone = advance(posterior, sampling_moves(proposal), state, 20)
        np.testing.assert_array_equal(alone.coordinates, block.coordinates)
        rounding = 1e-13 if engine == "numba" else 0
        np.testing.assert_allclose(alone.log_density, block.log_density, rtol=rounding)
        np.testing.assert_array_equal(alone.accepted, block.accepted)
        np.testing.assert_array_equal(alone.moves, block.moves)
        np.testing.assert_array_equal(alone.end.random_state, block.end.random_state)
