"""Proposals propose what their density says, and their acceptance ratio keeps a distribution.

How sure :func:`~tests.inference.problems.worst_score` is, and how rarely wrong, is told there.
"""

from __future__ import annotations

from dataclasses import dataclass

import emcee
import numpy as np
import pytest
from scipy import stats
from scipy.special import logsumexp

from bwbayes.arrays import FloatArray
from bwbayes.sampling.proposals import COMPONENTS, Proposal, StudentMixture, StudentProposal
from tests.inference.problems import ALARM, TARGETS, Known, worst_score

KINDS = ("student", "mixture")

# Two components far apart, so that a draw shows which one it came from, and a wide one.
MIXTURE = StudentMixture(
    np.array([0.2, 0.7, 0.1]),
    (
        StudentProposal(np.array([-40.0, 3.0]), np.array([[1.0, 0.0], [0.5, 2.0]]), 6.0),
        StudentProposal(np.array([40.0, 0.0]), np.array([[0.5, 0.0], [-1.0, 0.4]]), 6.0),
        StudentProposal(np.array([0.0, 200.0]), np.diag([3.0, 3.0]), 6.0),
    ),
)


def proposal_for(kind: str, known: Known) -> Proposal:
    """Return the target's own Student-t, or a mixture fitted to exact draws."""
    if kind == "student":
        return known.proposal
    return StudentMixture.fitted(known.draw(np.random.default_rng(21), 2000))


def score(name: str, proposal: Proposal, steps: int = 120) -> float:
    return worst_score(TARGETS[name], [(emcee.moves.MHMove(proposal), 1.0)], steps)


@pytest.mark.parametrize("name", TARGETS)
@pytest.mark.parametrize("kind", KINDS)
def test_a_proposal_leaves_the_right_distribution(kind: str, name: str) -> None:
    assert score(name, proposal_for(kind, TARGETS[name])) < ALARM


@dataclass(frozen=True)
class Scaled:
    """A proposal whose ratio is wrong: −1 is the wrong way round, 0 as if it were symmetric."""

    right: Proposal
    by: float

    def log_density(self, coordinates: FloatArray) -> FloatArray:
        """Return what the wrong ratio is made of."""
        return self.by * self.right.log_density(coordinates)

    def draw(self, random: np.random.RandomState, count: int) -> FloatArray:
        """Draw from the right distribution."""
        return self.right.draw(random, count)

    def __call__(
        self, coordinates: FloatArray, random: np.random.RandomState
    ) -> tuple[FloatArray, FloatArray]:
        """Propose with the wrong ratio."""
        proposed, ratio = self.right(coordinates, random)
        return proposed, self.by * ratio


@pytest.mark.parametrize("name", TARGETS)
@pytest.mark.parametrize("by", [-1.0, 0.0])
@pytest.mark.parametrize("kind", KINDS)
def test_twin_a_wrong_ratio_is_found(kind: str, by: float, name: str) -> None:
    assert score(name, Scaled(proposal_for(kind, TARGETS[name]), by), steps=30) > ALARM


class Unweighted(StudentMixture):
    """A mixture that draws with its weights and forgets them in its density."""

    def log_density(self, coordinates: FloatArray) -> FloatArray:
        """Return the density of equal weights."""
        equal = np.full(len(self.components), 1 / len(self.components))
        return StudentMixture(equal, self.components).log_density(coordinates)


def test_twin_forgotten_weights_are_found() -> None:
    right = StudentMixture.fitted(TARGETS["bimodal"].draw(np.random.default_rng(21), 2000))
    assert score("bimodal", Unweighted(right.weights, right.components), steps=60) > ALARM


def scipys_density(proposal: StudentProposal, x: FloatArray) -> FloatArray:
    shape = proposal.factor @ proposal.factor.T
    scipys = stats.multivariate_t(proposal.center, shape, df=int(proposal.freedom))
    return np.asarray(scipys.logpdf(x))


def test_the_student_density_is_scipys() -> None:
    factor = np.array([[1.0, 0.0, 0.0], [0.5, 2.0, 0.0], [-0.3, 0.1, 0.4]])
    proposal = StudentProposal(np.array([1.0, -1.0, 0.5]), factor, freedom=4.0)
    x = np.random.default_rng(2).normal(0, 3, (50, 3))
    difference = scipys_density(proposal, x) - proposal.log_density(x)
    np.testing.assert_allclose(difference[0], difference, atol=1e-10)


