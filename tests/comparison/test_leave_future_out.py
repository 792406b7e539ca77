"""Later readings are scored by their joint density, given the earlier ones alone."""

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np
import pytest
from scipy import stats

from bwbayes.app.running.workers import one_thread
from bwbayes.arrays import FloatArray, IntArray
from bwbayes.comparison.evidence import BLOCKS, FUTURE, Part, leave_future_out, log_ratios
from bwbayes.inference.posterior import Posterior
from bwbayes.sampling.plan import SamplingPlan
from tests.inference.linear import CASES, WINDOWS, Linear, every_case

PLAN = SamplingPlan(ess=400, walkers=24, block=25)


def scored(
    posterior: Posterior, flat: FloatArray, held_out: dict[str, dict[str, tuple[slice, ...]]]
) -> dict[str, Part]:
    with ThreadPoolExecutor(1) as pool, one_thread():
        rng = np.random.default_rng(1)
        return leave_future_out(posterior, PLAN, flat, held_out, rng, pool)


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
