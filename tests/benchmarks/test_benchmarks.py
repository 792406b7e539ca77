"""The benchmarks run, and the path that they compare with computes the same posterior.

It is right but for the step within which h passes zero. Such a step is v = 2 V long here at most,
and another rate for all of it would move h by γ α v² < 0.03 um, and the log density by less than 1.
"""

import numpy as np
import pytest
from click.testing import CliRunner

from tests.benchmarks.__main__ import QUOTED, main
from tests.benchmarks.models import trial
from tests.benchmarks.stock import stock
from tests.inference.problems import short_posterior


def test_the_stock_path_has_the_same_log_density() -> None:
    fixed = {"initial": 0.0, "mass": 0.00134, "stiffness": 4.1e5}
    posterior = short_posterior(samples=1200, dynamics="second-order", fixed=fixed)
    prior = posterior.prior
    free = [prior.names.index(name) for name in prior.free_names]
    coordinates = prior.unconstrain(trial(posterior, 5)[:, free])
    expected = posterior.log_density(coordinates)
    assert np.ptp(expected) > 10
    np.testing.assert_allclose(stock(posterior).log_density(coordinates), expected, rtol=0, atol=1)


@pytest.mark.slow
def test_the_quick_command_measures_all_that_is_quoted() -> None:
    done = CliRunner().invoke(main, ["--quick"], catch_exceptions=False)
    assert 0 == done.exit_code
    assert all(name in done.output for name in QUOTED)
