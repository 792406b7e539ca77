"""A record at 5 kHz, its every 2nd, 5th and 20th sample, and its readings thinned alone.

A thinned record's readings are a part of the whole record's, so both answers are allowed to differ,
and by how much is known. A posterior mean is a martingale as readings come in: given the thinned
record, the difference of both means has the variance that the readings in between take away,

    E[(m_1 − m_k)² / V_k] = 1 − E[V_1 / V_k],

with the posterior variances V (for estimates: Hausman, "Specification tests in econometrics",
1978). It holds for any function of a parameter; of most it is the logarithm. On the left stands
what runs say; on the right, where a hundredth matters, the variances come from Fisher's information
at the truth, and the Monte Carlo errors of both means are added. Over 20 seeds and for each
parameter, rate and lag two statistics are held to this: the sum of squared differences, which is
nearly χ² with 20 degrees of freedom, and their mean, which is nearly normal. A right analysis
exceeds one of all 120 limits at most once in 100 times (Bonferroni), as far as posteriors are
normal. The twin takes the default priors' times from the sampling interval, as the first version
did.

That every parameter is within one sd of the thinned record's posterior cannot be asked of all 600
differences: what a 20th of the readings knows of the sensor's noise has an sd √20 times as large,
so that one difference in three is beyond one. How many are within is kept.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
from scipy import linalg, stats

from bwbayes.arrays import FloatArray
from bwbayes.inference import defaults
from bwbayes.inference.noise import DiscrepancyNoise
from bwbayes.model.actuator import Actuator
from bwbayes.prediction.prediction import predict_windows
from bwbayes.record import Record, write_record
from tests.measured import keep
from tests.prediction.runs import KEPT, covered, study_of, weighted_draws
from tests.stand import Stand

SEEDS = 20
RATE = 5000.0
EVERY = (1, 2, 5, 20)
LAGS = (0.5e-3, 20e-3)

# Probability that a right analysis exceeds one of all limits, and their number: two for each of ten
# parameters, three rates and two lags.
FALSE_ALARM = 0.01
LIMITS = 2 * 10 * len(EVERY[1:]) * len(LAGS)

# Compared as they are; all others by their logarithms. That of a lag which is too short to be seen
# has a long tail.
PLAIN = ("gamma", "offset", "initial", "lag")
TRUTH = {"d": 0.7, "alpha": 0.357, "beta": 0.0272, "gamma": 0.0172, "offset": 2.0}
TRUTH |= {"discrepancy_sd": 0.3, "discrepancy_time": 0.1}
SENSOR = 0.1

# Until when a record is fitted, s.
FITTED = 2.5

# Sds of the priors that matter: of the logarithm of the discrepancy's time, and of the dynamics'
# start, um.
TIME_SIGMA, START_SD = 0.8, 70.0


def drive(time: FloatArray, seconds: float = 3.5) -> FloatArray:
    """Return a 2 Hz sine that decays, V."""
    voltage: FloatArray = 100 * np.sin(4 * np.pi * time) * (1 - 0.6 * time / seconds)
    return voltage


def measured(lag: float, seed: int, rate: float = RATE, seconds: float = 3.5) -> Record:
    voltage = drive(np.arange(round(seconds * rate)) / rate, seconds)
    stand = Stand(lag=lag, memory=0.1, rate=rate)
    return stand.measure(voltage, np.random.default_rng([31, seed]))


def thinned(record: Record, every: int) -> Record:
    assert record.displacement is not None
    return Record(
        record.voltage[::every], record.displacement[::every], interval=every * record.interval
    )


class Middle(NamedTuple):
    """Posterior mean, sd, and the mean's Monte Carlo error."""

    mean: float
    sd: float
    error: float


Answer = dict[str, Middle]


def middle(values: FloatArray, weights: FloatArray) -> Middle:
    """Return the middle of weighted draws (draws,)."""
    mean = float(weights @ values)
    squared = (values - mean) ** 2
    return Middle(mean, float(np.sqrt(weights @ squared)), float(np.sqrt(weights**2 @ squared)))


