"""What a sample of a model costs: by engine, batch, model and length, and in two threads."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from functools import partial

import numpy as np

from bwbayes.arrays import FloatArray
from bwbayes.inference.noise import NOISES
from bwbayes.inference.posterior import Posterior
from bwbayes.model.boucwen import hysteresis
from bwbayes.model.registry import DYNAMICS
from tests.benchmarks.cases import (
    BATCHES,
    ENGINES,
    LENGTHS,
    MODELS,
    Effort,
    on_engine,
    trial,
    variant,
    with_parts,
)
from tests.benchmarks.stock import hysteresis_loop
from tests.benchmarks.tables import Cell, Table
from tests.benchmarks.timing import interleaved

__all__ = [
    "STARTS",
    "Call",
    "batches",
    "hysteresis_alone",
    "lengths",
    "likelihood_of",
    "models",
    "parts",
    "shape_of",
    "speed_up",
    "threads",
]

Call = Callable[[], object]

# Where a record may start, and whether that is rest.
STARTS = {"from rest": True, "in motion": False}

CONTESTANTS = (*ENGINES, "stock")

# The stock path is not asked for more than this: it takes a second for a million of them.
MOST_FOR_STOCK = MODELS * 20_000

# Batches that a thread works out one after the other.
CALLS = 25

# Times as many rounds where two threads are timed: both cores must be free in the same moment.
CALM = 8


def likelihood_of(posterior: Posterior, name: str, count: int = MODELS) -> Call:
    """Return a call that works out the likelihood of some models on an engine, compiled before."""
    engine, theta = on_engine(posterior, name), trial(posterior, count)
    if name == "numba":
        engine.log_likelihood(theta[:1])
    return lambda: engine.log_likelihood(theta)


def batches(posterior: Posterior, effort: Effort) -> Table:
    """Measure the paper's record in batches of models."""
    rows = [{"models": count} | _row(posterior, count, effort.rounds) for count in BATCHES]
    return Table("batches", "Likelihood of the paper's record by batch", PER_SAMPLE, rows)


def models(posterior: Posterior, effort: Effort) -> Table:
    """Measure all dynamics and noises."""
    rows = [
        dict[str, Cell](dynamics=dynamics, noise=noise)
        | _row(variant(posterior, dynamics, noise), MODELS, effort.rounds)
        for dynamics in DYNAMICS
        for noise in NOISES
    ]
    return Table("models", f"Likelihood by model, {MODELS} models", PER_SAMPLE, rows)


def parts(posterior: Posterior, effort: Effort) -> Table:
    """Measure every operator, gain and creep on the compiled engine, and as times Bouc-Wen.

    Models are draws of the default priors. In motion, the start is unknown.
    """
    calls: dict[str, Call] = {}
    for start, from_rest in STARTS.items():
        for name, one in with_parts(posterior, from_rest=from_rest).items():
            theta = one.prior.theta(one.prior.draw(np.random.default_rng(1), MODELS))
            one.log_likelihood(theta[:1])
            calls[f"{name}, {start}"] = partial(one.log_likelihood, theta)
    cost = interleaved(calls, effort.rounds)
    usual = cost["bouc-wen, from rest"].wall
    work = MODELS * posterior.only.voltage.size
    rows = [
        dict[str, Cell](model=name, ns=1e9 * one.wall / work, times=one.wall / usual)
        for name, one in cost.items()
    ]
    text = "ns per sample and model on one core, compiled engine; times Bouc-Wen from rest"
    return Table("parts", f"Likelihood by part, {MODELS} models", text, rows)


def lengths(posterior: Posterior, effort: Effort) -> Table:
    """Measure records of many lengths."""
    rows = [
        {"samples": samples}
        | _row(variant(posterior, "second-order", "discrepancy", samples), MODELS, effort.rounds)
        for samples in LENGTHS
        if samples <= effort.longest
    ]
    return Table(
        "lengths", f"Likelihood by length of the record, {MODELS} models", PER_SAMPLE, rows
    )


def hysteresis_alone(posterior: Posterior, effort: Effort) -> Table:
    """Measure the hysteresis without the rest."""
    voltage, shape = posterior.only.voltage, shape_of(posterior)
    calls: Mapping[str, Call] = {
        "numpy": lambda: hysteresis(voltage, **shape),
        "stock": lambda: hysteresis_loop(voltage, **shape),
    }
    row = _per_sample(calls, voltage.size * MODELS, effort.rounds)
    return Table("hysteresis", f"Hysteresis alone, {MODELS} models", PER_SAMPLE, [row])


def threads(posterior: Posterior, effort: Effort) -> Table:
    """Measure batches in two threads and one after the other, on the compiled engine."""
    once = likelihood_of(posterior, "numba")

    def call() -> None:
        # A thread works for long: the moment it takes to wake it up is not to count.
        for _ in range(CALLS):
            once()

    with ThreadPoolExecutor(2) as pool:
        row = speed_up(call, pool, effort.rounds)
    return Table(
        "threads",
        f"Twice {CALLS} batches of {MODELS} models, compiled engine",
        "ms; in two threads and one after the other",
        [row],
    )


def shape_of(posterior: Posterior) -> dict[str, FloatArray]:
    """Return what the hysteresis takes besides a voltage, of models to try."""
    named = dict(zip(posterior.prior.names, trial(posterior).T, strict=True))
    return {name: named[name] for name in ("alpha", "beta", "gamma", "initial")}


def speed_up(call: Call, pool: ThreadPoolExecutor, rounds: int) -> dict[str, Cell]:
    """Time a call made twice, in two threads and one after the other."""

    def together() -> None:
        for future in [pool.submit(call), pool.submit(call)]:
            future.result()

    def in_turn() -> None:
        for _ in range(2):
            pool.submit(call).result()

    cost = interleaved({"two": together, "one": in_turn}, CALM * rounds)
    two, one = cost["two"].wall, cost["one"].wall
    return {"one after the other": 1e3 * one, "two threads": 1e3 * two, "speed-up": one / two}


PER_SAMPLE = "ns per sample and model on one core, best of several; stock: a loop over the samples"


def _row(posterior: Posterior, count: int, rounds: int) -> dict[str, Cell]:
    work = count * posterior.only.voltage.size
    calls = {
        name: likelihood_of(posterior, name, count)
        for name in CONTESTANTS
        if name != "stock" or work <= MOST_FOR_STOCK
    }
    return _per_sample(calls, work, rounds)


def _per_sample(calls: Mapping[str, Call], work: int, rounds: int) -> dict[str, Cell]:
    """Return ns per sample and model of each contestant, and nothing for those that are not in."""
    cost = interleaved(calls, rounds)
    return {name: 1e9 * cost[name].wall / work if name in cost else None for name in CONTESTANTS}
