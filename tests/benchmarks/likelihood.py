"""What a sample of a model costs: by engine and by part of the model, and in two threads."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import partial

import numpy as np

from bwbayes.inference.posterior import Posterior
from tests.benchmarks.cases import ENGINES, MODELS, Effort, on_engine, trial, with_parts
from tests.benchmarks.measuring import Cell, Table, interleaved

Call = Callable[[], object]

# Where a record may start, and whether that is rest.
STARTS = {"from rest": True, "in motion": False}

# Batches that a thread works out one after the other.
CALLS = 25

# Times as many rounds where two threads are timed: both cores must be free in the same moment.
CALM = 8


def likelihood_of(posterior: Posterior, name: str) -> Call:
    """Return a call that works out the likelihood of some models on an engine, compiled before."""
    engine, theta = on_engine(posterior, name), trial(posterior)
    if name == "numba":
        engine.log_likelihood(theta[:1])
    return lambda: engine.log_likelihood(theta)


def engines(posterior: Posterior, effort: Effort) -> Table:
    """Measure the paper's record on both engines, and by a loop over the samples."""
    calls = {name: likelihood_of(posterior, name) for name in (*ENGINES, "stock")}
    cost = interleaved(calls, effort.rounds)
    work = MODELS * posterior.only.voltage.size
    row: dict[str, Cell] = {name: 1e9 * cost[name].wall / work for name in calls}
    text = "ns per sample and model on one core, best of several; stock: a loop over the samples"
    return Table("engines", f"Likelihood of the paper's record, {MODELS} models", text, [row])


def parts(posterior: Posterior, effort: Effort) -> Table:
    """Measure every operator, gain and creep on the compiled engine, and as times Bouc-Wen.

    Models are draws of the default priors. In motion, the start is unknown.
    """
    calls: dict[str, Call] = {}
    for start, from_rest in STARTS.items():
        for name, variant in with_parts(posterior, from_rest=from_rest).items():
            theta = variant.prior.theta(variant.prior.draw(np.random.default_rng(1), MODELS))
            variant.log_likelihood(theta[:1])
            calls[f"{name}, {start}"] = partial(variant.log_likelihood, theta)
    costs = interleaved(calls, effort.rounds)
    usual = costs["bouc-wen, from rest"].wall
    work = MODELS * posterior.only.voltage.size
    rows = [
        dict[str, Cell](model=name, ns=1e9 * cost.wall / work, times=cost.wall / usual)
        for name, cost in costs.items()
    ]
    text = "ns per sample and model on one core, compiled engine; times Bouc-Wen from rest"
    return Table("parts", f"Likelihood by part, {MODELS} models", text, rows)


def threads(posterior: Posterior, effort: Effort) -> Table:
    """Measure batches in two threads and one after the other, on the compiled engine."""
    once = likelihood_of(posterior, "numba")

    def call() -> None:
        # A thread works for long: the moment it takes to wake it up is not to count.
        for _ in range(CALLS):
            once()

    with ThreadPoolExecutor(2) as pool:
        row = speed_up(call, pool, effort.rounds)
    title = f"Twice {CALLS} batches of {MODELS} models, compiled engine"
    return Table("threads", title, "ms; in two threads and one after the other", [row])


def speed_up(call: Call, pool: ThreadPoolExecutor, rounds: int) -> dict[str, Cell]:
    """Time a call made twice, in two threads and one after the other."""

    def together() -> None:
        for future in [pool.submit(call), pool.submit(call)]:
            future.result()

    def in_turn() -> None:
        for _ in range(2):
            pool.submit(call).result()

    cost = interleaved({"two": together, "one": in_turn}, CALM * rounds)
    two, alone = cost["two"].wall, cost["one"].wall
    return {"one after the other": 1e3 * alone, "two threads": 1e3 * two, "speed-up": alone / two}
