"""A fit that has swallowed a transient at the start of its record is told."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from bwbayes.arrays import FloatArray
from bwbayes.inference import pointfit
from bwbayes.inference.posterior import Posterior
from bwbayes.model.actuator import Actuator
from bwbayes.results.bands import Bands, LeadIn, Switched
from bwbayes.results.moved import Moved
from bwbayes.results.prediction import Start, predict_record
from bwbayes.results.transient import DECAYS, Transient, added, swallowed
from bwbayes.results.verdict import Background, Verdict, assess
from tests.inference import problems
from tests.results.records import bands_of, made
from tests.results.runs import Stand

PUSHED = Transient(24.0, 0.6, 31.2, 2.4, Moved("d", "um/V", (0.91, 0.013), (0.699, 0.002), 16.0))


def fitted(seed: int, transient: float = 0.0) -> Posterior:
    """Return the posterior of 12 s of a sine at 50 Hz, with a transient of so many um."""
    time = 0.02 * np.arange(600)
    voltage = 100 * np.sin(2 * np.pi * time) * (1 - 0.02 * time)
    actuator = Actuator("none", "first", 0.02)
    displacement = problems.ring_bender(actuator, "discrepancy", voltage, seed)
    displacement += transient * np.exp(-time / 0.6)
    return problems.posterior_of(voltage, displacement, actuator, "discrepancy")


def drawn(posterior: Posterior) -> FloatArray:
    """Draw from the point fit's approximation, (draws, free)."""
    generator = np.random.default_rng(1)
    point = pointfit.fit(posterior, generator)
    free, _ = posterior.prior.constrain(
        generator.multivariate_normal(point.mode, point.covariance, size=200)
    )
    return free


def test_good_fits_stay_where_they_are() -> None:
    for seed in range(3):
        posterior = fitted(seed)
        assert swallowed(posterior, drawn(posterior), np.random.default_rng(2)) is None


def test_a_transient_at_the_start_moves_the_parameters() -> None:
    """The twin: the same records with a switch-on transient of 25 um that dies out in 0.6 s."""
    for seed in range(3):
        posterior = fitted(seed, 25.0)
        told = swallowed(posterior, drawn(posterior), np.random.default_rng(2), begin=3.0)
        assert told is not None
        assert 3 + 2.4 == told.until
        assert told.size == pytest.approx(25.0, abs=4.0)
        assert told.decay == pytest.approx(0.6, rel=0.01)


def test_what_a_transient_adds_is_the_largest_of_all_sizes() -> None:
    """Against a search over sizes, one by one, for one draw."""
    posterior = fitted(1, 8.0)
    one = posterior.prior.unconstrain(drawn(posterior)[:1])
    name, time = posterior.only.name, 0.02 * np.arange(600)

    def plainly(size: float, decay: float) -> float:
        readings = posterior.only.displacement - size * np.exp(-time / decay)
        return float(posterior.with_readings({name: readings}).log_density(one)[0])

    nats, size, decay = added(posterior, name, one, 2.4)
    tried = [plainly(s, 2.4 * part) for s in np.linspace(-20, 20, 401) for part in DECAYS]
    assert nats == pytest.approx(max(tried) - plainly(0.0, 1.0), abs=0.05)
    assert nats >= max(tried) - plainly(0.0, 1.0) - 1e-6
    assert plainly(size, decay) - plainly(0.0, 1.0) == pytest.approx(nats, abs=1e-6)


def another(posterior: Posterior, draws: FloatArray, transient: float, seed: int) -> Switched:
    """Predict another record, cut from a running drive, with a transient of so many sds."""
    record = Stand(lag=0.0, rate=50.0).measure(
        90 * np.sin(2 * np.pi * 0.02 * np.arange(700)), np.random.default_rng(seed), cut=115
    )
    assert record.displacement is not None
    faded = transient * np.exp(-0.02 * np.arange(record.samples) / 0.6)
    record = replace(record, displacement=record.displacement + faded)
    bands = predict_record(posterior, draws, record, Start(lead_in=1.0), np.random.default_rng(3))
    assert bands.lead_in is not None
    assert bands.lead_in.transient is not None
    return bands.lead_in.transient


