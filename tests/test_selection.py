"""The path that people run is calibrated: a model is chosen for each record, then sampled.

``-m slow`` draws actuators from the priors of ``runs/calibration.toml``. One in five has just these
parameters; the others have a stage beside them, drawn from its own prior, which the search has to
find, or may leave out where 300 readings do not show it. The parameters that all actuators share
have 95% intervals that contain 95% of the truths; those of the chosen model alone contain fewer.
The truths are 420, which depend on each other in sevens: 2% are about 1.3 standard errors, and
right intervals pass in 80 of 100 such tests.
"""

from pathlib import Path

import numpy as np
import pytest

import bwbayes as bw
from bwbayes.app.config.config import load
from bwbayes.app.study.resolve import resolve_config
from bwbayes.arrays import BoolArray
from bwbayes.calibration.calibration import Simulated
from bwbayes.inference.posterior import Posterior
from tests.measured import keep

CONFIG = Path(__file__).resolve().parents[1] / "runs" / "calibration.toml"
SHARED = ("d", "alpha", "beta", "gamma", "lag", "offset", "sensor_sd")
STAGES: tuple[list[str], ...] = ([], ["backlash"], ["slew-limit"], ["saturation"], ["drift"])
ACTUATORS, SEED = 60, 12


def posterior_of(stages: list[str]) -> Posterior:
    """Return the posterior of the config's own record with these stages; its priors count."""
    config = load(CONFIG)
    model = config.model.model_copy(update={"stages": stages, "noise": "discrepancy"})
    run = resolve_config(config.model_copy(update={"model": model}), CONFIG.parent)
    return run.study.posterior


def actuator(posterior: Posterior, rng: np.random.Generator) -> tuple[bw.Record, dict[str, float]]:
    """Draw an actuator; return its record and its parameters."""
    theta = posterior.prior.theta(posterior.prior.draw(rng, 1))
    likelihood = posterior.likelihoods[0]
    of_record = posterior.table.of(theta, likelihood.name)
    sd = likelihood.start_sd(of_record)
    model = likelihood.actuator.advance(
        likelihood.table.actuator(of_record),
        likelihood.inputs,
        initial_transient=sd * rng.standard_normal(sd.shape),
        from_rest=likelihood.from_rest,
    )[0][0]
    record = bw.Record(likelihood.voltage, None, interval=likelihood.inputs.interval)
    noise = likelihood.table.noise(of_record)
    simulated = Simulated.of(record, model, likelihood.noise, noise, rng).record
    truth = {name: float(column[0]) for name, column in posterior.table.columns(theta).items()}
    return bw.Record.from_arrays(
        simulated.voltage, simulated.displacement, interval=simulated.interval
    ), truth


@pytest.mark.slow
def test_intervals_hold_whatever_the_search_chose() -> None:
    priors = {
        name: prior.model_dump(exclude_none=True) for name, prior in load(CONFIG).parameters.items()
    }
    posteriors = [posterior_of(stages) for stages in STAGES]
    inside: tuple[list[BoolArray], list[BoolArray]] = [], []
    for number in range(ACTUATORS):
        rng = np.random.default_rng([SEED, number])
        record, truth = actuator(posteriors[number % len(STAGES)], rng)
        fit = bw.fit(
            record, dynamics="lag", hold="zero", parameters=priors, ess=1000, progress=False
        )
        # Parameters of another operator are other quantities.
        shared = SHARED if fit.config.model.hysteresis == "bouc-wen" else ("lag", *SHARED[-2:])
        columns = [fit.study.posterior.names.index(name) for name in shared]
        true = np.array([truth[name] for name in shared])
        for row, draws in zip(inside, (fit.averaged, fit.flat_draws), strict=True):
            flat = draws.reshape(-1, draws.shape[-1])[:, columns]
            low, high = np.quantile(flat, [0.025, 0.975], axis=0)
            row.append((low <= true) & (true <= high))
    of_all, of_chosen = (float(np.mean(np.concatenate(row))) for row in inside)
    figures = {"of all models": of_all, "of the chosen one": of_chosen, "actuators": ACTUATORS}
    keep("selection", figures)
    assert 0.93 <= of_all <= 0.97
    assert of_chosen < of_all  # the twin