def test_the_mixtures_density_is_that_of_scipys_mixture() -> None:
    """Up to one constant, near each component and far from all of them."""
    x = np.random.default_rng(2).uniform([-60, -20], [60, 220], (200, 2))
    parts = np.stack([scipys_density(component, x) for component in MIXTURE.components])
    expected = logsumexp(parts, axis=0, b=MIXTURE.weights[:, np.newaxis])
    difference = expected - MIXTURE.log_density(x)
    np.testing.assert_allclose(difference[0], difference, atol=1e-10)


def mixture_cdf(mixture: StudentMixture, direction: FloatArray, x: FloatArray) -> FloatArray:
    parts = [
        weight
        * stats.t.cdf(x, c.freedom, c.center @ direction, np.linalg.norm(direction @ c.factor))
        for weight, c in zip(mixture.weights, mixture.components, strict=True)
    ]
    return np.asarray(np.sum(parts, axis=0))


@pytest.mark.parametrize("proposal", [MIXTURE, MIXTURE.components[0]], ids=["mixture", "student"])
def test_draws_have_the_distribution(proposal: StudentMixture | StudentProposal) -> None:
    """Each coordinate, and one direction across, by Kolmogorov-Smirnov at one in 10,000."""
    alone = StudentMixture(np.ones(1), (MIXTURE.components[0],))
    mixture = proposal if isinstance(proposal, StudentMixture) else alone
    draws = proposal.draw(np.random.RandomState(3), 20_000)  # emcee's generator
    for direction in np.array([[1.0, 0.0], [0.0, 1.0], [0.6, -0.8]]):
        along = draws @ direction
        expected = lambda x, d=direction: mixture_cdf(mixture, d, x)  # noqa: E731
        assert stats.kstest(along, expected).pvalue > 1e-4


@pytest.mark.parametrize("name", TARGETS)
def test_a_fitted_mixture_has_the_mean_and_covariance_of_the_draws(name: str) -> None:
    """Its scales as covariances; what each takes from all together leaves their mean as it is."""
    draws = TARGETS[name].draw(np.random.default_rng(6), 2000)
    mixture = StudentMixture.fitted(draws)
    centers = np.stack([component.center for component in mixture.components])
    scales = np.stack([component.factor @ component.factor.T for component in mixture.components])
    whole = np.cov(draws, rowvar=False)
    assert 1.0 == pytest.approx(np.sum(mixture.weights))
    np.testing.assert_allclose(np.mean(draws, axis=0), mixture.weights @ centers, atol=1e-10)
    within = np.einsum("j,jkl->kl", mixture.weights, scales)
    away = centers - np.mean(draws, axis=0)
    between = np.einsum("j,jk,jl->kl", mixture.weights, away, away)
    np.testing.assert_allclose(whole, within + between, rtol=1e-3, atol=1e-3)


def efficiency(known: Known, proposal: StudentMixture | StudentProposal) -> float:
    """Effective draws of importance sampling from a proposal, (Σw)² / Σw², a draw."""
    draws = proposal.draw(np.random.RandomState(8), 20_000)
    logs = known.log_density(draws) - proposal.log_density(draws)
    return float(np.exp(2 * logsumexp(logs) - logsumexp(2 * logs)) / len(draws))


def efficiencies(name: str) -> tuple[float, float]:
    """Efficiency of one fitted Student-t, and of a fitted mixture."""
    known = TARGETS[name]
    draws = known.draw(np.random.default_rng(9), 4000)
    one = efficiency(known, StudentProposal.fitted(draws))
    return one, efficiency(known, StudentMixture.fitted(draws))


@pytest.mark.parametrize("name", ["banana", "bounded", "bimodal"])
def test_a_mixture_covers_a_skewed_target_better_than_one_student(name: str) -> None:
    one, mixture = efficiencies(name)
    assert mixture > 1.1 * one


def test_modes_far_apart_do_not_widen_each_other() -> None:
    """Each component is as wide as its mode: 0.8 and not 0.3 of the draws are effective."""
    one, mixture = efficiencies("far modes")
    assert mixture > 0.6
    assert mixture > 2 * one


def exponential() -> Known:
    """Return one coordinate alone, with a wall and a tail."""
    return Known(
        1,
        lambda x: np.where(x[:, 0] > 0, -x[:, 0], -np.inf),
        lambda generator, count: generator.exponential(size=(count, 1)),
        StudentProposal(np.ones(1), np.eye(1)),
        np.array([[1.0], [2.0]]),
    )


