"""The compiled engine gives the reference's numbers, whatever the parameters.

Both engines sum over the samples in another order, so they may differ by rounding: by 1e-10 of
samples + |log density|.
"""

import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numba
import numpy as np
import pytest
from hypothesis import example, given, settings, strategies as st

from bwbayes import inference
from bwbayes.arrays import FloatArray
from bwbayes.errors import InputError
from bwbayes.inference import compiled, resolve_engine, stopwatch
from bwbayes.inference.compiled.lanes import LANES
from bwbayes.inference.posterior import Posterior
from bwbayes.model.registry import HYSTERESIS
from tests.inference.problems import short_posterior, truth
from tests.model.operators.test_every_operator import posterior as of_operator

MASS = {"mass": 0.00134, "stiffness": 4.1e5}


def assert_engines_agree(posterior: Posterior, theta: FloatArray) -> None:
    expected = replace(posterior, engine="numpy").log_likelihood(theta)
    got = replace(posterior, engine="numba").log_likelihood(theta)
    samples = sum(window.stop - window.start for window in posterior.single_record.training)
    np.testing.assert_array_less(np.abs(got - expected), 1e-10 * (samples + np.abs(expected)))


def prior_draws(posterior: Posterior, count: int, seed: int = 0) -> FloatArray:
    prior = posterior.prior
    return prior.theta(prior.draw(np.random.default_rng(seed), count))


def changed(posterior: Posterior, **values: float) -> FloatArray:
    """Return the truth (1, parameters) with some parameters at other values."""
    theta = truth(posterior)
    for name, value in values.items():
        theta[:, posterior.prior.names.index(name)] = value
    return theta


@pytest.mark.parametrize("noise", ["white", "discrepancy"])
@pytest.mark.parametrize("dynamics", ["none", "lag", "second-order"])
def test_engines_agree_on_prior_draws(noise: str, dynamics: str) -> None:
    fixed = {} if dynamics != "second-order" else MASS
    posterior = short_posterior(noise, 700, dynamics, fixed)
    assert_engines_agree(posterior, prior_draws(posterior, 300))


@pytest.mark.parametrize("count", [1, LANES - 1, LANES, LANES + 1, 100])
def test_any_number_of_models_fits_the_lanes(count: int) -> None:
    posterior = short_posterior(dynamics="lag")
    assert_engines_agree(posterior, prior_draws(posterior, count))


def test_a_general_exponent_is_left_to_numpy() -> None:
    posterior = short_posterior(dynamics="lag", fixed={"initial": 2.0})
    theta = np.repeat(truth(posterior), 5, axis=0)
    theta[:, posterior.prior.names.index("exponent")] = [1.0, 1.5, 1.0, 2.0, 3.0]
    assert_engines_agree(posterior, theta)


DEGENERATE = {
    "beta = gamma": {"beta": 0.02, "gamma": 0.02},
    "beta = -gamma": {"beta": 0.02, "gamma": -0.02},
    "no softening": {"beta": 0.0, "gamma": 0.0},
    "hardly any": {"beta": 1e-300, "gamma": 0.0},
    "steep": {"beta": 50.0, "gamma": 10.0},
    "gamma beyond beta": {"beta": 0.01, "gamma": 0.02},
    "no lag": {"lag": 0.0},
    "endless lag": {"lag": 1e6},
    "start above the ceiling": {"initial": 400.0, "gamma": 0.0},
    "start far below": {"initial": -400.0, "gamma": 0.0},
    "start near zero": {"initial": -1e-13},
    "no sensor noise to speak of": {"sensor_sd": 1e-7},
    "no discrepancy": {"discrepancy_sd": 0.0},
    "hardly a discrepancy": {"discrepancy_sd": 1e-9},
    "huge discrepancy": {"discrepancy_sd": 1e4},
    "constant discrepancy": {"discrepancy_time": 1e9},
    "nearly white discrepancy": {"discrepancy_time": 1e-4},
    "both huge": {"discrepancy_sd": 1e4, "discrepancy_time": 1e9, "sensor_sd": 1e-6},
    "a bad fit": {"d": 30.0, "offset": 1e4},
}


@pytest.mark.parametrize("values", DEGENERATE.values(), ids=DEGENERATE.keys())
def test_engines_agree_where_formulas_degenerate(values: dict[str, float]) -> None:
    posterior = short_posterior(dynamics="lag", fixed={})
    assert_engines_agree(posterior, changed(posterior, **values))


@pytest.mark.parametrize("damping", [0.0, 1.0, 2 * (0.00134 * 4.1e5) ** 0.5, 1580.0, 1e7])
def test_engines_agree_at_any_poles(damping: float) -> None:
    posterior = short_posterior(dynamics="second-order", fixed=MASS)
    assert_engines_agree(posterior, changed(posterior, damping=damping))


def test_without_hysteresis_an_initial_state_has_no_effect_on_either_engine() -> None:
    posterior = of_operator("linear")
    with_state = changed(posterior, initial=3.0)
    assert_engines_agree(posterior, with_state)
    expected = posterior.log_likelihood(changed(posterior, initial=0.0))
    assert np.array_equal(posterior.log_likelihood(with_state), expected)


