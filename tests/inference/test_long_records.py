"""A million samples with 64 walkers fit into a laptop's memory, on either engine."""

from __future__ import annotations

import subprocess
import sys

import pytest

from bwbayes.inference.engine import Engine

SCRIPT = """
import resource
from dataclasses import replace
import numpy as np
from bwbayes.inference.ensemble import advance, start
from bwbayes.inference.moves import pilot_moves
from bwbayes.inference.pointfit import PointFit
from tests.inference.problems import short_posterior

posterior = replace(short_posterior(samples={samples}, dynamics="lag"), engine="{engine}")
generator = np.random.default_rng(1)
place = np.median(posterior.prior.unconstrain(posterior.prior.draw(generator, 500)), axis=0)
nearby = 1e-6 * np.eye(place.size)
point = PointFit(place, nearby, 0.0, place[np.newaxis], nearby)
begin = start(posterior, point, 0, 64, generator)
block = advance(posterior, pilot_moves(), begin, 1)
assert np.isfinite(block.log_density).all()
print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss)
"""


def peak_kib(engine: Engine, samples: int) -> int:
    """Largest memory of a process that moves 64 walkers a step, KiB."""
    script = SCRIPT.format(engine=engine, samples=samples)
    done = subprocess.run(
        [sys.executable, "-c", script], capture_output=True, text=True, check=True
    )
    return int(done.stdout)


@pytest.mark.skipif(sys.platform != "linux", reason="the unit of ru_maxrss is Linux's")
@pytest.mark.parametrize("engine", ["numpy", "numba"])
def test_million_samples_take_less_than_a_gibibyte(engine: Engine) -> None:
    assert peak_kib(engine, 1_000_000) < 2**20
