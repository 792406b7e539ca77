"""Cost of a model's sample: by engine, in two threads, forward and backward."""

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import partial

import numpy as np

from bwbayes.app.config.config import load
from bwbayes.app.fit.fitted import Run
from bwbayes.app.study.resolve import resolve_config
from bwbayes.arrays import FloatArray
from bwbayes.control.sampled import SampledModel
from bwbayes.inference.posterior import Posterior
from bwbayes.model.actuator import Actuator
from bwbayes.model.linear import Creep
from bwbayes.model.nonlinearity import PolynomialNonlinearity
from bwbayes.model.operator import Operator
from bwbayes.model.operators.bouc_wen import BoucWen
from bwbayes.model.operators.bouc_wen_asymmetric import BoucWenAsymmetric
from bwbayes.model.operators.duhem import Duhem
from bwbayes.model.operators.prandtl_ishlinskii import MaxwellSlip, Plays
from bwbayes.record.waveforms import signal
from tests.benchmarks.measuring import ROOT, Call, Cell, Table, interleaved
from tests.benchmarks.stock import stock
from tests.control import cases
from tests.inference.problems import truth

# Models of a batch, and effective draws that our runs go on to.
MODELS, ESS = 64, 4000.0

# Samples and draws of what is read backwards.
SAMPLES, DRAWS = 500, 1000


def paper_record() -> Run:
    """Return the problem of the paper's record, with the target of effective draws."""
    config = load(ROOT / "runs" / "ring_bender.toml")
    sampling = config.sampling.model_copy(update={"ess": ESS, "engine": "numba"})
    return resolve_config(config.model_copy(update={"sampling": sampling}), ROOT / "runs")


def by_engine(posterior: Posterior) -> dict[str, Posterior]:
    """Return the same posterior on both engines, and on the stock path."""
    numpy = replace(posterior, engine="numpy")
    return {"numba": posterior, "numpy": numpy, "stock": stock(posterior)}


def trial(posterior: Posterior, count: int = MODELS) -> FloatArray:
    """Return θ (count, parameters) near the truth, free parameters a few percent off."""
    theta = np.repeat(truth(posterior), count, axis=0)
    free = [posterior.prior.names.index(name) for name in posterior.names]
    theta[:, free] *= 1 + 0.03 * np.random.default_rng(1).standard_normal((count, len(free)))
    return theta


def engines(posterior: Posterior, rounds: int) -> Table:
    """Measure the paper's record on both engines, and by a loop over the samples."""
    theta = trial(posterior)
    posterior.log_likelihood(theta[:1])
    calls = {name: partial(one.log_likelihood, theta) for name, one in by_engine(posterior).items()}
    work = MODELS * posterior.single_record.voltage.size
    cost = interleaved(calls, rounds)
    row: dict[str, Cell] = {name: 1e9 * cost[name].wall / work for name in calls}
    text = "ns per sample and model on one core, best of several; stock: a loop over the samples"
    return Table(f"Likelihood of the paper's record, {MODELS} models", text, [row])


def speed_up(call: Call, rounds: int, title: str) -> Table:
    """Time a call made twice, in two threads and one after the other.

    Eight times as many rounds as usual: both cores must be free in the same moment.
    """
    with ThreadPoolExecutor(2) as pool:

        def together() -> None:
            for future in [pool.submit(call), pool.submit(call)]:
                future.result()

        def in_turn() -> None:
            for _ in range(2):
                pool.submit(call).result()

        cost = interleaved({"two": together, "one": in_turn}, 8 * rounds)
    two, alone = cost["two"].wall, cost["one"].wall
    row: dict[str, Cell] = {"one after the other": 1e3 * alone, "two threads": 1e3 * two}
    return Table(title, "ms; two threads on two cores", [row | {"speed-up": alone / two}])


def threads(posterior: Posterior, rounds: int, calls: int = 25) -> Table:
    """Measure so many batches in each of two threads, on the compiled engine."""
    theta = trial(posterior)

    def call() -> None:
        # A thread works for long: the moment it takes to wake it up is not to count.
        for _ in range(calls):
            posterior.log_likelihood(theta)

    return speed_up(call, rounds, f"Twice {calls} batches of {MODELS} models, compiled engine")


# Hysteresis, dynamics, gain and creep of models that are read backwards.
INVERTED: dict[str, tuple[Operator, str, PolynomialNonlinearity | None, Creep | None]] = {
    "bouc-wen": (BoucWen(), "none", None, None),
    "bouc-wen, lag": (BoucWen(), "lag", None, None),
    "bouc-wen, second-order": (BoucWen(), "second-order", None, None),
    "bouc-wen, lag, creep": (BoucWen(), "lag", None, cases.CREEP),
    "bouc-wen, lag, nonlinearity": (BoucWen(), "lag", cases.NONLINEARITY, None),
    "plays, lag": (Plays(10), "lag", None, None),
    "maxwell-slip, lag": (MaxwellSlip(10), "lag", None, None),
    "asymmetric bouc-wen, lag": (BoucWenAsymmetric(), "lag", None, None),
    "duhem, lag": (Duhem(), "lag", None, None),
    "bouc-wen n = 1.7, lag": (BoucWen(), "lag", None, None),
}


def _read_backwards(model: SampledModel, displacement: FloatArray) -> None:
    """Find the voltage of every model for each of the displacements (samples,), um."""
    state = model.begin(np.zeros(model.models))
    for asked in displacement:
        _, state = model.inverse(state, np.full(model.models, asked), cases.SPAN)


def inversion(rounds: int) -> Table:
    """Measure the inverse of many draws against simulating them, on the paper's record.

    The reference is the displacement of their middle; each draw gets a voltage of its own.
    """
    voltage = signal("identification").sample(1000.0)[1][:SAMPLES]
    rows: list[dict[str, Cell]] = []
    for name, (hysteresis, dynamics, nonlinearity, creep) in INVERTED.items():
        actuator = Actuator(dynamics, "first", 1e-3, hysteresis, nonlinearity, creep, cases.SPAN)
        theta = cases.theta(actuator, DRAWS, name)
        simulate = partial(actuator.displacement, theta, voltage, from_rest=True)
        invert = partial(_read_backwards, SampledModel.of(actuator, theta), simulate().mean(axis=0))
        cost = interleaved({"simulate": simulate, "invert": invert}, min(rounds, 2))
        forward, backward = cost["simulate"].wall, cost["invert"].wall
        row: dict[str, Cell] = {"model": name, "simulate, ms": 1e3 * forward}
        rows.append(row | {"invert, ms": 1e3 * backward, "ratio": backward / forward})
    return Table("Inversion", f"{SAMPLES:,} samples, {DRAWS:,} draws", rows)