def test_a_transient_of_another_record_is_told_by_all_its_readings() -> None:
    posterior = fitted(1)
    draws = drawn(posterior)
    for seed in range(3):
        assert another(posterior, draws, 0.0, seed).nats < 4
        told = another(posterior, draws, 15.0, seed)
        assert told.nats > 20
        assert told.size == pytest.approx(15.0, abs=4.0)
        assert told.decay == pytest.approx(0.6, rel=0.2)


def test_few_readings_tell_nothing() -> None:
    posterior = problems.short_posterior(samples=150)
    assert swallowed(posterior, drawn(posterior), np.random.default_rng(2)) is None


def judged(bands: Bands, transient: Transient | None) -> Verdict:
    verdict = assess(bands, Background(0.3, 0.0, (-100.0, 100.0)), transient=transient)
    assert verdict is not None
    return verdict


def test_a_fit_that_hangs_on_its_start_does_not_hold() -> None:
    bands = bands_of(made(np.random.default_rng(1), length=30), training=True)
    assert judged(bands, None).holds is True
    verdict = judged(bands, PUSHED)
    assert verdict.holds is False
    assert verdict.reasons == (
        "a transient of 24 um that decays within 0.6 s explains its start better, by 31.2 nats; "
        "without the start, up to 2.4 s, d is 0.699 +- 0.002 um/V, with it 0.91 +- 0.013",
    )
    assert verdict.cause is not None
    assert "start" == verdict.cause.kind
    # Of the drive that would leave out a tenth; half of it is a few percent.
    assert "measure again" in verdict.cause.remedy
    cause = judged(bands, replace(PUSHED, decay=0.2)).cause
    assert cause is not None
    assert "exclude = [[0, 0.9" in cause.remedy


def test_a_transient_of_another_record_is_noted_where_it_is_large() -> None:
    """Larger than three sds of the band, 1.05 um each, and beyond chance."""
    bands = replace(bands_of(made(np.random.default_rng(1), length=30)), scored_from=100)
    for size, nats, noted in ((4.0, 5.0, True), (2.0, 9.5, False), (4.0, 2.9, False)):
        lead = LeadIn(0.0, 1.0, 100, 0.5, Switched(size, 0.4, nats))
        verdict = judged(replace(bands, lead_in=lead), None)
        assert verdict.holds is True
        assert noted == bool(verdict.notes)
    lead = LeadIn(0.0, 1.0, 100, 0.5, Switched(4.0, 0.4, 9.5))
    verdict = judged(replace(bands, lead_in=lead), None)
    assert verdict.notes == (
        "a transient of 4 um that decays within 0.4 s from 0 s on explains the readings better, "
        "by 9.5 nats",
    )


def test_a_transient_that_may_be_chance_leaves_it_open() -> None:
    bands = bands_of(made(np.random.default_rng(1), length=30), training=True)
    for size, holds in ((12.0, None), (2.0, True)):
        verdict = judged(bands, replace(PUSHED, size=size, nats=3.7, sure=False))
        assert verdict.holds is holds
    verdict = judged(bands, replace(PUSHED, nats=3.7, sure=False))
    assert "by 3.7 nats, which may be chance" in verdict.line
    assert verdict.cause is None


def test_a_drift_all_along_is_no_bad_start() -> None:
    """What a bad start leaves in the fit looks like a drift, but ends; a drift goes on."""
    record = made(np.random.default_rng(1), length=30)
    for extra, kind in ((record.time, "drift"), (30 * np.exp(-record.time / 1.2), "start")):
        verdict = judged(bands_of(record, extra - np.mean(extra), training=True), PUSHED)
        assert verdict.cause is not None
        assert kind == verdict.cause.kind


def test_places_that_are_not_possible_do_no_harm() -> None:
    """Warnings are errors here, and the answer is that of the possible ones."""
    posterior = fitted(1, 8.0)
    one = posterior.prior.unconstrain(drawn(posterior)[:1])
    nowhere = np.full_like(one, np.inf)
    assert posterior.log_density(nowhere)[0] == -np.inf
    expected = added(posterior, posterior.only.name, one, 2.4)
    both = np.concatenate([one, nowhere])
    assert added(posterior, posterior.only.name, both, 2.4) == expected
