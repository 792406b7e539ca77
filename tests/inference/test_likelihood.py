"""The likelihood of a record, the posterior of a batch of models, and that of several records.

Everything is compared with a dense Gaussian: the covariance of the discrepancy and the sensor at
the readings' times, with that of the unknown start added, all inverted at once.
"""

from dataclasses import dataclass, replace
from typing import Any, cast, get_args

import numpy as np
import pytest
from hypothesis import example, given, strategies as st
from scipy import linalg

from bwbayes.arrays import FloatArray
from bwbayes.errors import InputError
from bwbayes.inference import Engine, map_estimate as pointfit
from bwbayes.inference.likelihood import Likelihood
from bwbayes.inference.noise import DiscrepancyNoise, WhiteNoise, noise_model
from bwbayes.inference.outliers import outliers, surprise
from bwbayes.inference.parameters import JointPrior, Parameter
from bwbayes.inference.posterior import Posterior
from bwbayes.inference.study import Study
from bwbayes.model.actuator import Actuator
from bwbayes.model.inputs import Hold, Inputs
from tests.inference.problems import (
    INTERVAL,
    decaying_sine,
    posterior_of,
    ring_bender,
    short_posterior,
    single,
    study_of,
)

RINGING = {"mass": 0.00134, "stiffness": 4.1e5}
COMPLEX = {"mass": 300.0, "damping": 3000.0, "stiffness": 4.1e5}
MODELS: list[tuple[str, dict[str, float]]] = [
    ("none", {}),
    ("lag", {}),
    ("second-order", RINGING),
    ("second-order", COMPLEX),
]


def columns(likelihood: Likelihood, theta: FloatArray) -> dict[str, FloatArray]:
    names = likelihood.table.names
    return dict(zip(names, theta[np.newaxis].T, strict=True))


def responses(likelihood: Likelihood, theta: FloatArray) -> FloatArray:
    """Responses (unknowns, readings) of the start, by a slow filter."""
    sections = likelihood.actuator.sections(columns(likelihood, theta))
    free = sections.free_responses(likelihood.voltage.size)[0][:, likelihood.readings.rows]
    parts = [] if likelihood.from_rest else list(free)
    if likelihood.offset_sd:
        parts.insert(0, np.ones(likelihood.readings.rows.size))
    return np.array(parts).reshape(len(parts), likelihood.readings.rows.size)


def dense(likelihood: Likelihood, theta: FloatArray) -> tuple[float, FloatArray, FloatArray]:
    """Log density of the readings, and mean and covariance of the start, at one θ."""
    value = {name: float(v[0]) for name, v in columns(likelihood, theta).items()}
    size = len(likelihood.actuator.parameters)
    clean = likelihood.actuator.displacement(theta[:size], likelihood.voltage)[0]
    rows = likelihood.readings.rows
    time = rows * likelihood.actuator.interval
    apart = np.abs(np.subtract.outer(time, time)) / value.get("discrepancy_time", 1.0)
    noise = value.get("discrepancy_sd", 0.0) ** 2 * np.exp(-apart)
    noise += value["sensor_sd"] ** 2 * np.eye(rows.size)
    f = responses(likelihood, theta)
    prior = np.diag(likelihood.start_sd(theta[np.newaxis])[0] ** 2)
    residual = likelihood.readings.values - clean[rows]
    factor = linalg.cho_factor(noise + f.T @ prior @ f)
    logs = 2 * np.sum(np.log(np.diag(factor[0]))) + rows.size * np.log(2 * np.pi)
    density = -0.5 * (residual @ linalg.cho_solve(factor, residual) + logs)
    gain = linalg.cho_solve(factor, f.T @ prior).T
    return float(density), gain @ residual, prior - gain @ f.T @ prior


