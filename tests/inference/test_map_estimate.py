"""The point fit stands on the mode, sees all modes, and knows derivatives and curvature there."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, cast

import numpy as np
import pytest
from hypothesis import given, strategies as st
from scipy.optimize import least_squares
from scipy.signal import lfilter

from bwbayes.app.config.config import parse
from bwbayes.arrays import FloatArray
from bwbayes.inference import Engine, resolve_engine
from bwbayes.inference.map_estimate import LeastSquares, MAPEstimate, fit, mode_weights
from bwbayes.inference.mode_finding import (
    STEP,
    Target,
    climb,
    gradient_and_hessian,
    refine,
    value_and_jacobian,
)
from bwbayes.inference.noise import DISCREPANCY_SD, SENSOR_SD
from bwbayes.inference.posterior import Posterior
from bwbayes.inference.state_space import Noise, powers
from bwbayes.model.actuator import Actuator
from bwbayes.model.declaration import Declaration, Distribution
from tests.diagnosis.plants import bench
from tests.diagnosis.test_fixes import CONFIG, put
from tests.diagnosis.test_validation_end_to_end import made
from tests.inference.linear import CASES, Linear, every_case
from tests.inference.problems import (
    INTERVAL,
    decaying_sine,
    posterior_of,
    ring_bender,
    short_posterior,
)
from tests.prediction.runs import study_of

MODELS = ("white", "discrepancy", "lag")


def case(name: str) -> Posterior:
    if name == "lag":
        return short_posterior("discrepancy", 400, "lag", {}, seed=3)
    return short_posterior("white" if name == "white" else "discrepancy", 300, seed=2)


@pytest.fixture(scope="module")
def fits() -> dict[str, tuple[Posterior, MAPEstimate]]:
    return {name: (case(name), fit(case(name), np.random.default_rng(1))) for name in MODELS}


Fits = dict[str, tuple[Posterior, MAPEstimate]]


@pytest.mark.parametrize("steps", [False, True])
def test_least_squares_side_by_side_come_as_low_as_scipys(steps: bool) -> None:
    """From each of four prior draws, good starts or bad ones, to the optimum that scipy finds."""
    posterior = case("lag")
    prior = posterior.prior
    draws = prior.unconstrain(prior.draw(np.random.default_rng(4), 100))
    center, spread = np.median(draws, axis=0), np.std(draws, axis=0)
    study = LeastSquares(posterior, center, spread, steps=steps)
    starts = draws[:4]

    def residuals(physical: FloatArray) -> FloatArray:
        place = center.copy()
        place[study.physical] = physical
        residual: FloatArray = study.residuals(place[np.newaxis])[0]
        return residual

    lowest = [
        2 * least_squares(residuals, start, x_scale=spread[study.physical], jac="3-point").cost
        for start in starts[:, study.physical]
    ]
    costs = study.costs(study.optima(starts))
    assert np.min(costs) <= np.min(lowest) * (1 + 1e-6)
    # One may end in another valley.
    assert np.sum(costs <= np.array(lowest) * (1 + 1e-3)) >= 3


@pytest.mark.parametrize("name", MODELS)
def test_the_gradient_at_the_mode_vanishes(fits: Fits, name: str) -> None:
    """Less than 0.03 nats per posterior sd along each axis of the posterior."""
    posterior, point = fits[name]
    axes = np.linalg.cholesky(point.covariance).T
    step = 1e-3
    plus, minus = (posterior.log_density(point.mode + sign * step * axes) for sign in (1, -1))
    assert np.max(np.abs((plus - minus) / (2 * step))) < 0.03


@pytest.mark.parametrize("name", MODELS)
def test_the_covariance_is_that_of_the_curvature(fits: Fits, name: str) -> None:
    """In units of the reported covariance a numerical Hessian is the identity."""
    posterior, point = fits[name]
    axes = np.linalg.cholesky(point.covariance).T
    size, step = point.mode.size, 0.03
    hessian = np.empty((size, size))
    for i in range(size):
        for j in range(size):
            corners = [
                point.mode + step * (a * axes[i] + b * axes[j])
                for a, b in ((1, 1), (1, -1), (-1, 1), (-1, -1))
            ]
            pp, pm, mp, mm = posterior.log_density(np.array(corners))
            hessian[i, j] = -(pp - pm - mp + mm) / (4 * step**2)
    np.testing.assert_allclose(np.eye(size), hessian, atol=0.15)


@pytest.mark.parametrize(("number", "least"), [(97, 0.05), (106, 0.3)])
def test_both_modes_of_a_record_of_one_amplitude_are_seen(
    tmp_path: Path, number: int, least: float
) -> None:
    """The seed does not matter. In the second, least squares sees one optimum between the two."""
    study, _ = made((7, number), tmp_path)
    for seed in range(4):
        point = fit(study.posterior, np.random.default_rng(seed))
        free, _ = study.posterior.prior.constrain(point.optima)
        np.testing.assert_allclose([0.71, 0.95], np.sort(free[:, 0]), atol=0.02)
        assert least < min(mode_weights(study.posterior, point)[1])


PARTIAL = Distribution("uniform", {"lower": -1.0, "upper": 1.0})


@dataclass(frozen=True)
class Swaying(Noise):
    """An autoregressive process of second order, by its partial autocorrelations p and q."""

    @property
    def declarations(self) -> tuple[Declaration, ...]:
        """Sds of sensor and process, and both autocorrelations."""
        p, q = (
            Declaration(name, "", name, "a partial autocorrelation", lambda _: PARTIAL)
            for name in ("p", "q")
        )
        return (SENSOR_SD, DISCREPANCY_SD, p, q)

    @property
    def observe(self) -> FloatArray:
        """The first state."""
        return np.array([1.0, 0.0])

    def stationary(self, theta: FloatArray) -> FloatArray:
        """Return the autocovariances at lags zero and one."""
        _, sd, p, _ = theta.T
        rows = np.stack([np.ones_like(p), p, p, np.ones_like(p)], axis=-1)
        covariance: FloatArray = sd[:, np.newaxis, np.newaxis] ** 2 * rows.reshape(-1, 2, 2)
        return covariance

    def transition(self, theta: FloatArray, readings: float | FloatArray = 1.0) -> FloatArray:
        """Return a power of the companion matrix."""
        _, _, p, q = theta.T
        matrices = np.zeros((len(theta), 2, 2))
        matrices[:, 0, 0], matrices[:, 0, 1], matrices[:, 1, 0] = p * (1 - q), q, 1.0
        return powers(matrices, readings)


def test_noise_with_two_modes_has_the_better_one_whatever_the_seed() -> None:
    """One explains readings beside an oscillation, the other all by a process without any.

    They are dozens of nats apart. One sample of the prior leads to the better one seven times in
    twelve: with that alone, six seeds disagree 24 times in 25.
    """
    rng = np.random.default_rng(14)
    process = lfilter([1.0], [1.0, -0.98 * 1.8, 0.8], rng.standard_normal(2100))[500:]
    voltage, actuator = decaying_sine(1600), Actuator("none", "first", INTERVAL)
    reading = ring_bender(actuator, "white", voltage, 2) + 1.5 * process / np.std(process)
    reading += 0.5 * rng.standard_normal(1600)
    posterior = posterior_of(voltage, reading, actuator, f"{__name__}:Swaying")
    posterior = replace(posterior, engine=resolve_engine())
    found = [fit(posterior, np.random.default_rng(seed)).log_density for seed in range(6)]
    np.testing.assert_allclose(found, max(found), atol=0.05)


def test_a_climb_along_which_hardly_anything_changes_comes_to_an_end(tmp_path: Path) -> None:
    """A record of the wrong sign, with a place where d and alpha are all but one parameter.

    Axes there are so unlike in length that nothing can be solved for.
    """
    put(bench("sign", (6, 25)).records, tmp_path)
    posterior = study_of(parse(CONFIG, "config"), tmp_path).posterior
    point = fit(posterior, np.random.default_rng((6, 25)))
    assert point.log_density == pytest.approx(np.max(posterior.log_density(point.optima)))


@pytest.mark.parametrize("seed", [1, 2])
def test_two_lags_in_a_row_have_a_mode_for_either_order(
    tmp_path: Path, seed: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A sensor of 12 ms behind an actuator of 4 to 10 ms: exchanged, they do the same nearly.

    A mode that is known beforehand is found from there, too.
    """
    records = bench("good", (8, seed)).records
    keep = np.exp(-records[0].interval / 0.012)
    slow = [
        replace(
            record, displacement=lfilter([1 - keep], [1, -keep], np.asarray(record.displacement))
        )
        for record in records
    ]
    put(slow, tmp_path)
    config = CONFIG.replace("from_rest = true\n", "train = [[1.0, 9.0]]\n")
    config += '[model]\ndynamics = "lag"\nnoise = "discrepancy"\nstages = ["sensor-lag"]\n'
    posterior = study_of(parse(config, "config"), tmp_path).posterior
    point = fit(posterior, np.random.default_rng(seed))
    free, _ = posterior.prior.constrain(point.optima)
    lags = free[:, [posterior.names.index(name) for name in ("lag", "sensor_lag")]]
    np.testing.assert_allclose(lags[0].sum(), lags[1].sum(), rtol=0.05)
    assert np.prod(np.diff(lags[:2])) < 0
    assert min(mode_weights(posterior, point)[1]) > 0.1
    monkeypatch.setattr("bwbayes.inference.map_estimate._exchanged_starts", lambda *_: [])
    known = fit(posterior, np.random.default_rng(seed), further=point.optima)
    np.testing.assert_allclose(known.optima[:2], point.optima[:2], atol=0.01)


