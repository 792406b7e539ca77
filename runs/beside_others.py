"""A band against those of common methods, on one record of a measured piezo stack.

The same eleven seconds are fitted by four methods, and each predicts the other part of the record:
large loops, as they were fitted, and a decay to rest with a hold, which were not.

- least squares: Bouc-Wen with a lag, ``scipy.optimize.least_squares``, its covariance and the
  residual's sd;
- plays: a Prandtl-Ishlinskii model of ten plays with weights that are not negative, the residual's
  sd;
- emcee: Bouc-Wen with a lag, white noise, flat priors of log parameters, emcee's default move, from
  where least squares ends;
- bwbayes: everything left to its defaults, but for the effective draws: bands need no more than
  1,000, of 2,000.

    python runs/beside_others.py RECORD.csv [--figure FILE]
"""

from __future__ import annotations

import argparse
import json
import resource
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import emcee
import matplotlib.pyplot as plt
import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares, lsq_linear

import bwbayes as bw

type FloatArray = NDArray[np.float64]
type BoolArray = NDArray[np.bool_]

TRAIN = (25.0, 36.0)
TESTS = {"large loops": (3.0, 15.0), "decay and hold": (15.0, 25.0)}
NORMAL_95 = 1.96
DRAWS = 200


def bouc_wen(theta: FloatArray, voltage: FloatArray, interval: float) -> FloatArray:
    """Simulate displacements (draws, samples), um, sample by sample.

    θ (draws, 6) is d, alpha, beta, gamma, the lag's time in s, and an offset.
    """
    d, alpha, beta, gamma, lag, offset = theta.T
    passed = 1 - np.exp(-interval / lag)
    h = np.zeros(len(theta))
    x = d * voltage[0]
    displacement = np.empty((len(theta), voltage.size))
    displacement[:, 0] = x + offset
    for k in range(1, voltage.size):
        du = voltage[k] - voltage[k - 1]
        h = h + alpha * du - beta * abs(du) * h - gamma * du * np.abs(h)
        x = x + passed * (d * voltage[k] - h - x)
        displacement[:, k] = x + offset
    return displacement


def plays(voltage: FloatArray, count: int = 10) -> FloatArray:
    """Return offset, voltage and plays (samples, 2 + count) along a voltage."""
    radii = np.ptp(voltage) / 2 * np.arange(1, count + 1) / (count + 1)
    play = np.zeros((voltage.size, count))
    for k in range(1, voltage.size):
        play[k] = np.clip(play[k - 1], voltage[k] - radii, voltage[k] + radii)
    return np.column_stack([np.ones_like(voltage), voltage, play])


type Band = tuple[FloatArray, FloatArray, FloatArray]


def normal_band(mean: FloatArray, sd: FloatArray | float) -> Band:
    """Return mean, lower and upper edge of a 95 % band."""
    return mean, mean - NORMAL_95 * sd, mean + NORMAL_95 * sd


def least_squares_fit(
    record: bw.Record, fitted: BoolArray
) -> tuple[Any, Callable[[FloatArray], FloatArray]]:
    """Fit Bouc-Wen by least squares; return scipy's result, and what simulates its unknowns.

    The unknowns are the logs of all parameters but the offset.
    """
    measured = np.asarray(record.displacement)

    def simulate(z: FloatArray) -> FloatArray:
        theta = np.append(np.exp(z[:5]), z[5])[np.newaxis]
        return np.asarray(bouc_wen(theta, record.voltage, record.interval)[0])

    def residual(z: FloatArray) -> FloatArray:
        return np.asarray((simulate(z) - measured)[fitted])

    return least_squares(residual, start(record), x_scale="jac"), simulate


def by_least_squares(record: bw.Record, fitted: BoolArray) -> Band:
    """Fit Bouc-Wen by least squares; the band is from its covariance and the residual."""
    result, simulate = least_squares_fit(record, fitted)
    variance = 2 * result.cost / (fitted.sum() - result.x.size)
    mean = simulate(result.x)
    step = 1e-5
    slopes = np.stack([(simulate(result.x + step * e) - mean) / step for e in np.eye(6)], axis=1)
    covariance = variance * np.linalg.pinv(result.jac.T @ result.jac)
    parameters = np.einsum("ki,ij,kj->k", slopes, covariance, slopes)
    return normal_band(mean, np.sqrt(parameters + variance))


