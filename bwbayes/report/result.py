"""A finished run in one object, and its summary in numbers.

Everything that is written or drawn after sampling comes from a :class:`Result`. If the sampling
has not converged, the result keeps the draws but contains no interval: no parameter table, no
bands, no scores.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from functools import cached_property
from typing import Any

import numpy as np

from bwbayes.arrays import FloatArray
from bwbayes.diagnosis.consistency import Consistency
from bwbayes.diagnosis.drive_lock import DriveLock
from bwbayes.diagnosis.identifiability import InformationGain
from bwbayes.diagnosis.innovations import Innovations
from bwbayes.diagnosis.predictive_checks import PredictiveChecks
from bwbayes.diagnosis.residual_analysis import Explanation
from bwbayes.diagnosis.validation import BandValidation, ValidationSummary
from bwbayes.errors import Renamed
from bwbayes.inference.parameters import Parameter
from bwbayes.prediction.bands import Bands, Scores
from bwbayes.prediction.budget import Budget
from bwbayes.prediction.loops import Loops
from bwbayes.prediction.steps import StepResponse
from bwbayes.quantities import DEFAULT, Quantities
from bwbayes.sampling.diagnostics import SamplingResult
from bwbayes.shown import brief


@dataclass(frozen=True)
class Result:
    """A finished run.

    Parameters
    ----------
    name, outcome
        The run's name, and the outcome of the sampling.
    parameters
        All parameters, fixed ones included.
    draws, log_density
        (steps, ensembles, walkers, free), parameters in their own units; (steps, ensembles,
        walkers), nats. Where a voltage has noise, or the instruments' scales are unsure, the draws
        are the chain's made wider, and the density is that of the chain's own.
    moves
        Numbers of proposals to a walker for these draws, and of acceptances, by kind of move.
    predictions, validation
        All predicted bands; the validation of those with readings, by the bands' names.
        They are empty unless converged, and so are all results below.
    innovations, drive_locks, consistency, explanations, posterior_checks
        By fitted record: the innovation of each reading at the most probable draw; the test whether
        the model's error follows the drive; for several records, its consistency with the others;
        explanations that may describe it better, the best first; its place among replicated
        records.
    loops, step_responses
        The loops of the actuator, measured, and its responses to the predicted steps by name.
    uncertainty_budgets
        Shares of the sources in the uncertainty of the main quantities.
    information_gain
        Information gained from the data: prior against posterior.
    facts
        Description of the run for people: one line each, by subject.
    remarks
        Notes for the user: warnings of the record, combinations that are not identifiable.
    truth
        The true parameters, of a simulated record.
    quantities
        Quantities of the records, in whose words the run is shown.
    """

    __repr__ = brief

    name: str
    outcome: SamplingResult
    parameters: tuple[Parameter, ...]
    draws: FloatArray
    log_density: FloatArray
    moves: Mapping[str, tuple[int, int]] = field(default_factory=dict)
    predictions: tuple[Bands, ...] = ()
    validation: Mapping[str, BandValidation] = field(default_factory=dict)
    innovations: Mapping[str, Innovations] = field(default_factory=dict)
    drive_locks: Mapping[str, DriveLock] = field(default_factory=dict)
    loops: Loops | None = None
    step_responses: Mapping[str, StepResponse] = field(default_factory=dict)
    uncertainty_budgets: tuple[Budget, ...] = ()
    consistency: Mapping[str, Consistency] = field(default_factory=dict)
    explanations: Mapping[str, tuple[Explanation, ...]] = field(default_factory=dict)
    information_gain: InformationGain | None = None
    posterior_checks: Mapping[str, PredictiveChecks] = field(default_factory=dict)
    facts: Mapping[str, str] = field(default_factory=dict)
    remarks: tuple[str, ...] = ()
    truth: Mapping[str, float] = field(default_factory=dict)
    quantities: Quantities = DEFAULT

    # Earlier names
    agreement = Renamed("consistency")
    bands = Renamed("predictions")
    learned = Renamed("information_gain")
    replicated = Renamed("posterior_checks")
    steps = Renamed("step_responses")
    verdicts = Renamed("validation")

    @property
    def free(self) -> tuple[Parameter, ...]:
        """The sampled parameters, in the order of the draws."""
        return tuple(p for p in self.parameters if p.fixed is None)

    @property
    def flat_draws(self) -> FloatArray:
        """All draws, (draws, free)."""
        return self.draws.reshape(-1, self.draws.shape[-1])

    @property
    def scores(self) -> dict[str, Scores]:
        """Scores of the bands that have readings, by name."""
        return {b.name: b.scores for b in self.predictions if b.scores is not None}

    @property
    def looped(self) -> list[Bands]:
        """The bands that have a loop: a step has none."""
        return [bands for bands in self.predictions if bands.name not in self.step_responses]

    @property
    def standing(self) -> ValidationSummary:
        """Validation of all bands together."""
        return ValidationSummary.of(self.validation.values())

    @property
    def validation_numbers(self) -> dict[str, dict[str, Any]]:
        """Scores, verdict and correction of all bands that have readings, by name."""
        numbers = {
            name: scores.numbers
            | (self.validation[name].summary if name in self.validation else {})
            for name, scores in self.scores.items()
        }
        for bands in self.predictions:
            if bands.correction is not None:
                numbers[bands.name]["correction"] = asdict(bands.correction)
        return numbers

    @cached_property
    def estimates(self) -> dict[str, dict[str, Any]]:
        """Mean, sd, quantiles, convergence and unit of each free parameter, by name."""
        flat, check = self.flat_draws, self.outcome.check
        lower, median, upper = np.quantile(flat, [0.025, 0.5, 0.975], axis=0)
        sd = np.std(flat, axis=0, ddof=1)
        columns = {
            "mean": np.mean(flat, axis=0),
            "sd": sd,
            "median": median,
            "lower_95": lower,
            "upper_95": upper,
            "ess_bulk": check.ess_bulk,
            "ess_tail": check.ess_tail,
            "rhat": check.rhat,
            "mcse_mean": sd / np.sqrt(check.ess_mean),
        }
        table: dict[str, dict[str, Any]] = {}
        for i, parameter in enumerate(self.free):
            row = {key: float(values[i]) for key, values in columns.items()}
            table[parameter.name] = row | {"unit": parameter.unit}
            if parameter.name in self.truth:
                table[parameter.name]["truth"] = self.truth[parameter.name]
        return table


def summary(result: Result) -> dict[str, object]:
    """Return a run's numbers as ``summary.json`` holds them.

    ``parameters``, ``validation``, ``innovations``, ``loops``, ``step_responses``,
    ``uncertainty_budget``, ``identifiability``, ``model_error``, ``replicated`` and
    ``explanations`` are None unless the sampling has converged; ``agreement`` is there for several
    records alone.
    """
    outcome, check = result.outcome, result.outcome.check
    numbers: dict[str, object] = {
        "converged": outcome.converged,
        "stop_reason": outcome.stop_reason,
        "steps": check.steps,
        "acceptance": check.acceptance,
        "sampling": {
            "proposals": {move: proposed for move, (proposed, _) in result.moves.items()},
            "acceptance": {
                move: accepted / proposed for move, (proposed, accepted) in result.moves.items()
            },
            "pareto_k": check.pareto_k,
        },
        "remarks": list(result.remarks),
    }
    if not outcome.converged:
        sections = (
            *("parameters", "validation", "validated_drives", "innovations", "loops"),
            *("step_responses", "uncertainty_budget", "identifiability", "model_error"),
            *("replicated", "explanations"),
        )
        return numbers | dict.fromkeys(sections)
    innovations: Mapping[str, object] = {n: s.numbers for n, s in result.innovations.items()}
    if len(innovations) == 1:
        # The innovations of a single record have no name above them.
        innovations = next(iter(result.innovations.values())).numbers
    if result.consistency:
        numbers["agreement"] = {n: record.numbers for n, record in result.consistency.items()}
    gain = result.information_gain
    return numbers | {
        "parameters": result.estimates,
        "validation": result.validation_numbers,
        # The validation is for these drives alone: on others the model's error has another size.
        "validated_drives": result.facts.get("drive") if result.standing.passed else None,
        "innovations": innovations or None,
        "loops": None if result.loops is None else result.loops.numbers,
        "step_responses": {name: step.numbers for name, step in result.step_responses.items()},
        "uncertainty_budget": [budget.numbers for budget in result.uncertainty_budgets],
        "identifiability": None if gain is None else gain.numbers,
        "model_error": {name: lock.numbers for name, lock in result.drive_locks.items()},
        "replicated": {n: checks.numbers for n, checks in result.posterior_checks.items()} or None,
        "explanations": {
            name: [explanation.numbers for explanation in explanations]
            for name, explanations in result.explanations.items()
        },
    }