# Modes are those of closed forms, and what is simulated once is what is simulated each time


if TYPE_CHECKING:
    from bwbayes.inference.posterior import Posterior

LINEAR = {noise: Linear(free, noise) for free, noise in CASES}


@pytest.mark.parametrize("noise", LINEAR)
@given(
    start=st.lists(st.floats(-4.0, 4.0), min_size=3, max_size=3), width=st.sampled_from([0.01, 1.0])
)
def test_a_normal_posteriors_mode_is_the_closed_form(
    noise: str, start: list[float], width: float
) -> None:
    """From anywhere, in units far from those of the mode: to 1e-5 sds, its covariance to 1e-4."""
    model = LINEAR[noise]
    place = np.array(start[: model.mean.size])
    mode = refine(model.posterior, place, width * np.eye(place.size))
    exact = model.exact
    np.testing.assert_allclose(
        (model.mean + mode.coordinates * model.sd - exact.mean) / exact.sd, 0.0, atol=1e-5
    )
    covariance = mode.covariance * np.outer(model.sd, model.sd) / np.outer(exact.sd, exact.sd)
    correlation = exact.covariance / np.outer(exact.sd, exact.sd)
    np.testing.assert_allclose(covariance, correlation, atol=1e-4)


@dataclass
class Ridge:
    """A density that is flat along a diagonal, as of a record that does not tell a ratio."""

    width: float

    def log_density(self, coordinates: FloatArray) -> FloatArray:
        """Return it, up to a constant, at coordinates (points, 2)."""
        across = (coordinates @ np.array([0.6, 0.8])) / self.width
        return np.asarray(-0.5 * across**2)