VOLTAGES = st.lists(
    st.one_of(st.integers(-17, 17).map(lambda k: 10.0 * k), st.just(1e-9), st.floats(-200, 200)),
    min_size=2,
    max_size=150,
).filter(lambda path: max(path) - min(path) > 1)


@pytest.mark.parametrize("name", HYSTERESIS)
@given(path=VOLTAGES, seed=st.integers(0, 2**32 - 1), from_rest=st.booleans())
@example(path=[10.0, 0.0, 2e-309], seed=0, from_rest=True)  # a step whose inverse overflows
@settings(max_examples=8)
def test_engines_agree_on_any_path(
    name: str, path: list[float], seed: int, from_rest: bool
) -> None:
    """Plateaus, steps, turns at every sample; whole tens meet extrema and ends of the span."""
    usual = of_operator(name, from_rest=from_rest)
    reading = np.random.default_rng(seed).normal(size=len(path))
    posterior = usual.altered(
        voltage=np.array(path), displacement=reading, training=(slice(0, len(path)),)
    )
    assert_engines_agree(posterior, prior_draws(usual, 5, seed))


@pytest.mark.parametrize("name", HYSTERESIS)
def test_engines_agree_with_gain_and_creep(name: str) -> None:
    """Draws of the default priors have a likelihood, all of them."""
    whole = of_operator(name, parts=True)
    voltage, displacement = (
        column[::8].copy()
        for column in (whole.single_record.voltage, whole.single_record.displacement)
    )
    training = (slice(0, voltage.size),)
    posterior = whole.altered(voltage=voltage, displacement=displacement, training=training)
    count = 100 if name in ("jiles-atherton", "domain-wall") else 1000
    assert_engines_agree(posterior, prior_draws(posterior, count))


@pytest.mark.parametrize("name", HYSTERESIS)
def test_both_engines_simulate_alike(name: str) -> None:
    """To 1e-11 of the range; operators that are integrated, in steps of their own, to 1e-6."""
    posterior = of_operator(name, parts=True)
    theta = prior_draws(posterior, LANES + 3)
    expected = replace(posterior, engine="numpy").simulate(theta)
    got = replace(posterior, engine="numba").simulate(theta)
    size = np.abs(expected).max(axis=1, keepdims=True)
    tolerance = 1e-6 if name in ("jiles-atherton", "domain-wall") else 1e-11
    assert (np.abs(got - expected) <= tolerance * size).all()


@pytest.mark.parametrize("name", HYSTERESIS)
def test_what_is_rehearsed_simulates_and_whitens_but_needs_no_products(
    name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Another process does it, in which an error would not be seen."""
    posterior = replace(of_operator(name), engine="numba")
    monkeypatch.setattr(compiled.kernels, "sums", None)
    compiled.warm_up(posterior)


@pytest.mark.slow
def test_what_is_compiled_beforehand_is_all_that_the_products_take(tmp_path: Path) -> None:
    """Another process does it, in which another signature would only be in vain."""
    script = """if True:
        from bwbayes.inference.compiled import kernels, products
        from tests.inference.problems import short_posterior, truth

        posterior = short_posterior(dynamics="lag")
        kernels.compile_common()
        products(posterior.likelihoods[0], truth(posterior))
        common = kernels._one_by_one, kernels.noise.follow, kernels.displace
        print(*(len(function.signatures) for function in common))
    """
    variables = os.environ | {"NUMBA_CACHE_DIR": str(tmp_path)}
    done = subprocess.run(
        [sys.executable, "-c", script], env=variables, capture_output=True, check=True
    )
    assert done.stdout.split() == [b"1"] * 3


def test_twin_a_defect_of_a_millionth_is_found() -> None:
    """α one part in a million off is far outside what rounding may do."""
    posterior = short_posterior(dynamics="lag")
    right, wrong = truth(posterior), truth(posterior)
    wrong[:, posterior.prior.names.index("alpha")] *= 1 + 1e-6
    expected = replace(posterior, engine="numpy").log_likelihood(right)
    got = replace(posterior, engine="numba").log_likelihood(wrong)
    assert np.abs(got - expected)[0] > 1e-10 * (400 + np.abs(expected)[0])


def test_engine_is_chosen_or_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    assert ("numba", "numpy", "numba") == (
        resolve_engine(),
        resolve_engine("numpy"),
        resolve_engine("numba"),
    )
    monkeypatch.setattr(inference, "find_spec", lambda _: None)
    assert ("numpy", "numpy") == (resolve_engine("auto"), resolve_engine("numpy"))
    with pytest.raises(InputError, match="numba is not installed; pip install numba"):
        resolve_engine("numba")
    with pytest.raises(InputError, match="'fortran' is unknown; write one of auto, numpy, numba"):
        resolve_engine("fortran")  # type: ignore[arg-type]


def test_the_time_to_compile_is_left_out_of_what_a_search_takes() -> None:
    """Twin: the reference engine's time has it in."""

    def compiled_anew() -> None:
        numba.njit(lambda x: np.linalg.inv(x @ x.T) + np.sort(x[0]))(np.eye(3))

    with stopwatch("numba") as clock, stopwatch("numpy") as with_compiling:
        compiled_anew()
        assert clock() < with_compiling() / 3
        sum(range(3_000_000))
        assert clock() > 0
