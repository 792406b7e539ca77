"""The sampler finds the posteriors that an independent route found: long runs of nested sampling.

``tests/reference`` holds two cases, a virtual record and a measured one: configs in which every
prior is a number, the posterior written a second time, slowly and plainly, and what dynesty found
of it (``make.py``, more than 20,000 effective draws). First both likelihoods and both priors must
agree; then a run by the normal path, of 5,000 effective draws or more of every parameter, must give
means within 0.1 sd, sds within 5%, and 5 and 95% quantiles within 0.15 sd.

These limits are 3.3 or more standard errors of the difference, most of them above five: over seeds,
a right sampler would fail once in some 200 runs. A wrong one does not pass with sds that are 10%
off, nor with a noise whose correlation is half as long again, as the twins show.
"""

import json
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pytest

from bwbayes.app.config.config import RecordConfig, load
from bwbayes.app.fit.fitted import Run
from bwbayes.app.study.resolve import resolve_config
from bwbayes.arrays import FloatArray
from bwbayes.inference.posterior import Posterior
from bwbayes.record import Record, write_record
from bwbayes.sampling.chain import draws
from bwbayes.sampling.diagnostics import SamplingResult
from bwbayes.sampling.plan import SamplingPlan
from tests.reference.make import digest, from_cube
from tests.reference.plain import FOLDER, MEASURED, Case, load_case, log_likelihood, log_prior
from tests.sampled import sampled
from tests.together import WrongCorrelation

# Largest errors of a run: in sds, in parts, in sds.
LIMITS = {"mean": 0.1, "sd": 0.05, "quantile_5": 0.15, "quantile_95": 0.15}

ESS = 5000

absent = pytest.mark.skipif(
    not MEASURED.is_file(), reason="the measured record is not part of the project, and not here"
)


@dataclass(frozen=True)
class Reference:
    """A case twice, as the package and as the plain code read it, and what dynesty found."""

    problem: Run
    case: Case
    result: Mapping[str, Any]


@pytest.fixture(
    scope="module", params=["virtual", pytest.param("measured", marks=[absent, pytest.mark.slow])]
)
def reference(
    request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory
) -> Reference:
    """Let both read a case; the plain code thins the measured record, voltage and all, for both."""
    path = FOLDER / f"{request.param}.toml"
    result = json.loads(path.with_suffix(".json").read_text(encoding="utf-8"))
    config, case, folder = load(path), load_case(path), FOLDER
    if request.param == "measured":
        folder = tmp_path_factory.mktemp("thinned")
        assert config.records["record"].start is not None
        thinned = Record(
            case.voltage,
            case.displacement,
            interval=case.interval,
            start=config.records["record"].start,
        )
        write_record(thinned, folder / "thinned.h5")
        source = RecordConfig(file="thinned.h5", train=config.records["record"].train)
        config = config.model_copy(update={"record": source})
    return Reference(resolve_config(config, folder), case, result)


@pytest.fixture(scope="module")
def drawn_by_a_run(reference: Reference) -> FloatArray:
    """Draws of the case by the normal path, (draws, free)."""
    study = reference.problem.study
    outcome, result = run(study.posterior, reference.problem.plan, study.seed)
    check = outcome.check
    assert outcome.converged, outcome.stop_reason
    assert min(check.ess_bulk.min(), check.ess_tail.min()) >= ESS
    return result


def run(posterior: Posterior, plan: SamplingPlan, seed: int) -> tuple[SamplingResult, FloatArray]:
    """Sample a posterior as a run does; draws (draws, free)."""
    outcome, chain = sampled(posterior, plan, seed)
    return outcome, draws(posterior, chain).reshape(-1, len(posterior.names))