def moving(
    noise: str = "discrepancy",
    dynamics: str = "lag",
    fixed: dict[str, float] | None = None,
    *,
    hold: Hold = "first",
    missing: float = 0.0,
    stride: int = 1,
    training: tuple[slice, ...] | None = None,
    parts: dict[str, Any] | None = None,
) -> Posterior:
    """Cut a record out of a running drive, with readings missing at random."""
    actuator = Actuator(dynamics, hold, INTERVAL, **(parts or {}))
    voltage = decaying_sine(300)[100:]
    plain = replace(actuator, nonlinearity=None, creep=None)
    displacement = ring_bender(plain, noise, voltage, 3) + 5 * np.exp(-np.arange(200) / 3)
    lost = np.random.default_rng(4).uniform(size=200) < missing
    displacement[lost | (np.arange(200) % stride != 0)] = np.nan
    posterior = posterior_of(
        voltage, np.nan_to_num(displacement), actuator, noise, fixed or {}, training=training
    )
    return posterior.altered(displacement=displacement, from_rest=False)


@pytest.mark.parametrize("engine", ["numpy", "numba"])
@pytest.mark.parametrize("noise", ["white", "discrepancy"])
@pytest.mark.parametrize(("dynamics", "fixed"), MODELS, ids=["none", "lag", "slow", "complex"])
@pytest.mark.parametrize("hold", ["first", "zero"])
def test_the_unknown_start_is_integrated_out(
    engine: str, noise: str, dynamics: str, fixed: dict[str, float], hold: Hold
) -> None:
    posterior = moving(noise, dynamics, fixed, hold=hold)
    likelihood = replace(posterior.likelihood, engine=cast(Engine, engine), offset_sd=3.0)
    theta = posterior.prior.theta(posterior.prior.draw(np.random.default_rng(5), 6))
    assert_dense(likelihood, theta)


def assert_dense(likelihood: Likelihood, theta: FloatArray) -> None:
    start = likelihood.start(theta)
    for row, one in enumerate(theta):
        density, mean, covariance = dense(likelihood, one)
        assert abs(density - start.log_density[row]) < 1e-7 * (200 + abs(density))
        sd = likelihood.start_sd(one[np.newaxis])[0]
        if not sd.size:
            continue
        np.testing.assert_allclose(start.mean[row], mean, rtol=1e-5, atol=1e-6 * sd.max())
        np.testing.assert_allclose(start.covariance[row], covariance, atol=1e-6 * sd.max() ** 2)


@pytest.mark.parametrize(("dynamics", "fixed"), MODELS, ids=["none", "lag", "slow", "complex"])
def test_a_shape_takes_what_an_unknown_of_that_shape_would(
    dynamics: str, fixed: dict[str, float]
) -> None:
    """A constant is an offset of which nothing is known."""
    posterior = moving("discrepancy", dynamics, fixed, missing=0.1)
    without = posterior.likelihood
    free = replace(without, offset_sd=1e6)
    theta = posterior.prior.theta(posterior.prior.draw(np.random.default_rng(5), 6))
    expected = without.start(theta).squares - free.start(theta).squares
    constant = np.ones((1, without.readings.rows.size))
    np.testing.assert_allclose(
        expected, without.score(theta, constant).together, rtol=1e-4, atol=1e-4
    )


@pytest.mark.parametrize("engine", ["numpy", "numba"])
@pytest.mark.parametrize("missing", [0.1, 0.7])
@pytest.mark.parametrize("stride", [1, 8])
@pytest.mark.parametrize("training", [None, (slice(3, 4), slice(20, 90), slice(90, 180))])
def test_missing_readings_are_left_out_and_nothing_else(
    engine: str, missing: float, stride: int, training: tuple[slice, ...] | None
) -> None:
    """The simulation runs through, and one discrepancy goes through all gaps and windows."""
    posterior = moving(missing=missing, stride=stride, training=training)
    likelihood = replace(posterior.likelihood, engine=cast(Engine, engine))
    theta = posterior.prior.theta(posterior.prior.draw(np.random.default_rng(6), 5))
    got = likelihood.log_density(theta)
    for row, one in enumerate(theta):
        density, _, _ = dense(likelihood, one)
        assert abs(density - got[row]) < 1e-7 * (200 + abs(density))


