"""A residual that follows the drive is told from one that does not.

False alarms: at most 3% of residuals of white, rough and smooth noise (2% by the test's level; one
of 120 fits of good actuators). Power: 95% of misfits as large as that noise, where the drive comes
back to where it was; of a multisine, which hardly does in 12 s, of those twice as large by like
states alone, and of those half as large as white noise by its other parts.
"""

from functools import cache

import numpy as np
import pytest

from bwbayes.arrays import FloatArray
from bwbayes.diagnosis.rivals import (
    DriveLock,
    compare,
    drive_features,
    drive_lock,
    predictability,
)
from bwbayes.inference.noise import noise_model
from tests.inference.problems import short_posterior, truth
from tests.stand import play

INTERVAL, ROWS = 0.02, np.arange(600)
TIME = INTERVAL * ROWS
NOISES = {"white": [0.1], "discrepancy": [0.1, 0.2, 0.2], "smooth": [0.1, 0.2, 0.2, 0.6]}


def drive(kind: str, rng: np.random.Generator) -> FloatArray:
    """Return a voltage (samples,) of 12 s."""
    phases = rng.uniform(0, 2 * np.pi, 3)
    voltage: FloatArray = 100 * np.abs((0.9 * TIME + phases[0]) % 2 - 1)
    if kind == "decaying sine":
        voltage = 50 + 45 * np.exp(-0.12 * TIME) * np.sin(2 * np.pi * TIME + phases[0])
    if kind == "multisine":
        tones = np.sin(2 * np.pi * np.outer([0.21, 0.53, 0.9], TIME) + phases[:, np.newaxis])
        voltage = 50 + 15 * tones.sum(axis=0)
    return voltage


def misfit(voltage: FloatArray) -> FloatArray:
    """Return what plays add to a line of the voltage (samples,), of unit variance."""
    plays = [play(voltage - voltage[0], threshold) for threshold in (5.0, 15.0, 30.0)]
    followed = np.sum(plays, axis=0)
    line = np.polynomial.Polynomial.fit(voltage, followed, 1)
    rest: FloatArray = followed - line(voltage)
    return rest / np.std(rest)


def locked(noise: str, kind: str, number: int, size: float, *, own: bool = True) -> DriveLock:
    """Look at noise with a misfit of a size, in its sds, along its own drive or another one."""
    rng = np.random.default_rng((54, number))
    voltage = drive(kind, rng)
    followed = voltage if own else drive("multisine", rng)
    residual, *chance = drawn(noise)[[number, *range(100, 300)]]
    residual = residual + size * np.std(chance) * misfit(followed)
    return compare(residual, np.stack(chance), voltage, ROWS)


@cache
def drawn(noise: str) -> FloatArray:
    """Draw residuals (draws, samples) of a noise, um."""
    theta, rng = np.repeat([NOISES[noise]], 300, axis=0), np.random.default_rng(54)
    both = noise_model(noise, INTERVAL).draw_all(theta, ROWS.size, rng)
    total: FloatArray = both[0] + both[1]
    return total


@pytest.mark.parametrize("noise", NOISES)
def test_noise_does_not_follow_the_drive(noise: str) -> None:
    kinds = ("decaying sine", "triangle", "multisine")
    found = [locked(noise, kind, number, 0.0) for number in range(40) for kind in kinds]
    assert sum(lock.locked for lock in found) <= 0.03 * len(found)


@pytest.mark.parametrize("noise", NOISES)
@pytest.mark.parametrize("kind", ["decaying sine", "triangle", "multisine"])
def test_misfit_as_large_as_the_noise_is_seen(noise: str, kind: str) -> None:
    size = 2.0 if kind == "multisine" else 1.0
    found = [locked(noise, kind, number, size) for number in range(20)]
    assert sum(lock.locked for lock in found) >= 0.95 * len(found)


def test_misfit_of_another_drive_is_not_one_of_this() -> None:
    """The twin: as large, but along a drive that the actuator did not have, it is hardly seen."""
    found = [locked("smooth", "triangle", number, 1.0, own=False) for number in range(20)]
    assert sum(lock.locked for lock in found) <= 0.3 * len(found)


@pytest.mark.parametrize(("size", "seen"), [(0.0, (0.0, 0.03)), (0.5, (0.95, 1.0))])
def test_parts_of_a_record_tell_of_each_other(size: float, seen: tuple[float, float]) -> None:
    """What follows a multisine, half as large as white noise, is seen; the noise alone is not."""
    found = []
    for number in range(100):
        rng = np.random.default_rng((55, number))
        voltage = drive("multisine", rng)
        white = rng.standard_normal(voltage.size) + size * misfit(voltage)
        found.append(predictability(white, drive_features(voltage), rng) < 0.01)
    assert seen[0] <= np.mean(found) <= seen[1]


@pytest.mark.parametrize("planted", [False, True])
def test_posterior_of_a_record_is_looked_at(planted: bool) -> None:
    """With gaps between its readings; what is found is said in words."""
    posterior = short_posterior(samples=800)
    record, rng = posterior.single_record, np.random.default_rng(5)
    readings = record.displacement + 2.0 * planted * misfit(record.voltage)
    readings[100:160] = np.nan
    posterior = posterior.altered(displacement=readings)
    free = truth(posterior)[:, [posterior.prior.names.index(name) for name in posterior.names]]
    lock = drive_lock(posterior, free, rng)
    assert lock.locked is planted
    assert ["follows the drive" in str(finding) for finding in lock.findings] == [True] * planted
    # What to do is to measure a record that `design` finds.
    assert all("bwbayes design FOLDER --validate" in finding.fix for finding in lock.findings)
    assert lock.numbers["follows_the_drive"] is planted


def test_few_readings_and_readings_that_are_only_rounded_tell_nothing() -> None:
    posterior = short_posterior(samples=800)
    free = truth(posterior)[:, [posterior.prior.names.index(name) for name in posterior.names]]
    exact = posterior.simulate(truth(posterior))[0]
    for readings in (np.where(np.arange(800) < 30, exact, np.nan), np.round(exact)):
        altered = posterior.altered(displacement=readings)
        assert not drive_lock(altered, free, np.random.default_rng(1)).locked