def by_plays(record: bw.Record, fitted: BoolArray) -> Band:
    """Fit weights of plays by least squares; the band is the residual's."""
    columns, measured = plays(record.voltage), np.asarray(record.displacement)
    lowest = np.array([-np.inf, *np.zeros(columns.shape[1] - 1)])
    weights = lsq_linear(columns[fitted], measured[fitted], (lowest, np.inf)).x
    mean = columns @ weights
    return normal_band(mean, float(np.std((mean - measured)[fitted])))


def by_emcee(record: bw.Record, fitted: BoolArray, steps: int = 1500) -> Band:
    """Sample the posterior of Bouc-Wen with white noise, from the least squares on."""
    measured = np.asarray(record.displacement)
    # The drive before the fitted part is forgotten by then, but for its last second or so.
    first = int(np.flatnonzero(fitted)[0]) - 400
    voltage, kept = record.voltage[first:], fitted[first:]

    def log_density(z: FloatArray) -> FloatArray:
        theta = np.column_stack([np.exp(z[:, :5]), z[:, 5]])
        with np.errstate(all="ignore"):
            misfit = (bouc_wen(theta, voltage, record.interval) - measured[first:])[:, kept]
            density = -0.5 * np.sum(misfit**2, axis=1) * np.exp(-2 * z[:, 6])
        density -= kept.sum() * z[:, 6]
        return np.where(
            np.isfinite(density) & np.all(np.abs(z[:, :5]) < 12, axis=1), density, -1e300
        )

    generator = np.random.default_rng(1)
    result, _ = least_squares_fit(record, fitted)
    best = np.append(result.x, 0.5 * np.log(2 * result.cost / fitted.sum()))
    walkers = best + 1e-3 * generator.standard_normal((32, 7))
    sampler = emcee.EnsembleSampler(32, 7, log_density, vectorize=True)
    sampler.random_state = np.random.RandomState(1).get_state()
    sampler.run_mcmc(walkers, steps)
    chain = sampler.get_chain(discard=steps // 2, flat=True)
    drawn = chain[generator.integers(len(chain), size=DRAWS)]
    theta = np.column_stack([np.exp(drawn[:, :5]), drawn[:, 5]])
    simulated = bouc_wen(theta, record.voltage, record.interval)
    noise = np.exp(drawn[:, 6:]) * generator.standard_normal(simulated.shape)
    lower, upper = np.quantile(simulated + noise, [0.025, 0.975], axis=0)
    return simulated.mean(axis=0), lower, upper


def start(record: bw.Record) -> FloatArray:
    """Where least squares and emcee begin: the record's slope, and loops of ordinary width."""
    half = np.ptp(record.voltage) / 2
    slope = np.ptp(np.asarray(record.displacement)[-400:]) / np.ptp(record.voltage[-400:])
    return np.array(
        [
            np.log(1.2 * slope),
            np.log(0.3 * slope),
            np.log(1 / half),
            np.log(0.5 / half),
            np.log(2 * record.interval),
            float(np.mean(np.asarray(record.displacement)[-400:])),
        ]
    )


def by_bwbayes(record: bw.Record, fitted: BoolArray) -> Band:
    """Leave the model to bwbayes; a lead-in of a second tells where each test starts."""
    first, last = record.time[fitted][[0, -1]].tolist()
    run = bw.fit(record, train=(first, last), seed=1, ess=1000, progress=False)
    bands = run.predict(record, lead_in_start=2.0, lead_in=1.0)
    return bands.mean, bands.lower["sensor", 95], bands.upper["sensor", 95]


METHODS: dict[str, Callable[[bw.Record, BoolArray], Band]] = {
    "least squares": by_least_squares,
    "plays, least squares": by_plays,
    "emcee, white noise": by_emcee,
    "bwbayes": by_bwbayes,
}


@dataclass(frozen=True)
class Comparison:
    """Bands (samples,), um, of each method along a record, and the core seconds that each took."""

    record: bw.Record
    bands: dict[str, Band]
    seconds: dict[str, float]

    @property
    def table(self) -> dict[str, dict[str, Any]]:
        """Error, width and coverage of each method in each test."""
        measured, clock = np.asarray(self.record.displacement), self.record.time
        extent = float(np.ptp(measured[within(clock, TRAIN)]))
        table: dict[str, dict[str, Any]] = {}
        for name, (mean, lower, upper) in self.bands.items():
            table[name] = {"core s": self.seconds[name]}
            for test, window in TESTS.items():
                tested = within(clock, window)
                error = float(np.sqrt(np.mean((mean - measured)[tested] ** 2)))
                inside = ((measured >= lower) & (measured <= upper))[tested]
                table[name][test] = {
                    "error_um": error,
                    "error_percent": 100 * error / extent,
                    "width_um": float(np.mean((upper - lower)[tested])),
                    "covered_percent": 100 * float(np.mean(inside)),
                }
        return table

    def draw(self, path: Path) -> None:
        """Draw the readings, and what each method leaves of them beside its band.

        Readings outside of a band are red; a title says which share each test has inside.
        """
        measured, clock, table = np.asarray(self.record.displacement), self.record.time, self.table
        shown = within(clock, (min(TESTS.values())[0], max(TESTS.values())[1]))
        figure, (top, *panels) = plt.subplots(
            1 + len(self.bands), sharex=True, figsize=(5, 6), layout="constrained"
        )
        top.plot(clock[shown], measured[shown], color="0.3", linewidth=0.8)
        top.set_ylabel("reading, µm")
        for name, window in TESTS.items():
            middle = float(np.mean(window))
            top.text(middle, 1.03, name, transform=top.get_xaxis_transform(), ha="center")
        for panel, (name, (mean, lower, upper)) in zip(panels, self.bands.items(), strict=True):
            error, edges = measured - mean, ((lower - mean)[shown], (upper - mean)[shown])
            out = shown & ((measured < lower) | (measured > upper))
            panel.fill_between(clock[shown], *edges, color="C0", alpha=0.3, linewidth=0)
            panel.plot(clock[shown & ~out], error[shown & ~out], "k.", markersize=1)
            panel.plot(clock[out], error[out], ".", color="C3", markersize=2)
            covered = (f"{table[name][test]['covered_percent']:.0f}%" for test in TESTS)
            title = f"{name}: 95% band holds {' / '.join(covered)}"
            panel.set_title(title, loc="left", fontsize="medium")
            panel.set_ylabel("error, µm")
            panel.set_ylim(-1.3, 1.3)
        for axes in (top, *panels):
            axes.axvline(max(TESTS["large loops"]), color="0.6", linewidth=0.8)
            axes.margins(x=0)
        panels[-1].set_xlabel("time, s (fitted: 25 to 36 s)")
        figure.savefig(path, dpi=130)
        plt.close(figure)


def within(clock: FloatArray, window: tuple[float, float]) -> BoolArray:
    """Return which samples (samples,) lie in a window, s."""
    return np.asarray((clock >= window[0]) & (clock <= window[1]))


def core_seconds() -> float:
    """Return the processor time of this process and of those that it has waited for, s."""
    who = resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN
    return sum(used.ru_utime + used.ru_stime for used in map(resource.getrusage, who))


def compare(record: bw.Record, methods: Iterable[str] = METHODS) -> Comparison:
    """Fit each method to the same part of a record, and predict all of it."""
    fitted, bands, seconds = within(record.time, TRAIN), dict[str, Band](), dict[str, float]()
    for name in methods:
        began = core_seconds()
        bands[name] = METHODS[name](record, fitted)
        seconds[name] = core_seconds() - began
    return Comparison(record, bands, seconds)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("record", type=Path)
    parser.add_argument("--figure", type=Path)
    parser.add_argument("--methods", nargs="+", default=list(METHODS), choices=METHODS)
    arguments = parser.parse_args()
    compared = compare(bw.read_record(arguments.record), arguments.methods)
    print(json.dumps(compared.table, indent=1))
    if arguments.figure:
        compared.draw(arguments.figure)