def answer(
    record: Record, folder: Path, seed: int, lines: str = "", stop: float = FITTED
) -> tuple[Answer, dict[int, float]]:
    """Return the middle of each parameter, and the coverage of what was not fitted."""
    write_record(record, folder / "record.h5")
    end = float(record.time[-1] + record.interval)
    text = f'[record]\nfile = "record.h5"\ntrain = [[0.0, {stop}]]\n{lines}\n'
    text += f"[validation.rest]\nwindow = [{stop}, {end}]\n"
    study, source = study_of(text, folder), np.random.default_rng([32, seed])
    draws, weights = weighted_draws(study.posterior, source)
    window = study.validations["rest"].windows
    assert window is not None
    chosen = draws[source.choice(len(draws), KEPT, p=weights)]
    (bands,) = predict_windows(study.posterior, chosen, study.record, {"rest": window}, source)
    return {
        name: middle(column if name in PLAIN else np.log(column), weights)
        for name, column in zip(study.posterior.names, draws.T, strict=True)
    }, {level: covered(bands, level) for level in (50, 90, 95)}


def apart(one: Answer, other: Answer) -> dict[str, float]:
    """Return how many sds, of the larger, two answers differ by."""
    return {n: abs(one[n].mean - other[n].mean) / max(one[n].sd, other[n].sd) for n in one}


def variances(lag: float, every: int) -> dict[str, float]:
    """Return the posterior variances that a part of the samples leaves, by Fisher's information."""
    return of_simulation(lag, every / RATE) | of_noise(every / RATE)


def slopes(lag: float, interval: float) -> dict[str, FloatArray]:
    """Return the simulation's derivatives (samples,) at the truth, the unknown start's too."""
    time = interval * np.arange(round(FITTED / interval), dtype=float)
    voltage, actuator = drive(time), Actuator("lag", "first", interval)
    truth = TRUTH | {"lag": lag, "exponent": 1.0, "initial": 0.0}

    def simulated(name: str, step: float) -> FloatArray:
        moved = truth[name] + step if name in PLAIN else truth[name] * np.exp(step)
        theta = [(truth | {name: moved})[n] for n in actuator.parameters]
        displacement: FloatArray = actuator.displacement([theta], voltage)[0]
        return displacement

    steps = dict.fromkeys(actuator.parameters, 1e-4) | {"gamma": 1e-6, "lag": 1e-2 * lag}
    del steps["exponent"]
    central = {n: (simulated(n, h) - simulated(n, -h)) / (2 * h) for n, h in steps.items()}
    return central | {"start": np.exp(-time / lag)}


def of_simulation(lag: float, interval: float) -> dict[str, float]:
    """Return variances of the simulation's parameters at the truth.

    The inverse of DᵀC⁻¹D, with the derivatives D and the noise's covariance C.
    """
    moves = slopes(lag, interval)
    noise = np.array([[SENSOR, TRUTH["discrepancy_sd"], TRUTH["discrepancy_time"]]])
    white = DiscrepancyNoise(interval).whiten(noise, np.stack([*moves.values()])[np.newaxis])[0][0]
    told = white @ white.T
    told[-1, -1] += START_SD**-2
    return dict(zip(moves, np.diag(linalg.inv(told)), strict=True))


def of_noise(interval: float) -> dict[str, float]:
    """Return variances of the logarithms of the noise's parameters at the truth, by Whittle.

    The information is half the sum over frequencies of the products of derivatives of the log
    spectrum.
    """
    samples = round(FITTED / interval)
    angle = 2 * np.pi * (np.arange(samples) + 0.5) / samples

    def log_spectrum(sizes: FloatArray) -> FloatArray:
        white, slow, memory = np.exp(sizes)
        kept = np.exp(-interval / memory)
        shape = (1 - kept**2) / (1 - 2 * kept * np.cos(angle) + kept**2)
        spectrum: FloatArray = np.log(white**2 + slow**2 * shape)
        return spectrum

    truth = np.log([SENSOR, TRUTH["discrepancy_sd"], TRUTH["discrepancy_time"]])
    steps = 1e-4 * np.eye(3)
    moves = np.stack([(log_spectrum(truth + h) - log_spectrum(truth - h)) / 2e-4 for h in steps])
    told = moves @ moves.T / 2
    told[2, 2] += TIME_SIGMA**-2
    names = ("sensor_sd", "discrepancy_sd", "discrepancy_time")
    return dict(zip(names, np.diag(linalg.inv(told)), strict=True))