def test_one_free_parameter_is_fitted_and_sampled() -> None:
    known = exponential()
    draws = known.draw(np.random.default_rng(10), 4000)
    mixture = StudentMixture.fitted(draws)
    assert efficiency(known, mixture) > 1.1 * efficiency(known, StudentProposal.fitted(draws))
    assert worst_score(known, [(emcee.moves.MHMove(mixture), 1.0)]) < ALARM


GENERATOR = np.random.default_rng(12)
NORMAL = GENERATOR.standard_normal((1000, 3))
FLAT = {
    "all the same": np.zeros((100, 3)),
    "one coordinate the same": np.column_stack([NORMAL, np.full(1000, 0.1)]),
    "one parameter, the same": np.full((1000, 1), 0.1),
    "in a plane": np.column_stack([NORMAL, NORMAL @ [0.3, 0.7, -0.2]]),
    "fewer than coordinates": GENERATOR.standard_normal((5, 9)),
}


@pytest.mark.parametrize("name", FLAT)
@pytest.mark.parametrize("kind", [StudentProposal, StudentMixture])
def test_draws_that_do_not_span_the_space_give_no_proposal(
    kind: type[StudentProposal] | type[StudentMixture], name: str
) -> None:
    with pytest.raises(np.linalg.LinAlgError, match="do not span the space"):
        kind.fitted(FLAT[name])


def stuck(generator: np.random.Generator) -> FloatArray:
    """Nine tenths of the walkers do not move, so body, flank and tail cannot be told apart."""
    draws = generator.standard_normal((2000, 3))
    draws[200:] = draws[0]
    return draws


TINY = {
    "a few outliers": np.concatenate([NORMAL, 1e3 + NORMAL[:4]]),
    "far outliers": np.concatenate([NORMAL, 1e8 * (1 + NORMAL[:5])]),
    "stuck walkers": stuck(np.random.default_rng(13)),
    "units far apart": NORMAL * [1e-6, 1.0, 1e3],
}


@pytest.mark.parametrize("name", TINY)
def test_components_of_hardly_any_draws_give_no_nan(name: str) -> None:
    mixture = StudentMixture.fitted(TINY[name], np.zeros(len(TINY[name])))
    assert (COMPONENTS,) == mixture.weights.shape
    assert (mixture.weights > 0).all()
    assert np.isfinite(mixture.log_density(TINY[name])).all()
    proposed, ratio = mixture(TINY[name][:500], np.random.RandomState(14))
    assert np.isfinite(proposed).all()
    assert np.isfinite(ratio).all()


def test_a_component_of_its_own_covers_what_the_others_cover_worst() -> None:
    """Four small modes beside a large one are too many for three components.

    The largest weight p/q, in units of the mean one, is how long a walker stays there.
    """
    rng = np.random.default_rng(16)
    centers = np.array([[0, 0], [9, 9], [9, -9], [-9, 9], [-9, -9]])
    shares, widths = np.array([0.96, 0.01, 0.01, 0.01, 0.01]), np.array([1, 0.5, 0.5, 0.5, 0.5])
    modes = rng.choice(5, p=shares, size=10_000)
    draws = centers[modes] + widths[modes, np.newaxis] * rng.standard_normal((modes.size, 2))
    squares = np.sum((draws[:, np.newaxis] - centers) ** 2, axis=-1) / widths**2
    log_density = np.logaddexp.reduce(np.log(shares / widths**2) - 0.5 * squares, axis=1)

    def longest_stay(mixture: StudentMixture) -> float:
        log_weights = log_density - mixture.log_density(draws)
        return float(np.max(log_weights) + np.log(np.mean(np.exp(-log_weights))))

    without = longest_stay(StudentMixture.fitted(draws))
    assert longest_stay(StudentMixture.fitted(draws, log_density)) < without - np.log(3)


def test_the_fit_goes_with_the_units() -> None:
    """Shifted and scaled coordinates, a mirrored one included, give the same density."""
    draws = TARGETS["banana"].draw(np.random.default_rng(15), 2000)
    scale = np.array([1e-3, -20.0])
    usual = StudentMixture.fitted(draws).log_density(draws)
    moved = StudentMixture.fitted(5 + draws * scale).log_density(5 + draws * scale)
    np.testing.assert_allclose(usual - np.log(np.prod(np.abs(scale))), moved, atol=1e-6)