def test_from_rest_means_a_path_from_zero_volts() -> None:
    """A record from rest at 50 V is one from zero volts whose first samples were not read."""
    usual = short_posterior(samples=200, dynamics="lag", fixed={})
    approach = np.concatenate([np.zeros(1), np.full(400, 50.0)])
    voltage = 50 + usual.single_record.voltage / 4
    whole = np.concatenate([approach, voltage])
    reading = ring_bender(usual.single_record.actuator, "discrepancy", whole, 9)
    theta = usual.prior.theta(usual.prior.draw(np.random.default_rng(10), 5))
    theta[:, usual.prior.names.index("initial")] = 0.0
    settled = usual.altered(
        voltage=whole, displacement=reading, training=(slice(approach.size, whole.size),)
    )
    at_rest = usual.altered(voltage=voltage, displacement=reading[approach.size :])
    np.testing.assert_allclose(
        at_rest.log_likelihood(theta), settled.log_likelihood(theta), rtol=1e-9
    )
    wrong = at_rest.altered(voltage=voltage - 50).log_likelihood(theta)
    assert np.min(np.abs(wrong - at_rest.log_likelihood(theta))) > 1


@example(exponents=(2.0, 6.0, -4.0, -3.0))
@given(
    exponents=st.tuples(st.floats(0, 15), st.floats(0, 18), st.floats(-15, -3), st.floats(-26, -3))
)
def test_no_absurd_place_is_more_probable_than_a_possible_one(
    exponents: tuple[float, float, float, float],
) -> None:
    """Gains of 1e15 um/V, lags of 1e18 s, next to no noise: there rounding is all that is left."""
    posterior = moving("discrepancy", "lag", {}, missing=0.1)
    likelihood = replace(posterior.likelihood, offset_sd=100.0)
    usual = posterior.prior.theta(posterior.prior.draw(np.random.default_rng(5), 50))
    size, lag, sensor, discrepancy = 10.0 ** np.array(exponents)
    absurd = {"d": size, "alpha": size / 2, "lag": lag}
    absurd |= {"sensor_sd": sensor, "discrepancy_sd": discrepancy}
    theta = usual[:1]
    for name, value in absurd.items():
        theta = likelihood.table.with_values(theta, name, np.array([value]))
    assert likelihood.log_density(theta)[0] < np.max(likelihood.log_density(usual))


# The posterior of a batch of models; :mod:`tests.test_reference_posteriors` has its numbers


@pytest.mark.parametrize("size", [1, 63, 64, 65, 130])
def test_a_batch_is_its_rows(size: int) -> None:
    posterior = short_posterior(samples=100, dynamics="lag", fixed={})
    z = posterior.prior.unconstrain(posterior.prior.draw(np.random.default_rng(2), size))
    z[0, 0] = 40.0  # one row is outside
    together = posterior.log_density(z)
    alone = np.concatenate([posterior.log_density(row[np.newaxis]) for row in z])
    assert -np.inf == together[0] == alone[0]
    np.testing.assert_allclose(alone[1:], together[1:], rtol=1e-12)


@dataclass(frozen=True)
class BrokenNoise(WhiteNoise):
    """A likelihood that fails for every other model."""

    value: float = np.nan

    def whiten(
        self, theta: FloatArray, series: FloatArray, skipped: FloatArray | None = None
    ) -> tuple[FloatArray, FloatArray]:
        """Return the white noise's innovations, with a hole in every other determinant."""
        white, log_determinant = super().whiten(theta, series, skipped)
        log_determinant[::2] = self.value
        return white, log_determinant


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_a_likelihood_that_is_not_finite_is_no_evidence(value: float) -> None:
    sound = short_posterior("white", 100)
    broken = sound.altered(noise=BrokenNoise(value=value))
    z = sound.prior.unconstrain(sound.prior.draw(np.random.default_rng(3), 6))
    expected = sound.log_density(z)
    expected[::2] = -np.inf
    np.testing.assert_array_equal(expected, broken.log_density(z))


