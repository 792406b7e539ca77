"""What the hysteresis model promises of any model, any start and any path of the voltage."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import assume, example, given, settings
from hypothesis import strategies as st

from bwbayes.arrays import FloatArray
from bwbayes.model.operators.bouc_wen import ceiling, hysteresis
from tests.model.references import Model

NODES, WEIGHTS = (values / 2 for values in np.polynomial.legendre.leggauss(12))

few = settings(deadline=None, max_examples=60)


def of(top: float, ratio: float, exponent: float, alpha: float) -> Model:
    """Return the model with this ceiling (um) and ratio of β − γ to β + γ."""
    rate = alpha / top**exponent
    return Model(alpha, (1 + ratio) / 2 * rate, (1 - ratio) / 2 * rate, exponent)


def models(
    ratios: st.SearchStrategy[float], exponents: tuple[float, ...] = (1.0, 1.3, 2.0, 5.0)
) -> st.SearchStrategy[Model]:
    return st.builds(
        of, st.floats(0.1, 100), ratios, st.sampled_from(exponents), st.floats(0.01, 10)
    )


# From β = 0 (−1) through β = γ (0) and γ = 0 (1) to γ near −β.
every_ratio = st.one_of(st.sampled_from([-1.0, 0.0, 1.0]), st.floats(-1, 20))
passive_ratio = st.one_of(st.sampled_from([0.0, 1.0]), st.floats(0, 20))
any_model = models(every_ratio)
corners = st.lists(st.floats(-100, 100).map(lambda u: round(u, 6)), min_size=2, max_size=8)
inside = st.floats(-1, 1)


def top_of(parameters: Model) -> float:
    return float(ceiling(*np.array([*parameters])[:, np.newaxis])[0])


def refined(path: list[float], pieces: list[int]) -> tuple[FloatArray, list[int]]:
    """Put samples between those of a path; return the finer path and the places of the old ones."""
    fine, places = [path[0]], [0]
    for (one, two), count in zip(pairwise(path), pieces, strict=False):
        fine += np.linspace(one, two, count + 1)[1:].tolist()
        places.append(len(fine) - 1)
    return np.array(fine), places


@few
@given(parameters=any_model, share=inside, path=corners)
@example(parameters=of(1.0, -1.0, 1.0, 1.0), share=1.0, path=[0.0, 0.0])
def test_the_mirrored_drive_and_start_give_mirrored_h(
    parameters: Model, share: float, path: list[float]
) -> None:
    start, voltage = share * top_of(parameters), np.array(path)
    expected = -hysteresis(voltage, *parameters, initial=start)
    np.testing.assert_array_equal(expected, hysteresis(-voltage, *parameters, initial=-start))


@few
@given(
    parameters=any_model,
    share=inside,
    path=corners,
    pieces=st.lists(st.integers(1, 9), min_size=7, max_size=7),
)
def test_refining_the_drive_changes_nothing(
    parameters: Model, share: float, path: list[float], pieces: list[int]
) -> None:
    start = share * top_of(parameters)
    fine, places = refined(path, pieces)
    expected = hysteresis(np.array(path), *parameters, initial=start)[0]
    got = hysteresis(fine, *parameters, initial=start)[0][places]
    tolerance = 1e-10 * growth(parameters, path) * top_of(parameters)
    np.testing.assert_allclose(got, expected, rtol=0, atol=tolerance)


def growth(parameters: Model, path: list[float]) -> float:
    """Return what a rounding error can grow to, for paths on which it stays small.

    With γ > β the flow drives starts apart, at most with the rate n (γ − β) h^(n−1) at the ceiling.
    """
    n, top = parameters.exponent, top_of(parameters)
    rate = max(parameters.gamma - parameters.beta, 0) * n * top ** (n - 1)
    exponent = rate * float(np.abs(np.diff(path)).sum())
    assume(exponent <= 12)
    return float(np.exp(exponent))


@few
@given(parameters=any_model, share=inside, path=corners)
def test_h_stays_below_the_ceiling_from_any_start_inside(
    parameters: Model, share: float, path: list[float]
) -> None:
    top = top_of(parameters)
    h = hysteresis(np.array(path), *parameters, initial=share * top)
    assert np.isfinite(h).all()
    assert np.abs(h).max() <= top * (1 + 1e-11)


@few
@given(
    parameters=any_model,
    share=inside,
    path=corners,
    volts=st.floats(1e-3, 1e3),
    length=st.floats(1e-3, 1e3),
)
def test_units_do_not_matter(
    parameters: Model,
    share: float,
    path: list[float],
    volts: float,
    length: float,
) -> None:
    """In other units of voltage and length the numbers differ, and h is the same displacement."""
    alpha, beta, gamma, n = parameters
    start, rate = share * top_of(parameters), length ** (1 - n) / volts
    expected = length * hysteresis(np.array(path), *parameters, initial=start)
    other = Model(alpha * length / volts, beta * rate, gamma * rate, n)
    got = hysteresis(volts * np.array(path), *other, initial=length * start)
    tolerance = 1e-10 * growth(parameters, path) * length * top_of(parameters)
    np.testing.assert_allclose(got, expected, rtol=0, atol=tolerance)


# Energy


def dissipated(parameters: Model, start: float, path: list[float]) -> FloatArray:
    """∫ h du − Δ(h²)/(2α) along pieces of every stretch, in um V, for n = 1.

    The pieces end where the voltage turns and where h changes its sign, and besides are short
    against both rates, so that Gauss's rule is exact to rounding.
    """
    h, parts = start, []
    for before, after in pairwise(path):
        edges = before + np.unique(travels(parameters, h, after - before)) * np.sign(after - before)
        inner = edges[:-1, np.newaxis] + np.diff(edges)[:, np.newaxis] * (NODES + 0.5)
        drive = np.concatenate([edges[:1], np.hstack([inner, edges[1:, np.newaxis]]).ravel()])
        values = hysteresis(drive, *parameters, initial=h)[0]
        grid = values[1:].reshape(-1, NODES.size + 1)
        ends = np.concatenate([values[:1], grid[:, -1]])
        supplied = np.diff(edges) * (grid[:, :-1] @ WEIGHTS)
        parts.append(supplied - np.diff(ends**2) / (2 * parameters.alpha))
        h = float(ends[-1])
    return np.concatenate(parts)


def travels(parameters: Model, h: float, change: float) -> FloatArray:
    """Return where the pieces of a stretch from h end, V from its start."""
    against = parameters.beta - parameters.gamma
    g, whole = h * np.sign(change), abs(change)
    fastest = max(abs(against), parameters.beta + parameters.gamma)
    even = np.linspace(0, whole, int(np.ceil(whole * fastest)) + 2)
    if g >= 0:
        return even
    depth = -g * against / parameters.alpha
    crossing = np.log1p(depth) / against if abs(depth) > 1e-12 else -g / parameters.alpha
    return np.append(even, min(crossing, whole))


@few
@given(
    parameters=models(passive_ratio, (1.0,)),
    share=st.floats(-3, 3),
    path=st.lists(st.integers(-100, 100).map(float), min_size=2, max_size=8),
)
def test_no_path_draws_energy_from_a_passive_model(
    parameters: Model, share: float, path: list[float]
) -> None:
    """Not even a piece of one, whatever its start: the loss is ∫ c h² |du| / α with c ≥ 0."""
    parts = dissipated(parameters, share * top_of(parameters), path)
    size = 9 * top_of(parameters) ** 2 / parameters.alpha
    assert parts.min(initial=0) >= -1e-10 * (size + 200 * top_of(parameters))


def test_gamma_above_beta_is_not_passive() -> None:
    assert dissipated(Model(0.3575, 0.01, 0.03), -7.0, [0.0, 10.0]).sum() < -2.0


# Memory. A Preisach model returns to the point where a minor loop began, and goes on as if it had
# not been. This one does so without hysteresis alone; else a loop drifts, and its trace fades.


@few
@given(
    parameters=models(st.just(-1.0)),
    far=st.floats(-3, 3),
    width=st.floats(0, 2),
)
def test_without_beta_a_minor_loop_closes(parameters: Model, far: float, width: float) -> None:
    turn = far - np.copysign(width, far)
    path = (
        top_of(parameters) / parameters.alpha / parameters.exponent * np.array([0, far, turn, far])
    )
    h = hysteresis(path, *parameters)[0]
    tolerance = 1e-11 * growth(parameters, path.tolist()) * top_of(parameters)
    assert h[3] == pytest.approx(h[1], abs=tolerance)
