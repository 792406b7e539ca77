"""A record and its every k-th sample give one answer: the default priors are the drive's own.

Fewer samples tell less of the sensor's noise, and the white part of their noise is another draw:
so the lag and the sensor's sd may differ by two sds, all else by 0.6. The twin has priors
of so many sampling intervals.
"""

from __future__ import annotations

import numpy as np
import pytest

from bwbayes.arrays import FloatArray
from bwbayes.diagnosis.conflict import around
from bwbayes.inference.map_estimate import fit
from bwbayes.model.actuator import Actuator
from bwbayes.model.distributions import Distribution
from tests.inference.problems import decaying_sine, posterior_of, ring_bender

INTERVAL = 2e-3
SAMPLES = 2000


def lognormal(median: float, sigma: float) -> Distribution:
    return Distribution("lognormal", {"median": median, "sigma": sigma})


def of_intervals(interval: float) -> dict[str, Distribution]:
    """Return priors that depend on the sampling interval."""
    return {"lag": lognormal(3 * interval, 1.0), "discrepancy_time": lognormal(250 * interval, 0.8)}


def fitted(every: int, seed: int, *, twin: bool) -> dict[str, tuple[float, float]]:
    """Return mean and sd of each parameter's logarithm, or of gamma and the offset themselves."""
    actuator = Actuator("lag", "first", INTERVAL)
    voltage = decaying_sine(SAMPLES)
    displacement = ring_bender(actuator, "discrepancy", voltage, seed)[::every]
    interval = every * INTERVAL
    posterior = posterior_of(
        voltage[::every],
        displacement,
        Actuator("lag", "first", interval),
        "discrepancy",
        priors=of_intervals(interval) if twin else None,
    )
    generator = np.random.default_rng(1)
    draws = around(posterior.prior, fit(posterior, generator), generator)

    def value(name: str, column: FloatArray) -> FloatArray:
        return column if name in ("gamma", "offset") else np.log(column)

    columns = {n: value(n, c) for n, c in zip(posterior.names, draws.T, strict=True)}
    return {n: (float(np.median(c)), float(np.std(c))) for n, c in columns.items()}


def apart(every: int, seed: int, *, twin: bool) -> dict[str, float]:
    """Return how many posterior sds a record and its every k-th sample are apart."""
    whole, part = (fitted(k, seed, twin=twin) for k in (1, every))
    return {n: abs(whole[n][0] - part[n][0]) / max(whole[n][1], part[n][1]) for n in whole}


@pytest.mark.parametrize(("every", "seed"), [(5, 1), (10, 2)])
def test_every_kth_sample_gives_the_same_answer(every: int, seed: int) -> None:
    result = apart(every, seed, twin=False)
    assert max(result.pop("sensor_sd"), result.pop("lag")) < 2
    assert max(result.values()) < 0.6, result


def test_twin_with_priors_of_so_many_intervals_gives_another() -> None:
    assert apart(10, 2, twin=True)["discrepancy_time"] > 0.6
