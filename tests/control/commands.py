"""Fitted problems to compensate with, and what becomes of commands that are played."""

import re
from collections.abc import Callable, Iterable, Mapping
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from bwbayes.app.config.config import parse
from bwbayes.app.config.keywords import config_of
from bwbayes.app.fit.fitted import Run
from bwbayes.app.study.resolve import resolve_config
from bwbayes.arrays import FloatArray
from bwbayes.control.compensation import Compensation, compensate
from bwbayes.control.references import Reference
from bwbayes.diagnosis.validation import ValidationSummary
from bwbayes.inference.noise import noise_model
from bwbayes.model.inputs import Limits
from bwbayes.prediction.bands import LEVELS
from bwbayes.prediction.prediction import thin_draws
from bwbayes.record.record import Record
from bwbayes.record.teststand import LaserSensor, VirtualTestStand
from bwbayes.record.waveforms import signal
from bwbayes.sampling.chain import draws
from tests.measured import keep
from tests.sampled import sampled

CONFIG = Path(__file__).resolve().parents[2] / "runs" / "ring_bender.toml"
LIMITS = Limits(-100.0, 100.0)

# The stand whose voltage is measured: sds, um, time, s, and the rate at which it moves, Hz.
SENSOR, DISCREPANCY, TIME, FAST = 0.1, 0.3, 0.5, 10_000.0


def fit_of(problem: Run, flat: FloatArray) -> Run:
    """Return a fit with draws (draws, free) that come from no chain."""
    return problem.with_cache(flat_draws=flat, standing=ValidationSummary())


@cache
def problem(discrepancy: str = "process", rate: float = 100.0, seed: int = 1) -> Run:
    """Return that of the ring bender with the command for a voltage."""
    text = CONFIG.read_text(encoding="utf-8").replace(
        'discrepancy = "process"', f'discrepancy = "{discrepancy}"\nsample_rate = {rate}'
    )
    config = parse(re.sub(r"ess = \d+", "ess = 500", text), "compensation")
    return resolve_config(config.model_copy(update={"seed": seed}), CONFIG.parent)


def measured_voltage(rate: float, seed: int = 1) -> Run:
    """Return that of a ring bender whose amplifier's output is measured at a rate, Hz.

    The amplifier moves as fast as it can, whatever the rate, and the discrepancy is small.
    """
    source, every = np.random.default_rng(seed), round(FAST / rate)
    stand = VirtualTestStand("none", FAST, sensor=LaserSensor(sd=SENSOR, span=200.0))
    run = stand.run(signal("identification"), source)
    assert run.truth is not None
    moved = run.truth[::every] + discrepancy(run.truth[::every].size, 1 / rate, source)
    reading = moved + SENSOR * source.standard_normal(moved.size)
    voltage = stand.amplifier.output(run.voltage, 1 / FAST)[::every]
    truth = stand.parameters() | {"discrepancy_sd": DISCREPANCY, "discrepancy_time": TIME}
    keys: dict[str, Any] = {
        "dynamics": "second-order",
        "from_rest": True,
        "parameters": {name: {"fixed": truth[name]} for name in ("mass", "stiffness")},
        "truth": truth,
        "ess": 500,
        "seed": seed,
    }
    config, records = config_of(Record(voltage, reading, interval=1 / rate), keys)
    return resolve_config(config, Path(), records)


def discrepancy(samples: int, interval: float, source: np.random.Generator) -> FloatArray:
    """Draw that of the stand whose voltage is measured, (samples,), um."""
    noise = noise_model("discrepancy", interval)
    return noise.draw(np.array([[0.0, DISCREPANCY, TIME]]), samples, source)[0]


def drawn(of: Run) -> FloatArray:
    """Fit a problem, and return a thousand draws (draws, free)."""
    outcome, chain = sampled(of.study.posterior, of.plan, of.study.seed)
    assert outcome.converged, outcome.stop_reason
    flat = draws(of.study.posterior, chain).reshape(-1, len(of.study.posterior.names))
    return thin_draws(flat, of.study.generator("draws"))


