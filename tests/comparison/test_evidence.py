"""The log evidence is the integral that it stands for.

Held against the closed form where the model is linear and Gaussian, against dynesty's nested
sampling of the plain posterior (``tests/reference``), and against integrals over a grid. Later
readings are scored by their joint density, given the earlier ones alone.
"""

import json
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy import integrate, stats

from bwbayes.app.config.config import RecordConfig, load
from bwbayes.app.running.workers import one_thread
from bwbayes.app.study.resolve import resolve_config
from bwbayes.arrays import FloatArray, IntArray
from bwbayes.comparison.evidence import (
    BLOCKS,
    FUTURE,
    Evidence,
    Part,
    bridge,
    evidence,
    leave_future_out,
    log_prior_mass,
    log_ratios,
)
from bwbayes.inference.parameters import JointPrior
from bwbayes.inference.posterior import Posterior
from bwbayes.inference.study import generator
from bwbayes.model.declaration import Distribution
from bwbayes.record import Record, write_record
from bwbayes.sampling.chain import draws, log_densities
from bwbayes.sampling.plan import SamplingPlan
from tests.inference.linear import CASES, WINDOWS, Linear, every_case
from tests.measured import keep
from tests.reference.make import digest
from tests.reference.plain import FOLDER, MEASURED, load_case
from tests.sampled import converged
from tests.stand import autoregressive

PLAN = SamplingPlan(ess=1000, walkers=24, block=25)


def estimated(
    posterior: Posterior, plan: SamplingPlan = PLAN, source: np.random.Generator | None = None
) -> Evidence:
    chain = converged(posterior, plan)
    source = source or np.random.default_rng(2)
    return evidence(posterior, draws(posterior, chain), log_densities(chain), source)


@every_case
def test_a_linear_model_has_the_closed_form(free: tuple[str, ...], noise: str) -> None:
    """Within 0.1 nats, and within five of its errors: one in a million by chance."""
    model = Linear(free, noise)
    made, known = estimated(model.posterior), model.log_density(model.rows)
    assert abs(made.log_evidence - known) < 0.1
    assert abs(made.log_evidence - known) < 5 * made.error
    assert made.error < 0.02
    # The twin: a prior that was forgotten would cost more than that.
    wrong = made.log_evidence + 0.5 * len(free) * np.log(2 * np.pi)
    assert abs(wrong - known) > 1


def test_the_error_is_that_of_repeated_estimates() -> None:
    """Between two normals, from walkers that forget in ten steps: a χ² with 60 degrees of freedom.

    Outside of the limits with a probability of one in 10,000 for right errors; of draws taken for
    independent ones the sum would be some five times as large.
    """
    source = np.random.default_rng(6)
    p, q = stats.norm(1, 1), stats.norm(0, 1.5)
    total = 0.0
    for _ in range(60):
        x = 1 + autoregressive(0.9, 400, (4, 2), source)
        y = q.rvs(2000, source)
        log_ratio, error, _ = bridge(p.logpdf(x) - q.logpdf(x), p.logpdf(y) - q.logpdf(y))
        total += (log_ratio / error) ** 2
    assert 25 < total < 110


def test_a_cut_prior_has_the_mass_of_a_grid() -> None:
    """Two normal priors of which a constraint leaves x < y and x + y > 0."""
    posterior = Linear(("d", "alpha"), "white").posterior
    d, alpha = (p for p in posterior.prior.free)
    wide = Distribution("normal", {"mean": 0.5, "sd": 0.3})
    other = Distribution("normal", {"mean": 0.4, "sd": 0.2})
    prior = JointPrior(
        [replace(d, prior=wide), replace(alpha, prior=other)],
        posterior.single_record.actuator.hysteresis.holds,
    )
    mass, error = log_prior_mass(prior, np.random.default_rng(3))

    def density(y: float, x: float) -> float:
        return float(wide.frozen.pdf(x) * other.frozen.pdf(y))

    known, _ = integrate.dblquad(density, 0, 3, 0, lambda x: x)
    assert abs(mass - np.log(known)) < 5 * error + 1e-9
    assert 0 < error < 0.01
    # Without constraints a prior has all its mass.
    alone = Linear(("offset",), "white").posterior.prior
    assert (0.0, 0.0) == log_prior_mass(alone, np.random.default_rng(1))


@pytest.mark.slow
@pytest.mark.skipif(not MEASURED.is_file(), reason="the measured record is not here")
def test_nested_sampling_agrees_on_the_measured_record(tmp_path: Path) -> None:
    """Within 0.1 nats of the mean of four runs of dynesty, aimed at the evidence."""
    path = FOLDER / "measured.toml"
    config, case = load(path), load_case(path)
    known = json.loads((FOLDER / "measured_evidence.json").read_text(encoding="utf-8"))
    assert known["digest"] == digest(case)
    assert isinstance(config.record, RecordConfig)
    start = config.record.start
    assert start is not None
    write_record(
        Record(case.voltage, case.displacement, interval=case.interval, start=start),
        tmp_path / "t.h5",
    )
    source = RecordConfig(file="t.h5", train=config.record.train)
    problem = resolve_config(config.model_copy(update={"record": source}), tmp_path)
    made = estimated(problem.study.posterior, problem.plan, generator(1, "evidence"))
    away = made.log_evidence + made.log_prior_mass - np.mean(known["log_evidence"])
    keep("log evidence of the measured record", {"less dynesty's": round(float(away), 3)})
    assert abs(away) < 0.1


