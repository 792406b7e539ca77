"""Records cut out of a running drive are predicted as well as the bands promise.

The parameters are the true ones, so that all that bands can get wrong is the start of the record:
its hysteretic state, how the dynamics are moving, its offset (:mod:`tests.prediction.moving`). Mean
coverages are held to the spread between records. Any operator may be in the actuator: the drive's
amplitude goes up and down before the record and in it, which leaves operators with a memory of
extrema in states that no sweep through the whole range leaves. Twins take the dynamics to be at
rest, and all earlier drives for as large as the range, and fail.

``-m slow`` goes through 72 cases of 200 records each, 24 for each kind of dynamics. Each case gives
three t-values, of the 50, 90 and 95% bands. By chance alone one in 330 of the 216 is beyond three
standard errors, so all are held to three by a rule that is right for the whole family: none may be
beyond the limit that 216 pass once in 100 times (Bonferroni), and for no kind of dynamics may more
cases have one beyond three than happens once in 300 times, if every t-value were a case of its own.
As coverages of a case go together, both are on the safe side; as they are skewed, t-values are not
quite Student's. It also makes 200 records for every operator, whose 95% band must cover 93 to
97%.
"""

from collections.abc import Iterable
from dataclasses import replace
from itertools import product
from unittest.mock import patch

import numpy as np
import pytest
from scipy import stats

from bwbayes.arrays import FloatArray
from bwbayes.diagnosis.departures import LEAD_IN_ALARM
from bwbayes.inference.likelihood import Likelihood
from bwbayes.inference.study import InitialConditions
from bwbayes.model.operator import Operator
from bwbayes.model.operators.extremum_memory import RemembersExtrema
from bwbayes.model.registry import HYSTERESIS
from bwbayes.prediction import initial_state
from bwbayes.prediction.bands import LEVELS, Bands
from bwbayes.prediction.histories import Histories, Put, choose_histories
from bwbayes.prediction.initial_state import estimate_initial_states
from bwbayes.watching import Watch
from tests.measured import keep
from tests.prediction.moving import (
    RATE,
    Case,
    Cut,
    alarms,
    covered,
    errors_off,
    posterior_of_case,
    record_of,
    studied,
    widening,
    width,
)

QUICK = 20
QUICK_LIMIT = 4.0
SECOND = Case("second-order")

RECORDS = 200
LIMIT = 3.0
FALSE_ALARM = 0.01

# Coverage of the 95% band of any operator, at least and at most.
LEAST, MOST = 0.93, 0.97

# Part of good records whose lead-in may be taken for one that does not fit.
MOST_ALARMS = 0.01

KINDS_OF_DYNAMICS = (SECOND, Case(lag=38e-3), Case(lag=3.8e-3))
CUTS: tuple[Cut, ...] = ("any", "turn", "speed", "knocked")
EVERY = [
    replace(kind, discrepancy=discrepancy, lead_in=lead_in, cut=cut)
    for kind, discrepancy, lead_in, cut in product(
        KINDS_OF_DYNAMICS, (0.3, 1.5), (0.3, 1.0, 3.0), CUTS
    )
]


def name_of(case: Case) -> str:
    return f"lag {1e3 * case.lag:g} ms" if case.dynamics == "lag" else case.dynamics


def off(every: list[Bands]) -> dict[int, float]:
    """How far the coverage of each sensor band is off, in standard errors."""
    return {level: errors_off(covered(every, level), level) for level in LEVELS}


@pytest.mark.parametrize("hysteresis", ["bouc-wen", "preisach"])
@pytest.mark.parametrize(
    "case",
    [Case(), *(pytest.param(case, marks=pytest.mark.slow) for case in (Case(cut="speed"), SECOND))],
    ids=str,
)
def test_bands_cover_records_cut_from_a_running_drive(case: Case, hysteresis: str) -> None:
    """Beyond four standard errors by chance in one of 1,300 times."""
    every = studied(replace(case, hysteresis=hysteresis), QUICK, seed=1)
    assert {} == {level: t for level, t in off(every).items() if abs(t) > QUICK_LIMIT}
    assert np.mean(covered(every, 95)) > LEAST
    assert alarms(every) <= stats.binom.isf(1e-3, QUICK, LEAD_IN_ALARM)


