"""How fast effective draws come: emcee's defaults, its stretch move, and a whole run of ours.

A run of ours is timed as it is: point fit, pilot, tuning and sampling until it has converged with
the effective draws asked for. The stretch move is given a start that is finished, draws of our
chain, and no burn-in. Its effective draws per step do not depend on what computes the density:
they are counted once, on the compiled engine, and divided by what a step costs on each engine and
on the stock path.

Effective draws are the smaller of bulk and tail of the slowest parameter. Ours are what a run
reports, never more than its ensembles' means are worth. For the stretch move that cap is left out:
it takes a long chain to be known, and without it there are more.
"""

# mypy: allow-untyped-calls
# arviz_stats says that it has types, but its functions have none.

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from arviz_stats.base import array_stats  # type: ignore[attr-defined]  # not in an __all__
from emcee.moves import StretchMove

from bwbayes.app.problem.problem import Problem, generator
from bwbayes.app.running.workers import executor
from bwbayes.inference import map_estimate as pointfit
from bwbayes.inference.posterior import Posterior
from bwbayes.sampling.chain import Block, Chain, EnsembleState, Phase
from bwbayes.sampling.diagnostics import TAIL, Check, Outcome, as_chains
from bwbayes.sampling.ensemble import advance
from bwbayes.sampling.moves import sampling_moves
from bwbayes.sampling.sampler import first_chain, sample
from tests.benchmarks.cases import ENGINES, MODELS, Effort, on_engine, problem
from tests.benchmarks.likelihood import speed_up
from tests.benchmarks.measuring import Cell, Cost, Table, interleaved

WORKERS = 2
PARTS = ("point fit", "pilot", "tuning", "sampling", "checks")

# Walkers of the stretch move, and ensembles that its effective draws are counted in.
WALKERS = MODELS
ENSEMBLES = 2

# Steps of ours that two threads are timed with.
THREAD_STEPS = 20


@dataclass(frozen=True)
class Run:
    """A run of ours: its chain and outcome, and the seconds that each part of it took."""

    problem: Problem
    chain: Chain
    outcome: Outcome
    seconds: dict[str, float]

    @property
    def ess(self) -> float:
        """Effective draws, bulk and tail, of the slowest parameter."""
        check = self.outcome.check
        return float(np.min([check.ess_bulk, check.ess_tail]))


def our_run(problem: Problem) -> Run:
    """Fit, start and sample as a run does, with two workers."""
    posterior, seed = problem.posterior, problem.config.seed
    seconds = dict.fromkeys(PARTS, 0.0)
    last = time.perf_counter()

    def passed(part: str) -> None:
        nonlocal last
        now = time.perf_counter()
        seconds[part] += now - last
        last = now

    def watcher(phase: Phase, check: Check | None) -> None:
        passed(phase if check is None else "checks")

    point = pointfit.fit(posterior, generator(seed, "point fit"))
    chain = first_chain(posterior, point, problem.plan, generator(seed, "sampling"))
    passed("point fit")
    with executor(WORKERS, posterior.engine) as pool:
        outcome = sample(posterior, problem.plan, chain, pool, watcher)
    return Run(problem, chain, outcome, seconds)


def from_posterior(run: Run, walkers: int = WALKERS) -> list[EnsembleState]:
    """Return ensembles whose walkers are draws of a finished chain."""
    coordinates = run.chain.coordinates("sampling")
    draws = coordinates.reshape(-1, coordinates.shape[-1])
    chosen = np.random.default_rng(1).choice(len(draws), (ENSEMBLES, walkers), replace=False)
    posterior = run.problem.posterior
    return [
        replace(end, coordinates=draws[rows], log_density=posterior.log_density(draws[rows]))
        for end, rows in zip(run.chain.ends, chosen, strict=False)
    ]


def stretched(posterior: Posterior, state: EnsembleState, steps: int) -> Block:
    """Move an ensemble by emcee's default move."""
    return advance(posterior, [[(StretchMove(), 1.0)]], [state], steps)[0]


def sampling(effort: Effort) -> list[Table]:
    """Measure whole runs and the stretch move, and the ratios between them."""
    paper = problem("numba")
    # What is not timed: the first call on the compiled engine, and a first run to start from.
    first = our_run(paper)
    states = from_posterior(first)
    stretch_draws = draws_per_step(paper.posterior, states, effort.steps)
    runs: list[Run] = []
    calls: dict[str, Callable[[], object]] = {
        engine: partial(stretched, on_engine(paper.posterior, engine), states[0], 1)
        for engine in (*ENGINES, "stock")
    }
    calls["ours"] = lambda: runs.append(our_run(paper))
    cost = interleaved(calls, max(effort.rounds // 2, 1))
    rates = {name: stretch_draws / cost[name].wall for name in (*ENGINES, "stock")}
    rates["ours"] = runs[-1].ess / cost["ours"].wall
    rows: list[dict[str, Cell]] = [
        {"moves": name, "draws/s": rate, "x stock": rate / rates["stock"]}
        for name, rate in rates.items()
    ]
    note = (
        "effective draws, slowest parameter; ours with point fit, pilot and tuning, emcee's "
        "stretch move from the posterior on, by engine; stock: a loop over the samples"
    )
    return [
        Table("effective_draws", "Effective draws per second, the paper's record", note, rows),
        _run_table(runs[-1], cost["ours"]),
        _thread_table(first, effort.rounds),
    ]


def draws_per_step(posterior: Posterior, states: Sequence[EnsembleState], steps: int) -> float:
    """Count the effective draws of a step of one ensemble, started from the posterior."""
    with ThreadPoolExecutor(WORKERS) as pool:
        blocks = list(pool.map(lambda state: stretched(posterior, state, steps), states))
    coordinates = np.stack([block.coordinates for block in blocks], axis=1)
    flat, _ = posterior.prior.constrain(coordinates.reshape(-1, coordinates.shape[-1]))
    columns = np.moveaxis(flat.reshape(coordinates.shape), -1, 0)
    ess = [
        min(
            array_stats.ess(chains, method="bulk"),
            array_stats.ess(chains, method="tail", prob=TAIL),
        )
        for chains in map(as_chains, columns)
    ]
    return float(min(ess)) / (steps * len(states))


def _run_table(run: Run, cost: Cost) -> Table:
    row: dict[str, Cell] = {
        "converged": run.outcome.converged,
        "ESS": run.ess,
        "steps": run.chain.steps("sampling"),
        "s": cost.wall,
        "core s": cost.cpu,
    }
    note = f"best of several, s, with {WORKERS} workers; the parts are those of the last run, s"
    title = "A run of ours, from the point fit to convergence"
    return Table("runs", title, note, [row | dict[str, Cell](run.seconds)])


def _thread_table(run: Run, rounds: int) -> Table:
    """Advance two of our ensembles, each call with moves of its own."""
    posterior, state = run.problem.posterior, run.chain.ends[0]
    proposal = run.chain.proposal_in_use("sampling")

    def call() -> Block:
        return advance(posterior, [sampling_moves(proposal)], [state], THREAD_STEPS)[0]

    with ThreadPoolExecutor(2) as pool:
        row = speed_up(call, pool, rounds)
    walkers = state.coordinates.shape[0]
    title = f"Two ensembles of {walkers} walkers, {THREAD_STEPS} steps of ours, compiled engine"
    note = "ms; in two threads and one after the other"
    return Table("ensemble_threads", title, note, [row])