def about(of: Run, spread: float, count: int, source: np.random.Generator) -> FloatArray:
    """Return draws (draws, free) about the truth, each parameter with this relative sd."""
    truth = of.config.truth
    known = np.array([truth.get(name, 0.5) for name in of.study.posterior.names])
    scale = np.where(known == 0.0, 1.0, known)
    return known + spread * scale * source.standard_normal((count, known.size))


def compensated(of: Run, asked: Reference, flat: FloatArray, **options: Any) -> Compensation:
    options = {"from_rest": True, "limits": LIMITS, **options}
    return compensate(of.study.posterior, flat, asked, np.random.default_rng(7), **options)


def promised(
    of: Run,
    command: Compensation,
    truths: FloatArray,
    source: np.random.Generator,
    before: Callable[[], FloatArray] = lambda: np.empty(0),
    judged: slice = slice(None),
) -> dict[tuple[str, int], float]:
    """Return the part of truths (truths, free) whose errors are where the command says.

    Each plays the command by a DAC, which holds it, after another voltage, and has a sample at
    which it is judged.
    """
    record = of.study.posterior.single_record
    theta = of.study.posterior.prior.theta(truths)
    actuator = replace(record.actuator, interval=command.reference.interval, hold="zero")
    noise = record.noise.at(command.reference.interval)
    samples = np.arange(command.voltage.size)[judged]
    held: dict[tuple[str, int], list[float]] = {}
    for row in theta[:, np.newaxis]:
        lead = before()
        voltage = np.concatenate([lead, command.voltage])
        moved = actuator.displacement(record.table.actuator(row), voltage, from_rest=True)[0]
        # Displacements count from where the actuator stands at zero volts, where it begins.
        moved = moved[lead.size :] - moved[lead.size]
        truth = moved + noise.draw(record.table.noise(row), moved.size, source)[0]
        # One sample of each truth: its samples are not independent.
        for key, part in inside(command, truth, source.choice(samples, 1)).items():
            held.setdefault(key, []).append(part)
    return {key: float(np.mean(values)) for key, values in held.items()}


def played(
    asked: Reference, voltage: FloatArray, discrepancy: Any = "none", seed: int = 1
) -> FloatArray:
    """Return the true displacement (samples,) of the stand that holds a command, um."""
    stand = VirtualTestStand(discrepancy, 1 / asked.interval)
    truth = stand.run(voltage, np.random.default_rng(seed)).truth
    assert truth is not None
    return truth


def inside(
    command: Compensation, truth: FloatArray, at: Any = slice(None)
) -> dict[tuple[str, int], float]:
    """Return the part of a displacement's samples inside the bands, and whether its rms error is.

    ``at`` are the samples that count for the bands.
    """
    held = {}
    for level in LEVELS:
        bands = command.compensated.bands
        low, high = (edge["displacement", level][at] for edge in (bands.lower, bands.upper))
        held["band", level] = float(np.mean((low <= truth[at]) & (truth[at] <= high)))
        least, most = command.summary["compensated"]["rms_um"][str(level)]
        held["rms", level] = float(least <= rms(truth - command.asked) <= most)
    return held


def off(held: dict[tuple[str, int], float], count: int) -> dict[tuple[str, int], float]:
    """Return by how many standard errors the parts are off."""
    return {
        (kind, level): (part - level / 100) / np.sqrt(level / 100 * (1 - level / 100) / count)
        for (kind, level), part in held.items()
    }


def study(name: str, parts: Iterable[Mapping[tuple[str, int], float]]) -> dict[str, list[float]]:
    """Keep, and return, what fits' commands held: the mean, and its standard errors off nominal."""
    rows = list(parts)
    figures = {}
    for kind, level in rows[0]:
        values = np.array([row[kind, level] for row in rows])
        p, spread = level / 100, np.std(values, ddof=1)
        if set(values) <= {0.0, 1.0}:
            spread = np.sqrt(p * (1 - p))
        off = (np.mean(values) - p) / spread * values.size**0.5
        figures[f"{kind} {level}"] = [float(np.mean(values)), float(off)]
    keep(name, figures)
    return figures


def rms(error: FloatArray) -> float:
    return float(np.sqrt(np.mean(error**2)))
