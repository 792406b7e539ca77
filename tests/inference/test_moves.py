"""Moves leave a distribution as it is.

Every test starts its walkers as exact draws of a target. A right move keeps them so: the expected
mean and mean square of every coordinate stay what they are at every step. Twelve independent
ensembles give each an error, so a t-score with 11 degrees of freedom; |t| > 7 is an alarm, which a
right move gives in one of 2,000 tests of 18 statistics. For the Gaussian the standard errors are
0.5 % (Student-t) and 3 % (snooker) of a variance, so a variance that is wrong by 6 or 30 % is found
nearly always; the banana's tails are known only 14 % well. The planted errors are larger.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import emcee
import numpy as np
import pytest
from emcee.moves import Move
from scipy import stats

from bwbayes.arrays import FloatArray
from bwbayes.inference.ensemble import advance, start
from bwbayes.inference.moves import SnookerMove, StudentProposal, pilot_moves, sampling_moves
from tests.inference.problems import gaussian, target

REPLICATES = 12
ALARM = 7.0


@dataclass(frozen=True)
class Known:
    """A target of which log density, exact draws and moments are known.

    ``moments`` are the means and mean squares (2, free).
    """

    free: int
    log_density: Callable[[FloatArray], FloatArray]
    draw: Callable[[np.random.Generator, int], FloatArray]
    proposal: StudentProposal
    moments: FloatArray


def nine_dimensional_gaussian() -> Known:
    posterior, point = gaussian(9, 0.6)
    factor = np.linalg.cholesky(point.covariance)
    return Known(
        9,
        posterior.log_density,
        lambda generator, count: generator.standard_normal((count, 9)) @ factor.T,
        StudentProposal(np.full(9, 0.1), factor),
        np.array([[0.0] * 9, [1.0] * 9]),
    )


def banana() -> Known:
    def log_density(x: FloatArray) -> FloatArray:
        bend = (x[:, 1] - x[:, 0] ** 2) / 0.5
        density: FloatArray = -0.5 * (x[:, 0] ** 2 + bend**2)
        return density

    def draw(generator: np.random.Generator, count: int) -> FloatArray:
        first, second = generator.standard_normal((2, count))
        return np.stack([first, first**2 + 0.5 * second], axis=1)

    proposal = StudentProposal(np.array([0.0, 1.0]), np.diag([1.2, 1.6]))
    return Known(2, log_density, draw, proposal, np.array([[0.0, 1.0], [1.0, 3.25]]))


def bounded() -> Known:
    """Return an exponential and a uniform coordinate, both with hard walls."""

    def log_density(x: FloatArray) -> FloatArray:
        inside = (x[:, 0] > 0) & (x[:, 1] > 0) & (x[:, 1] < 1)
        return np.where(inside, -x[:, 0], -np.inf)

    def draw(generator: np.random.Generator, count: int) -> FloatArray:
        return np.stack([generator.exponential(size=count), generator.uniform(size=count)], axis=1)

    proposal = StudentProposal(np.array([1.0, 0.5]), np.diag([1.0, 0.3]))
    return Known(2, log_density, draw, proposal, np.array([[1.0, 0.5], [2.0, 1 / 3]]))


def bimodal() -> Known:
    """Two humps of different weight, 0.3 at -2 and 0.7 at 2 in the first of three coordinates."""

    def log_density(x: FloatArray) -> FloatArray:
        rest = -0.5 * np.sum(x[:, 1:] ** 2, axis=1)
        humps = np.stack([-0.5 * ((x[:, 0] - m) / 0.7) ** 2 for m in (-2, 2)])
        density: FloatArray = rest + np.logaddexp(np.log(0.3) + humps[0], np.log(0.7) + humps[1])
        return density

    def draw(generator: np.random.Generator, count: int) -> FloatArray:
        x = generator.standard_normal((count, 3))
        x[:, 0] = 0.7 * x[:, 0] + np.where(generator.uniform(size=count) < 0.3, -2, 2)
        return x

    proposal = StudentProposal(np.zeros(3), np.diag([2.0, 1.0, 1.0]))
    return Known(3, log_density, draw, proposal, np.array([[0.8, 0.0, 0.0], [4.49, 1.0, 1.0]]))


TARGETS = {
    "gaussian": nine_dimensional_gaussian(),
    "banana": banana(),
    "bounded": bounded(),
    "bimodal": bimodal(),
}


def worst_score(known: Known, moves: list[tuple[Move, float]], steps: int = 120) -> float:
    """Largest |t| of means and mean squares over the replicates."""
    walkers = 200
    posterior = target(known.log_density, known.free)
    origin = np.zeros(known.free)
    _, point = gaussian(known.free)
    found = []
    for seed in np.random.SeedSequence(1).spawn(REPLICATES):
        generator = np.random.default_rng(seed)
        draws = known.draw(generator, walkers)
        flat = target(lambda x: np.zeros(len(x)), known.free)
        state = start(flat, replace(point, mode=origin), 0, walkers, generator)
        state = replace(state, coordinates=draws, log_density=known.log_density(draws))
        chain = advance(posterior, moves, state, steps).coordinates
        found.append([np.mean(chain**power, axis=(0, 1)) for power in (1, 2)])
    means = np.array(found)
    error = np.std(means, axis=0, ddof=1) / np.sqrt(REPLICATES)
    scores: FloatArray = np.abs(np.mean(means, axis=0) - known.moments) / error
    return float(np.max(scores))


@pytest.mark.parametrize("name", TARGETS)
def test_the_student_proposal_leaves_the_right_distribution(name: str) -> None:
    known = TARGETS[name]
    assert worst_score(known, [(emcee.moves.MHMove(known.proposal), 1.0)]) < ALARM


@pytest.mark.parametrize("name", TARGETS)
def test_the_snooker_move_leaves_the_right_distribution(name: str) -> None:
    assert worst_score(TARGETS[name], [(SnookerMove(), 1.0)]) < ALARM


class Inverted(StudentProposal):
    """The wrong way round: log q(new) − log q(old)."""

    def __call__(
        self, coordinates: FloatArray, random: np.random.RandomState
    ) -> tuple[FloatArray, FloatArray]:
        """Propose with the ratio inverted."""
        proposed, factor = super().__call__(coordinates, random)
        return proposed, -factor


class Omitted(StudentProposal):
    """As if the proposal were symmetric."""

    def __call__(
        self, coordinates: FloatArray, random: np.random.RandomState
    ) -> tuple[FloatArray, FloatArray]:
        """Propose without the ratio."""
        proposed, factor = super().__call__(coordinates, random)
        return proposed, 0 * factor


@pytest.mark.parametrize("name", TARGETS)
@pytest.mark.parametrize("wrong", [Inverted, Omitted])
def test_twin_a_wrong_ratio_of_the_student_proposal_is_found(
    name: str, wrong: type[StudentProposal]
) -> None:
    known = TARGETS[name]
    proposal = wrong(known.proposal.centre, known.proposal.factor)
    assert worst_score(known, [(emcee.moves.MHMove(proposal), 1.0)]) > ALARM


def test_twin_half_of_the_snooker_factor_is_found() -> None:
    """The move of emcee itself, up to 3.1.6, in nine dimensions."""
    halved = emcee.moves.DESnookerMove()
    assert worst_score(TARGETS["gaussian"], [(halved, 1.0)], steps=40) > ALARM


def test_the_student_density_is_scipys() -> None:
    factor = np.array([[1.0, 0.0, 0.0], [0.5, 2.0, 0.0], [-0.3, 0.1, 0.4]])
    proposal = StudentProposal(np.array([1.0, -1.0, 0.5]), factor, freedom=4.0)
    x = np.random.default_rng(2).normal(0, 3, (50, 3))
    scipys = stats.multivariate_t(proposal.centre, factor @ factor.T, df=4)
    difference = scipys.logpdf(x) - proposal.log_density(x)
    np.testing.assert_allclose(difference[0], difference, atol=1e-10)


def test_student_draws_have_the_student_distribution() -> None:
    """Each coordinate, and one direction across, by Kolmogorov-Smirnov at one in 10,000."""
    factor = np.array([[1.0, 0.0], [0.5, 2.0]])
    proposal = StudentProposal(np.array([1.0, -1.0]), factor, freedom=4.0)
    draws = proposal.draw(np.random.RandomState(3), 20_000)  # emcee's generator
    for direction in ([1.0, 0.0], [0.0, 1.0], [0.6, -0.8]):
        along = draws @ direction
        scale = np.linalg.norm(np.array(direction) @ factor)
        expected = stats.t(4.0, proposal.centre @ direction, scale)
        assert stats.kstest(along, expected.cdf).pvalue > 1e-4


@pytest.mark.parametrize("free", [1, 4])
def test_a_fitted_proposal_has_the_mean_and_covariance_of_the_draws(free: int) -> None:
    draws = np.random.default_rng(4).standard_normal((500, free)) @ np.diag(np.arange(1, free + 1))
    proposal = StudentProposal.fitted(draws)
    np.testing.assert_allclose(np.mean(draws, axis=0), proposal.centre)
    expected = np.atleast_2d(np.cov(draws, rowvar=False))
    np.testing.assert_allclose(expected, proposal.factor @ proposal.factor.T, atol=1e-12)


def test_draws_that_do_not_span_the_space_give_no_proposal() -> None:
    with pytest.raises(np.linalg.LinAlgError):
        StudentProposal.fitted(np.zeros((100, 3)))


def test_a_fifth_of_the_steps_at_least_stays_differential_evolution_and_snooker() -> None:
    proposal = TARGETS["banana"].proposal
    weights = {type(move).__name__: weight for move, weight in sampling_moves(proposal)}
    assert 1.0 == pytest.approx(sum(weights.values()))
    assert weights["DEMove"] + weights["SnookerMove"] >= 0.2
    assert {"MHMove", "DEMove", "SnookerMove"} == set(weights)


def test_without_a_proposal_the_pilots_moves_go_on() -> None:
    names = [(type(move).__name__, weight) for move, weight in pilot_moves()]
    assert names == [(type(move).__name__, weight) for move, weight in sampling_moves(None)]
