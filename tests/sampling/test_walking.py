"""A walk is emcee's own, bit for bit, and the same one whether it is alone or one of several."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import cast

import emcee
import numpy as np
import pytest
from emcee.moves import DEMove, Move, StretchMove

from bwbayes.arrays import FloatArray
from bwbayes.errors import InputError
from bwbayes.inference import pointfit
from bwbayes.inference.engine import Engine
from bwbayes.inference.pointfit import PointFit
from bwbayes.inference.posterior import Posterior
from bwbayes.sampling.ensemble import EnsembleState, advance, advance_together, start
from bwbayes.sampling.moves import pilot_moves, sampling_moves
from bwbayes.sampling.proposals import StudentMixture
from tests.inference.problems import gaussian, short_posterior, target

FREE, WALKERS, STEPS = 3, 12, 60
POSTERIOR, POINT = gaussian(FREE)
FLAT = target(lambda x: np.zeros(len(x)), FREE)
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


class Counted:
    """A posterior that counts its calls, and remembers how many places each asked for."""

    def __init__(self, posterior: Posterior) -> None:
        self.posterior = posterior
        self.calls: list[int] = []

    def log_density(self, coordinates: FloatArray) -> FloatArray:
        """Pass on a call."""
        self.calls.append(len(coordinates))
        return self.posterior.log_density(coordinates)


def counted(posterior: Posterior = POSTERIOR) -> tuple[Posterior, list[int]]:
    made = Counted(posterior)
    return cast("Posterior", made), made.calls


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


def test_one_call_serves_all_ensembles() -> None:
    """Stretch moves ask twice a step: so do four ensembles together, for four times as much."""
    posterior, calls = counted()
    states = [begin(number) for number in range(4)]
    advance_together(posterior, [MOVES["stretch"]() for _ in states], states, STEPS)
    assert [4 * WALKERS // 2] * 2 * STEPS == calls


def test_independent_steps_in_a_row_ask_once() -> None:
    posterior, calls = counted()
    block = advance(posterior, sampling_moves(MIXTURE), begin(1), STEPS)
    mixture = int(block.moves[2, 0])
    others = 2 * int(block.moves[0, 0]) // WALKERS + 2 * int(block.moves[1, 0]) // WALKERS
    assert STEPS * WALKERS == sum(calls)
    assert max(calls) > 2 * WALKERS
    assert len(calls) < others + mixture // WALKERS


def test_places_that_are_not_finite_have_no_density() -> None:
    posterior, calls = counted(FLAT)
    state = begin(1)
    far = EnsembleState(state.coordinates * 1e307, state.log_density, state.random_state)
    block = advance(posterior, [(StretchMove(1e9), 1.0)], far, 5)
    assert np.isfinite(block.coordinates).all()
    assert sum(calls) < 5 * WALKERS


def test_a_move_of_another_kind_is_refused() -> None:
    with pytest.raises(InputError, match="moves: Move is neither a RedBlueMove nor an MHMove"):
        advance(POSTERIOR, [(Move(), 1.0)], begin(1), 1)
