"""What a record does not tell is said in words: what, how much, what decides, what to measure.

Whether the prior decides is checked where the answer is known: with a normal prior and a normal
likelihood, the posterior under a prior twice as wide is known exactly.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from bwbayes.arrays import FloatArray
from bwbayes.data.waveforms import signal
from bwbayes.diagnosis.conflict import around
from bwbayes.diagnosis.finding import Finding
from bwbayes.inference.parameters import JointPrior, Parameter
from bwbayes.inference.pointfit import PointFit, fit
from bwbayes.inference.posterior import Posterior
from bwbayes.model.distributions import Distribution
from bwbayes.results.identifiability import percent, sway, undetermined
from tests.inference.problems import decaying_sine, posterior_of, ring_bender, short_posterior
from tests.results.test_identifiability import at_truth, measured, sine

STANDARD = JointPrior(
    [
        Parameter(name, "um", name, "", prior=Distribution("normal", {"mean": 0.0, "sd": 1.0}))
        for name in ("offset", "initial_offset")
    ]
)


def normal_posterior(mean: float, sd: float, draws: int = 40_000) -> FloatArray:
    """Draw (draws, 2) from prior N(0, 1) times likelihood N(x; mean, sd), in each column."""
    precision = 1 + 1 / sd**2
    center = mean / sd**2 / precision
    generator = np.random.default_rng(1)
    made: FloatArray = center + generator.standard_normal((draws, 2)) / np.sqrt(precision)
    return made


@pytest.mark.parametrize(("mean", "sd"), [(0.0, 0.1), (1.0, 0.3), (1.0, 1.0), (-1.5, 0.7)])
def test_wider_prior_moves_the_posterior_as_far_as_it_does(mean: float, sd: float) -> None:
    result = sway(STANDARD, normal_posterior(mean, sd), ["offset"])
    before, after = 1 + 1 / sd**2, 0.25 + 1 / sd**2
    moved = abs(mean / sd**2 / after - mean / sd**2 / before) * np.sqrt(before)
    assert result.told
    assert result.name == "offset"
    assert result.moved == pytest.approx(moved, abs=0.05)
    assert result.widened == pytest.approx(np.sqrt(before / after), rel=0.05)
    assert result.part == pytest.approx(1 / np.sqrt(before), rel=0.05)
    assert result.decides == (moved > 0.3 or before / after > 1.44 or before < 1 / 0.49)


def test_where_the_wider_prior_leads_away_from_all_draws_nothing_is_told() -> None:
    """A posterior that is the prior: its draws do not reach as far as one twice as wide."""
    result = sway(STANDARD, normal_posterior(0.0, 1e6), ["offset", "initial_offset"])
    assert not result.told
    assert result.decides


def judged(posterior: Posterior) -> list[Finding]:
    generator = np.random.default_rng(1)
    point = fit(posterior, generator)
    return [*undetermined(posterior, point, around(posterior.prior, point, generator))]


def near_truth(posterior: Posterior, spread: float = 0.05) -> tuple[PointFit, FloatArray]:
    """Return a point fit at the truth, and draws around it."""
    point = replace(at_truth(posterior), covariance=spread**2 * np.eye(len(posterior.names)))
    return point, around(posterior.prior, point, np.random.default_rng(1))


@pytest.mark.parametrize(("amplitude", "periods"), [(50.0, 3.0), (100.0, 4.0), (20.0, 3.0)])
def test_steady_sine_is_told_to_vary_its_amplitude(amplitude: float, periods: float) -> None:
    posterior = measured(sine(amplitude, 1.0, periods), rate=250.0)
    (finding, *_) = undetermined(posterior, *near_truth(posterior))
    assert finding.text.startswith("gamma")
    assert "% of the prior's SD remains (next alpha" in finding.text
    assert finding.fix == "vary the amplitude: let it decay to a tenth over ten periods"


def test_small_steady_sine_does_not_tell_alpha_from_beta() -> None:
    """What it shows is d - alpha and alpha beta: both may grow while beta falls."""
    fixed = {"gamma": 0.0, "initial": 0.0, "mass": 0.00134, "stiffness": 4.1e5}
    posterior = measured(sine(10.0, 1.0, 3.0), rate=250.0)
    actuator = posterior.only.actuator
    small = posterior_of(
        posterior.only.voltage, posterior.only.displacement, actuator, "discrepancy", fixed
    )
    (finding,) = undetermined(small, *near_truth(small))
    assert finding.text.startswith("alpha with d against beta: ")
    assert finding.fix.startswith(
        "drive over more than 20 V peak to peak, if the actuator allows it"
    )


def test_decaying_amplitudes_need_no_words() -> None:
    posterior = measured(signal("identification"), rate=250.0)
    assert [] == [*undetermined(posterior, *near_truth(posterior))]


@pytest.mark.parametrize(
    ("amplitude", "said"),
    [
        (60.0, "the prior decides there: one twice as wide moves alpha by"),
        (8.0, "the prior decides there: the posterior has "),
    ],
)
def test_prior_that_decides_is_said_to(amplitude: float, said: str) -> None:
    """A user's priors of alpha and beta, and half a loop, which hardly closes or not at all."""
    voltage = decaying_sine(200, periods=0.5, amplitude=amplitude)
    usual = short_posterior(samples=200, dynamics="none")
    displacement = ring_bender(usual.only.actuator, "white", voltage, 1)
    priors = {
        "beta": Distribution("lognormal", {"median": 0.05, "sigma": 0.3}),
        "alpha": Distribution("lognormal", {"median": 0.25, "sigma": 0.2}),
    }
    known = {"gamma": 0.0, "initial": 0.0}
    posterior = posterior_of(
        voltage, displacement, usual.only.actuator, "white", known, priors=priors
    )
    finding = judged(posterior)[0]
    assert said in finding.text
    asked = "drive the actuator up and down several times" if amplitude > 20 else "drive over more"
    assert asked in finding.fix


def test_no_more_than_all_of_a_prior_is_left() -> None:
    """A posterior that is wider than its prior has all of it, and not 101 %."""
    assert ["34%", "99%", "all", "all"] == [percent(part) for part in (0.34, 0.99, 0.996, 1.25)]


def test_known_loop_needs_no_words() -> None:
    known = {"d": 0.7, "alpha": 0.3575, "beta": 0.0272, "gamma": 0.0172, "initial": 0.0}
    posterior = short_posterior(samples=60, fixed=known)
    assert [] == [*undetermined(posterior, *near_truth(posterior))]
