"""The uncertainty budget and the certificate of a run: ``fit.budget()``, ``fit.certificate()``.

A certificate is a page to print: what was measured, under which conditions and with which
instruments, as [certificate] in the config says; the model's equation, its quantities with coverage
intervals, their budget, what was validated, and the limits of use. It is none where validation
failed, and says so in the first line.

The quantities that get an uncertainty budget are the slope d (or the operator's first parameter),
the largest width of the loop, and the displacement at the highest voltage of what is predicted: a
record of its own, or else a held-out window, or else the training one.
"""

from __future__ import annotations

import inspect
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from hashlib import sha256
from importlib.metadata import version
from typing import Any, ClassVar

import numpy as np

from bwbayes.app.fit.fitted import Run
from bwbayes.app.jobs.predict import reaching
from bwbayes.arrays import FloatArray
from bwbayes.diagnosis.validation import ValidationSummary
from bwbayes.inference.posterior import Posterior
from bwbayes.prediction.bands import Bands
from bwbayes.prediction.budget import (
    CHOICE,
    CREEP,
    CURVE,
    MODEL,
    STATE,
    Budget,
    Measurand,
    loop_width,
    uncertainty_budgets,
)
from bwbayes.prediction.initial_state import (
    InitialStates,
    estimate_initial_states,
    training_initial_states,
)
from bwbayes.prediction.loops import MEASURES
from bwbayes.prediction.prediction import thin_draws
from bwbayes.report.report import (
    Banner,
    Facts,
    Product,
    Report,
    Table,
    Text,
    coverage_text,
    digits,
    error_text,
    standing_banner,
    unit_text,
)
from bwbayes.report.run import budget_table, drives_like
from bwbayes.watching import WatchSteps, unwatched


@dataclass(frozen=True)
class UncertaintyBudget(Product):
    """The budgets of a run's main quantities."""

    NAME: ClassVar[str] = "budget"

    budgets: tuple[Budget, ...]
    standing: ValidationSummary = field(default_factory=ValidationSummary)

    def report(self) -> Report:
        """Return the table of the sources' shares."""
        return Report(
            title="Uncertainty budget",
            banners=standing_banner(self.standing),
            blocks=[budget_table(self.budgets, on="both")],
            numbers={"uncertainty_budget": [budget.numbers for budget in self.budgets]},
        )


def budget(fit: Run, *, watch: WatchSteps = unwatched) -> UncertaintyBudget:
    """Say which source has which share of what is not known of the main quantities.

    These are d, the largest width of the loop and a predicted displacement; shares are of the
    variance, and add up.

    Parameters
    ----------
    fit
        The fit to use.
    watch
        Called with the name of a step and the share of it that is done.

    Raises
    ------
    NotConvergedError
        The sampling has not converged.

    Examples
    --------
    bwbayes budget results/ring_bender
    """
    watch("budget", 0.0)
    return UncertaintyBudget(fit.uncertainty_budgets, fit.standing)


