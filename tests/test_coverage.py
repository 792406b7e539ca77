"""Intervals and bands are right over many records of the stand, not on one lucky seed.

Each seed makes a record of the paper's identification signal and one of its verification signal,
at 1000 Hz, fits the first, predicts the second. Over 40 seeds, the part of the parameters that
their intervals cover, and the part of the verification samples that the bands cover, must agree
with the nominal level within three standard errors taken from the spread between seeds. The twin
shows that bands and intervals of 0.4 times the right width are found.
"""

import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from scipy import stats

from bwbayes.app.config.config import parse
from bwbayes.app.jobs.predict import predictions
from bwbayes.app.study.resolve import resolve_config
from bwbayes.arrays import FloatArray
from bwbayes.prediction.bands import LEVELS, Bands, Kind
from bwbayes.sampling.chain import draws
from tests.measured import keep
from tests.prediction.runs import no_rivals
from tests.sampled import sampled

CONFIG = Path(__file__).resolve().parents[1] / "runs" / "ring_bender.toml"
pytestmark = pytest.mark.slow

LIMIT = 3.0


@dataclass(frozen=True)
class Replicate:
    """Result of one seed: where the truth lies in each posterior, and the verification's bands."""

    ranks: FloatArray
    bands: Bands


def replicate(seed: int, discrepancy: str) -> Replicate:
    text = CONFIG.read_text(encoding="utf-8").replace(
        'discrepancy = "process"', f'discrepancy = "{discrepancy}"'
    )
    config = parse(re.sub(r"ess = \d+", "ess = 500", text), "coverage")
    problem = resolve_config(config.model_copy(update={"seed": seed}), CONFIG.parent)
    posterior = problem.study.posterior
    outcome, chain = sampled(posterior, problem.plan, seed)
    assert outcome.converged, outcome.stop_reason
    kept = draws(posterior, chain)
    run = problem.with_cache(flat_draws=kept.reshape(-1, kept.shape[-1]), widening_rivals=no_rivals)
    bands = predictions(run)[-1]
    # A stand without discrepancy has none to cover: its sd and time are no truths.
    truth = problem.config.truth
    ranks = [np.mean(kept[..., i] < truth[n]) for i, n in enumerate(posterior.names) if n in truth]
    return Replicate(np.array(ranks), bands)


def errors_off(covered: FloatArray, level: int) -> float:
    """Distance of a mean coverage (seeds,) from its nominal level, in standard errors."""
    return float((np.mean(covered) - level / 100) / stats.sem(covered))


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


@pytest.mark.parametrize("discrepancy", ["process", "none"])
def test_intervals_and_bands_cover_over_forty_seeds(discrepancy: str) -> None:
    seeds = [replicate(seed, discrepancy) for seed in range(40)]
    covered, off, narrowed = {}, {}, []
    for level in LEVELS:
        fractions = {"parameters": parameters_covered(seeds, level)}
        fractions |= {kind: bands_cover(seeds, kind, level) for kind in ("sensor", "displacement")}
        for name, fraction in fractions.items():
            covered[f"{name} {level}"] = round(float(np.mean(fraction)), 4)
            off[f"{name} {level}"] = round(errors_off(fraction, level), 2)
        narrowed.append(errors_off(parameters_covered(seeds, level, 0.4), level))
        narrowed.append(errors_off(bands_cover(seeds, "sensor", level, 0.4), level))
    keep(f"coverage {discrepancy}", {"covered": covered, "errors_off": off})
    assert max(map(abs, off.values())) < LIMIT, off
    # The twin.
    assert max(narrowed) < -LIMIT, narrowed
