"""Noise on the recorded voltage: parameters and the next record's bands are those of a clean one.

Simulated Bouc-Wen actuators, each driven from rest by a record to fit and by a multisine to
predict, whose voltages are read with white noise of 0.003 to 0.3% of their range, at 200 Hz to
4 kHz. The twin drives the model by the voltage as measured.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest

from bwbayes.arrays import FloatArray
from bwbayes.inference import map_estimate as pointfit
from bwbayes.inference.map_estimate import path_covariance, widen_draws
from bwbayes.inference.study import InitialConditions
from bwbayes.model.actuator import Actuator
from bwbayes.prediction.prediction import predict_record
from bwbayes.record import Record, write_record
from bwbayes.record.voltage_path import estimate_path
from tests.inference.problems import decaying_sine, short_posterior
from tests.measured import keep
from tests.prediction.runs import KEPT, covered, study_of, weighted_draws
from tests.record.drives import DRIVES, drive

TRUTH = {"d": 0.12, "alpha": 0.04, "beta": 0.028, "gamma": 0.009, "exponent": 1.0, "lag": 0.003}
SHAPE = ("d", "alpha", "beta", "gamma")
SENSOR, RANGE = 0.01, 90.0
CONFIG = (
    '[record]\nfile = "record.h5"\nfrom_rest = true\n[model]\ndynamics = "lag"\nhold = "first"\n'
)


@dataclass(frozen=True)
class Answer:
    """Errors of :data:`SHAPE` as parts of the truth and in sds; of the next record what it is."""

    error: FloatArray
    z: FloatArray
    coverage: float
    width: float

    def right(self, clean: "Answer") -> bool:
        """Whether it is what is asked for, beside that of the ``clean`` voltage.

        Largest errors: 2% of d, alpha and beta, 10% of gamma, or three sds; 88 to 99% of the next
        record covered, by bands that are at most 1.5 times as wide.
        """
        near = np.abs(self.error) < np.array([0.02, 0.02, 0.02, 0.1])
        known = np.all(near | (np.abs(self.z) < 3))
        return bool(known and 0.88 <= self.coverage <= 0.99 and self.width <= 1.5 * clean.width)


def records(kind: str, rate: float, seed: int) -> tuple[Record, Record]:
    rng = np.random.default_rng([91, seed])
    actuator = Actuator("lag", "first", 1 / rate)
    model = np.array([[TRUTH.get(name, 0.0) for name in actuator.parameters]])
    made = []
    for shape, extent in ((kind, RANGE), ("multisine", 0.95 * RANGE)):
        driven = 5 + extent * drive(shape, rate, rng)
        voltage = np.concatenate([np.linspace(0, driven[0], round(rate / 2)), driven])
        reading = actuator.displacement(model, voltage)[0]
        reading = reading + SENSOR * rng.standard_normal(voltage.size)
        made.append(Record(voltage, reading, interval=1 / rate))
    return made[0], made[1]


def noisy(record: Record, part: float, seed: int) -> Record:
    noise = part * RANGE * np.random.default_rng([92, seed]).standard_normal(record.samples)
    return replace(record, voltage=record.voltage + noise)


def answer(fitted: Record, other: Record, folder: Path) -> Answer:
    """Fit a record as a run does it, and predict the other one."""
    write_record(fitted, folder / "record.h5")
    study = study_of(CONFIG, folder)
    posterior, source = study.posterior, np.random.default_rng(5)
    point = pointfit.fit(posterior, source)
    draws, weights = weighted_draws(posterior, source, point)
    draws = draws[source.choice(len(draws), 8 * KEPT, p=weights)]
    more = path_covariance(posterior, {"record": study.record.path}, point, source)
    wide = widen_draws(posterior.prior.unconstrain(draws), point.covariance, more)
    draws, _ = posterior.prior.constrain(wide)
    shape = draws[:, [posterior.names.index(name) for name in SHAPE]]
    truth = np.array([TRUTH[name] for name in SHAPE])
    off = np.mean(shape, axis=0) - truth
    start = InitialConditions(from_rest=True, hold="first")
    bands = predict_record(posterior, draws[::8], other, start, source)
    width = float(np.mean(bands.upper["sensor", 95] - bands.lower["sensor", 95]))
    return Answer(off / truth, off / np.std(shape, axis=0), covered(bands), width)


def summary(answers: Mapping[str, Answer], clean: Mapping[str, Answer]) -> dict[str, object]:
    """Return the figures of one size of noise, of answers by their cells."""
    widths = [answers[cell].width / clean[cell].width for cell in answers]
    error = np.array([found.error for found in answers.values()])
    z = np.array([found.z for found in answers.values()])
    coverage = [found.coverage for found in answers.values()]
    return {
        "cells": len(answers),
        "wrong": sorted(cell for cell, found in answers.items() if not found.right(clean[cell])),
        "largest error": dict(zip(SHAPE, np.abs(error).max(axis=0).tolist(), strict=True)),
        "rms z": dict(zip(SHAPE, np.sqrt(np.mean(z**2, axis=0)).tolist(), strict=True)),
        "coverage": [min(coverage), float(np.mean(coverage)), max(coverage)],
        "width": [float(np.median(widths)), max(widths)],
    }


@pytest.mark.slow
def test_noise_on_the_voltage_changes_no_answer(tmp_path: Path) -> None:
    """All is as asked in 55 of 60 cells.

    By chance, of 60 right answers about one has a parameter three sds away, and two cover more or
    less than asked, as parameters' errors are common to all readings of a record. At 200 Hz and
    0.3% two of five bands are 1.7 times as wide: what is unsure of the path is worth as much there
    as the sensor's noise.
    """
    parts = (3e-5, 3e-4, 1e-3, 3e-3)
    clean: dict[str, Answer] = {}
    found: dict[float, dict[str, Answer]] = {part: {} for part in parts}
    for number, kind in enumerate(DRIVES):
        for rate in (200.0, 1000.0, 4000.0):
            seed = 140 + number
            fitted, other = records(kind, rate, seed)
            cell = f"{kind} at {rate:g} Hz"
            clean[cell] = answer(fitted, other, tmp_path)
            for part in parts:
                measured = noisy(fitted, part, seed), noisy(other, part, seed + 500)
                found[part][cell] = answer(*measured, tmp_path)
    figures = {f"{100 * part:g}%": summary(answers, clean) for part, answers in found.items()}
    keep("noise on the voltage", {"clean": summary(clean, clean), **figures})
    wrong = [
        f"{part:g} {cell}"
        for part, answers in found.items()
        for cell, one in answers.items()
        if not one.right(clean[cell])
    ]
    assert len(wrong) <= 5, wrong


def test_one_noisy_record_is_right_and_as_measured_it_is_not(tmp_path: Path) -> None:
    """The twin says that a command, which has no noise, was measured: its gamma is far off."""
    fitted, other = records("decaying sine", 400.0, 1)
    clean = answer(fitted, other, tmp_path)
    fitted, other = noisy(fitted, 1e-3, 1), noisy(other, 1e-3, 1)
    assert answer(fitted, other, tmp_path).right(clean)
    raw = [replace(record, voltage_is="command") for record in (fitted, other)]
    assert not answer(raw[0], raw[1], tmp_path).right(clean)


# Uncertainty of the parameters from an estimated voltage, against fits along other estimates


def test_newton_steps_are_what_fits_along_other_paths_move(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(pointfit, "COPIES", 4)
    rng = np.random.default_rng(2)
    posterior = short_posterior(samples=1500, noise="white")
    path = estimate_path(decaying_sine(1500) + 0.3 * rng.standard_normal(1500))
    assert path.noise_sd == pytest.approx(0.3, rel=0.1)
    posterior = posterior.altered(voltage=path.voltage)
    point = pointfit.fit(posterior, rng)
    covariance = path_covariance(posterior, {"record": path}, point, np.random.default_rng(1))
    again = np.random.default_rng(1)
    moved = np.stack(
        [
            pointfit.fit(posterior.altered(voltage=path.redrawn(again)), rng).mode - point.mode
            for _ in range(4)
        ]
    )
    physical = [name in posterior.table.physical for name in posterior.names]
    expected = np.sqrt(np.mean(moved**2, axis=0))[physical]
    found = np.sqrt(np.diag(covariance))
    np.testing.assert_allclose(found[physical], expected, rtol=0.2)
    assert not found[np.logical_not(physical)].any()
    # A path without noise is known.
    known = {"record": replace(path, noise_sd=0.0)}
    assert not path_covariance(posterior, known, point, again).any()


def test_draws_are_as_much_wider_as_is_said() -> None:
    rng = np.random.default_rng(0)
    square = rng.standard_normal((2, 3, 3))
    covariance, more = square @ np.swapaxes(square, 1, 2)
    draws = rng.multivariate_normal(np.ones(3), covariance, size=(50, 4, 500))
    wide = widen_draws(draws, covariance, more)
    flat = wide.reshape(-1, 3)
    np.testing.assert_allclose(flat.mean(axis=0), draws.mean(axis=(0, 1, 2)))
    np.testing.assert_allclose(np.cov(flat.T), covariance + more, rtol=0.05, atol=0.05)
    np.testing.assert_allclose(widen_draws(draws, covariance, 0 * more), draws)
