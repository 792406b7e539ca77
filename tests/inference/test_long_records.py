"""A million samples with 64 walkers fit into a laptop's memory, on either engine."""

from __future__ import annotations

import subprocess
import sys

import pytest

from bwbayes.inference.engine import Engine

SCRIPT = """
from pathlib import Path
from dataclasses import replace
import numpy as np
from bwbayes.sampling.ensemble import advance, start
from bwbayes.sampling.moves import pilot_moves
from bwbayes.inference.map_estimate import PointFit
from tests.inference.problems import short_posterior

posterior = replace(short_posterior(samples={samples}, dynamics="lag"), engine="{engine}")
generator = np.random.default_rng(1)
place = np.median(posterior.prior.unconstrain(posterior.prior.draw(generator, 500)), axis=0)
nearby = 1e-6 * np.eye(place.size)
point = PointFit(place, nearby, 0.0, place[np.newaxis], nearby)
begin = start(posterior, point, 0, 64, generator)
(block,) = advance(posterior, [pilot_moves()], [begin], 1)
assert np.isfinite(block.log_density).all()
# Not ru_maxrss, which a process takes over from the one that starts it.
status = dict(line.split(":", 1) for line in Path("/proc/self/status").read_text().splitlines())
print(status["VmHWM"].split()[0])
"""


def peak_kib(engine: Engine, samples: int) -> int:
    """Largest memory of a process that moves 64 walkers a step, KiB."""
    script = SCRIPT.format(engine=engine, samples=samples)
    done = subprocess.run(
        [sys.executable, "-c", script], capture_output=True, text=True, check=True
    )
    return int(done.stdout)


@pytest.mark.skipif(sys.platform != "linux", reason="reads Linux's /proc")
@pytest.mark.parametrize(
    ("engine", "samples"),
    [
        ("numba", 1_000_000),
        pytest.param("numpy", 1_000_000, marks=pytest.mark.slow),
        # The quick twin: NumPy's batches of models have the same size, of fewer samples each.
        ("numpy", 150_000),
    ],
)
def test_million_samples_take_less_than_a_gibibyte(engine: Engine, samples: int) -> None:
    assert peak_kib(engine, samples) < 2**20