def test_nested_sampling_agrees() -> None:
    """It is that of dynesty, on the virtual stand's record, within 0.1 nats.

    Its prior is not divided by the mass that the constraints leave.
    """
    problem = resolve_config(load(FOLDER / "virtual.toml"), FOLDER)
    plan = replace(problem.plan, ess=1000.0)
    made = estimated(problem.study.posterior, plan, generator(1, "evidence"))
    reference = json.loads((FOLDER / "virtual.json").read_text(encoding="utf-8"))
    known = np.mean(reference["log_evidence"])
    assert abs(made.log_evidence + made.log_prior_mass - known) < 0.1
    assert made.error < 0.05


SHORT = SamplingPlan(ess=400, walkers=24, block=25)


def scored(
    posterior: Posterior, flat: FloatArray, held_out: dict[str, dict[str, tuple[slice, ...]]]
) -> dict[str, Part]:
    with ThreadPoolExecutor(1) as pool, one_thread():
        rng = np.random.default_rng(1)
        return leave_future_out(posterior, SHORT, flat, held_out, rng, pool)


def block_densities(model: Linear, known: IntArray, later: IntArray) -> FloatArray:
    """Log density of each block of later readings, given the known ones and earlier blocks."""
    edges = [k * later.size // BLOCKS for k in range(BLOCKS)] + [later.size]
    return np.diff([model.log_density(np.sort(np.r_[known, later[:edge]])) for edge in edges])


@every_case
def test_the_later_half_has_the_conditional_density_of_its_closed_form(
    free: tuple[str, ...], noise: str
) -> None:
    """Block by block within 0.15 nats, the sum too, with a discrepancy and without."""
    model = Linear(free, noise)
    part = scored(model.posterior, model.exact.draw(4000, 3), {})[FUTURE]
    rows = model.rows
    half = rows.size // 2
    expected = block_densities(model, rows[:half], rows[half:])
    np.testing.assert_allclose(part.log_scores, expected, atol=0.15)
    assert abs(np.sum(part.log_scores - expected)) < 0.3
    assert part.readings == rows.size - half
    # The twin: readings taken for independent ones score otherwise.
    later = rows[half:]
    sd = np.sqrt(np.diag(model.marginal())[later])
    alone = stats.norm.logpdf(model.readings[later], model.level[later], sd)
    assert abs(np.sum(alone) - np.sum(expected)) > (1 if noise == "discrepancy" else 0.1)


@pytest.mark.parametrize(
    ("free", "noise", "windows"), [(*CASES[0], WINDOWS[::-1]), (*CASES[1], WINDOWS)]
)
def test_a_held_out_window_has_the_conditional_density_of_its_closed_form(
    free: tuple[str, ...], noise: str, windows: tuple[slice, slice]
) -> None:
    """Also one that lies before what was fitted, for readings know their neighbors either way."""
    model, (known, later) = Linear(free, noise), windows
    fitted = model.posterior.altered(training=(known,))
    rows = np.arange(known.start, known.stop), np.arange(later.start, later.stop)
    drawn = model.given(rows[0]).draw(4000, 3)
    part = scored(fitted, drawn, {"record": {"window": (later,)}})["window"]
    expected = block_densities(model, *rows)
    assert abs(np.sum(part.log_scores) - np.sum(expected)) < 0.3
    np.testing.assert_allclose(part.log_scores, expected, atol=0.2)


def test_two_records_are_scored_given_the_beginnings_of_both() -> None:
    """Two windows as records that share all parameters; white noise forgets the cut at once."""
    model = Linear(("d", "offset"), "white")
    posterior = model.posterior
    names = ("first", "second")
    datasets = tuple(
        replace(posterior.single_record, training=(window,), name=name)
        for name, window in zip(names, WINDOWS, strict=True)
    )
    table = replace(datasets[0].table, records=names, shared=("initial", "offset"))
    both = Posterior(datasets, posterior.prior, joint=table)
    part = scored(both, model.exact.draw(4000, 3), {})[FUTURE]
    rows = [dataset.readings.rows for dataset in datasets]
    known = np.concatenate([own[: own.size // 2] for own in rows])
    later = np.concatenate([own[own.size // 2 :] for own in rows])
    expected = np.sum(block_densities(model, known, later))
    assert abs(np.sum(part.log_scores) - expected) < 0.3
    assert part.readings == later.size


def test_the_ratios_of_normal_integrals_are_those_of_their_volumes() -> None:
    """Draws of the two ends tell all between; of one end alone less, and they say so."""
    rng = np.random.default_rng(2)
    sds = np.array([4.0, 3.0, 2.0, 1.0, 0.25])
    ends = np.concatenate([rng.normal(0, sds[0], 4000), rng.normal(0, sds[-1], 4000)])
    log_likelihood = -0.5 * (ends / sds[:, np.newaxis]) ** 2
    log_z, effective = log_ratios(log_likelihood, {0: 4000, 4: 4000})
    np.testing.assert_allclose(log_z, np.log(sds / sds[0]), atol=0.1)
    assert np.min(effective) > 1000
    _, alone = log_ratios(log_likelihood[:, :4000], {0: 4000})
    assert alone[-1] < 600 < alone[0]