@pytest.mark.parametrize("width", [1e-2, 1e-5, 1e-7])
def test_a_direction_without_any_curvature_leaves_a_covariance(width: float) -> None:
    """Which has a Cholesky factor, and is no wider than the prior if it would have none."""
    mode = refine(cast("Posterior", Ridge(width)), np.array([0.3, 0.1]), np.eye(2))
    assert np.isfinite(np.linalg.cholesky(mode.covariance)).all()
    assert np.linalg.eigvalsh(mode.covariance)[0] > 0


@every_case
def test_a_climb_to_a_normal_posterior_ends_at_its_mode(free: tuple[str, ...], noise: str) -> None:
    """It is the best of several starts, with the Fisher information's covariance."""
    model, target = LINEAR[noise], Target(LINEAR[noise].posterior)
    state = climb(target, np.array([[3.0, -2.0, 1.0], [0.5, 4.0, -1.0]])[:, : len(free)])
    away = (model.mean + state.coordinates * model.sd - model.exact.mean) / model.exact.sd
    np.testing.assert_allclose(away, 0.0, atol=1e-5)
    covariance, log_determinant = target.covariance(state)
    exact = model.exact.covariance / np.outer(model.sd, model.sd)
    np.testing.assert_allclose(covariance, exact, rtol=1e-6)
    assert log_determinant == pytest.approx(np.linalg.slogdet(exact)[1], abs=1e-6)


