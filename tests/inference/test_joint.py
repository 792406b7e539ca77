"""The posterior of several records: a sum over them, with what is shared there once.

It is held against the posteriors of the records alone, and against the whole record where two
records are its halves.
"""

from dataclasses import replace
from typing import get_args

import numpy as np
import pytest

from bwbayes.arrays import FloatArray
from bwbayes.errors import InputError
from bwbayes.inference import map_estimate as pointfit
from bwbayes.inference.engine import Engine
from bwbayes.inference.likelihood import Likelihood
from bwbayes.inference.noise import noise_model
from bwbayes.inference.outliers import outliers
from bwbayes.inference.parameters import JointPrior, Parameter
from bwbayes.inference.posterior import Posterior
from bwbayes.model.actuator import Actuator
from bwbayes.model.inputs import Inputs
from tests.inference.problems import INTERVAL, decaying_sine, posterior_of, ring_bender

ENGINES = get_args(Engine)

# The records: samples, periods, amplitude in V, sampling interval in s, and whether from rest.
RECORDS = {"loops": (240, 4.0, 100.0, INTERVAL, True), "slow": (150, 1.5, 60.0, 0.025, False)}


def dataset(name: str, noise: str = "discrepancy", dynamics: str = "lag") -> Likelihood:
    samples, periods, amplitude, interval, from_rest = RECORDS[name]
    actuator = Actuator(dynamics, "first", interval)
    voltage = decaying_sine(samples, periods, amplitude)
    offset = 3.0 if from_rest else -2.0
    displacement = offset + ring_bender(actuator, noise, voltage, samples)
    windows = (slice(0, samples // 2), slice(samples // 2 + 10, samples))
    model = noise_model(noise, interval)
    inputs = Inputs(voltage, interval=interval)
    return Likelihood(inputs, displacement, windows, actuator, model, from_rest, name)


def joint(
    *datasets: Likelihood,
    per_record: tuple[str, ...] = (),
    shared: tuple[str, ...] = (),
    engine: Engine = "numpy",
) -> Posterior:
    first = datasets[0]
    names = tuple(one.name for one in datasets)
    table = replace(first.table, records=names, per_record=per_record, shared=shared)
    usual = posterior_of(first.voltage, first.displacement, first.actuator, "discrepancy", {})
    known = {p.name: p for p in usual.prior.parameters}
    parameters = []
    for name, declared, record in table.layout:
        parameter = known[declared.name]
        rested = {one.name for one in datasets if one.from_rest}
        if declared.name == "initial" and rested and (record in rested or not record):
            parameter = Parameter.of(declared, 0.0)
        parameters.append(replace(parameter, name=name, record=record))
    prior = JointPrior(parameters, first.actuator.hysteresis.holds)
    return Posterior(tuple(datasets), prior, engine, table)


def drawn(posterior: Posterior, models: int, seed: int = 1) -> FloatArray:
    """Return θ (models, parameters) from the prior."""
    prior = posterior.prior
    return prior.theta(prior.draw(np.random.default_rng(seed), models))


LOOPS, SLOW = dataset("loops"), dataset("slow")


@pytest.mark.parametrize("engine", ENGINES)
def test_likelihood_is_the_sum_of_the_records_likelihoods(engine: Engine) -> None:
    """Each at its own θ; other intervals, starts, windows and ranges of the voltage."""
    both = joint(LOOPS, SLOW, engine=engine)
    theta = drawn(both, 7)
    expected = np.zeros(7)
    for one in (LOOPS, SLOW):
        mine = [
            name if name in both.table.names else f"{name}[{one.name}]" for name in one.table.names
        ]
        columns = [both.table.names.index(name) for name in mine]
        expected += one.by("numpy").log_density(theta[:, columns])
    np.testing.assert_allclose(both.log_likelihood(theta), expected, rtol=1e-9)


def test_halves_with_a_discrepancy_are_the_whole() -> None:
    """Means to 0.1 sd and sds to 5%, the halves ten correlation times apart.

    Windows of one record share the discrepancy, too: halves that follow at once on each other lose
    what it remembers over the cut, 0.15 sd of the offset in 20 s. By point fits, which have no
    Monte Carlo error; the twin has an offset of its own in each half.
    """
    voltage = decaying_sine(2000, 8.0)
    actuator = Actuator("none", "first", INTERVAL)
    reading = ring_bender(actuator, "discrepancy", voltage, 3)
    noise = noise_model("discrepancy", INTERVAL)
    windows = slice(0, 900), slice(1100, 2000)

    def half(name: str, *training: slice) -> Likelihood:
        inputs = Inputs(voltage, interval=INTERVAL)
        return Likelihood(inputs, reading, training, actuator, noise, True, name)

    one = joint(half("whole", *windows))
    halves = [half(f"half-{i}", window) for i, window in enumerate(windows)]
    points = {}
    for shared in (("initial", "offset"), ("initial",)):
        two = joint(*halves, shared=shared)
        points[shared] = two, pointfit.fit(two, np.random.default_rng(1))
    whole = pointfit.fit(one, np.random.default_rng(1))
    sd = np.sqrt(np.diag(whole.covariance))
    two, point = points["initial", "offset"]
    assert one.names == two.names
    assert np.max(np.abs(point.mode - whole.mode) / sd) < 0.1
    np.testing.assert_allclose(np.sqrt(np.diag(point.covariance)), sd, rtol=0.05)
    loose, wrong = points["initial",]
    place = loose.names.index("offset[half-1]")
    assert np.sqrt(wrong.covariance[place, place]) > 1.2 * sd[one.names.index("offset")]


def test_bounds_hold_in_every_record() -> None:
    """With alpha of each record its own: 0 < alpha < d, and |gamma| <= beta."""
    both = joint(LOOPS, SLOW, per_record=("alpha", "gamma"))
    column = both.table.columns(drawn(both, 200))
    for record in ("loops", "slow"):
        assert (column[f"alpha[{record}]"] < column["d"]).all()
        assert (np.abs(column[f"gamma[{record}]"]) <= column["beta"]).all()
    free = both.prior.draw(np.random.default_rng(5), 50)
    back, _ = both.prior.constrain(both.prior.unconstrain(free))
    np.testing.assert_allclose(back, free, rtol=1e-6, atol=1e-9)
    # A shared parameter whose bounds hang on the records' own obeys the tightest.
    tight = joint(LOOPS, SLOW, per_record=("beta",))
    column = tight.table.columns(drawn(tight, 200))
    least = np.minimum(column["beta[loops]"], column["beta[slow]"])
    assert (np.abs(column["gamma"]) <= least).all()


def test_outliers_are_found_in_the_record_that_has_them() -> None:
    loops, slow = (dataset(name, "white", "none") for name in RECORDS)
    spoilt = slow.displacement.copy()
    spoilt[40] += 60.0
    both = joint(loops, replace(slow, displacement=spoilt))
    aside = outliers(both.without, np.random.default_rng(6))
    assert {"loops": [], "slow": [40]} == {name: rows.tolist() for name, rows in aside.items()}


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"per_record": ("sensor",)}, r"model.per_record: no part here has 'sensor'; did you mean"),
        ({"shared": ("creep_1",)}, r"model.shared: no part here has 'creep_1'; "),
        (
            {"per_record": ("offset",), "shared": ("offset",)},
            "model.per_record: 'offset' is in model.shared too; remove it from one of them",
        ),
    ],
)
def test_scopes_of_parameters_that_there_are_not_are_refused(
    given: dict[str, tuple[str, ...]], message: str
) -> None:
    with pytest.raises(InputError, match=message):
        joint(LOOPS, SLOW, **given)  # type: ignore[arg-type]
