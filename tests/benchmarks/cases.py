"""What is measured: the paper's record, other models and lengths of it, and models to try."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from bwbayes.app.config.config import Config, load
from bwbayes.app.problem.problem import Problem, resolve
from bwbayes.arrays import FloatArray
from bwbayes.inference.engine import Engine
from bwbayes.inference.posterior import Posterior
from bwbayes.model.actuator import Actuator
from bwbayes.model.creep import Creep
from bwbayes.model.gain import PolynomialGain
from bwbayes.model.operator import Span
from bwbayes.model.registry import HYSTERESIS, made
from tests.benchmarks.stock import stock
from tests.inference.problems import posterior_of, truth

ROOT = Path(__file__).resolve().parents[2]
ENGINES: tuple[Engine, ...] = ("numba", "numpy")

# The model whose exponent is not fixed at 1, and the times of four creep lags, s.
FREE_EXPONENT = "bouc-wen, free exponent"
CREEPING = "bouc-wen, gain, four creep lags"
LAGS = (0.1, 1.0, 10.0, 100.0)

# Models of a batch where nothing else is said.
MODELS = 64

# Effective draws that our runs go on to.
ESS = 4000.0


@dataclass(frozen=True)
class Effort:
    """How much to measure: ``rounds``, ``steps`` for an ESS, all runs."""

    rounds: int
    steps: int
    everything: bool


FULL = Effort(rounds=7, steps=3000, everything=True)
QUICK = Effort(rounds=2, steps=400, everything=False)


def config() -> Config:
    """Return the config of the paper's record, with the target."""
    read = load(ROOT / "runs" / "ring_bender.toml")
    return read.model_copy(update={"sampling": read.sampling.model_copy(update={"ess": ESS})})


def problem(engine: Engine) -> Problem:
    """Return the paper's record as a run would see it on an engine."""
    whole = config()
    sampling = whole.sampling.model_copy(update={"engine": engine})
    return resolve(whole.model_copy(update={"sampling": sampling}), ROOT / "runs")


def on_engine(posterior: Posterior, name: str) -> Posterior:
    """Return the same posterior on an engine, or on the stock path."""
    if name == "stock":
        return stock(posterior)
    return replace(posterior, engine=name)  # type: ignore[arg-type]  # one of the engines


def with_parts(posterior: Posterior, *, from_rest: bool) -> dict[str, Posterior]:
    """Return posteriors of the same record with a lag: each operator, and what adds to it.

    Without a start from rest the state of everything at the first sample is unknown.
    """
    voltage, displacement = posterior.only.voltage, posterior.only.displacement
    span = Span(float(np.min(voltage)), float(np.max(voltage)))
    plain = Actuator(
        "lag", posterior.only.actuator.hold, posterior.only.actuator.interval, span=span
    )
    gain = PolynomialGain(reference=span)
    actuators = {
        name: replace(plain, hysteresis=made("hysteresis", name, HYSTERESIS, {}))
        for name in HYSTERESIS
    }
    even = made("hysteresis", "duhem", HYSTERESIS, {"odd": False})
    creep = Creep(LAGS, reference=span)
    actuators |= {
        FREE_EXPONENT: plain,
        "duhem, even terms": replace(plain, hysteresis=even),
        "bouc-wen, gain": replace(plain, gain=gain),
        CREEPING: replace(plain, gain=gain, creep=creep),
        "bouc-wen, creep that grows": replace(plain, creep=replace(creep, growing=True)),
    }
    rest = {"initial": 0.0} if from_rest else {}
    return {
        name: replace(
            posterior_of(
                voltage,
                displacement,
                one,
                "discrepancy",
                rest if name == FREE_EXPONENT else rest | {"exponent": 1.0},
                from_rest=from_rest,
            ),
            engine="numba",
        )
        for name, one in actuators.items()
    }


def trial(posterior: Posterior, count: int = MODELS) -> FloatArray:
    """Return θ (count, parameters) near the truth, free parameters a few percent off."""
    theta = np.repeat(truth(posterior), count, axis=0)
    free = [posterior.prior.names.index(name) for name in posterior.names]
    theta[:, free] *= 1 + 0.03 * np.random.default_rng(1).standard_normal((count, len(free)))
    return theta
