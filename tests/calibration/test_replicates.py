"""Replicates come from the model that is fitted; ranks are judged at the level stated."""

import json
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
import pytest
from scipy.special import ndtr

from bwbayes.arrays import FloatArray
from bwbayes.calibration import calibration as module
from bwbayes.calibration.calibration import (
    FAMILY_LEVEL,
    RANKED,
    Calibration,
    CalibrationSetup,
    Entry,
    Replicate,
    evaluate_calibration,
    holm,
    replicate,
    smooth_power,
    smooth_test,
)
from bwbayes.errors import InputError
from bwbayes.inference import map_estimate, resolve_engine
from bwbayes.inference.noise import WhiteNoise
from bwbayes.inference.study import InitialConditions, Validation
from bwbayes.model.actuator import Actuator
from bwbayes.model.declaration import Distribution
from bwbayes.prediction.bands import KINDS, LEVELS
from bwbayes.record.record import Record
from bwbayes.sampling.chain import draws
from bwbayes.sampling.plan import SamplingPlan
from bwbayes.sampling.sampler import init_chain, sample
from tests.inference.problems import posterior_of, short_posterior

# Three free parameters, so that a replicate takes a fraction of a second.
FIXED = {"initial": 0.0, "offset": 0.0, "beta": 0.0272, "gamma": 0.0172}
PRIORS = {
    "d": Distribution("normal", {"mean": 0.7, "sd": 0.05}),
    "alpha": Distribution("normal", {"mean": 0.3, "sd": 0.05}),
    "sensor_sd": Distribution("lognormal", {"median": 0.5, "sigma": 0.3}),
}
PLAN = SamplingPlan(ess=100, walkers=12, block=10, max_pilot_steps=30, max_steps=2_000)


def small(**changes: object) -> CalibrationSetup:
    """Return an experiment of 80 samples, of which 20 are held out."""
    posterior = short_posterior("white", 80, fixed=FIXED, priors=PRIORS, training=(slice(0, 60),))
    fast = replace(posterior, engine="numba")
    return replace(CalibrationSetup(fast, PLAN, {"record": [slice(60, 80)]}), **changes)  # type: ignore[arg-type]


def test_replicate_depends_on_seed_and_number_alone() -> None:
    with ThreadPoolExecutor(2) as executor:
        both = [one.entry for one in executor.map(partial(replicate, small(), 1), [0, 1])]
    assert both[1] == replicate(small(), 1, 1).entry
    assert both[1]["truth"] != both[0]["truth"]
    assert both[1]["truth"] != replicate(small(), 2, 1).entry["truth"]


@pytest.fixture(scope="module")
def third() -> Replicate:
    return replicate(small(), 1, 3)


def test_entry_is_plain_and_complete(third: Replicate) -> None:
    entry = third.entry
    assert entry == json.loads(json.dumps(entry))
    names = ["d", "alpha", "sensor_sd", "log_likelihood", "loop_area", "range"]
    assert names == list(entry["ranks"]) == list(entry["truth"])
    assert [f"{kind} {level}" for kind in KINDS for level in LEVELS] == list(entry["covered"])
    assert (3, True) == (entry["number"], entry["converged"])
    assert (RANKED, len(names)) == third.draws.shape
    for name, true, column in zip(names, entry["truth"].values(), third.draws.T, strict=True):
        assert sum(draw < true for draw in column) == entry["ranks"][name]


def test_replicate_that_cannot_be_fitted_is_kept(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: object) -> None:
        raise np.linalg.LinAlgError("priors: no draw has a finite posterior density")

    monkeypatch.setattr("bwbayes.inference.map_estimate.fit", refuse)
    entry = replicate(small(), 1, 0).entry
    assert (False, {}, {}) == (entry["converged"], entry["ranks"], entry["covered"])
    assert "finite posterior density" in entry["stop_reason"]
    assert 6 == len(entry["truth"])


def test_replicate_with_too_few_draws_is_not_ranked() -> None:
    """Among fewer than others it would have other ranks."""
    plan = replace(PLAN, walkers=6, block=5, max_steps=5)
    entry = replicate(small(plan=plan), 1, 0).entry
    assert (5, False) == (entry["steps"], entry["converged"])
    assert {} == entry["ranks"] == entry["covered"]


# Around a posterior that was sampled


