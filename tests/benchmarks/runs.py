"""How fast effective draws come: emcee's defaults, its stretch move, and a whole run of ours.

A run of ours is timed as it is: MAP estimate, pilot, tuning and sampling until it has converged
with the effective draws asked for. The stretch move is given a start that is finished, draws of our
chain, and no burn-in. Its effective draws per step do not depend on what computes the density:
they are counted once, on the compiled engine, and divided by what a step costs on each engine and
on the stock path.

Effective draws are the smaller of bulk and tail of the slowest parameter. Ours are what a run
reports, never more than its ensembles' means are worth. For the stretch move that cap is left out:
it takes a long chain to be known, and without it there are more.
"""

# mypy: allow-untyped-calls
# arviz_stats says that it has types, but its functions have none.

import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from arviz_stats.base import array_stats  # not in an __all__
from emcee.moves import StretchMove

from bwbayes.app.config.config import load
from bwbayes.app.fit.fitted import Run
from bwbayes.app.jobs.calibrate import experiment
from bwbayes.app.running.workers import open_executor
from bwbayes.app.study.resolve import resolve_config
from bwbayes.calibration.calibration import replicate
from bwbayes.inference import map_estimate
from bwbayes.inference.posterior import Posterior
from bwbayes.inference.study import generator
from bwbayes.sampling.chain import Block, Chain, EnsembleState, Phase
from bwbayes.sampling.diagnostics import ConvergenceDiagnostics, SamplingResult, as_chains
from bwbayes.sampling.moves import advance, sampling_moves
from bwbayes.sampling.sampler import init_chain, sample
from tests.benchmarks.measuring import ROOT, Call, Cell, Table, interleaved, timed
from tests.benchmarks.models import MODELS, by_engine, paper_record, speed_up

PARTS = ("point fit", "pilot", "tuning", "sampling", "checks")


@dataclass(frozen=True)
class OurRun:
    """A run of ours: its chain and outcome, and the seconds that each part of it took."""

    chain: Chain
    outcome: SamplingResult
    seconds: dict[str, float]

    @property
    def ess(self) -> float:
        """Effective draws, bulk and tail, of the slowest parameter."""
        return float(np.min([self.outcome.check.ess_bulk, self.outcome.check.ess_tail]))


def our_run(problem: Run) -> OurRun:
    """Fit, start and sample as a run does, with two workers."""
    posterior, seed = problem.study.posterior, problem.config.seed
    seconds = dict.fromkeys(PARTS, 0.0)
    last = time.perf_counter()

    def passed(part: str) -> None:
        nonlocal last
        now = time.perf_counter()
        seconds[part] += now - last
        last = now

    def watcher(phase: Phase, check: ConvergenceDiagnostics | None) -> None:
        passed(phase if check is None else "checks")

    point = map_estimate.fit(posterior, generator(seed, "point fit"))
    chain = init_chain(posterior, point, problem.plan, generator(seed, "sampling"))
    passed("point fit")
    with open_executor(2, posterior.engine) as pool:
        outcome = sample(posterior, problem.plan, chain, pool, watcher)
    return OurRun(chain, outcome, seconds)


def stretched(posterior: Posterior, state: EnsembleState, steps: int) -> Block:
    return advance(posterior, [state], [{"stretch": (StretchMove(), 1.0)}], steps)[0]


def sampling(rounds: int, steps: int) -> Iterator[tuple[str, Table]]:
    """Measure whole runs and the stretch move of so many steps, and the ratios between them."""
    paper = paper_record()
    posterior = paper.study.posterior
    # The first call on the compiled engine and a first run to start from are not timed.
    first = our_run(paper)
    draws = first.chain.coordinates("sampling").reshape(-1, posterior.prior.dimensions)
    chosen = np.random.default_rng(1).choice(len(draws), MODELS, replace=False)
    density = posterior.log_density(draws[chosen])
    state = replace(first.chain.ends[0], coordinates=draws[chosen], log_density=density)
    runs: list[OurRun] = []
    calls: dict[str, Call] = {
        name: partial(stretched, one, state, 1) for name, one in by_engine(posterior).items()
    }
    calls["ours"] = lambda: runs.append(our_run(paper))
    cost = interleaved(calls, max(rounds // 2, 1))
    a_step = draws_per_step(posterior, state, steps)
    rates = {name: a_step / one.wall for name, one in cost.items()}
    rates["ours"] = runs[-1].ess / cost["ours"].wall
    note = (
        "effective draws, slowest parameter; ours with point fit, pilot and tuning, emcee's "
        "stretch move from the posterior on, by engine; stock: a loop over the samples"
    )
    rows: list[dict[str, Cell]] = [
        {"moves": name, "draws/s": rate, "ours, times": rates["ours"] / rate}
        for name, rate in rates.items()
    ]
    yield "draws", Table("Effective draws per second, the paper's record", note, rows)
    row: dict[str, Cell] = {"ESS": runs[-1].ess, "steps": runs[-1].chain.steps("sampling")}
    row |= {"s": cost["ours"].wall, "core s": cost["ours"].cpu, **runs[-1].seconds}
    note = "best of several, s, with two workers; the parts are those of the last run, s"
    yield "run", Table("A run of ours, from the point fit to convergence", note, [row])
    # Each call has moves of its own.
    proposal, end = first.chain.proposal_in_use("sampling"), first.chain.ends[0]
    yield (
        "ensembles",
        speed_up(
            lambda: advance(posterior, [end], [sampling_moves(proposal)], 20),
            rounds,
            "Two ensembles, 20 steps of ours, compiled engine",
        ),
    )


def draws_per_step(posterior: Posterior, state: EnsembleState, steps: int) -> float:
    """Count the effective draws of a step of an ensemble, started from the posterior."""
    coordinates = stretched(posterior, state, steps).coordinates[:, np.newaxis]
    flat, _ = posterior.prior.constrain(coordinates.reshape(-1, coordinates.shape[-1]))
    columns = np.moveaxis(flat.reshape(coordinates.shape), -1, 0)
    ess = [
        min(
            array_stats.ess(chains, method="bulk"),
            array_stats.ess(chains, method="tail", prob=(0.05, 0.95)),
        )
        for chains in map(as_chains, columns)
    ]
    return float(min(ess)) / steps


def replicates(count: int) -> Table:
    """Measure replicates of ``runs/calibration.toml``: records so short that Python counts."""
    common = experiment(resolve_config(load(ROOT / "runs" / "calibration.toml"), ROOT))
    costs = [timed(partial(replicate, common, 1, number)).cpu for number in range(count + 1)]
    # The first one loads what is compiled.
    row: dict[str, Cell] = {"replicates": count, "core s": float(np.median(costs[1:]))}
    return Table("A calibration replicate of 300 samples", "CPU s, one thread; median", [row])
