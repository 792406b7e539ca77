"""A chain of the default budget is judged, stored and read within a laptop's memory."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from bwbayes.arrays import FloatArray
from bwbayes.sampling import chain as chains
from bwbayes.sampling.chain import draws, log_densities, thinning
from bwbayes.sampling.diagnostics import check
from tests.memory import on_linux, peak
from tests.sampling.samplings import PLAN, POSTERIOR, run

# Ten parameters, the default's 64 walkers; ensembles that disagree, so that all checks are made.
SCRIPT = """
import sys
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
import numpy as np
from bwbayes.sampling.storage import ChainFile
from bwbayes.sampling.chain import Block, draws, log_densities
from bwbayes.sampling.proposals import StudentMixture
from bwbayes.sampling.plan import SamplingPlan
from bwbayes.sampling.sampler import init_chain, sample
from tests.sampling.targets import gaussian

posterior, point = gaussian(10)
plan = SamplingPlan(walkers=64, max_steps=int(sys.argv[2]))
generator = np.random.default_rng(1)
chain = init_chain(posterior, point, plan, generator)
mixture = StudentMixture.fitted(generator.standard_normal((2000, 10)))
path = Path(sys.argv[1])
moved, moves = np.full(64, 20), {"mixture": (20, 20)}
file = ChainFile.create(path, chain, point, plan.block, {})
file.freeze("sampling", mixture)
for phase, blocks in (("pilot", 60), ("tuning", 2), ("sampling", plan.max_steps // 50)):
    for _ in range(blocks):
        places = generator.standard_normal((4, 50, 64, 10)) + np.arange(4.0).reshape(4, 1, 1, 1)
        density = -0.5 * np.sum(places**2, axis=-1)
        ends = [replace(s, coordinates=p[-1], log_density=d[-1])
                for s, p, d in zip(chain.starts, places, density)]
        file.append(phase, [Block(*each, moved, moves, end)
                            for *each, end in zip(places, density, ends)])
del file
again = ChainFile.resume(path)
with ThreadPoolExecutor(1) as executor:
    outcome = sample(posterior, plan, again, executor)
assert not outcome.converged
assert outcome.check.steps == plan.max_steps == again.steps("sampling")
kept = draws(posterior, again)
assert kept.shape[:3] == log_densities(again).shape
"""


@on_linux
@pytest.mark.parametrize(
    ("steps", "mebibytes"), [(4_000, 768), pytest.param(20_000, 1024, marks=pytest.mark.slow)]
)
def test_the_default_budget_takes_less_than_a_gibibyte(
    tmp_path: Path, steps: int, mebibytes: int
) -> None:
    """The whole of it is slow; a fifth of it, as a quick twin, three quarters of that memory."""
    assert peak(SCRIPT, tmp_path / "chain", steps) < 2**20 * mebibytes


def test_a_long_chain_is_judged_by_every_so_many_steps(monkeypatch: pytest.MonkeyPatch) -> None:
    """As its steps counted from one are, however often it was thinned on the way; and says so."""
    plan, most = replace(PLAN, ess=200), 800
    monkeypatch.setattr(chains, "MOST_DRAWS", most)
    chain, outcome = run(plan)
    assert outcome.check.steps == chain.steps("sampling")
    thin = thinning(chain.draws("sampling"), most)
    assert thin > 2
    steps = np.arange(1, chain.steps("sampling") + 1)
    kept: FloatArray = chain.coordinates("sampling")[steps % thin == 0]
    np.testing.assert_array_equal(kept, draws(POSTERIOR, chain))
    density = chain.log_density("sampling")[steps % thin == 0]
    np.testing.assert_array_equal(density, log_densities(chain))
    expected = check(kept, chain.accepted("sampling"), plan.block, thin)
    for name in ("rhat", "ess_bulk", "ess_tail", "ess_mean", "autocorrelation", "stuck"):
        np.testing.assert_array_equal(getattr(expected, name), getattr(outcome.check, name))
    assert f"one in {thin} is reported" in outcome.remarks[-1]
