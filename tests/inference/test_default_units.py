"""Default priors go with the units: a record in other ones has the same priors, in those."""

from __future__ import annotations

import numpy as np
import pytest

from bwbayes.inference.defaults import ranges_of
from bwbayes.model.distributions import Distribution
from tests.declared import default_prior
from tests.inference.problems import INTERVAL, decaying_sine

# Powers of k and m by which a parameter grows if displacements are k and voltages m times as large.
# With another exponent n, beta and gamma grow by k^(1 - n) / m.
POWERS = {
    "d": (1, -1),
    "alpha": (1, -1),
    "beta": (0, -1),
    "gamma": (0, -1),
    "initial": (1, 0),
    "offset": (1, 0),
    "lag": (0, 0),
    "sensor_sd": (1, 0),
    "discrepancy_sd": (1, 0),
    "discrepancy_time": (0, 0),
}


def scale(name: str, exponent: float, k: float = 1.0, m: float = 1.0) -> float:
    """Return half of the central 68 % of a default prior, given k and m."""
    voltage = decaying_sine(400)
    ranges = ranges_of(m * voltage, k * 0.6 * voltage, INTERVAL)
    prior = default_prior(name, ranges, exponent)
    assert isinstance(prior, Distribution)
    low, high = prior.frozen.ppf([0.16, 0.84])
    return float(high - low) / 2


@pytest.mark.parametrize("exponent", [1.0, 1.5, 3.0])
@pytest.mark.parametrize("name", POWERS)
def test_a_default_prior_goes_with_the_units(name: str, exponent: float) -> None:
    """Within the three digits that a default prior has."""
    of_k, of_m = map(float, POWERS[name])
    if name in ("beta", "gamma"):
        of_k = 1 - exponent
    for k, m in ((1000.0, 1.0), (1.0, 0.001), (0.03, 7.0)):
        grown = scale(name, exponent, k, m) / scale(name, exponent)
        np.testing.assert_allclose(k**of_k * m**of_m, grown, rtol=0.01)
