"""Spikes of any size are set aside, and the priors and the posterior are those without them.

The family: records of 60 to 20,000 readings of a decaying sine of ±20 to ±100 V on the stand, up to
one in fifty readings spoiled, by 10 sds of the noise to a million ranges, all alike or of different
sizes, also the last reading and neighbors. One sd is 1.6 um, what a good reading lies off by; a
spike of ten is missed, or a good reading set aside, less than once in 10,000. The first reading is
off by two ranges or more, and the second one is good: less is what an actuator in motion may do.
"""

import warnings
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest

from bwbayes.app.config.config import parse
from bwbayes.app.fit.fitted import Run
from bwbayes.app.study.resolve import resolve_config
from bwbayes.arrays import FloatArray, IntArray
from bwbayes.diagnosis.record_checks import inspect
from bwbayes.errors import InputWarning
from bwbayes.record import Record
from bwbayes.record.teststand import VirtualTestStand

# Sensor noise of 0.5 um and a discrepancy of 1.5 um.
NOISE = 1.6

# Part of its value, or of its sd, that a prior's argument may be off.
NEARLY = 0.05


class Spoiled(NamedTuple):
    """A good record, the same with spikes, and the samples and sizes (um) of these."""

    good: Record
    record: Record
    rows: IntArray
    sizes: FloatArray


def measured(samples: int, amplitude: float, rng: np.random.Generator) -> Record:
    time = np.arange(samples) * (8.0 / samples)
    voltage = amplitude * np.sin(2 * np.pi * 0.6 * time) * np.exp(-0.12 * time)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", InputWarning)
        return VirtualTestStand("process", samples / 8.0).run(voltage, rng)


def with_spikes(good: Record, rows: IntArray, sizes: FloatArray, signs: FloatArray) -> Spoiled:
    assert good.displacement is not None
    displacement = good.displacement.copy()
    displacement[rows] += sizes * signs
    return Spoiled(good, replace(good, displacement=displacement, truth=None), rows, sizes)


def of_the_family(seed: int, most: int) -> Spoiled:
    """Return a record of up to `most` readings with spikes of ten sds to 30 m."""
    rng = np.random.default_rng([7, seed])
    samples = int(np.exp(rng.uniform(np.log(60), np.log(most))))
    good = measured(samples, float(rng.choice([20.0, 60.0, 100.0])), rng)
    count = int(np.exp(rng.uniform(0, np.log(min(max(1, samples // 50), 20) + 0.999))))
    rows = np.sort(rng.choice(samples, count, replace=False))
    if rng.random() < 0.3:
        rows[-1] = samples - 1
    if count > 2 and rng.random() < 0.3:
        rows[2] = rows[1] + 1
    if rng.random() < 0.3:
        rows[0] = 0
    rows = np.unique(rows[rows != 1])
    sizes = np.exp(rng.uniform(np.log(10 * NOISE), np.log(3e7), rows.size))
    if rng.random() < 0.5:
        sizes[:] = sizes[0]
    sizes[rows == 0] += 3 * float(np.ptp(good.voltage))
    return with_spikes(good, rows, sizes, np.where(rng.random(rows.size) < 0.5, -1.0, 1.0))


def resolved(record: Record, model: str = "") -> Run:
    config = parse(f'[record]\nfile = "record.h5"\n[model]\n{model}\n', "my.toml")
    return resolve_config(config, Path(), {"record": record})


def set_aside(problem: Run) -> list[int]:
    return np.flatnonzero(np.isnan(problem.study.posterior.single_record.displacement)).tolist()


def prior_arguments(problem: Run) -> FloatArray:
    values: list[float] = []
    for parameter in problem.study.parameters:
        arguments = parameter.prior.arguments if parameter.prior else {}
        values += [v / arguments.get("sd", 1.0) for k, v in arguments.items() if k == "mean"]
        values += [v for k, v in arguments.items() if k != "mean"]
    return np.array(values)


def off(spoiled: Spoiled) -> str:
    problem = resolved(spoiled.record, "outliers = true")
    if set_aside(problem) != spoiled.rows.tolist():
        return f"{set_aside(problem)} for {spoiled.rows.tolist()}, {spoiled.sizes} um"
    if not any("set aside as isolated outlier" in remark for remark in problem.record_remarks):
        return "not said"
    without, clean = prior_arguments(problem), prior_arguments(resolved(spoiled.good))
    worst = float(np.max(np.abs(without - clean) / np.maximum(np.abs(clean), 1.0)))
    return f"priors off by {worst:.2g}" if worst > NEARLY else ""


@pytest.mark.parametrize("seed", range(10))
def test_exactly_the_spikes_are_set_aside(seed: int) -> None:
    assert "" == off(of_the_family(seed, 400))


@pytest.mark.slow
def test_exactly_the_spikes_are_set_aside_in_200_records() -> None:
    """Of up to 20,000 readings; one in a hundred may be off."""
    said = {seed: off(of_the_family(seed, 20_000)) for seed in range(1000, 1200)}
    assert sum(bool(text) for text in said.values()) <= 2, said


@pytest.mark.parametrize("size", [40.0, 1e9])
@pytest.mark.parametrize("row", [0, 1, 59])
def test_a_spike_of_a_small_record_is_seen_and_hides_nothing(row: int, size: float) -> None:
    """What is seen of the record is what is seen without it: no wrong unit, no other relation."""
    good = measured(60, 20.0, np.random.default_rng(2))
    spoiled = with_spikes(good, np.array([row]), np.array([size]), np.array([-1.0]))
    found, expected = inspect(spoiled.record), [one.kind for one in inspect(good)]
    assert [*expected, "spikes"] == [one.kind for one in found]
    assert found[-1].start == good.time[row]
    assert "outliers = true under [model]" == found[-1].fix
