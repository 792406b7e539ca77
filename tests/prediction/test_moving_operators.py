"""Records cut out of a running drive, with any operator in the actuator.

As in :mod:`tests.prediction.test_moving`, with the virtual stand's true values and a lag of 38 ms:
the parameters are the true ones, so all that a band can get wrong is the start. The drive's
amplitude goes up and down before the record and in it, which leaves operators with a memory of
extrema in states that no sweep through the whole range leaves. Mean coverages are held to the
spread between records; a t-value beyond four standard errors has a probability of 1 in 1,300 with
20 records.

A twin takes all earlier drives for as large as the range of voltages: then the 95 % band of the
operators with such a memory covers some 85 %, and the test fails.

``-m slow`` makes 200 records for every operator, whose 95 % band must cover 93 to 97 %.
"""

from __future__ import annotations

from dataclasses import replace
from unittest.mock import patch

import numpy as np
import pytest
from scipy import stats

from bwbayes.diagnosis.causes import LEAD_IN_ALARM
from bwbayes.inference.engine import Engine
from bwbayes.model.operator import Operator
from bwbayes.model.operators.extremum_memory import RemembersExtrema
from bwbayes.model.registry import HYSTERESIS
from bwbayes.prediction.bands import KINDS, LEVELS, Bands
from tests.measured import keep
from tests.prediction.moving import (
    Case,
    alarms,
    covered,
    errors_off,
    posterior_of_case,
    predicted,
    record_of,
    studied,
    widening,
)

QUICK = 20
QUICK_LIMIT = 4.0
# Of those that remember extrema the quicker one.
FEW = ("preisach", pytest.param("duhem", marks=pytest.mark.slow))

RECORDS = 200
LEAST, MOST = 0.93, 0.97


def coverages(every: list[Bands]) -> dict[str, list[float]]:
    """Mean coverage and t-value of each sensor band."""
    parts = {level: covered(every, level) for level in LEVELS}
    return {
        str(level): [round(float(np.mean(part)), 4), round(errors_off(part, level), 2)]
        for level, part in parts.items()
    }


@pytest.mark.parametrize("name", FEW)
def test_bands_cover_records_cut_from_a_running_drive(name: str) -> None:
    every = studied(Case(hysteresis=name), QUICK, seed=1)
    t = {level: off for level, (_, off) in coverages(every).items()}
    assert {} == {level: off for level, off in t.items() if abs(off) > QUICK_LIMIT}
    assert np.mean(covered(every, 95)) > LEAST
    assert alarms(every) <= stats.binom.isf(1e-3, QUICK, LEAD_IN_ALARM)


@pytest.mark.slow
def test_twin_earlier_drives_taken_for_as_large_as_the_range_do_not_cover_them() -> None:
    with patch.object(RemembersExtrema, "earlier", Operator.earlier):
        every = studied(Case(hysteresis="preisach"), 2 * QUICK, seed=1)
    assert np.mean(covered(every, 95)) < LEAST


@pytest.mark.slow
@pytest.mark.parametrize("name", HYSTERESIS)
def test_bands_cover_records_of_every_operator(name: str) -> None:
    case = Case(hysteresis=name)
    every = studied(case, RECORDS, seed=7)
    result = coverages(every)
    wider = max(widening(replace(case, discrepancy=sd), 10) for sd in (0.3, 1.5))
    alarmed = alarms(every)
    keep(
        f"moving operators, {name}",
        {
            "records": RECORDS,
            "coverage and t": result,
            "widening from rest": round(wider, 3),
            "false alarms of the lead-in": alarmed / RECORDS,
        },
    )
    assert LEAST <= result["95"][0] <= MOST
    assert wider < 1.1
    assert alarmed <= stats.binom.isf(1e-3, RECORDS, LEAD_IN_ALARM)


@pytest.mark.parametrize("name", ["bouc-wen", "preisach"])
def test_bands_are_the_same_on_either_engine(name: str) -> None:
    """Draws of different histories among them, which are simulated apart."""
    case = Case(hysteresis=name)
    record = record_of(case, np.random.default_rng(8))
    engines: tuple[Engine, ...] = ("numba", "numpy")
    compiled, plain = (
        predicted(case, posterior_of_case(case, engine), record, 3) for engine in engines
    )
    for kind in KINDS:
        np.testing.assert_allclose(compiled.lower[kind, 95], plain.lower[kind, 95], atol=1e-6)
    np.testing.assert_allclose(compiled.mean, plain.mean, rtol=0, atol=1e-8)