@pytest.mark.parametrize(
    "windows",
    [(slice(20, 50), slice(0, 20)), (slice(0, 30), slice(20, 50))],
    ids=["order", "apart"],
)
def test_windows_must_be_in_order_and_apart(windows: tuple[slice, ...]) -> None:
    with pytest.raises(InputError, match="in order of time and must not overlap"):
        short_posterior("white", 50, training=windows)


def test_parameters_must_be_those_of_the_model() -> None:
    sound = short_posterior("white", 50)
    with pytest.raises(InputError, match=r"^prior: its parameters must be d, .*, in this order"):
        sound.altered(noise=DiscrepancyNoise(INTERVAL))
    offset = single("offset", sound.prior.free[-2].prior or pytest.fail("has a prior"))
    with pytest.raises(InputError, match="in this order"):
        replace(sound, prior=offset)


# Isolated outliers are found, all of them and nothing else, and what is left is as without them


def spoilt(samples: int, rows: list[int], size: float = 20.0) -> Study:
    """Return the study of a record, some of whose readings are off by a size, um."""
    record = short_posterior(samples=samples).single_record
    displacement = record.displacement.copy()
    displacement[rows] += size * (-1.0) ** np.arange(len(rows))
    return study_of(replace(record, displacement=displacement))


NONE = {"record": np.zeros(0, dtype=np.int64)}


def test_a_reading_is_set_aside_from_six_sds_on() -> None:
    """One that is moved to nine sds from what the others predict is, one at four is not."""
    good = spoilt(400, []).posterior
    place = pointfit.fit(good, np.random.default_rng(9)).mode
    reading = good.single_record.displacement.copy()
    reading[300] += 1.0
    moved_by_one = good.altered(displacement=reading)
    before, after = (surprise(p, place)[300] for p in (good, moved_by_one))
    for sds, aside in ((9.0, [300]), (4.0, [])):
        moved = spoilt(400, [300], (sds - before) / (after - before))
        assert aside == outliers(moved, np.random.default_rng(9), NONE)["record"].tolist()


def test_what_is_left_is_the_posterior_without_those_readings() -> None:
    """The same posterior as that of the good record with these readings missing, exactly."""
    rows = [40, 41, 300, 599]
    good, spiky = spoilt(600, []), spoilt(600, rows)
    aside = outliers(spiky, np.random.default_rng(4), NONE)
    assert rows == aside["record"].tolist()
    cleaned, missing = spiky.without(aside).posterior, good.without(aside).posterior
    z = missing.prior.unconstrain(missing.prior.draw(np.random.default_rng(5), 5))
    np.testing.assert_array_equal(cleaned.log_density(z), missing.log_density(z))


def test_a_record_full_of_outliers_is_refused() -> None:
    noisy = spoilt(400, list(range(0, 400, 12)), 30.0)
    with pytest.raises(InputError, match="too many for isolated outliers"):
        outliers(noisy, np.random.default_rng(8), NONE)


def test_a_record_that_is_not_searched_keeps_its_readings() -> None:
    assert outliers(spoilt(400, [300]), np.random.default_rng(8), {}) == {}


# The posterior of several records: a sum over them, with what is shared there once.
# It is held against the posteriors of the records alone, and against the whole record where two
# records are its halves.


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

    one = joint(half("whole", *windows), engine="numba")
    halves = [half(f"half-{i}", window) for i, window in enumerate(windows)]
    points = {}
    for shared in (("initial", "offset"), ("initial",)):
        two = joint(*halves, shared=shared, engine="numba")
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
    both = study_of(loops, replace(slow, displacement=spoilt), noise="white")
    suspects = dict.fromkeys(RECORDS, np.zeros(0, dtype=np.int64))
    aside = outliers(both, np.random.default_rng(6), suspects)
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
