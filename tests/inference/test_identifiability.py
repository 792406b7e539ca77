"""One constant amplitude does not identify the model, decaying amplitudes do, and the user hears.

At 100 Hz the ring bender's lag of 4 ms is far below a sample, so the damping is fixed there.
"""

from __future__ import annotations

from typing import Literal

import numpy as np
import pytest

from bwbayes.arrays import FloatArray
from bwbayes.data.record import Record
from bwbayes.data.teststand import VirtualTestStand
from bwbayes.data.waveforms import Sine, Waveform, identification_signal
from bwbayes.inference.identifiability import spectrum, undetermined
from bwbayes.inference.pointfit import PointFit, fit
from bwbayes.inference.posterior import Posterior
from tests.inference.problems import posterior_of_record, short_posterior

RATE = 100.0
FIXED = {"mass": 0.00134, "damping": 1580.0, "stiffness": 4.1e5, "initial": 0.0}

Discrepancy = Literal["none", "process"]


def record(drive: Waveform, discrepancy: Discrepancy, seed: int) -> Record:
    return VirtualTestStand(discrepancy, RATE).run(drive, np.random.default_rng(seed))


def named(drive: Waveform, discrepancy: Discrepancy, seed: int) -> list[str]:
    posterior = posterior_of_record(record(drive, discrepancy, seed), FIXED)
    return undetermined(posterior, fit(posterior, np.random.default_rng(seed)))


@pytest.mark.parametrize(
    ("amplitude", "discrepancy", "seed"),
    [(100.0, "none", 0), (100.0, "process", 1), (50.0, "none", 1), (50.0, "process", 0)],
)
def test_one_sine_leaves_the_loops_shape_open(
    amplitude: float, discrepancy: Discrepancy, seed: int
) -> None:
    found = named(Waveform(Sine(amplitude, 1.0), 10.0), discrepancy, seed)
    assert any("gamma" in text or "beta" in text for text in found), found


@pytest.mark.parametrize(("discrepancy", "seed"), [("none", 0), ("process", 1)])
def test_decaying_amplitudes_leave_nothing_open(discrepancy: Discrepancy, seed: int) -> None:
    assert [] == named(identification_signal(), discrepancy, seed)


def around(posterior: Posterior, mode: FloatArray) -> PointFit:
    """Return a point fit at a given mode."""
    draws = posterior.prior.unconstrain(posterior.prior.draw(np.random.default_rng(1), 500))
    prior = np.cov(draws, rowvar=False)
    return PointFit(mode, 0.01 * prior, 0.0, mode[np.newaxis], prior)


def left(posterior: Posterior) -> FloatArray:
    mode = np.zeros(len(posterior.names))
    return spectrum(posterior, around(posterior, mode))[0]


def test_more_periods_of_the_same_loop_tell_hardly_more() -> None:
    """Each distinct stretch counts once; only the sensor noise averages out."""
    short, long = (
        left(posterior_of_record(record(Waveform(Sine(100.0, 1.0), t), "process", 1), FIXED))
        for t in (4.0, 16.0)
    )
    np.testing.assert_allclose(short, long, rtol=0.35)


def test_parts_are_between_none_and_all_and_the_largest_comes_first() -> None:
    parts = left(short_posterior(samples=200, fixed={}))
    assert (parts > 0).all()
    assert (parts <= 1).all()
    assert (np.diff(parts) <= 0).all()


def test_a_constant_voltage_tells_nothing_about_the_hysteresis() -> None:
    """Only the offset and what holds it back are told; everything else stays as it was."""
    usual = short_posterior(samples=200)
    posterior = Posterior(
        0 * usual.voltage,
        usual.displacement,
        usual.training,
        usual.actuator,
        usual.noise,
        usual.prior,
    )
    assert ("d", "alpha", "beta", "gamma", "offset") == posterior.names[:5]
    parts = left(posterior)
    np.testing.assert_allclose(1, parts[:4], atol=1e-6)
    assert parts[4] < 0.1


def test_without_physical_parameters_nothing_is_open() -> None:
    known = {"d": 0.7, "alpha": 0.3575, "beta": 0.0272, "gamma": 0.0172, "initial": 0.0}
    posterior = short_posterior(samples=60, fixed={**known, "offset": 0.0})
    mode = np.zeros(len(posterior.names))
    assert [] == undetermined(posterior, around(posterior, mode))
