"""Populations whose truth is known: drawn, with specimens and their posteriors drawn too."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import stats

from bwbayes.arrays import FloatArray
from bwbayes.population.specimen import Specimen

SPECIMENS = 8
NAME = "gain"


@dataclass(frozen=True)
class Drawn:
    """A population N(mean, spread²), its specimens' ``truths`` and what is known of each."""

    mean: float
    spread: float
    truths: FloatArray
    specimens: list[Specimen]


def normal_specimen(
    name: str, measured: float, sd: float, generator: np.random.Generator, draws: int = 1000
) -> Specimen:
    """Return a specimen with the likelihood N(measured; y, sd²) under the prior N(0, 1)."""
    precision = 1 / sd**2 + 1
    y = measured / sd**2 / precision + generator.standard_normal(draws) / np.sqrt(precision)
    return Specimen(
        name,
        (NAME,),
        ("um/V",),
        np.array([False]),
        y[:, np.newaxis],
        stats.norm.logpdf(y)[:, np.newaxis],
        np.zeros(1),
        np.ones(1),
    )


def drawn(
    generator: np.random.Generator, mean: float | None = None, spread: float | None = None
) -> Drawn:
    """Draw a population from its prior, unless it is given, and specimens of it."""
    mean = float(generator.standard_normal()) if mean is None else mean
    spread = abs(float(generator.standard_normal())) if spread is None else spread
    truths = mean + spread * generator.standard_normal(SPECIMENS)
    errors = generator.uniform(0.02, 0.2, SPECIMENS)
    measured = truths + errors * generator.standard_normal(SPECIMENS)
    each = zip(measured, errors, strict=True)
    specimens = [normal_specimen(f"s{i}", m, s, generator) for i, (m, s) in enumerate(each)]
    return Drawn(mean, spread, truths, specimens)


def covered(draws: FloatArray, truth: float) -> bool:
    """Tell whether the central 95 % interval of draws holds the truth."""
    lower, upper = np.quantile(draws, [0.025, 0.975])
    return bool(lower < truth < upper)
