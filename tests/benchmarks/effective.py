"""How fast effective draws come: emcee's stretch move, differential evolution, and a whole run.

A run of ours is timed as it is: point fit, pilot, tuning and sampling until it has converged with
the effective draws asked for. The other moves are given a start that is finished, draws of our
chain, and no burn-in. Their effective draws per step do not depend on what computes the density:
they are counted once, on the compiled engine, and divided by what a step costs on each engine and
on the stock path.

Effective draws are the smaller of bulk and tail of the slowest parameter. Ours are what a run
reports, never more than its ensembles' means are worth. For the others that cap is left out: it
takes a long chain to be known, and without it they have more.
"""

# mypy: allow-untyped-calls
# arviz_stats says that it has types, but its functions have none.

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from arviz_stats.base import array_stats  # type: ignore[attr-defined]  # not in an __all__
from emcee.moves import Move, StretchMove

from bwbayes.app.problem.problem import Problem, generator
from bwbayes.app.running.workers import executor
from bwbayes.inference import pointfit
from bwbayes.inference.posterior import Posterior
from bwbayes.sampling.chain import Chain, Phase
from bwbayes.sampling.diagnostics import TAIL, Check, as_chains
from bwbayes.sampling.ensemble import Block, EnsembleState, advance
from bwbayes.sampling.moves import pilot_moves, sampling_moves
from bwbayes.sampling.sampler import Outcome, first_chain, sample
from tests.benchmarks.cases import ENGINES, MODELS, Effort, on_engine, problem
from tests.benchmarks.likelihood import speed_up
from tests.benchmarks.tables import Cell, Table
from tests.benchmarks.timing import Cost, interleaved

__all__ = ["MOVES", "PARTS", "WORKERS", "Run", "from_posterior", "our_run", "sampling", "step"]

Moves = list[tuple[Move, float]]

# What moves, and on what engine.
Contestant = tuple[str, str]

WORKERS = 2
PARTS = ("point fit", "pilot", "tuning", "sampling", "checks")

# Walkers of the moves that are not ours, and ensembles that their effective draws are counted in.
WALKERS = MODELS
ENSEMBLES = 2

MOVES: dict[str, Callable[[], Moves]] = {
    "stretch": lambda: [(StretchMove(), 1.0)],
    "DE + snooker": pilot_moves,
}

# A longer run, over which point fit and pilot weigh less.
MANY = 20_000.0
LONGER = "ours, ESS 20,000"

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


def step(posterior: Posterior, name: str, state: EnsembleState) -> Callable[[], Block]:
    """Return a call that makes one step of a move."""
    return partial(advance, posterior, MOVES[name](), state, 1)


