"""Intervals hold whichever model acts, of those that a record does not rule out."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.stats import ks_2samp, multivariate_normal

from bwbayes.app.config.config import Config, RecordConfig
from bwbayes.app.study.resolve import resolve_config
from bwbayes.arrays import FloatArray
from bwbayes.diagnosis import averaging
from bwbayes.diagnosis.averaging import (
    Alternative,
    alternatives,
    average,
    from_text,
    remarks,
    to_text,
)
from bwbayes.diagnosis.defects import DEFECTS
from bwbayes.diagnosis.explanations import KINDS
from bwbayes.diagnosis.laplace import LocalFit
from bwbayes.diagnosis.residual_analysis import Explanation, ResidualAnalysis
from bwbayes.inference import map_estimate as pointfit
from bwbayes.inference.study import Study
from bwbayes.record import write_record
from tests.app.test_model_choice import config_of
from tests.diagnosis.plants import plant

STAGES = ("backlash", "drift", "cubic")


@pytest.fixture
def study(tmp_path: Path) -> Study:
    return resolve_config(config_of("good", tmp_path), tmp_path).study


def fits_of(study: Study, nats: float) -> dict[tuple[str, ...], LocalFit]:
    """Return fits of a study and of three models with a stage more, by their parameters."""
    rng, fits = np.random.default_rng(1), {}
    for number, stages in enumerate([(), *((stage,) for stage in STAGES)]):
        posterior = study.with_model(study.spec.with_stages(*stages)).posterior
        size = len(posterior.names)
        factor = 0.05 * (np.eye(size) + 0.2 * rng.standard_normal((size, size)))
        place = 0.1 * rng.standard_normal(size)
        evidence = (nats + 0.3 * number) * (number > 0)
        readings = posterior.single_record.readings.values
        fit = LocalFit(posterior, place, factor @ factor.T, 0.0, evidence, readings)
        fits[posterior.names] = fit
    return fits


def explained(study: Study) -> list[Explanation]:
    return [
        Explanation(
            stage,
            f"a {stage}",
            "none",
            nats=0.0,
            spec=study.spec.with_stages(stage),
            mode={"d": 0.0},
        )
        for stage in STAGES
    ]


def found_of(
    study: Study, fits: dict[tuple[str, ...], LocalFit], causes: list[Explanation]
) -> list[Alternative]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(averaging, "climb", lambda posterior, _: fits[posterior.names])
        return alternatives(study, np.zeros((1, len(study.posterior.names))), causes)


def test_draws_are_those_of_all_models_together(study: Study) -> None:
    """Each model's share has its mean and covariance; the shares are by evidence, a priori even."""
    fits, names = fits_of(study, np.log(KINDS)), study.posterior.names
    found = from_text(to_text(found_of(study, fits, explained(study))))
    odds = np.exp([0.0, 0.3, 0.6, 0.9])
    np.testing.assert_allclose([one.probability for one in found], odds[1:] / np.sum(odds))
    here, *others = fits.values()
    rng, size = np.random.default_rng(2), 200_000
    sampled = rng.multivariate_normal(here.coordinates, here.covariance, size)
    own, _ = study.posterior.prior.constrain(sampled)
    shape = 100, 4, -1, len(names)
    draws = average(study.posterior, own.reshape(shape), here.covariance, found, rng)
    places = study.posterior.prior.unconstrain(draws.reshape(size, -1))

    shares, normals, again = odds / np.sum(odds), list[Any](), list[FloatArray]()
    for fit, share in zip((here, *others), shares, strict=True):
        columns = [fit.posterior.names.index(name) for name in names]
        of_names = fit.covariance[np.ix_(columns, columns)]
        normals.append(multivariate_normal(fit.coordinates[columns], of_names))
        again.append(normals[-1].rvs(round(size * share), rng))

    def entropies(at: FloatArray) -> FloatArray:
        """Return the log density of all models together, whose mean tells distributions apart."""
        densities = [share * normal.pdf(at) for share, normal in zip(shares, normals, strict=True)]
        return np.log(np.sum(densities, axis=0))

    expected, moved, unmoved = map(entropies, (np.concatenate(again), places, sampled))
    error = 5 * np.std(expected) / np.sqrt(size / 2)
    assert abs(np.mean(moved) - np.mean(expected)) < error
    assert abs(np.mean(unmoved) - np.mean(expected)) > 5 * error  # the twin: one model alone
    for column, name in enumerate(names):
        p = ks_2samp(places[:, column], np.concatenate(again)[:, column]).pvalue
        assert p > 0.001 / len(names), name


@pytest.mark.parametrize(
    "change",
    [
        lambda cause, _: replace(cause, nats=-8.0),
        lambda cause, _: replace(cause, spec=None),
        lambda cause, _: replace(cause, mode={}),
        lambda cause, _: replace(cause, held_out=(0.1, 0.2)),
        lambda cause, spec: replace(cause, spec=spec.with_stages("duhem")),
    ],
    ids=["improbable", "without a model", "without a fit", "misleading", "another operator"],
)
def test_some_models_are_no_alternatives(change: Callable[..., Explanation], study: Study) -> None:
    causes = [change(cause, study.spec) for cause in explained(study)]
    assert not found_of(study, fits_of(study, 0.0), causes)


def test_a_model_of_fewer_readings_is_compared_on_those(tmp_path: Path) -> None:
    """A delay needs the voltage beyond the record; it is none that any reading needs."""
    write_record(plant("good", (8, 1), 8.0), tmp_path / "whole.h5")
    config = Config(record=RecordConfig(file="whole.h5"))
    study, rng = resolve_config(config, tmp_path).study, np.random.default_rng(4)
    optima = pointfit.fit(study.posterior, rng).optima
    analysis = ResidualAnalysis.of(study.posterior, optima, rng, study)
    (delay,) = DEFECTS["delay"].explanations(analysis)
    assert delay.spec is not None
    delayed = study.with_model(delay.spec).posterior
    readings = [one.single_record.readings.rows.size for one in (delayed, study.posterior)]
    assert readings[0] < readings[1]
    found = alternatives(study, optima, [replace(delay, nats=0.0)])
    assert sum(other.probability for other in found) < 1 / KINDS


def test_what_the_prior_excludes_stays_as_sampled(study: Study) -> None:
    """Here |gamma| would exceed beta."""
    names, rng = study.posterior.names, np.random.default_rng(3)
    own = study.posterior.prior.draw(rng, 1000)
    covariance = np.eye(len(names))
    far = Alternative("far", 0.5, ["beta"], [-9.0], [[1e-6]])
    draws = average(study.posterior, own, covariance, [far], rng)
    _, log_prior = study.posterior.prior.constrain(study.posterior.prior.unconstrain(draws))
    assert np.isfinite(log_prior).all()
    assert np.any(draws != own)
    assert np.any(np.all(draws == own, axis=1))


def test_what_is_probable_is_named() -> None:
    others = [Alternative(text, share, [], [], []) for text, share in (("a", 0.3), ("b", 0.05))]
    assert remarks(others) == [
        "the record neither shows nor rules out a (probability 30%); the intervals allow for it"
    ]
    assert remarks(others[1:]) == []