@dataclass(frozen=True)
class Certificate(Product):
    """Findings on an actuator, for those who have to rely on it.

    ``stated`` is said of it by subject; ``equations`` are those of the model's parts; ``estimates``
    have mean, standard uncertainty, coverage interval and expanded uncertainty of each quantity;
    ``validated`` says on what, ``limits`` where it may be used; ``facts`` are software and hashes.
    """

    NAME: ClassVar[str] = "certificate"

    name: str
    stated: Mapping[str, str]
    equations: Sequence[str]
    estimates: Sequence[Mapping[str, Any]]
    budgets: tuple[Budget, ...]
    validated: Sequence[str]
    limits: Sequence[str]
    facts: Mapping[str, str]
    standing: ValidationSummary

    def report(self) -> Report:
        """Return the page."""
        banners = standing_banner(self.standing)
        if self.standing.passed is False:
            lines = self.standing.lines
            banners = [Banner("bad", "VALIDATION FAILED: this is no certificate", items=lines)]
        return Report(
            title=f"Certificate: {self.name}",
            banners=banners,
            blocks=[
                Facts([*self.stated.items()]),
                self._table(),
                budget_table(self.budgets, totals=False),
                Facts(
                    [
                        *(("model", text) for text in self.equations),
                        *(("validated", text) for text in self.validated),
                        *(("limits of use", text) for text in self.limits),
                        *self.facts.items(),
                    ],
                    "notes",
                ),
                Text("Issued by (name, date, signature): ________________________________"),
            ],
            numbers={
                "name": self.name,
                "stated": dict(self.stated),
                "model": list(self.equations),
                "quantities": [dict(estimate) for estimate in self.estimates],
                "uncertainty_budget": [budget.numbers for budget in self.budgets],
                "validation": {**self.standing.numbers, "of": list(self.validated)},
                "limits_of_use": list(self.limits),
                **self.facts,
            },
        )

    def _table(self) -> Table:
        """Return the quantities with their uncertainties."""
        rows = []
        for estimate in self.estimates:
            keys = ("mean", "sd", "lower_95", "upper_95", "expanded_uncertainty")
            mean, sd, low, high, expanded = (digits(estimate[key], estimate["sd"]) for key in keys)
            factor = f"{estimate['coverage_factor']:.2f}"
            unit = unit_text(estimate["unit"])
            rows.append([estimate["name"], mean, sd, f"{low} to {high}", expanded, factor, unit])
        note = (
            "Propagation of distributions (JCGM 101): 95% coverage intervals are probabilistically "
            "symmetric, 2.5% on each side; the expanded uncertainty U is half their length, k is U "
            "over the standard uncertainty u. Voltages of loops are as the monitor reads them."
        )
        columns = ("Quantity", "Estimate", "u", "95% interval", "U", "k", "Unit")
        return Table("quantities", "Quantities", columns, rows, note=note, on="both")


def certificate(fit: Run, *, watch: WatchSteps = unwatched) -> Certificate:
    """Write one page to print on what was found of an actuator, with its uncertainties.

    Object, conditions and instruments are those of [certificate] in the config. A run whose
    validation failed gets a page that is stamped so.

    Parameters
    ----------
    fit
        The fit to use.
    watch
        Called with the name of a step and the share of it that is done.

    Raises
    ------
    NotConvergedError
        The sampling has not converged.

    Examples
    --------
    bwbayes certificate results/ring_bender
    """
    watch("certificate", 0.0)
    result, study, stated = fit.result, fit.study, fit.config.certificate
    entries = {
        "certificate": stated.number,
        "laboratory": stated.laboratory,
        "object": stated.object or fit.name,
        "conditions": stated.conditions,
        "instruments": "; ".join(stated.instruments) or None,
    }
    facts = fit.facts
    pairs = {subject: text or "not stated" for subject, text in entries.items()}
    instruments = study.record.instruments.facts
    for subject in ("sensor scale", "monitor scale"):
        pairs[subject] = instruments.get(subject, "taken as exact: no uncertainty is stated")
    if "sensor linearity" in instruments:
        pairs["sensor linearity"] = instruments["sensor linearity"]
    pairs |= {s: fact for s, fact in facts.items() if s.partition(" ")[0] in ("record", "fitted")}
    validated = []
    for name, verdict in result.validation.items():
        scores = result.scores[name]
        validated.append(
            f"{verdict.where}: {verdict.status}; the 95% sensor band covers "
            f"{coverage_text(scores, 'sensor', 95)} of its readings, NRMSE {error_text(scores)}"
        )
    limits = [
        drives_like(facts)
        if fit.standing.passed
        else f"none to rely on: validation {fit.standing.status}",
        "other temperatures, loads, mounts and later aging are not covered",
    ]
    software = {"software": f"bwbayes {version('bwbayes')}", "data, SHA-256": study.sha256}
    for path in (fit.folder.config, fit.folder.backend):
        software[f"{path.name}, SHA-256"] = sha256(path.read_bytes()).hexdigest()
    return Certificate(
        stated.object or fit.name,
        pairs,
        _equations(fit),
        _estimates(fit),
        fit.uncertainty_budgets,
        validated or ["nothing: no readings were held against the bands"],
        limits,
        software,
        fit.standing,
    )