def sampling(effort: Effort) -> list[Table]:
    """Measure moves, whole runs, and the ratios between them."""
    problems = {("ours", "numba"): problem("numba")}
    if effort.everything:
        problems["ours", "numpy"] = problem("numpy")
        problems[LONGER, "numba"] = problem("numba", MANY)
    posterior = problems["ours", "numba"].posterior
    # What is not timed: the first call on the compiled engine, and a first run to start from.
    first = our_run(problems["ours", "numba"])
    states = from_posterior(first)
    draws = {move: _draws_per_step(posterior, move, states, effort.steps) for move in MOVES}
    steps = {
        (move, engine): step(on_engine(posterior, engine), move, states[0])
        for move in MOVES
        for engine in (*ENGINES, "stock")
        if (move, engine) != ("DE + snooker", "stock")
    }
    runs: dict[Contestant, Run] = {}

    def again(key: Contestant) -> None:
        runs[key] = our_run(problems[key])

    calls: dict[Contestant, Callable[[], object]] = {key: partial(again, key) for key in problems}
    cost = interleaved(steps | calls, max(effort.rounds // 2, 1))
    rates = {key: _rates(draws[key[0]], cost[key]) for key in steps}
    rates |= {key: _rates(run.ess, cost[key]) for key, run in runs.items()}
    return [
        _effective(rates),
        _steps(draws, {key: cost[key] for key in steps}),
        _parts(runs, cost),
        _thread_table(first, effort.rounds),
    ]


def _draws_per_step(
    posterior: Posterior, name: str, states: Sequence[EnsembleState], steps: int
) -> float:
    """Count the effective draws of a step of one ensemble, started from the posterior."""
    with ThreadPoolExecutor(WORKERS) as pool:
        futures = [pool.submit(advance, posterior, MOVES[name](), s, steps) for s in states]
        blocks = [future.result() for future in futures]
    coordinates = np.stack([block.coordinates for block in blocks], axis=1)
    flat, _ = posterior.prior.constrain(coordinates.reshape(-1, coordinates.shape[-1]))
    chains = as_chains(flat.reshape(coordinates.shape))
    bulk = array_stats.ess(chains, chain_axis=0, draw_axis=1, method="bulk")
    tail = array_stats.ess(chains, chain_axis=0, draw_axis=1, method="tail", prob=TAIL)
    return float(np.min([bulk, tail])) / (steps * len(states))


def _rates(draws: float, cost: Cost) -> tuple[float, float]:
    """Effective draws per second, and per second of a core."""
    return draws / cost.wall, draws / cost.cpu


def _effective(rates: Mapping[Contestant, tuple[float, float]]) -> Table:
    stock, stock_core = rates["stretch", "stock"]
    rows: list[dict[str, Cell]] = [
        {
            "moves": move,
            "engine": engine,
            "cores": 1 if move in MOVES else WORKERS,
            "draws/s": rate,
            "per core": core,
            "x stock": rate / stock,
            "per core x stock": core / stock_core,
        }
        for (move, engine), (rate, core) in rates.items()
    ]
    note = (
        "effective draws, slowest parameter; ours with point fit, pilot and tuning, the others "
        "from the posterior on; stock: emcee's defaults, a loop over the samples"
    )
    return Table("effective_draws", "Effective draws per second, the paper's record", note, rows)


def _steps(draws: Mapping[str, float], cost: Mapping[Contestant, Cost]) -> Table:
    rows: list[dict[str, Cell]] = [
        {
            "moves": move,
            "engine": engine,
            "draws per step": draws[move],
            "ms per step": 1e3 * seen.wall,
            "core ms per step": 1e3 * seen.cpu,
        }
        for (move, engine), seen in cost.items()
    ]
    return Table("steps", f"Moves of {WALKERS} walkers", "one ensemble on one core", rows)


def _parts(runs: Mapping[Contestant, Run], cost: Mapping[Contestant, Cost]) -> Table:
    rows: list[dict[str, Cell]] = []
    for key, run in runs.items():
        row: dict[str, Cell] = {
            "run": key[0],
            "engine": key[1],
            "converged": run.outcome.converged,
            "ESS": run.ess,
            "steps": run.chain.steps("sampling"),
            "s": cost[key].wall,
            "core s": cost[key].cpu,
        }
        row.update(run.seconds)
        rows.append(row)
    note = f"best of several, s, with {WORKERS} workers; the parts are those of the last run, s"
    return Table("runs", "Our runs, from the point fit to convergence", note, rows)


def _thread_table(run: Run, rounds: int) -> Table:
    """Advance two of our ensembles, each call with moves of its own."""
    posterior, state = run.problem.posterior, run.chain.ends[0]
    proposal = run.chain.proposal_in_use("sampling")

    def call() -> Block:
        return advance(posterior, sampling_moves(proposal), state, THREAD_STEPS)

    with ThreadPoolExecutor(2) as pool:
        row = speed_up(call, pool, rounds)
    walkers = state.coordinates.shape[0]
    title = f"Two ensembles of {walkers} walkers, {THREAD_STEPS} steps of ours, compiled engine"
    note = "ms; in two threads and one after the other"
    return Table("ensemble_threads", title, note, [row])
