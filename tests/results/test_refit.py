"""A fit that hangs on the start of its record is told by a second one without it."""

from __future__ import annotations

import numpy as np

from bwbayes.arrays import FloatArray
from bwbayes.inference import pointfit
from bwbayes.inference.posterior import Posterior
from bwbayes.model.actuator import Actuator
from bwbayes.results.bands import Bands
from bwbayes.results.refit import Moved, without_start
from bwbayes.results.verdict import Background, Verdict, assess
from tests.inference import problems
from tests.results.records import bands_of, made

PUSHED = Moved("d", "um/V", 2.4, (0.91, 0.013), (0.699, 0.002))


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
        assert without_start(posterior, drawn(posterior), np.random.default_rng(2)) is None


def test_a_transient_at_the_start_moves_the_parameters() -> None:
    """The twin: the same records with a switch-on transient of 25 um that dies out in 0.6 s."""
    for seed in range(3):
        posterior = fitted(seed, 25.0)
        moved = without_start(posterior, drawn(posterior), np.random.default_rng(2), begin=3.0)
        assert moved is not None
        assert 3 + 2.4 == moved.until


def test_few_readings_tell_nothing() -> None:
    posterior = problems.short_posterior(samples=150)
    assert without_start(posterior, drawn(posterior), np.random.default_rng(2)) is None


def judged(bands: Bands, moved: Moved | None) -> Verdict:
    verdict = assess(bands, Background(0.3, 0.0, (-100.0, 100.0)), moved=moved)
    assert verdict is not None
    return verdict


def test_a_fit_that_hangs_on_its_start_does_not_hold() -> None:
    bands = bands_of(made(np.random.default_rng(1), length=30), training=True)
    assert judged(bands, None).holds is True
    verdict = judged(bands, PUSHED)
    assert verdict.holds is False
    assert verdict.reasons == (
        "without the readings before 2.4 s d is 0.699 +- 0.002 um/V, with them 0.91 +- 0.013",
    )
    assert verdict.cause is not None
    assert "start" == verdict.cause.kind
    assert "exclude = [[0, 2.4]] in [record]" in verdict.cause.remedy


def test_a_drift_all_along_is_no_bad_start() -> None:
    """What a bad start leaves in the fit looks like a drift, but ends; a drift goes on."""
    record = made(np.random.default_rng(1), length=30)
    for added, kind in ((record.time, "drift"), (30 * np.exp(-record.time / 1.2), "start")):
        verdict = judged(bands_of(record, added - np.mean(added), training=True), PUSHED)
        assert verdict.cause is not None
        assert kind == verdict.cause.kind
