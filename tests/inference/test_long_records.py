"""A million samples with 64 walkers fit into a laptop's memory, on either engine."""

import pytest

from bwbayes.inference.engine import Engine
from tests.memory import on_linux, peak

SCRIPT = """
from dataclasses import replace
import numpy as np
from bwbayes.sampling.ensemble import advance, start
from bwbayes.sampling.moves import pilot_moves
from bwbayes.inference.map_estimate import MAPEstimate
from tests.inference.problems import short_posterior

posterior = replace(short_posterior(samples={samples}, dynamics="lag"), engine="{engine}")
generator = np.random.default_rng(1)
place = np.median(posterior.prior.unconstrain(posterior.prior.draw(generator, 500)), axis=0)
nearby = 1e-6 * np.eye(place.size)
point = MAPEstimate(place, nearby, 0.0, place[np.newaxis], nearby)
begin = start(posterior, point, 0, 64, generator)
(block,) = advance(posterior, [begin], [pilot_moves()], 1)
assert np.isfinite(block.log_density).all()
"""


@on_linux
@pytest.mark.parametrize(
    ("engine", "samples"),
    [
        ("numba", 1_000_000),
        pytest.param("numpy", 1_000_000, marks=pytest.mark.slow),
        # The quick twin: NumPy's batches of models have the same size, of fewer samples each.
        ("numpy", 1 << 17),
    ],
)
def test_million_samples_take_less_than_a_gibibyte(engine: Engine, samples: int) -> None:
    """Of a process that moves 64 walkers a step."""
    assert peak(SCRIPT.format(engine=engine, samples=samples)) < 2**30