@pytest.fixture(scope="module")
def around() -> CalibrationSetup:
    """Return an experiment around the posterior of the first replicate's record."""
    posterior = replace(small().posterior, engine=resolve_engine())
    _, records = module._simulate_truth(small(), np.random.default_rng(1))
    reading = records["record"].record.displacement
    assert reading is not None
    posterior = posterior.with_readings({"record": reading})
    point = map_estimate.fit(posterior, np.random.default_rng(2))
    chain = init_chain(posterior, point, PLAN, np.random.default_rng(3))
    with ThreadPoolExecutor(1) as executor:
        assert sample(posterior, PLAN, chain, executor).converged
    flat = draws(posterior, chain).reshape(-1, len(posterior.names))
    plan = replace(PLAN, ahead=10, tries=4)
    return CalibrationSetup(posterior, plan, around=(flat, point))


def calibrated(experiment: CalibrationSetup, count: int) -> Calibration:
    entries = [replicate(experiment, 5, number).entry for number in range(count)]
    return evaluate_calibration(entries, np.random.default_rng(6))


def moved(experiment: CalibrationSetup, shift: float, width: float) -> CalibrationSetup:
    assert experiment.around is not None
    sampled, point = experiment.around
    middle = np.mean(sampled, axis=0)
    wrong = middle + shift * np.std(sampled, axis=0) + width * (sampled - middle)
    return replace(experiment, around=(wrong, point))


def test_ranks_around_a_posterior_are_even(around: CalibrationSetup) -> None:
    """One sound calibration of a hundred fails; of defects as large as below none passes."""
    assert calibrated(around, 6).passed


@dataclass(frozen=True)
class Loud(WhiteNoise):
    """White noise that is twice as loud as it says."""

    def draw(
        self,
        theta: FloatArray,
        samples: int,
        generator: np.random.Generator,
        speed: FloatArray | None = None,
    ) -> tuple[FloatArray, FloatArray]:
        """Draw twice the noise."""
        slow, white = super().draw(theta, samples, generator, speed)
        return slow, 2 * white


def test_twice_the_noise_is_noticed(around: CalibrationSetup) -> None:
    """The noise's sd is then half as large again as the truth, by five of its own sds."""
    loud = around.posterior.altered(noise=Loud())
    failures = calibrated(replace(around, source=loud), 5).failures
    assert any(reason.startswith("sensor_sd: ranks") for reason in failures)


def test_draws_beside_the_posterior_are_noticed(around: CalibrationSetup) -> None:
    """By three sds: truths then lie 1.5 of them off, which are two of both records' together."""
    failures = calibrated(moved(around, 3.0, 1.0), 5).failures
    assert any("ranks are not even" in reason for reason in failures)


@pytest.mark.slow
def test_draws_that_are_too_narrow_are_noticed_by_more_replicates(around: CalibrationSetup) -> None:
    """Draws a quarter as wide: truths lie sqrt((1 + 1/16) / 2) = 0.73 times as far off.

    Two hundred replicates find that in one of three parameters 99 times in 100, and pass as often
    without it.
    """
    assert 1 - (1 - smooth_power(200, 0.005 / 6, 1 / 0.73)) ** 3 > 0.99
    assert calibrated(around, 200).passed
    failures = calibrated(moved(around, 0.0, 0.25), 200).failures
    assert any("ranks are not even" in reason for reason in failures)


def test_readings_of_both_enter(around: CalibrationSetup) -> None:
    """The log density of both together is the sum, less a prior."""
    posterior = around.posterior
    _, records = module._simulate_truth(around, np.random.default_rng(9))
    reading = records["record"].record.displacement
    assert reading is not None
    replicated = posterior.with_readings({"record": reading})
    places = np.random.default_rng(8).normal(size=(5, len(posterior.names)))
    parts = posterior.log_density(places) + replicated.log_density(places)
    both = posterior.with_readings_of(replicated).log_density(places)
    _, log_prior = posterior.prior.constrain(places)
    np.testing.assert_allclose(both, parts - log_prior, rtol=1e-10)


# Simulated records


def another(**changes: object) -> Validation:
    """Return a sine of another rate; the last reading is missing, and a tenth is the lead-in."""
    voltage = 60 * np.sin(2 * np.pi * np.arange(200) / 100 + 1)
    reading = np.where(np.arange(200) < 199, 0.0, np.nan)
    record = Record(voltage, reading, interval=0.005)
    other = Validation((), record, InitialConditions(lead_in=0.1))
    return replace(other, **changes)  # type: ignore[arg-type]