@pytest.mark.parametrize("engine", ["numpy", "numba"])
@pytest.mark.parametrize("sparse", [False, True])
def test_a_displacement_that_is_held_gives_the_density_of_the_noise(
    engine: Engine, sparse: bool
) -> None:
    posterior = replace(short_posterior(samples=200), engine=engine)
    if sparse:
        reading = np.full_like(posterior.single_record.displacement, np.nan)
        reading[::4] = posterior.single_record.displacement[::4]
        posterior = posterior.altered(displacement=reading)
    target = Target(posterior)
    places = np.tile(np.random.default_rng(1).normal(0, 0.5, len(posterior.names)), (5, 1))
    places[:, target.noise] += np.random.default_rng(2).normal(0, 0.5, (5, target.noise.size))
    places[4, target.noise] = 1e4  # beyond anything that is possible
    moved = target.at(places[:1])[0].displacement
    held = target.noise_density(places, moved[np.newaxis])
    np.testing.assert_allclose(held, posterior.log_density(places), rtol=1e-9)


def test_steps_in_the_noise_side_by_side_are_those_of_each_state_alone() -> None:
    """But for what differences make of the densities' rounding, ε |f| / h² of 1e5 nats: 1e-7."""
    posterior = replace(short_posterior(samples=200), engine="numpy")
    target = Target(posterior)
    places = np.random.default_rng(3).normal(0, 0.5, (3, len(posterior.names)))
    states = target.at(places)
    for state, before in zip(target.step_noise(states), states, strict=True):
        (alone,) = target.step_noise([before])
        np.testing.assert_allclose(state.coordinates, alone.coordinates, atol=1e-6)
        density = posterior.log_density(state.coordinates[np.newaxis])
        np.testing.assert_allclose(density, state.density, rtol=1e-9)
        assert state.density > before.density


# Derivatives in a posterior's coordinates are those of closed forms, within the errors stated


numbers = st.floats(-3.0, 3.0)


@given(rate=st.floats(0.1, 3.0), phase=numbers, z=numbers, power=st.integers(-6, 6))
def test_a_slope_is_the_complex_steps_within_its_error(
    rate: float, phase: float, z: float, power: int
) -> None:
    """For exp(sin(rate z + phase)), in any unit: h²|f‴|/6 by truncation, and a few ε|f|/h."""
    unit = 10.0**power

    def function(places: FloatArray) -> FloatArray:
        values: FloatArray = unit * np.exp(np.sin(rate * places + phase))
        return values

    exact = np.imag(unit * np.exp(np.sin(rate * (z + 1e-30j) + phase))) / 1e-30
    value, slopes = value_and_jacobian(function, np.array([[z]]))
    # |f‴| of exp(sin) is at most 4 e.
    truncation, rounding = STEP**2 * 4 * np.e * rate**3 / 6, 16 * 2.0**-52 * np.e / STEP
    assert value == function(np.array([[z]]))
    assert abs(slopes[0, 0, 0] - exact) < unit * (truncation + rounding)


@pytest.mark.parametrize("side", [-1.0, 1.0])
def test_a_slope_beside_the_impossible_is_that_of_the_other_side(side: float) -> None:
    def function(places: FloatArray) -> FloatArray:
        moved = places @ np.array([[2.0, 0.0], [0.0, 5.0]])
        return np.where(side * places[:, :1] > 0, np.nan, moved)

    _, slopes = value_and_jacobian(function, np.zeros((1, 2)))
    np.testing.assert_allclose(slopes[0], [[2.0, 0.0], [0.0, 5.0]], rtol=1e-9)
    _, slopes = value_and_jacobian(function, np.zeros((1, 2)), value=np.full((1, 2), np.nan))
    np.testing.assert_array_equal(slopes[0, 0], [0.0, 0.0])