def deviations(
    result: Mapping[str, Any], names: tuple[str, ...], got: FloatArray
) -> dict[str, Any]:
    """Distance of draws (draws, free) from a reference, in parts of what is allowed."""
    off = {}
    for name, column in zip(names, got.T, strict=True):
        known = result["parameters"][name]
        low, high = np.quantile(column, [0.05, 0.95])
        values = {"mean": np.mean(column), "sd": np.std(column, ddof=1)}
        values |= {"quantile_5": low, "quantile_95": high}
        for key, limit in LIMITS.items():
            off[f"{name} {key}"] = abs(float(values[key]) - known[key]) / (limit * known["sd"])
    return off


def drawn(case: Case, size: int) -> list[dict[str, float]]:
    """Draw from the single priors, with the fixed parameters, outside the constraints too."""
    cubes = np.random.default_rng(1).uniform(size=(size, len(case.free)))
    return [
        {**case.fixed, **dict(zip(case.free, from_cube(case, cube).tolist(), strict=True))}
        for cube in cubes
    ]


def test_both_read_the_same_case(reference: Reference) -> None:
    posterior, case = reference.problem.study.posterior, reference.case
    assert case.names == posterior.prior.names
    assert case.training == posterior.single_record.training
    assert case.hold == posterior.single_record.actuator.hold
    np.testing.assert_allclose(case.interval, posterior.single_record.actuator.interval, rtol=1e-9)
    np.testing.assert_array_equal(case.voltage, posterior.single_record.voltage)
    np.testing.assert_array_equal(case.displacement, posterior.single_record.displacement)


def test_the_reference_is_of_this_case(reference: Reference) -> None:
    """If not, config or record have changed: make the reference again."""
    assert digest(reference.case) == reference.result["digest"]


def test_the_likelihood_is_the_plain_one(reference: Reference) -> None:
    posterior, case = reference.problem.study.posterior, reference.case
    theta = posterior.prior.theta(posterior.prior.draw(np.random.default_rng(1), 40))
    rows = [dict(zip(case.names, row, strict=True)) for row in theta.tolist()]
    expected = np.array([log_likelihood(case, row) for row in rows])
    np.testing.assert_allclose(expected, posterior.log_likelihood(theta), rtol=1e-8)


def test_the_prior_is_the_plain_one(reference: Reference) -> None:
    """But for a constant; and zero at the same places."""
    prior, case = reference.problem.study.posterior.prior, reference.case
    rows = drawn(case, 100)
    expected = np.array([log_prior(case, row) for row in rows])
    got = prior.log_density(np.array([[row[name] for name in case.free] for row in rows]))
    inside = np.isfinite(expected)
    assert 10 < np.sum(inside) < 90
    np.testing.assert_array_equal(inside, np.isfinite(got))
    assert np.ptp(expected[inside] - got[inside]) < 1e-9


def test_a_run_gives_the_reference(reference: Reference, drawn_by_a_run: FloatArray) -> None:
    off = deviations(reference.result, reference.case.free, drawn_by_a_run)
    assert max(off.values()) < 1, off


def test_twin_draws_that_are_too_narrow_are_found(
    reference: Reference, drawn_by_a_run: FloatArray
) -> None:
    """Ten per cent, in every parameter."""
    middle = np.mean(drawn_by_a_run, axis=0)
    off = deviations(
        reference.result, reference.case.free, middle + 0.9 * (drawn_by_a_run - middle)
    )
    assert all(off[f"{name} sd"] > 1 for name in reference.case.free), off


def test_twin_noise_with_a_wrong_correlation_is_found(reference: Reference) -> None:
    """Its correlation decays as if the samples were half as far apart again."""
    wrong = WrongCorrelation(reference.case.interval, 1.5)
    planted = reference.problem.study.posterior.altered(noise=wrong)
    plan = replace(reference.problem.plan, ess=1000.0, walkers=24)
    outcome, got = run(planted, plan, reference.problem.study.seed)
    assert outcome.converged, outcome.stop_reason
    off = deviations(reference.result, reference.case.free, got)
    assert max(off.values()) > 2, off