def test_bands_of_other_records_are_held_against_them(third: Replicate) -> None:
    common = small(others={"one": another(), "part": another(judged=(0.5, 1.0))})
    entry = replicate(common, 1, 3).entry
    assert list(common.bands) == list(entry["covered"])
    assert entry["covered"]["one sensor 50"] != entry["covered"]["part sensor 50"]
    # It does not matter to the rest whether there are others.
    alone = third.entry
    assert alone["ranks"] == entry["ranks"]
    assert alone["covered"] == {name: entry["covered"][name] for name in alone["covered"]}


def test_one_discrepancy_goes_through_all_training_windows() -> None:
    """As the likelihood takes it: over 200 records, neighbors on a border are correlated too.

    Less than those in a window only because correlation times that the prior draws differ.
    """
    windows = (slice(0, 30), slice(30, 60))
    fixed = FIXED | {"discrepancy_time": 0.2}
    posterior = short_posterior("discrepancy", 80, fixed=fixed, training=windows)
    experiment = CalibrationSetup(posterior, PLAN)
    away = []
    for seed in range(200):
        theta, records = module._simulate_truth(experiment, np.random.default_rng(seed))
        made = records["record"]
        assert made.record.truth is not None
        away.append((made.record.truth - made.model) / theta["discrepancy_sd"])
    last_but_one, last, first = np.array(away)[:, 28:31].T
    within, across = (np.corrcoef(last, other)[0, 1] for other in (last_but_one, first))
    assert across > 0.5
    assert across == pytest.approx(within, abs=0.2)


# Loop measures


def test_loop_of_a_lag_is_known_in_closed_form() -> None:
    """Without hysteresis a sine V sin ωt comes out as d V/√(1 + (ωτ)²) sin(ωt − φ), tan φ = ωτ.

    So each period's loop has the area π d V² ωτ/(1 + (ωτ)²); it ranges over 2 d V/√(1 + (ωτ)²).
    """
    samples, interval, lag, d = 4_000, 1e-3, 0.02, 0.7
    time = interval * np.arange(samples)
    # From the crest, where it is at rest: the sine has settled by the first passage.
    voltage = 100 * np.cos(2 * np.pi * time)
    posterior = posterior_of(voltage, voltage, Actuator("lag", "first", interval), "white")
    experiment = CalibrationSetup(posterior, PLAN)
    known = {"d": d, "alpha": 1e-9, "beta": 0.02, "exponent": 1.0, "lag": lag, "sensor_sd": 1.0}
    theta = np.array([[known.get(name, 0.0) for name in posterior.prior.names]])
    *_, area, extent = experiment.measures(posterior, theta)[0]
    turn = 2 * np.pi * lag
    periods = samples * interval
    np.testing.assert_allclose(periods * np.pi * d * 100**2 * turn / (1 + turn**2), area, rtol=1e-2)
    # The crest that it starts from is the range's upper end.
    np.testing.assert_allclose(d * 100 * (1 + 1 / np.sqrt(1 + turn**2)), extent, rtol=1e-3)


# Ranks are judged at the level that is stated, and with the power that is stated.
# The simulations here have 400 to 4,000 trials each; limits are four binomial standard errors, so
# that one comparison is wrong by chance once in 16,000 times. Defects are planted on draws of a
# normal posterior in the twins.


NAMES = tuple("abcdefghijkl")


def entries(z: FloatArray, covered: FloatArray | None = None) -> list[Entry]:
    """Make replicates up whose truths lie at normal scores z (replicates, statistics)."""
    ranks = np.floor(ndtr(z) * (RANKED + 1)).astype(int)
    return [
        Entry(
            number=i,
            converged=True,
            stop_reason="",
            steps=100,
            spacing=3,
            truth=dict.fromkeys(NAMES, 0.0),
            ranks=dict(zip(NAMES, row, strict=False)),
            covered={} if covered is None else {"sensor 95": float(covered[i])},
        )
        for i, row in enumerate(ranks.tolist())
    ]


def scores(count: int, seed: int = 1) -> FloatArray:
    """Return the normal scores of a sound calibration, (count, statistics)."""
    return np.random.default_rng(seed).standard_normal((count, len(NAMES)))


def judged(made: list[Entry]) -> Calibration:
    return evaluate_calibration(made, np.random.default_rng(2))


