"""Specimens of a known population on the virtual stand, as small as a record can be."""

from pathlib import Path

import numpy as np

import bwbayes as bw
from bwbayes.app.config.config import parse
from bwbayes.app.study.resolve import resolve_config

# Medians and relative spreads of the population that specimens are drawn from.
POPULATION = {"d": (0.7, 0.05), "alpha": (0.3575, 0.08)}

# Three free parameters: a record takes less than a second.
MODEL = """\
[model]
dynamics = "none"
noise = "white"

[parameters]
initial = { fixed = 0.0 }
offset = { fixed = 0.0 }
beta = { fixed = 0.0272 }
gamma = { fixed = 0.0172 }
"""
CONFIG = (
    f"seed = 3\n[record]\n{MODEL}"
    + """\
d = { prior = { distribution = "lognormal", median = 0.7, sigma = 0.3 } }
alpha = { prior = { distribution = "lognormal", median = 0.35, sigma = 0.4 } }

[sampling]
ess = 200
walkers = 12
block = 20
pilot_steps = 60
"""
)

STAND = """\
seed = {seed}

[record]
signal = {{ amplitude = 100.0, frequency = 1.0, duration = 2.5, decay = 0.1 }}

[model]
dynamics = "none"

[stand]
sample_rate = 40.0
discrepancy = "none"

[stand.model]
dynamics = "none"

[stand.parameters]
d = {d!r}
alpha = {alpha!r}
"""


def truths(number: int) -> dict[str, float]:
    generator = np.random.default_rng([7, number])
    return {
        name: float(median * np.exp(spread * generator.standard_normal()))
        for name, (median, spread) in POPULATION.items()
    }


def record(number: int) -> bw.Record:
    config = parse(STAND.format(seed=number + 1, **truths(number)), "stand")
    return resolve_config(config, Path()).study.record


def specimens(folder: Path, count: int) -> None:
    folder.mkdir(parents=True)
    for number in range(count):
        bw.write_record(record(number), folder / f"s{number:03d}.csv")
