"""Measured loops are those of slow loops, of the whole range and of half of it."""

from typing import Any

import numpy as np
import pytest

from bwbayes.arrays import FloatArray
from bwbayes.model.actuator import Actuator
from bwbayes.model.operator import Operator
from bwbayes.model.operators.bouc_wen import BoucWen
from bwbayes.model.operators.prandtl_ishlinskii import Plays
from bwbayes.prediction.loops import TracedLoop, initial_curve, measure_loops, measures, steady_loop
from bwbayes.report.run import loops_table
from tests.model.operators.slow import by_plays
from tests.model.operators.test_every_operator import posterior


def still(operator: Operator | None = None) -> Actuator:
    return Actuator("none", "first", 1.0, operator or BoucWen())


def columns(actuator: Actuator, **known: float) -> dict[str, FloatArray]:
    return {name: np.array([known.get(name, 0.0)]) for name in actuator.parameters}


def measured(loop: TracedLoop) -> dict[str, float]:
    every = {name: values for name, values in measures(loop).items() if values is not None}
    return {name: float(values[0]) for name, values in every.items()}


@pytest.mark.parametrize(("low", "high"), [(-80.0, 80.0), (-20.0, 100.0), (10.0, 90.0)])
def test_plays_are_measured_as_in_a_slow_loop(low: float, high: float) -> None:
    """By the shoelace formula along the path, and by a search along each branch."""
    thresholds, weights, d = (5.0, 15.0, 33.0), (0.1, 0.15, 0.2), 0.4
    actuator = still(Plays(thresholds))
    column = columns(actuator, d=d, weight_1=0.1, weight_2=0.15, weight_3=0.2)
    got = measured(steady_loop(actuator, column, low, high, 1201))
    up = np.linspace(low, high, 24_001)
    path = np.concatenate([np.linspace(0, high, 9000), up[::-1], up, up[::-1]])
    x = by_plays(d, np.array(thresholds), np.array(weights), path.tolist())
    (rising, falling), u = (x[-2 * up.size : -up.size], x[-up.size :][::-1]), up
    middle = (rising[-1] + falling[0]) / 2
    expected = {
        "range_um": rising[-1] - rising[0],
        "max_width_percent": 100 * np.max(falling - rising) / (rising[-1] - rising[0]),
    }
    cycle = np.concatenate([u, u[::-1]]), np.concatenate([rising, falling[::-1]])
    forward = cycle[0] * np.roll(cycle[1], -1) - np.roll(cycle[0], -1) * cycle[1]
    expected["area_um_V"] = np.sum(forward) / 2
    if low < 0:
        expected["width_at_zero_um"] = np.interp(0.0, u, falling - rising)
    if low == -high:
        expected["remanence_um"] = np.interp(0.0, u, falling) - middle
        passing = [np.interp(middle, branch, u) for branch in (rising, falling)]
        expected["coercive_V"] = (passing[0] - passing[1]) / 2
    assert set(got) == set(expected)
    for name, value in expected.items():
        assert value == pytest.approx(got[name], rel=1e-4), name


def problem(name: str, draws: int = 40) -> tuple[Any, FloatArray]:
    """Return a posterior with an operator, and draws from a prior that is narrow about its median.

    The joint prior holds models without a loop and without a range, too.
    """
    of = posterior(name, from_rest=True)
    free = of.prior.draw(np.random.default_rng(2), 400)
    away = np.sum(np.log(np.abs(free) / np.median(np.abs(free), axis=0)) ** 2, axis=1)
    return of, free[np.argsort(away)[:draws]]


def test_loops_are_those_of_the_whole_range_and_of_half_of_it() -> None:
    of, draws = problem("bouc-wen")
    loops = measure_loops(of.altered(voltage=of.single_record.voltage + 30.0), draws)
    low, high = np.min(of.single_record.voltage) + 30, np.max(of.single_record.voltage) + 30
    quarter = (high - low) / 4
    assert (low, high) == (loops.major.voltage[0], loops.major.voltage[-1])
    assert [low + quarter, high - quarter] == pytest.approx(loops.minor.voltage[[0, -1]])
    assert 2 * quarter == pytest.approx(loops.major.amplitude)


@pytest.mark.parametrize(("shift", "about_zero"), [(-5.0, True), (60.0, False), (150.0, False)])
def test_remanence_and_coercive_voltage_are_of_loops_about_zero_volts(
    shift: float, about_zero: bool
) -> None:
    """Elsewhere they have no number, no row and no term; a width is where the loop has zero."""
    of, draws = problem("bouc-wen")
    # Over 200 V, with a coercive voltage of some 10 V.
    voltage = 100 * of.single_record.voltage / np.max(np.abs(of.single_record.voltage))
    loops = measure_loops(of.altered(voltage=voltage + shift), draws)
    for loop in (loops.major, loops.minor):
        for name in ("remanence_um", "coercive_V"):
            assert (loop.estimates[name] is not None) == about_zero
    titles = [row[0] for row in loops_table(loops).rows]
    assert ("Remanence" in titles, "Coercive voltage" in titles) == (about_zero, about_zero)
    assert ("Loop width at zero voltage" in titles) == (shift < 100)


def test_initial_curve_starts_at_zero_volts_and_ends_where_the_voltage_does() -> None:
    actuator = still()
    column = columns(actuator, d=0.7, alpha=0.36, beta=0.027, gamma=0.017, exponent=1.0)
    voltage, curve = initial_curve(actuator, column, 20.0, 80.0, 81)
    assert (0.0, 80.0) == (voltage[0], voltage[-1])
    np.testing.assert_allclose(
        curve[0],
        actuator.displacement(
            np.array([[column[n][0] for n in actuator.parameters]]), voltage, from_rest=True
        )[0],
    )
    assert 0.0 == curve[0, 0]
    _, both = initial_curve(actuator, column, -80.0, 80.0, 161)
    np.testing.assert_allclose(both[0], -both[0, ::-1], atol=1e-12)
    np.testing.assert_allclose(both[0, 80:], curve[0], atol=1e-12)
