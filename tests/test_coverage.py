"""Intervals and bands are right over many records of the stand, not on one lucky seed.

Each seed makes a record of the paper's identification signal and one of its verification signal,
fits the first, predicts the second. Over the seeds, the part of the parameters that their intervals
cover, and the part of the verification samples that the bands cover, must agree with the nominal
level within standard errors taken from the spread between seeds. With 12 seeds and a limit of 5
errors (t distribution, 11 degrees of freedom) one comparison is wrong by chance once in 2,500
times, and the 18 comparisons here once in 140. The twins show that bands and intervals of 0.4 times
the right width are found.

Without a discrepancy all that a displacement band can miss is the parameters' error, the same along
the whole record: most seeds then cover nearly all samples and some few only half, and twelve
without any of those show hardly a spread. Over 40 seeds the sd of a coverage p was 0.35 of
√(p (1 − p)); so there a spread below 0.3 of that is not believed.

These run at 100 Hz, and 40 seeds at 1000 Hz, all of them slow: that posteriors and bands are
calibrated at all is for the calibrations, in the default suite.
"""

from __future__ import annotations

import re
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from bwbayes.app.config.config import parse
from bwbayes.app.problem.problem import generator, resolve
from bwbayes.app.running.run import predictions
from bwbayes.app.running.workers import one_thread
from bwbayes.arrays import FloatArray
from bwbayes.inference import pointfit
from bwbayes.results.bands import LEVELS, Bands, Kind
from bwbayes.results.result import Result
from bwbayes.sampling.sampler import draws, first_chain, sample
from tests.measured import keep

CONFIG = Path(__file__).resolve().parents[1] / "runs" / "ring_bender.toml"
pytestmark = pytest.mark.slow

LIMIT = 5.0
LEAST_SPREAD = 0.3


@dataclass(frozen=True)
class Replicate:
    """What one seed gave: where the truth lies in each posterior, and the verification's bands."""

    discrepancy: str
    ranks: FloatArray
    bands: Bands


def replicate(seed: int, discrepancy: str, rate: float) -> Replicate:
    """Simulate, fit and predict, by the same path as a run."""
    text = CONFIG.read_text(encoding="utf-8").replace(
        'discrepancy = "process"', f'discrepancy = "{discrepancy}"\nsample_rate = {rate}'
    )
    config = parse(re.sub(r"ess = \d+", "ess = 500", text), "coverage")
    problem = resolve(config.model_copy(update={"seed": seed}), CONFIG.parent)
    posterior = problem.posterior
    with ThreadPoolExecutor(1) as executor, one_thread():
        point = pointfit.fit(posterior, generator(seed, "point fit"))
        chain = first_chain(posterior, point, problem.plan, generator(seed, "sampling"))
        outcome = sample(posterior, problem.plan, chain, executor)
        assert outcome.converged, outcome.stop_reason
        kept = draws(posterior, chain)
        result = Result("", outcome, problem.parameters, kept, chain.log_density("sampling"))
        bands = predictions(problem, result)[-1]
    # A stand without discrepancy has none to cover: its sd and time are no truths.
    truth = problem.config.truth
    ranks = [np.mean(kept[..., i] < truth[n]) for i, n in enumerate(posterior.names) if n in truth]
    return Replicate(discrepancy, np.array(ranks), bands)


@pytest.fixture(scope="module", params=["process", "none"])
def replicates(request: pytest.FixtureRequest) -> list[Replicate]:
    return [replicate(seed, request.param, 100.0) for seed in range(12)]


def errors_off(covered: FloatArray, level: int, least_spread: float = 0.0) -> float:
    """Distance of a mean coverage (seeds,) from its nominal level, in standard errors."""
    p = level / 100
    spread = max(np.std(covered, ddof=1), least_spread * (p * (1 - p)) ** 0.5)
    return float((np.mean(covered) - p) / (spread / covered.size**0.5))


def parameters_covered(
    replicates: list[Replicate], level: int, narrowed: float = 1.0
) -> FloatArray:
    """Part of the parameters (seeds,) whose central interval covers the truth.

    A narrowed interval keeps that part of the probability on either side of the median.
    """
    inside = [np.abs(r.ranks - 0.5) < narrowed * level / 200 for r in replicates]
    return np.array([np.mean(one) for one in inside])


def bands_cover(
    replicates: list[Replicate], kind: Kind, level: int, width: float = 1.0
) -> FloatArray:
    """Part of the judged samples (seeds,) that lie inside the verification's bands."""
    parts = []
    for bands in (r.bands for r in replicates):
        target = bands.measured if kind == "sensor" else bands.truth
        assert target is not None
        middle = (bands.upper[kind, level] + bands.lower[kind, level]) / 2
        half = (bands.upper[kind, level] - bands.lower[kind, level]) / 2
        inside = np.abs(target - middle) <= width * half
        parts.append(np.mean(inside[bands.scored_from :]))
    return np.array(parts)


def test_parameter_intervals_cover_the_truth(replicates: list[Replicate]) -> None:
    off = {level: errors_off(parameters_covered(replicates, level), level) for level in LEVELS}
    assert all(abs(value) < LIMIT for value in off.values()), off


@pytest.mark.parametrize("kind", ["sensor", "displacement"])
def test_bands_cover_the_verification_signal(replicates: list[Replicate], kind: Kind) -> None:
    alone = kind == "displacement" and replicates[0].discrepancy == "none"
    least = LEAST_SPREAD if alone else 0.0
    covered = {level: bands_cover(replicates, kind, level) for level in LEVELS}
    off = {level: errors_off(covered[level], level, least) for level in LEVELS}
    assert all(abs(value) < LIMIT for value in off.values()), off


def test_twin_intervals_that_are_too_narrow_are_found(replicates: list[Replicate]) -> None:
    off = {
        level: errors_off(parameters_covered(replicates, level, narrowed=0.4), level)
        for level in LEVELS
    }
    assert min(off.values()) < -LIMIT, off


@pytest.mark.parametrize("kind", ["sensor", "displacement"])
def test_twin_bands_that_are_too_narrow_are_found(replicates: list[Replicate], kind: Kind) -> None:
    off = {
        level: errors_off(bands_cover(replicates, kind, level, width=0.4), level)
        for level in LEVELS
    }
    assert min(off.values()) < -LIMIT, off


@pytest.mark.parametrize("discrepancy", ["process", "none"])
def test_forty_seeds_at_the_full_rate(discrepancy: str) -> None:
    """Three standard errors, with 40 seeds, at 1000 Hz."""
    seen = [replicate(seed, discrepancy, 1000.0) for seed in range(40)]
    covered, off = {}, {}
    for level in LEVELS:
        parts = {
            "parameters": parameters_covered(seen, level),
            "sensor": bands_cover(seen, "sensor", level),
            "displacement": bands_cover(seen, "displacement", level),
        }
        for name, part in parts.items():
            covered[f"{name} {level}"] = round(float(np.mean(part)), 4)
            off[f"{name} {level}"] = round(errors_off(part, level), 2)
    keep(f"coverage {discrepancy}", {"covered": covered, "errors_off": off})
    assert max(map(abs, off.values())) < 3, off