@given(st.lists(numbers, min_size=10, max_size=10))
def test_the_hessian_of_a_quadratic_is_exact(numbers: list[float]) -> None:
    matrix = np.zeros((3, 3))
    matrix[np.tril_indices(3)] = numbers[:6]
    matrix, slope = matrix + matrix.T, np.array(numbers[6:9])

    def function(w: FloatArray) -> FloatArray:
        values: FloatArray = numbers[9] + w @ slope + 0.5 * np.einsum("mi,ij,mj->m", w, matrix, w)
        return values

    for value in (None, numbers[9]):
        gradient, hessian = gradient_and_hessian(function, 3, 0.1, value)
        np.testing.assert_allclose(gradient, slope, atol=1e-12)
        np.testing.assert_allclose(hessian, matrix, atol=1e-11)
    both = gradient_and_hessian(lambda w: np.outer(function(w), [1.0, 2.0]), 3, 0.1)
    np.testing.assert_allclose(both[0], np.outer(slope, [1.0, 2.0]), atol=1e-11)
    np.testing.assert_allclose(both[1], np.multiply.outer(matrix, [1.0, 2.0]), atol=1e-10)


@every_case
def test_a_linear_model_is_the_closed_form(free: tuple[str, ...], noise: str) -> None:
    model = Linear(free, noise)
    z = np.array([[0.3, -0.8, 1.1][: len(free)], [-1.0, 0.2, 0.4][: len(free)]])
    linear = Target(model.posterior).linearize(z)
    design = model.design[model.rows] * model.sd
    residual = (model.readings - model.level)[model.rows] - z @ design.T
    weighted = np.linalg.solve(model.noise[np.ix_(model.rows, model.rows)], design)
    for number in range(2):
        np.testing.assert_allclose(linear.slopes[number], design.T, rtol=1e-6, atol=1e-9)
        np.testing.assert_allclose(linear.residual[number], residual[number], atol=1e-9)
        np.testing.assert_allclose(linear.gradient[number], residual[number] @ weighted, rtol=1e-6)
        np.testing.assert_allclose(
            linear.fisher_information[number], design.T @ weighted, rtol=1e-6
        )


@pytest.mark.parametrize("engine", ["numpy", "numba"])
def test_the_gradient_is_that_of_the_density_where_nothing_is_unknown(engine: Engine) -> None:
    """In the physical coordinates of a record from rest; several models at once."""
    posterior = short_posterior(samples=200, fixed={"initial": 0.0})
    posterior = replace(posterior.altered(from_rest=True), engine=engine)
    places = np.random.default_rng(1).normal(0, 0.5, (3, len(posterior.names)))
    linear = Target(posterior).linearize(places)

    def log_likelihood(z: FloatArray) -> FloatArray:
        return posterior.log_likelihood(posterior.prior.theta(posterior.prior.constrain(z)[0]))

    _, expected = value_and_jacobian(log_likelihood, places, Target(posterior).physical)
    np.testing.assert_allclose(linear.gradient, expected, rtol=1e-5, atol=1e-4)


def test_what_two_records_say_adds_up() -> None:
    single = short_posterior(samples=200, fixed={"initial": 0.0, "offset": 0.0, "sensor_sd": 0.3})
    single = single.altered(name="first")
    second = replace(
        single.single_record, name="second", displacement=single.single_record.displacement[::-1]
    )
    shared = single.table.of_scope("record", "event")
    table = replace(single.table, records=("first", "second"), shared=shared)
    joint = Posterior((single.single_record, second), single.prior, single.engine, table)
    z = np.full((1, len(joint.names)), 0.1)
    parts = [Target(p).linearize(z) for p in (single, single.altered(**vars(second)))]
    whole = Target(joint).linearize(z)
    np.testing.assert_allclose(whole.gradient, sum(p.gradient for p in parts), rtol=1e-9)
    information = sum(p.fisher_information for p in parts)
    np.testing.assert_allclose(whole.fisher_information, information, rtol=1e-9)
    residual = np.concatenate([p.residual for p in parts], axis=1)
    np.testing.assert_array_equal(whole.residual, residual)
