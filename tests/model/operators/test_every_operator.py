"""What is promised of every operator in the registry, and of one from outside the package."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from bwbayes.arrays import FloatArray
from bwbayes.diagnosis.conflict import conflicts
from bwbayes.errors import InputError
from bwbayes.inference.pointfit import PointFit, fit
from bwbayes.inference.posterior import Posterior
from bwbayes.model.actuator import Actuator
from bwbayes.model.creep import Creep
from bwbayes.model.gain import PolynomialGain
from bwbayes.model.operator import Span
from bwbayes.model.registry import HYSTERESIS, made
from bwbayes.results import identifiability
from tests.inference.problems import decaying_sine, posterior_of

every_operator = pytest.mark.parametrize("name", HYSTERESIS)


def posterior(
    name: str,
    options: Mapping[str, Any] | None = None,
    *,
    from_rest: bool = False,
    parts: bool = False,
) -> Posterior:
    """Return a posterior of a short record with an operator."""
    operator = made("hysteresis", name, HYSTERESIS, options or {})
    voltage = decaying_sine(300)[60:]
    gain = PolynomialGain() if parts else None
    creep = Creep((0.1, 1.0), growing=True) if parts else None
    actuator = Actuator("lag", "first", 0.01, operator, gain, creep, Span(-100.0, 100.0))
    displacement = 0.6 * voltage + np.random.default_rng(1).normal(size=voltage.size)
    return posterior_of(voltage, displacement, actuator, "discrepancy", {}, from_rest=from_rest)


def drawn(of: Posterior, count: int) -> FloatArray:
    return of.prior.theta(of.prior.draw(np.random.default_rng(2), count))


@every_operator
@pytest.mark.parametrize("from_rest", [True, False])
@pytest.mark.parametrize("parts", [True, False])
def test_engines_agree(name: str, from_rest: bool, parts: bool) -> None:
    of = posterior(name, from_rest=from_rest, parts=parts)
    theta = drawn(of, 40)
    one = replace(of, engine="numpy").log_likelihood(theta)
    other = replace(of, engine="numba").log_likelihood(theta)
    assert np.isfinite(one).all()
    size = of.only.voltage.size + np.abs(one)
    assert np.max(np.abs(one - other) / size) < 1e-10


@every_operator
def test_pieces_of_a_record_equal_the_whole(name: str) -> None:
    of = posterior(name, parts=True)
    actuator, theta = of.likelihood.actuator, of.only.table.actuator(drawn(of, 5))
    whole = actuator.displacement(theta, of.only.voltage)
    state, parts = None, []
    for first, last in ((0, 1), (1, 2), (2, 77), (77, 240)):
        part, state = actuator.advance(theta, of.only.voltage[first:last], state)
        parts.append(part)
    size = np.ptp(whole)
    np.testing.assert_allclose(np.concatenate(parts, axis=1), whole, atol=1e-9 * size)


@every_operator
def test_states_that_are_reachable_are_inside_the_prior(name: str) -> None:
    of = posterior(name)
    column = of.table.columns(drawn(of, 200))
    (initial,) = (p for p in of.prior.parameters if p.name == "initial")
    low, high = initial.limits(column)
    least, most = of.only.actuator.hysteresis.reachable(
        column, float(of.only.voltage[0]), Span(-100.0, 100.0)
    )
    assert (least <= most).all()
    slack = 1e-9 * (np.abs(least) + np.abs(most))
    assert (least >= low - slack).all()
    assert (most <= high + slack).all()


@every_operator
def test_last_declared_is_the_initial_state(name: str) -> None:
    declarations = made("hysteresis", name, HYSTERESIS, {}).parameters
    assert [d.name for d in declarations if d.scope == "record"] == ["initial"]
    assert "initial" == declarations[-1].name
    assert any(d.loop for d in declarations)
    for one in declarations:
        assert one.label
        assert one.description
        assert one.unit


def test_an_option_that_an_operator_does_not_take_is_refused() -> None:
    with pytest.raises(InputError, match="hysteresis: 'preisach' has no option passive"):
        made("hysteresis", "preisach", HYSTERESIS, {"passive": False})


def test_an_unknown_operator_is_refused_with_the_nearest_name() -> None:
    with pytest.raises(InputError, match="did you mean preisach"):
        made("hysteresis", "presach", HYSTERESIS, {})
    with pytest.raises(InputError, match="cannot import 'nowhere:Loop'"):
        made("hysteresis", "nowhere:Loop", HYSTERESIS, {})


@every_operator
def test_remarks_of_a_point_can_be_made_with_every_operator(name: str) -> None:
    """What the record does not tell, and where priors and draws disagree; by draws of the prior."""
    of = posterior(name)
    generator = np.random.default_rng(3)
    draws = of.prior.draw(generator, 400)
    mode = of.prior.unconstrain(draws[:1])[0]
    identity = np.eye(mode.size)
    point = PointFit(mode, identity, 0.0, mode[np.newaxis], identity)
    column = of.table.columns(of.prior.theta(draws))
    findings = [
        *identifiability.undetermined(of, point),
        *conflicts(of.prior, draws, {}),
        *of.only.actuator.hysteresis.remarks(column, of.names),
    ]
    assert all(str(finding) for finding in findings)


def assert_fitted(of: Posterior) -> None:
    """Fit a simulated record: the mode is at least as probable as the truth."""
    generator = np.random.default_rng(4)
    free = of.prior.draw(generator, 1)
    clean = of.only.actuator.displacement(
        of.only.table.actuator(of.prior.theta(free)), of.only.voltage
    )[0]
    noise = 0.01 * np.ptp(clean) * generator.standard_normal(clean.size)
    record = of.altered(displacement=clean + noise)
    truth = record.log_density(of.prior.unconstrain(free))[0]
    assert fit(record, generator).log_density >= truth


def test_a_point_fit_asks_for_no_impossible_loop() -> None:
    """Bounds of single parameters do not say which shape terms may go together."""
    assert_fitted(posterior("bouc-wen-asymmetric", {"terms": ["b3", "b5", "b6"]}))


@pytest.mark.slow
@every_operator
def test_every_operator_is_fitted(name: str) -> None:
    assert_fitted(posterior(name))


def assert_finite(name: str, draws: int) -> None:
    """Every draw of the default priors has a likelihood, on both engines."""
    of = posterior(name, parts=True)
    voltage = of.only.voltage[::8].copy()
    displacement = of.only.displacement[::8].copy()
    of = of.altered(voltage=voltage, displacement=displacement, training=(slice(0, voltage.size),))
    theta = drawn(of, draws)
    for engine in ("numpy", "numba"):
        density = replace(of, engine=engine).log_likelihood(theta)
        assert np.isfinite(density).all()


@every_operator
def test_draws_of_the_default_priors_have_a_likelihood(name: str) -> None:
    assert_finite(name, 300 if name in ("jiles-atherton", "domain-wall") else 2000)


@pytest.mark.slow
@every_operator
def test_100000_draws_of_the_default_priors_have_a_likelihood(name: str) -> None:
    assert_finite(name, 100_000)
