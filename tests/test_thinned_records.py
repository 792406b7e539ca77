"""A record at 5 kHz, its every 2nd, 5th and 20th sample, and its readings thinned alone.

What is compared are posterior medians, of logarithms where a parameter is positive, in units of
the larger posterior sd of the two. What a record and its thinned copy see of the discrepancy is
the same; of the sensor's noise a copy sees a part, so that the estimates of ``sensor_sd``, and of
what the sensor's noise limits (a short lag, a long record's every parameter), must differ by about
as much as their sds do. The limit is one sd for the physical parameters.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from bwbayes.arrays import FloatArray
from bwbayes.data import Record, write_record
from bwbayes.results.prediction import predict_windows
from tests.found import keep
from tests.results.runs import Stand, covered, posterior_draws, problem_of

SEEDS = 20
EVERY = (1, 2, 5, 20)
SIGNED = ("gamma", "offset", "initial")
TRUTH = {"d": 0.7, "alpha": 0.357, "beta": 0.0272, "gamma": 0.0172, "offset": 2.0}
TRUTH |= {"discrepancy_sd": 0.3, "discrepancy_time": 0.1}


def measured(lag: float, seed: int, rate: float = 5000.0, seconds: float = 3.5) -> Record:
    """Return a record of a decaying 2 Hz sine from rest."""
    time = np.arange(round(seconds * rate)) / rate
    voltage = 100 * np.sin(4 * np.pi * time) * (1 - 0.6 * time / seconds)
    stand = Stand(lag=lag, memory=0.1, rate=rate)
    return stand.measure(voltage, np.random.default_rng([31, seed]))


def thinned(record: Record, every: int) -> Record:
    assert record.displacement is not None
    return Record(record.voltage[::every], record.displacement[::every], every * record.interval)


Answer = dict[str, tuple[float, float]]


def answer(
    record: Record, folder: Path, seed: int, lines: str = "", stop: float = 2.5
) -> tuple[Answer, dict[int, float]]:
    """Return median and sd of each parameter, and the coverage of what was not fitted."""
    write_record(record, folder / "record.h5")
    end = float(record.time[-1] + record.interval)
    text = f'[record]\nfile = "record.h5"\ntrain = [[0.0, {stop}]]\n{lines}\n'
    text += f"[validation.rest]\nwindow = [{stop}, {end}]\n"
    problem, source = problem_of(text, folder), np.random.default_rng([32, seed])
    draws = posterior_draws(problem.posterior, source)
    window = problem.validations["rest"].window
    assert window is not None
    (bands,) = predict_windows(
        problem.posterior, draws[:100], problem.record, {"rest": window}, source
    )

    def middle(name: str, column: FloatArray) -> tuple[float, float]:
        values = column if name in SIGNED else np.log(column)
        low, median, high = np.quantile(values, [0.16, 0.5, 0.84])
        return float(median), float((high - low) / 2)

    columns = zip(problem.posterior.names, draws.T, strict=True)
    return {n: middle(n, c) for n, c in columns}, {
        level: covered(bands, level) for level in (50, 90, 95)
    }


def apart(one: Answer, other: Answer) -> dict[str, float]:
    """Return how many sds two answers differ by."""
    return {n: abs(one[n][0] - other[n][0]) / max(one[n][1], other[n][1]) for n in one}


def off(one: Answer) -> dict[str, float]:
    """Return how many sds an answer is from the truth."""
    log = {n: v if n in SIGNED else float(np.log(v)) for n, v in TRUTH.items()}
    return {n: abs(one[n][0] - v) / one[n][1] for n, v in log.items()}


@pytest.mark.parametrize("seed", [1, 2])
def test_thinned_readings_lead_to_the_truth_as_all_of_them_do(tmp_path: Path, seed: int) -> None:
    """``decimate = 8`` at 100 Hz: what the voltage did between the readings is not forgotten."""
    record = measured(0.02, seed, 100.0, 10.0)
    whole, _ = answer(record, tmp_path, seed, stop=8.0)
    part, _ = answer(record, tmp_path, seed, "decimate = 8", stop=8.0)
    for one in (whole, part):
        assert max(off(one).values()) < 4
    assert apart(whole, part)["d"] < 2
    # The twin thins the voltage too, and with it the turning points.
    twin, _ = answer(thinned(record, 8), tmp_path, seed, stop=8.0)
    assert max(off(twin).values()) > 4


@pytest.mark.slow
@pytest.mark.parametrize("lag", [0.5e-3, 20e-3])
def test_every_kth_sample_of_a_record_at_5_khz_gives_its_answer(tmp_path: Path, lag: float) -> None:
    """Over 20 seeds; and the bands of the rest of the record cover at each rate."""
    distances: dict[int, list[dict[str, float]]] = {k: [] for k in EVERY[1:]}
    coverage: dict[int, list[dict[int, float]]] = {k: [] for k in EVERY}
    for seed in range(SEEDS):
        record = measured(lag, seed)
        first: Answer = {}
        for every in EVERY:
            found, parts = answer(thinned(record, every), tmp_path, seed)
            coverage[every].append(parts)
            first = first or found
            if every > 1:
                distances[every].append(apart(first, found))
        print(lag, seed, distances[20][-1], flush=True)
    largest = {
        k: {n: round(max(one[n] for one in every), 2) for n in every[0]}
        for k, every in distances.items()
    }
    usual = {
        k: {n: round(float(np.median([one[n] for one in every])), 2) for n in every[0]}
        for k, every in distances.items()
    }
    mean = {
        k: {level: round(100 * float(np.mean([one[level] for one in every])), 1) for level in parts}
        for k, every in coverage.items()
    }
    keep(
        f"every k-th sample, lag {1000 * lag:g} ms",
        {"seeds": SEEDS, "largest sds apart": largest, "median": usual, "covered": mean},
    )
    for every in EVERY[1:]:
        told = {n: x for n, x in largest[every].items() if n not in ("sensor_sd", "lag")}
        assert max(told.values()) < 1, (every, told)
    for every in EVERY:
        parts95 = [one[95] for one in coverage[every]]
        error = np.std(parts95, ddof=1) / np.sqrt(SEEDS)
        assert abs(np.mean(parts95) - 0.95) < 3 * error
