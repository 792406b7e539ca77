"""Arrays with something wrong in them end in a good answer, or in one clear line, in Python too."""

from __future__ import annotations

import warnings
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

import bwbayes as bw
from bwbayes.app.fit.fitted import Fit
from bwbayes.data import Record
from bwbayes.data.teststand import VirtualTestStand
from bwbayes.data.waveforms import identification_signal

pytestmark = pytest.mark.slow

SPIKES = np.arange(50, 1150, 110)


@pytest.fixture(scope="module")
def record() -> Record:
    stand = VirtualTestStand("process", 100.0)
    return stand.run(identification_signal(), np.random.default_rng(1))


def fitted(record: Record, **keys: Any) -> tuple[Fit, str]:
    """Return a fit of a record's first twelve seconds, and all that it warned of, line by line."""
    held_out = {"held_out": (12, 16)}
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        made = bw.fit(record, train=(0, 12), validation=held_out, ess=500, progress=False, **keys)
    assert {bw.InputWarning} >= {warning.category for warning in caught}
    return made, "\n".join(str(warning.message) for warning in caught)


def near(fit: Fit, factor: float = 1.0) -> bool:
    """Tell whether d is the stand's, within four sds."""
    d = fit.summary.loc["d"]
    return bool(abs(factor * d["mean"] - 0.7) < 4 * factor * d["sd"])


def test_a_good_record_holds_and_is_silent(record: Record) -> None:
    fit, said = fitted(record)
    assert (True, True, "") == (fit.converged, fit.holds, said)
    assert near(fit)


def test_a_reversed_sign_does_not_hold(record: Record) -> None:
    assert record.displacement is not None
    fit, said = fitted(replace(record, displacement=-record.displacement))
    assert fit.holds is False
    assert "record: reversed sign: the displacement falls by" in said
    assert "training, fitted: does not hold: the readings fall where the voltage rises" in said


def test_millivolts_are_said_and_fitted_as_they_are(record: Record) -> None:
    fit, said = fitted(replace(record, voltage=1e3 * record.voltage))
    assert "record: wrong units: voltages of up to 1e+05 V" in said
    assert fit.holds
    assert near(fit, 1e3)


def test_ten_outliers_do_not_hold_or_are_set_aside(record: Record) -> None:
    assert record.displacement is not None
    spoilt = record.displacement.copy()
    spoilt[SPIKES] += 20.0
    fit, said = fitted(replace(record, displacement=spoilt))
    assert fit.holds is False
    assert "likeliest cause: outliers; leave them out: exclude = [[" in said
    fit, said = fitted(replace(record, displacement=spoilt), outliers=True)
    assert fit.holds
    assert near(fit)
    assert "10 readings set aside as isolated outliers, at 0.5, 1.6, " in said


def test_a_gap_in_the_readings_changes_little(record: Record) -> None:
    fit, said = fitted(record.exclude([(4.0, 4.5)]))
    assert (True, "") == (fit.holds, said)
    assert near(fit)
