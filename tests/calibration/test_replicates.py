"""Replicates: records come from the model that is fitted, and statistics are what they say."""

import json
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
import pytest

from bwbayes.arrays import FloatArray
from bwbayes.calibration import calibration as module
from bwbayes.calibration.calibration import (
    RANKED,
    Calibration,
    CalibrationSetup,
    Replicate,
    Sampled,
    evaluate_calibration,
    replicate,
    smooth_power,
)
from bwbayes.inference import map_estimate
from bwbayes.inference.engine import resolve_engine
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
    _, records = module._simulated(small(), np.random.default_rng(1))
    reading = records["record"].record.displacement
    assert reading is not None
    posterior = posterior.with_readings({"record": reading})
    point = map_estimate.fit(posterior, np.random.default_rng(2))
    chain = init_chain(posterior, point, PLAN, np.random.default_rng(3))
    with ThreadPoolExecutor(1) as executor:
        assert sample(posterior, PLAN, chain, executor).converged
    flat = draws(posterior, chain).reshape(-1, len(posterior.names))
    plan = replace(PLAN, ahead=10, tries=4)
    return CalibrationSetup(posterior, plan, around=Sampled(flat, point))


def calibrated(experiment: CalibrationSetup, count: int) -> Calibration:
    entries = [replicate(experiment, 5, number).entry for number in range(count)]
    return evaluate_calibration(entries, np.random.default_rng(6))


def moved(experiment: CalibrationSetup, shift: float, width: float) -> CalibrationSetup:
    assert experiment.around is not None
    sampled = experiment.around.draws
    middle = np.mean(sampled, axis=0)
    wrong = middle + shift * np.std(sampled, axis=0) + width * (sampled - middle)
    return replace(experiment, around=replace(experiment.around, draws=wrong))


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
    _, records = module._simulated(around, np.random.default_rng(9))
    reading = records["record"].record.displacement
    assert reading is not None
    replicated = posterior.with_readings({"record": reading})
    places = np.random.default_rng(8).normal(size=(5, len(posterior.names)))
    parts = posterior.log_density(places) + replicated.log_density(places)
    both = module._together(posterior, replicated).log_density(places)
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
        theta, records = module._simulated(experiment, np.random.default_rng(seed))
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