def _equations(fit: Run) -> list[str]:
    """Return what the parts of the model say of themselves: their equations."""
    actuator = fit.study.posterior.datasets[0].actuator
    parts = [actuator.hysteresis, actuator.nonlinearity, actuator.filter, actuator.creep]
    equations = []
    for part in filter(None, [*parts, *actuator.stages]):
        first, *lines = (
            (inspect.getdoc(type(part)) or "").partition("\nParameters\n")[0].split("\n")
        )
        formulas = [line.strip().rstrip(",.") for line in lines if line.startswith("    ")]
        equations.append("; ".join([first.rstrip("."), *formulas]))
    return [*equations, f"noise: {fit.config.model.noise}"]


def _estimates(fit: Run) -> list[dict[str, Any]]:
    """Return the actuator's free parameters, the major loop's measures, and what has a budget.

    A parameter's budget is from fewer draws than its estimate, so that the estimate stands.
    """
    actuators = {p.name for p in fit.result.free if p.declared.scope == "actuator"}
    physical = actuators & {*fit.study.posterior.table.physical}
    estimates = [
        {"name": p.name, **fit.result.estimates[p.name]}
        for p in fit.result.free
        if p.name in physical
    ]
    assert fit.result.loops is not None
    for name, measured in fit.result.loops.major.estimates.items():
        if measured is not None:
            words, unit = MEASURES[name]
            estimates.append({"name": f"loop: {words.lower()}", "unit": unit, **measured.numbers})
    named = {estimate["name"] for estimate in estimates}
    for source in fit.uncertainty_budgets:
        if source.name not in named:
            estimates.append({"name": source.name, **source.numbers})
    for estimate in estimates:
        half = (estimate["upper_95"] - estimate["lower_95"]) / 2
        estimate["expanded_uncertainty"] = half
        estimate["coverage_factor"] = half / estimate["sd"] if estimate["sd"] else 0.0
    kept = [*("name", "unit", "mean", "sd", "lower_95", "upper_95")]
    kept += ["expanded_uncertainty", "coverage_factor"]
    return [{key: estimate[key] for key in kept} for estimate in estimates]


def run_budgets(run: Run) -> tuple[Budget, ...]:
    """Return the budgets of a run from half of its draws as the readings have them.

    A parameter's has the draws of all models that the record does not rule out.
    """
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
    of_all = run.averaged[..., posterior.names.index(name)].reshape(-1, 1)
    is_averaged = "alternatives" in run.chain.attributes()
    values = thin_draws(of_all, study.generator("draws"))[::2, 0]  # of the same draws
    quantities = [
        Measurand(name, unit, values, unexplained=CHOICE if is_averaged else ""),
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

        def estimate_states(posterior: Posterior, own_draws: FloatArray) -> InitialStates:
            theta = posterior.prior.theta(own_draws)
            return estimate_initial_states(posterior, theta, record, validation.start, rng)

        alone = study.posterior.for_record(of)
        own_draws = study.posterior.select_draws(draws, of)
        states = estimate_states(alone, own_draws)
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
        for simulated in of.pieces(inputs, 400):  # samples that are simulated at once
            last = simulated[:, -1]
        return last - of.mean_offset

    displacement = values(states)
    if reached is not None and reached[0] is not alone:
        crept = estimate_states(*reached)
        creep = np.var(values(crept)) - np.var(displacement)
        added[CREEP] = max(float(creep), 0.0)
    dataset = alone.single_record
    slow, _ = dataset.noise.marginal_sd(alone.noise_of_new(alone.prior.theta(own_draws)))
    added[MODEL] = float(np.mean(slow**2)) + (bands.model_error_sd or 0.0) ** 2
    added[STATE] = float(np.mean(states.offset_sd**2))
    added[CURVE] = study.record.instruments.linearity_sd(dataset.extent) ** 2
    name = f"displacement at {bands.voltage[at]:.3g} V ({bands.name}, {bands.time[at]:.4g} s)"
    return Measurand(name, "um", displacement, added, STATE, states.rows)