class Nested(NamedTuple):
    """How far thinned records' means are from the whole ones', over what is to be expected.

    ``sum`` of squares over their number, one if all is right; ``mean`` in its own errors; ``p`` the
    smaller p-value of both.
    """

    sum: float
    mean: float
    p: float


def nested(
    whole: Sequence[Answer], part: Sequence[Answer], lag: float, k: int
) -> dict[str, Nested]:
    """Compare the means of all parameters over seeds of records and their every k-th sample."""
    first, second = variances(lag, 1), variances(lag, k)
    compared = {}
    for name in whole[0]:
        every = np.array([[one[name], other[name]] for one, other in zip(whole, part, strict=True)])
        mean, _, error = np.moveaxis(every / every[:, 1:, 1:2], 2, 0)
        difference, seeds = mean[:, 1] - mean[:, 0], len(every)
        expected = 1 - first[name] / second[name] + float(np.mean(np.sum(error**2, axis=1)))
        square = float(np.sum(difference**2) / expected)
        along = float(np.sum(difference) / np.sqrt(seeds * expected))
        p = min(float(stats.chi2.sf(square, seeds)), float(2 * stats.norm.sf(abs(along))))
        compared[name] = Nested(square / seeds, along, p)
    return compared


@pytest.mark.slow
@pytest.mark.parametrize("lag", LAGS)
def test_every_kth_sample_of_a_record_at_5_khz_gives_its_answer(tmp_path: Path, lag: float) -> None:
    """Over 20 seeds; and the bands of the rest of the record cover at each rate."""
    answers: dict[int, list[Answer]] = {k: [] for k in EVERY}
    coverage: dict[int, list[dict[int, float]]] = {k: [] for k in EVERY}
    for seed in range(SEEDS):
        record = measured(lag, seed)
        for every in EVERY:
            one, parts = answer(thinned(record, every), tmp_path, seed)
            answers[every].append(one)
            coverage[every].append(parts)
    names = tuple(answers[1][0])
    assert LIMITS == 2 * len(names) * len(EVERY[1:]) * len(LAGS)
    compared = {k: nested(answers[1], answers[k], lag, k) for k in EVERY[1:]}
    sds = {k: list(map(apart, answers[1], answers[k])) for k in EVERY[1:]}
    keep(
        f"every k-th sample, lag {1000 * lag:g} ms",
        {
            "seeds": SEEDS,
            "smallest p": min(one.p for every in compared.values() for one in every.values()),
            "p of the family": FALSE_ALARM / LIMITS,
            "squares over expected, and mean in errors": {
                k: {n: [round(one.sum, 2), round(one.mean, 2)] for n, one in every.items()}
                for k, every in compared.items()
            },
            "within one sd": {
                k: f"{sum(x < 1 for one in every for x in one.values())} of {SEEDS * len(names)}"
                for k, every in sds.items()
            },
            "largest sds apart": {
                k: {n: round(max(one[n] for one in every), 2) for n in names}
                for k, every in sds.items()
            },
            "covered": {
                k: {v: round(100 * float(np.mean([one[v] for one in every])), 1) for v in every[0]}
                for k, every in coverage.items()
            },
        },
    )
    for k, each in compared.items():
        beyond = {n: one for n, one in each.items() if one.p < FALSE_ALARM / LIMITS}
        assert {} == beyond, k
    for k in EVERY:
        parts95 = [one[95] for one in coverage[k]]
        error = np.std(parts95, ddof=1) / np.sqrt(SEEDS)
        assert abs(np.mean(parts95) - 0.95) < 3 * error


@pytest.mark.slow
def test_twin_whose_priors_come_from_the_sampling_interval_gives_other_answers(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(defaults, "time_between_turns", lambda _, interval, __: 500 * interval)
    whole, part = [], []
    for seed in range(SEEDS):
        record = measured(LAGS[1], seed)
        whole.append(answer(record, tmp_path, seed)[0])
        part.append(answer(thinned(record, EVERY[-1]), tmp_path, seed)[0])
    compared = nested(whole, part, LAGS[1], EVERY[-1])
    assert min(one.p for one in compared.values()) < FALSE_ALARM / LIMITS, compared