def test_bands_cover_records_behind_a_play_that_begins_anywhere() -> None:
    """The twin, which does not ask the lead-in where the play begins, has wider bands."""
    case = Case(stages=("backlash",), discrepancy=0.05)
    every = studied(case, QUICK // 2, seed=1)
    limit = stats.t.isf(stats.t.sf(QUICK_LIMIT, QUICK - 1), QUICK // 2 - 1)
    assert {} == {level: t for level, t in off(every).items() if abs(t) > limit}
    assert np.mean(covered(every, 95)) > 0.9
    with patch.object(initial_state, "choose_together", unasked):
        anywhere = studied(case, len(every), seed=1)
    wide, narrow = (np.mean([width(b, "sensor") for b in bands]) for bands in (anywhere, every))
    assert narrow < 0.97 * wide


def unasked(
    likelihoods: tuple[Likelihood, ...],
    probability: FloatArray,
    theta: FloatArray,
    unknowns: Iterable[Put],
    generator: np.random.Generator,
    watch: Watch,  # noqa: ARG001
) -> tuple[Histories, FloatArray, FloatArray]:
    """Choose histories, and take the unknowns of stages as they are drawn beforehand."""
    for put in unknowns:
        theta = put(theta, generator.uniform(size=len(theta)))
    return choose_histories(likelihoods, probability, theta, generator)


@pytest.mark.slow
def test_twin_earlier_drives_taken_for_as_large_as_the_range_do_not_cover_them() -> None:
    with patch.object(RemembersExtrema, "remembers_range", Operator.remembers_range):
        every = studied(Case(hysteresis="preisach"), QUICK, seed=1)
    assert np.mean(covered(every, 95)) < LEAST


def test_twin_dynamics_taken_to_be_at_rest_do_not_cover_them() -> None:
    case = Case(cut="speed")
    with patch.object(Likelihood, "start_sd", at_rest):
        every = studied(case, QUICK, seed=1)
    assert np.mean(covered(every, 95)) < 0.9
    assert off(every)[95] < -QUICK_LIMIT


right_sd = Likelihood.start_sd


def at_rest(likelihood: Likelihood, theta: FloatArray) -> FloatArray:
    """Return the sds of a start whose dynamics are at rest for certain."""
    sd = right_sd(likelihood, theta).copy()
    sd[:, int(likelihood.offset_sd > 0) :] = 0.0
    return sd


def test_lead_ins_that_do_not_fit_are_found() -> None:
    """An actuator that moves 1.3 times as far; a drift, a transient, a jump of 20 um."""
    posterior, generator = posterior_of_case(Case()), np.random.default_rng(4)
    theta = posterior.prior.theta(np.empty((20, 0)))
    for number in range(12):
        record = record_of(Case(), generator)
        reading, time = record.displacement, np.arange(record.samples) / RATE
        assert reading is not None
        added = np.minimum(time, 1.0), np.exp(-time / 0.38), time > 0.5
        for spoilt in (1.3 * reading, *(reading + 20 * one for one in added)):
            other, start = replace(record, displacement=spoilt), InitialConditions(lead_in=1.0)
            begun = estimate_initial_states(
                posterior, theta, other, start, np.random.default_rng(number)
            )
            assert begun.lead_in is not None
            assert begun.lead_in.p_value < LEAD_IN_ALARM


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS_OF_DYNAMICS, ids=name_of)
def test_bands_cover_all_kinds_of_moving_records(kind: Case) -> None:
    cases = [case for case in EVERY if name_of(case) == name_of(kind)]
    t, alarmed, cells = {}, 0, {}
    for number, case in enumerate(cases):
        every = studied(case, RECORDS, seed=1000 + number)
        t[case] = off(every)
        alarmed += alarms(every)
        label = f"{case.discrepancy:g} um, lead-in {case.lead_in:g} s, {case.cut}"
        cells[label] = {
            str(level): [round(float(np.mean(covered(every, level))), 4), round(t[case][level], 2)]
            for level in LEVELS
        }
    values = np.array([list(one.values()) for one in t.values()])
    comparisons = len(EVERY) * len(LEVELS)
    beyond = int(np.sum(np.any(np.abs(values) > LIMIT, axis=1)))
    strict = float(stats.t.isf(FALSE_ALARM / 2 / comparisons, RECORDS - 1))
    chance = 2 * stats.t.sf(LIMIT, RECORDS - 1)
    allowed = int(stats.binom.isf(FALSE_ALARM / len(KINDS_OF_DYNAMICS), values.size, chance))
    keep(
        f"moving, {name_of(kind)}",
        {
            "records of each case": RECORDS,
            "cases": len(t),
            "largest t": round(float(np.max(np.abs(values))), 2),
            "cases beyond three standard errors": beyond,
            "allowed beyond": allowed,
            "limit of one t": round(strict, 2),
            "false alarms of the lead-in": alarmed / (RECORDS * len(t)),
            "coverage and t": cells,
        },
    )
    assert np.max(np.abs(values)) < strict
    assert beyond <= allowed
    assert alarmed <= MOST_ALARMS * RECORDS * len(t)


@pytest.mark.slow
@pytest.mark.parametrize("name", HYSTERESIS)
def test_bands_cover_records_of_every_operator(name: str) -> None:
    case = Case(hysteresis=name)
    every = studied(case, RECORDS, seed=7)
    t, wider = off(every), max(widening(replace(case, discrepancy=sd), 10) for sd in (0.3, 1.5))
    cover = {level: round(float(np.mean(covered(every, level))), 4) for level in LEVELS}
    keep(
        f"moving operators, {name}",
        {
            "records": RECORDS,
            "coverage and t": {str(v): [cover[v], round(t[v], 2)] for v in LEVELS},
            "widening from rest": round(wider, 3),
            "false alarms of the lead-in": alarms(every) / RECORDS,
        },
    )
    assert LEAST <= cover[95] <= MOST
    assert wider < 1.1
    assert alarms(every) <= stats.binom.isf(1e-3, RECORDS, LEAD_IN_ALARM)
