"""The backlash-like operator: the equation as Su and others write it, and the Bouc-Wen model."""

from __future__ import annotations

import numpy as np
import pytest

from bwbayes.model.operators.backlash_like import BacklashLike
from bwbayes.model.operators.bouc_wen import hysteresis
from tests.model.operators.differential import by_integration, paths, single, w_of
from tests.model.references import assert_close

MODEL = {"d": 0.62, "alpha": 0.31, "beta": 0.033, "initial": 2.5}


@pytest.mark.parametrize("name", paths())
def test_agrees_with_the_equation_as_published(name: str) -> None:
    """That is dw = a |du| (c u − w) + b du."""
    voltage = paths()[name]
    a, b, c = MODEL["beta"], MODEL["d"] - MODEL["alpha"], MODEL["d"]
    start = c * voltage[0] - MODEL["initial"]
    expected = by_integration(voltage, lambda u, w, s: s * a * (c * u - w) + b, start)
    assert_close(expected, w_of(BacklashLike(), single(**MODEL), voltage)[0], 1e-9)


@pytest.mark.parametrize("name", paths())
def test_is_bouc_wen_without_gamma(name: str) -> None:
    voltage = paths()[name]
    h = hysteresis(voltage, MODEL["alpha"], MODEL["beta"], 0.0, initial=MODEL["initial"])
    got = w_of(BacklashLike(), single(**MODEL), voltage)
    np.testing.assert_array_equal(got, MODEL["d"] * voltage - h)
