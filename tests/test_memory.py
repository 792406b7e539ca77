"""Long records and long chains fit into a laptop's memory, each in a process of its own."""

import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from bwbayes.arrays import FloatArray
from bwbayes.inference import Engine
from bwbayes.sampling import chain as chains
from bwbayes.sampling.chain import draws, log_densities, thinning
from bwbayes.sampling.diagnostics import check
from tests.measured import keep
from tests.sampling.samplings import PLAN, POSTERIOR, run

on_linux = pytest.mark.skipif(sys.platform != "linux", reason="reads Linux's /proc")

# This is not ru_maxrss, which a process takes over from the one that starts it.
LARGEST = """
from pathlib import Path
status = dict(line.split(":", 1) for line in Path("/proc/self/status").read_text().splitlines())
print(status["VmHWM"].split()[0])
"""


def peak(script: str, *arguments: object) -> int:
    done = subprocess.run(
        [sys.executable, "-c", script + LARGEST, *map(str, arguments)],
        stdout=subprocess.PIPE,
        text=True,
        check=True,
    )
    return 1024 * int(done.stdout.split()[-1])


# All that a run does: point fit, sampling, bands, scores, replicated records, figures, report.
WHOLE_FIT = """
import warnings
from pathlib import Path
from tempfile import TemporaryDirectory
import numpy as np
import bwbayes as bw

samples, keys = {samples}, {keys}
time = np.arange(samples) / 1000
decay = 1 - 0.9 * np.arange(samples) / samples
stand = bw.VirtualTestStand()
record = stand.run(100 * np.sin(2 * np.pi * time) * decay, np.random.default_rng(1))
warnings.simplefilter("ignore")
with TemporaryDirectory() as folder:
    run = Path(folder) / "run"
    edge = 0.75 * samples / 1000
    fit = bw.fit(
        record, folder=run, progress=False, workers=2, from_rest=True, train=(0, edge),
        validation={{"later": (edge, samples / 1000)}}, **keys,
    )
    assert fit.converged, fit.outcome.stop_reason
    assert fit.chain.ends[0].coordinates.shape[0] == 64
    assert (run / "report.html").is_file() and (run / "bands.csv").stat().st_size > 100 * samples
"""


@pytest.mark.slow
@on_linux
def test_whole_fit_of_million_samples_takes_two_gibibytes() -> None:
    """To convergence with 400 effective draws: more of them take longer, not more memory."""
    keys = {"dynamics": "lag", "ess": 400}
    whole = peak(WHOLE_FIT.format(samples=1_000_000, keys=keys)) / 2**30
    keep("long fit", {"gib": whole})
    assert whole <= 2


# A million samples with 64 walkers fit into a laptop's memory, on either engine


ONE_STEP = """
from dataclasses import replace
import numpy as np
from bwbayes.sampling.moves import advance, pilot_moves, start
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
        ("numpy", 1 << 16),
    ],
)
def test_million_samples_take_less_than_a_gibibyte(engine: Engine, samples: int) -> None:
    """The peak of a process that moves 64 walkers a step."""
    assert peak(ONE_STEP.format(engine=engine, samples=samples)) < 2**30


# A chain of the default budget is judged, stored and read within a laptop's memory


# Ten parameters, the default's 64 walkers; ensembles that disagree, so that all checks are made.
LONG_CHAIN = """
import sys
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
import numpy as np
from bwbayes.sampling.chain import Block, ChainFile, draws, log_densities
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
    assert peak(LONG_CHAIN, tmp_path / "chain", steps) < 2**20 * mebibytes


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