def assert_near(expected: float, got: float, trials: int) -> None:
    """Compare a frequency with its probability, to four standard errors."""
    assert abs(got - expected) < 4 * np.sqrt(expected * (1 - expected) / trials), got


@pytest.mark.parametrize("count", [20, 500])
def test_smooth_test_has_its_level(count: int) -> None:
    uniform = np.random.default_rng(count).uniform(size=(count, 4_000))
    assert_near(0.05, float(np.mean(smooth_test(uniform) < 0.05)), 4_000)


@pytest.mark.parametrize(("count", "width"), [(150, 0.8), (500, 0.9), (500, 1.2)])
def test_smooth_test_has_the_power_that_is_stated(count: int, width: float) -> None:
    z = np.random.default_rng(count).standard_normal((count, 4_000))
    expected = smooth_power(count, 1e-3, width)
    result = float(np.mean(smooth_test(ndtr(z / width)) < 1e-3))
    # Means of b1 and b2 are only nearly normal.
    assert abs(result - expected) < 0.02 + 4 * np.sqrt(0.25 / 4_000)


def test_holm_is_the_textbooks() -> None:
    p = np.array([0.01, 0.04, 0.03, 0.005])
    np.testing.assert_allclose([0.03, 0.06, 0.06, 0.02], holm(p))


def test_sound_calibrations_pass_but_for_the_family_level() -> None:
    """Both tests of all statistics together, over 200 calibrations of 60 replicates."""
    failed = [not judged(entries(scores(60, seed))).passed for seed in range(200)]
    # The smooth test's tail is a little too long with so few replicates.
    assert np.mean(failed) < 1.3 * FAMILY_LEVEL + 4 * np.sqrt(FAMILY_LEVEL / 200)


@pytest.mark.parametrize("defect", ["sds a fifth too small", "a bias of 0.3 sd", "two peaks"])
def test_twin_defects_are_found(defect: str) -> None:
    """The last one by the distribution function, too."""
    for seed in range(3):
        z = scores(500, seed)
        spoiled = {
            "sds a fifth too small": z / 0.8,
            "a bias of 0.3 sd": z + 0.3,
            "two peaks": np.where(np.abs(z) > 1, z, np.sign(z) * 0.68),
        }[defect]
        result = judged(entries(spoiled))
        assert not result.passed
        assert result.telling
        assert result.power["20% too small"] > 0.98
        if defect == "two peaks":
            assert any("leaves its band" in text for text in result.failures)


def test_defect_of_one_statistic_is_told_by_its_name() -> None:
    z = scores(500)
    z[:, 4] /= 0.6
    result = judged(entries(z))
    assert all(text.startswith("e: ") for text in result.failures), result.failures
    assert result.statistics["e"].adjusted < FAMILY_LEVEL / 2
    assert result.statistics["e"].outside


def test_unconverged_replicates_are_counted_and_fail_beyond_one_per_cent() -> None:
    """They are ranked all the same, if they have draws."""
    for unconverged, passed in ((0, True), (2, True), (3, False)):
        made = entries(scores(200))
        for entry in made[:unconverged]:
            entry["converged"] = False
        result = judged(made)
        assert (passed, 200) == (result.passed, result.replicates)
        assert tuple(range(unconverged)) == result.unconverged
        assert 200 == result.positions.shape[0]
    made[5] = {**made[5], "converged": False, "ranks": {}}
    assert 199 == judged(made).positions.shape[0]
    for entry in made:
        entry["ranks"], entry["stop_reason"] = {}, "no luck"
    with pytest.raises(InputError, match="none of the 200 replicates could be fitted: no luck"):
        judged(made)


@pytest.mark.parametrize(("mean", "passed"), [(0.95, True), (0.91, False), (0.99, False)])
def test_bands_must_cover_within_three_standard_errors(mean: float, passed: bool) -> None:
    """With few replicates it is shown and not judged."""
    covered = mean + 0.1 * np.random.default_rng(1).standard_normal(500)
    covered += mean - np.mean(covered)
    result = judged(entries(scores(500), covered))
    assert result.bands["sensor 95"].mean == pytest.approx(mean)
    assert result.bands["sensor 95"].error == pytest.approx(0.1 / np.sqrt(500), rel=0.2)
    assert passed == result.passed
    assert judged(entries(scores(20), covered[:20])).passed
