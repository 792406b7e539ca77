"""Which quantities of a run get an uncertainty budget, and their values of each draw.

These are the slope d (or the operator's first parameter), the largest width of the loop, and the
displacement at the highest voltage of what is predicted: a record of its own, or else a held-out
window, or else the training one.
"""

from __future__ import annotations

import numpy as np

from bwbayes.app.fit.fitted import Run
from bwbayes.app.running.predictions import reaching
from bwbayes.arrays import FloatArray
from bwbayes.inference.posterior import Posterior
from bwbayes.prediction import budget
from bwbayes.prediction.bands import Bands
from bwbayes.prediction.budget import Budget, Measurand, loop_width, uncertainty_budgets
from bwbayes.prediction.initial_state import (
    InitialStates,
    estimate_initial_states,
    training_initial_states,
)

# Samples that are simulated at once.
PIECE = 400


def run_budgets(run: Run) -> tuple[Budget, ...]:
    """Return the budgets of a run from half of its draws as the readings have them."""
    study, draws, predictions = run.study, run.subset[::2], run.predictions
    posterior, instruments = study.posterior, study.record.instruments
    shown = next((bands for bands in predictions if not bands.training), predictions[0])
    actuators = [
        parameter.name
        for parameter in posterior.prior.free
        if parameter.declared.scope == "actuator" and parameter.name in posterior.table.physical
    ]
    name = "d" if "d" in actuators else [*actuators, *posterior.names][0]
    unit = next(p.unit for p in study.parameters if p.name == name)
    quantities = [
        Measurand(name, unit, draws[:, posterior.names.index(name)]),
        loop_width(posterior, draws),
        _displacement(run, draws, shown),
    ]
    return uncertainty_budgets(posterior, draws, quantities, instruments, study.scales(len(draws)))


def _displacement(run: Run, draws: FloatArray, bands: Bands) -> Measurand:
    """Return the displacement beyond the sensor's zero at the highest voltage of some bands."""
    study = run.study
    at = int(np.argmax(np.where(bands.scored(bands.mean), bands.voltage, -np.inf)))
    added, validation = dict[str, float](), study.validations.get(bands.name)
    if validation is not None and validation.record is not None:
        record, of = validation.record, validation.of
        beyond = run.extrapolations[bands.name]
        rng = study.generator(f"budget {record.sha256}")

        def begun(posterior: Posterior, own_draws: FloatArray) -> InitialStates:
            theta = posterior.prior.theta(own_draws)
            return estimate_initial_states(posterior, theta, record, validation.start, rng)

        alone = study.posterior.for_record(of)
        own_draws = study.posterior.select_draws(draws, of)
        states = begun(alone, own_draws)
        reached = reaching(study, draws, of, record, beyond)
    else:
        of = next(name for name in study.records if bands.name in study.windows(name))
        record = study.records[of]
        alone = study.posterior.for_record(of)
        own_draws = study.posterior.select_draws(draws, of)
        rng = study.generator(f"budget {record.sha256}")
        states = training_initial_states(alone, alone.prior.theta(own_draws), rng)
        reached = None
    sample = int(np.argmin(np.abs(record.time - bands.time[at])))
    inputs = record.inputs[: sample + 1]

    def values(of: InitialStates) -> FloatArray:
        last = np.empty(0)
        for simulated in of.pieces(inputs, PIECE):
            last = simulated[:, -1]
        return last - of.mean_offset

    displacement = values(states)
    if reached is not None and reached[0] is not alone:
        crept = begun(*reached)
        creep = np.var(values(crept)) - np.var(displacement)
        added[budget.CREEP] = max(float(creep), 0.0)
    dataset = alone.single_record
    slow, _ = dataset.noise.marginal_sd(alone.noise_of_new(alone.prior.theta(own_draws)))
    added[budget.MODEL] = float(np.mean(slow**2)) + (bands.model_error_sd or 0.0) ** 2
    added[budget.STATE] = float(np.mean(states.offset_sd**2))
    added[budget.CURVE] = study.record.instruments.linearity_sd(dataset.extent) ** 2
    name = f"displacement at {bands.voltage[at]:.3g} V ({bands.name}, {bands.time[at]:.4g} s)"
    return Measurand(name, "um", displacement, added, budget.STATE, states.rows)
