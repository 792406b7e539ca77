"""A run: one object with the posterior, its bands, figures and remarks.

:func:`bwbayes.fit` returns a :class:`Run`, :func:`bwbayes.open_run` opens one, and ``bwbayes run``
makes one. Without a folder of one's own it lives in a temporary one, as long as the object does.

Its stages are computed once, when first asked for, and kept in its folder. A stage knows what it
needs and asks for that. Progress and figures listen to stages; no computation knows of them.
Opening a run only reads files: a stage loads what it needs when it is computed.
"""

from __future__ import annotations

import json
import os
from copy import copy
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self, cast

import numpy as np

from bwbayes.app.fit.stage import RunStage, always
from bwbayes.app.running.folder import RunFolder
from bwbayes.app.verbs import VERBS
from bwbayes.errors import InputError, NotConvergedError, Renamed
from bwbayes.model.spec import ModelSpec
from bwbayes.quantities import DEFAULT
from bwbayes.report.report import Shown
from bwbayes.sampling.chain import PHASES, ChainFile, draws, log_densities
from bwbayes.watching import Watch, WatchSteps, parts, unwatched, watched

if TYPE_CHECKING:
    from tempfile import TemporaryDirectory

    import xarray

    from bwbayes.app.config.config import Config
    from bwbayes.app.fit.plots import Plots
    from bwbayes.app.jobs.calibrate import calibrate as calibrate_fit
    from bwbayes.app.jobs.certificate import budget as budget_fit, certificate as certificate_fit
    from bwbayes.app.jobs.control import (
        compensate as compensate_fit,
        export as export_fit,
        track as track_fit,
    )
    from bwbayes.app.jobs.design import design as design_fit
    from bwbayes.app.jobs.fit_methods import fit_method
    from bwbayes.app.jobs.predict import Prediction, predict as predict_record
    from bwbayes.app.running.workers import FigureWorker
    from bwbayes.arrays import FloatArray
    from bwbayes.comparison.comparison import Comparison
    from bwbayes.diagnosis.consistency import Consistency
    from bwbayes.diagnosis.finding import Finding
    from bwbayes.diagnosis.identifiability import InformationGain
    from bwbayes.diagnosis.innovations import Innovations, PredictiveChecks
    from bwbayes.diagnosis.residual_analysis import Explanation
    from bwbayes.diagnosis.rivals import DriveLock, Rival
    from bwbayes.diagnosis.validation import BandValidation, ValidationContext, ValidationSummary
    from bwbayes.inference.study import Study
    from bwbayes.prediction.bands import Bands
    from bwbayes.prediction.budget import Budget
    from bwbayes.prediction.loops import Loops, StepResponse
    from bwbayes.quantities import Quantities
    from bwbayes.report.report import Report
    from bwbayes.report.result import Result
    from bwbayes.sampling.diagnostics import SamplingResult
    from bwbayes.sampling.plan import SamplingPlan


# By this a chain notes what noise on the voltages leaves unsure: a covariance, (free, free).
VOLTAGE_NOISE = "voltage_noise_covariance"


@dataclass(eq=False, repr=False)
class Run(Shown):
    """A fit with all that is computed of it: posterior, bands, notes on both.

    Parameters
    ----------
    folder
        The run's folder, if it has begun.
    seconds
        Wall time of the sampling.
    watch
        Called with the name of a stage, and the share of it that is done.

    Notes
    -----
    Without convergence nothing is said of an interval: whatever would need one raises
    :class:`bwbayes.NotConvergedError`. The draws stay, and :meth:`resume` continues them.
    """

    folder: RunFolder = field(default_factory=lambda: RunFolder(Path(os.devnull)))
    seconds: float = 0.0
    watch: WatchSteps = unwatched
    _scratch: TemporaryDirectory[str] | None = None

    def with_cache(self, **results: object) -> Self:
        """Return this run with attributes that are there already, computed ones too."""
        run = copy(self)
        run.__dict__.update(results)  # a cached property is a plain attribute
        return run

    @cached_property
    def chain(self) -> ChainFile:
        """The draws."""
        return ChainFile.read(self.folder.chain)

    @cached_property
    def _resolved(self) -> Run:
        """The run that the config and the records in its folder describe."""
        from bwbayes.app.config.config import load
        from bwbayes.app.study.resolve import resolve_config

        return resolve_config(load(self.folder.config), self.folder.path)

    @cached_property
    def config(self) -> Config:
        """Its config, in explicit numbers."""
        return self._resolved.config

    @cached_property
    def study(self) -> Study:
        """Model, records, priors, and what is held out.

        Raises
        ------
        InputError
            Config or records were edited, so that the chain is another posterior's.
        """
        from bwbayes.app.running.fingerprint import require_own

        study = self._resolved.study
        if "chain" in vars(self):
            require_own(self._resolved, self.folder.chain, self.chain.attributes())
        return study

    @cached_property
    def plan(self) -> SamplingPlan:
        """How it is sampled."""
        from bwbayes.app.study.from_config import plan_of

        return plan_of(self.config, self.study.posterior)

    @property
    def facts(self) -> dict[str, str]:
        """The fitted model and records, for people: one line each, by subject."""
        from bwbayes.app.study.about import facts_of

        return facts_of(self.study, self.config)

    @cached_property
    def extrapolations(self) -> dict[str, list[Finding]]:
        """In what the drive of each validation leaves the training data, by its name."""
        from bwbayes.app.study.about import extrapolations_of

        return extrapolations_of(self.study)

    @cached_property
    def record_remarks(self) -> tuple[str, ...]:
        """Notes on its records, one line each."""
        from bwbayes.app.study.about import record_remarks

        return record_remarks(self.config, self.study, self.extrapolations)

    @cached_property
    def kept(self) -> dict[str, Any]:
        """Results computed before from the chain as it is now, by stage; none if it has grown."""
        from bwbayes.app.running.fingerprint import load, state_of

        return load(self.folder.result, state_of(self)) or {}

    def keep(self, folder: RunFolder) -> None:
        """Write what is computed to a folder: all that neither the chain nor the config holds."""
        from bwbayes.app.running.fingerprint import save, state_of

        save(folder.result, state_of(self), {"outcome": self.outcome, **self._computed})

    @cached_property
    def outcome(self) -> SamplingResult:
        """How the sampling ended, or stands."""
        if self.kept:
            outcome: SamplingResult = self.kept["outcome"]
            return outcome
        from bwbayes.app.running.workers import open_executor
        from bwbayes.sampling.sampler import sample

        plan = replace(self.plan, max_steps=self.chain.steps("sampling"))
        with open_executor(1) as pool:
            return sample(self.study.posterior, plan, self.chain, pool)

    @property
    def converged(self) -> bool:
        """Whether the sampling has converged."""
        return self.outcome.converged

    @property
    def more_steps(self) -> int:
        """Twice the steps that the sampling had or was allowed, or all that it seems to need."""
        check = self.outcome.check
        # Blocks are whole: there may be more steps than the limit.
        taken = max(self.config.sampling.steps, check.steps)
        needed = [check.steps_needed, check.steps_for(self.plan.ess)]
        return max(2 * taken, int(np.ceil(np.max(np.nan_to_num(needed, posinf=0.0)))))

    @property
    def resuming(self) -> str:
        """The command that resumes the run, with more steps."""
        return f"bwbayes resume {self.folder.path} --steps {self.more_steps}"

    def require_converged(self) -> None:
        """Raise a NotConvergedError unless the sampling has converged."""
        if not self.converged:
            call = "fit.resume(" if self._scratch else f"bwbayes.resume({str(self.folder.path)!r}, "
            raise NotConvergedError(
                f"not converged: {self.outcome.stop_reason}; intervals are withheld; resume with "
                f"`{call}steps={self.more_steps})`, and look at the traces"
            )

    @cached_property
    def flat_draws(self) -> FloatArray:
        """All draws, (draws, free), of the chosen model, in their own units, as of the readings."""
        return self._draws.reshape(-1, self._draws.shape[-1])

    @cached_property
    def _draws(self) -> FloatArray:
        """The draws in their own units, wider by what noise on the voltages leaves unsure."""
        posterior, noted = self.study.posterior, self.chain.attributes().get(VOLTAGE_NOISE)
        if noted is None:
            return draws(posterior, self.chain)
        covariances = self.chain.point.covariance, np.array(json.loads(str(noted)))
        return draws(posterior, self.chain, covariances=covariances)

    @cached_property
    def averaged(self) -> FloatArray:
        """The draws as those of all models that the record does not rule out."""
        noted, study = self.chain.attributes().get("alternatives"), self.study
        if noted is None:
            return self._draws
        from bwbayes.diagnosis.averaging import average, from_text

        covariance, source = self.chain.point.covariance, study.generator("alternatives")
        return average(study.posterior, self._draws, covariance, from_text(str(noted)), source)

    @cached_property
    def sampled(self) -> Result:
        """The draws, and what the study says of them, before anything is computed of them."""
        from bwbayes.report.result import Result

        study, chain, plan = self.study, self.chain, self.plan
        steps = ", ".join(f"{chain.steps(phase)} steps of {phase}" for phase in PHASES)
        accepted = {
            phase: ", ".join(f"{n} {count / p:.0%}" for n, (p, count) in chain.moves(phase).items())
            for phase in PHASES
        }
        facts = {
            "sampling": f"{plan.ensembles} ensembles of {plan.walkers} walkers; {steps}",
            "accepted": "; ".join(f"{phase}: {text}" for phase, text in accepted.items() if text),
            "engine": study.engine,
        }
        return Result(
            name=self.config.name or "run",
            outcome=self.outcome,
            parameters=study.parameters,
            draws=study.true_draws(self.averaged),
            log_density=log_densities(chain),
            moves=chain.moves("sampling"),
            facts=self.facts | facts,
            truth=self.config.truth,
            quantities=study.quantities,
        )

    @cached_property
    def subset(self) -> FloatArray:
        """Draws (draws, free) that are enough to simulate with."""
        from bwbayes.prediction.prediction import thin_draws

        return thin_draws(self.flat_draws, self.study.generator("draws"))

    @property
    def best(self) -> FloatArray:
        """The most probable draw, (1, free)."""
        return self.flat_draws[[int(np.argmax(self.sampled.log_density))]]

    @cached_property
    def background(self) -> ValidationContext:
        """Facts about the fit that the validation of bands needs."""
        from bwbayes.diagnosis.validation import ValidationContext

        return ValidationContext.of(self.study.posterior, self.flat_draws)

    @RunStage
    def step_responses(self, _: Watch) -> dict[str, StepResponse]:
        """Return the responses to the steps among what was predicted, by name."""
        from bwbayes.prediction.loops import measure_steps

        records = self.study.others
        if len(self.study.records) > 1:
            records = {**self.study.records, **records}
        scales = self.study.scales(len(self.subset))
        return measure_steps(self.study.posterior, self.subset, records, scales)

    @RunStage
    def predictions(self, watch: Watch) -> tuple[Bands, ...]:
        """Return the bands of all that was held out, and of the training windows.

        Those of held-out readings that fail validation have their correction.
        """
        from bwbayes.app.jobs.predict import correct_failed, predictions

        return correct_failed(self, predictions(self, watch))

    @RunStage
    def innovations(self, watch: Watch) -> dict[str, Innovations]:
        """Return the innovation of each reading at the most probable draw, by record."""
        from bwbayes.diagnosis.innovations import innovations

        records = self.study.records
        return {
            name: innovations(single, theta[0], records[name].start)
            for name, single, theta in watched([*self.study.posterior.each(self.best)], watch)
        }

    @RunStage
    def consistency(self, watch: Watch) -> dict[str, Consistency]:
        """Return how each of several records agrees with the others, by record."""
        from bwbayes.diagnosis.consistency import agreements

        starts = {name: record.start for name, record in self.study.records.items()}
        return agreements(self.study.posterior, self.chain.point, starts, watch)

    @RunStage
    def loops(self, watch: Watch) -> Loops:
        """Return the major and a minor loop and the initial curve."""
        from bwbayes.prediction.loops import measure_loops

        scales = self.study.scales(len(self.subset))
        return measure_loops(self.study.posterior, self.subset, watch, scales)

    @RunStage
    def uncertainty_budgets(self, _: Watch) -> tuple[Budget, ...]:
        """Return which source has which share of what is not known of the main quantities."""
        from bwbayes.app.jobs.certificate import run_budgets

        return run_budgets(self)

    @RunStage
    def drive_locks(self, _: Watch) -> dict[str, DriveLock]:
        """Return whether what the model misses follows the drive, by record."""
        from bwbayes.diagnosis.rivals import drive_locks

        source = self.study.generator("drive lock")
        return drive_locks(self.study.posterior, self.subset, source)

    def rivals(self, of: str, watch: Watch = unwatched) -> tuple[Rival, ...]:
        """Return rivals of other families on a training record, by its name.

        They are fitted when first needed, and kept in the folder. ``watch`` is called with the
        share that is done.
        """
        from bwbayes.app.running.explaining import fitted_rivals
        from bwbayes.diagnosis.rivals import families

        return fitted_rivals(self, of, tuple(families(self.study.spec)), watch)

    def widening_rivals(self, of: str, watch: Watch = unwatched) -> tuple[Rival, ...] | None:
        """Return the models whose differences widen bands of unlike drives; None without any.

        Where the model's error of that record follows the drive they are those of other families,
        else those for which the record has as much evidence.
        """
        if self.drive_locks[of].locked:
            return self.rivals(of, watch)
        from bwbayes.app.running.explaining import fitted_rivals

        keys = self.study.spec.keys
        tied = [ModelSpec.from_keys(keys | changes) for changes in self.config.model.tied]
        return fitted_rivals(self, of, tuple(tied), watch) if tied else None

    @RunStage
    def explanations(self, watch: Watch) -> dict[str, tuple[Explanation, ...]]:
        """Return what may explain each record's readings better than the model, the best first."""
        from bwbayes.app.running.explaining import explain_record
        from bwbayes.app.running.fingerprint import fingerprint, load
        from bwbayes.inference.map_estimate import distinct

        # The search for stages ended with all of this.
        if searched := load(self.folder.search, fingerprint(self)):
            return searched
        best = self.study.posterior.prior.unconstrain(self.best)
        modes = distinct([*best, *self.chain.point.optima], self.chain.point.covariance)
        return {
            name: explain_record(self.study, name, modes, of_record)
            for name, of_record in parts([*self.study.records], watch)
        }

    @always
    def validation(self, _: Watch) -> dict[str, BandValidation]:
        """Return whether the bands hold, and why not, by the bands' name."""
        from bwbayes.app.jobs.predict import validate_predictions

        if not self.converged:
            return {}
        return validate_predictions(self, self.predictions, self.explanations)

    @cached_property
    def _check_source(self) -> np.random.Generator:
        return self.study.generator("checks")

    @RunStage
    def information_gain(self, watch: Watch) -> InformationGain:
        """Return information gained from the data: prior against posterior."""
        from bwbayes.diagnosis.identifiability import information_gain

        prior, sampled = self.study.posterior.prior, self.sampled
        source = self._check_source
        return information_gain(prior, self._draws, sampled.log_density, source, watch)

    @RunStage
    def posterior_checks(self, watch: Watch) -> dict[str, PredictiveChecks]:
        """Return where each record lies among replicated ones."""
        from bwbayes.diagnosis.innovations import check_predictions

        _ = self.information_gain  # first: it draws from the same source
        posterior, subset, source = self.study.posterior, self.subset, self._check_source
        return {
            name: check_predictions(posterior, subset, source, name, of_record)
            for name, of_record in parts([*self.study.records], watch)
        }

    @always
    def remarks(self, watch: Watch) -> tuple[str, ...]:
        """Return what to know of the record, the priors and the fit, one line each."""
        from bwbayes.app.study.about import run_remarks

        return tuple(run_remarks(self, watch))

    @property
    def _computed(self) -> dict[str, Any]:
        """Results computed by now, by stage."""
        return {name: vars(self)[name] for name in STAGES if name in vars(self)}

    def compute(
        self, watch: WatchSteps = unwatched, figure_worker: FigureWorker | None = None
    ) -> Result:
        """Compute all stages in turn; return the run as the report is made of it.

        ``watch`` is called with the name of a stage and the share of it that is done; the
        ``figure_worker`` draws what there is to see, after each of them.
        """
        self.watch = watch
        result = self.sampled
        for name, stage in STAGES.items():
            if figure_worker is not None:
                figure_worker.draw(result)
            if self.converged or stage.always:
                getattr(self, name)
                result = replace(self.sampled, **self._computed)
        self.watch = unwatched
        return result

    @cached_property
    def result(self) -> Result:
        """The run in numbers and arrays, as the report is made of."""
        return self.compute()

    @property
    def name(self) -> str:
        """The name of its config, or else of its operator."""
        return self.config.name or self.config.model.hysteresis

    @property
    def quantities(self) -> Quantities:  # type: ignore[override]
        """Quantities of its records, in whose words it is shown."""
        return self.study.quantities

    @cached_property
    def standing(self) -> ValidationSummary:
        """Whether the bands hold, all together: as its folder says, if it does."""
        from bwbayes.diagnosis.validation import ValidationSummary

        numbers = self.folder.numbers()
        return (
            ValidationSummary.read(numbers)
            if numbers and self.quantities == DEFAULT  # in the package's own words
            else ValidationSummary.of(self.validation.values())
        )

    @property
    def passed(self) -> bool | None:
        """Whether all bands hold on their readings; None if that is inconclusive anywhere."""
        return self.standing.passed if self.converged else None

    holds, verdicts, problem = Renamed("passed"), Renamed("validation"), Renamed("study")

    @property
    def notes(self) -> tuple[str, ...]:
        """The remarks, what does not hold, and a sampling that has not converged."""
        unconverged = [] if self.converged else [self._unconverged]
        return (*self.remarks, *self.standing.messages, *unconverged)

    @property
    def _unconverged(self) -> str:
        return f"NOT CONVERGED: {self.outcome.stop_reason}; intervals are withheld"

    @property
    def log_likelihood(self) -> FloatArray:
        """The log likelihood of each draw, nats, (steps, ensembles, walkers)."""
        posterior, log_density = self.study.posterior, log_densities(self.chain)
        sampled = draws(posterior, self.chain).reshape(-1, len(posterior.names))
        _, log_prior = posterior.prior.constrain(posterior.prior.unconstrain(sampled))
        return log_density - log_prior.reshape(log_density.shape)

    @property
    def numbers(self) -> dict[str, object]:
        """The run's numbers, as its ``summary.json`` holds them."""
        from bwbayes.app.running.fingerprint import versions
        from bwbayes.report.result import summary

        numbers = summary(self.result) | {
            "seed": self.config.seed,
            "go_on": None if self.converged else self.resuming,
            "wall_s": self.seconds,
            "versions": versions(self.study.engine),
            "data_sha256": self.study.sha256,
            "calibration": self.calibration,
        }
        rendered: dict[str, object] = self.quantities.rendered(numbers)
        return rendered

    @property
    def calibration(self) -> dict[str, Any] | None:
        """How ``bwbayes calibrate`` came out for the run as it is now; None if it was not run."""
        from bwbayes.app.running.fingerprint import state_of

        numbers = self.folder.calibration.numbers()
        if numbers.get("of") != state_of(self):
            return None
        names = ("passed", "telling", "failures", "replicates", "unconverged")
        return {name: numbers[name] for name in names}

    @cached_property
    def posterior(self) -> Any:
        """The draws as arviz has them, an xarray.DataTree; its ``converged`` is 1 or 0."""
        from bwbayes.report.result import posterior_tree

        return posterior_tree(self.sampled, self.log_likelihood, self.study.records)

    @property
    def draws(self) -> xarray.Dataset:
        """The draws (chain, draw) of each free parameter, in its own unit; converged or not."""
        return cast("xarray.Dataset", self.posterior["posterior"].to_dataset())

    @property
    def summary(self) -> Any:
        """A pandas.DataFrame with a row for each free parameter.

        Mean, sd, median, 95% interval, effective draws, R-hat, Monte Carlo error, unit, and the
        truth of a simulated record.

        Raises
        ------
        NotConvergedError
            The sampling has not converged.
        """
        import pandas as pd

        self.require_converged()
        return pd.DataFrame.from_dict(self.sampled.estimates, orient="index")

    @cached_property
    def bands(self) -> dict[str, Prediction]:
        """The bands of the training windows and of all that was held out, by name.

        Raises
        ------
        NotConvergedError
            The sampling has not converged.
        """
        from bwbayes.app.jobs.predict import Prediction

        return {
            bands.name: Prediction(
                **vars(bands),
                validation=self.validation.get(bands.name),
            ).said_in(self.quantities)
            for bands in self.predictions
        }

    @property
    def residuals(self) -> xarray.DataArray:
        """Readings less the mean along the training record, (time,), um.

        nan where nothing was predicted or read. A fit of several records raises an InputError: take
        ``fit.bands[NAME].residuals``.
        """
        import xarray as xr

        study, record = self.study, self.study.record
        if len(study.records) > 1:
            raise InputError("residuals: of several records; take fit.bands[NAME].residuals")
        values = np.full(record.samples, np.nan)
        for name, windows in study.windows(*study.records).items():
            span = slice(windows[0].start, windows[-1].stop)
            residuals = self.bands[name].residuals
            values[span] = np.where(np.isfinite(residuals), residuals, values[span])
        coords = {"time": ("time", record.time, {"units": "s"})}
        unit = {"units": self.quantities.output.unit}
        return xr.DataArray(values, coords, "time", "residual", unit)

    @property
    def plot(self) -> Plots:
        """The figures: ``fit.plot.loop()``, ``bands()``, ``corner()``, ``trace()`` and more."""
        from bwbayes.app.fit.plots import Plots

        return Plots(self)

    # Every verb is a method, see below. Type checkers do not run that, and see these.
    if TYPE_CHECKING:
        predict = fit_method(predict_record)
        compensate = fit_method(compensate_fit)
        design = fit_method(design_fit)
        export = fit_method(export_fit)
        track = fit_method(track_fit)
        budget = fit_method(budget_fit)
        certificate = fit_method(certificate_fit)
        calibrate = fit_method(calibrate_fit)

    def compare(self, *others: Run, **options: Any) -> Comparison:
        """Compare this fit with others of the same readings, to tell which model to take.

        Options and errors are as in :func:`bwbayes.compare`, which fits models, too.
        """
        from bwbayes.app.fit.calls import compare

        return compare(self, *others, **options)

    def resume(self, *, progress: bool = True, **options: Any) -> Run:
        """Continue the sampling, with a new target or budget, and return what comes of it.

        Options and errors are as in :func:`bwbayes.resume`.
        """
        from bwbayes.app.jobs.fit_methods import console_of, warn
        from bwbayes.app.running import run

        files = self._scratch is None
        fit = run.resume(self.folder, console_of(progress), files=files, **options)
        warn(fit.notes, 3)
        return fit.with_cache(_scratch=self._scratch)

    def save(self, folder: str | Path, *, overwrite: bool = False) -> Path:
        """Write the run to a folder of its own, all that ``bwbayes run`` writes, and return it.

        Raises
        ------
        InputError
            The folder exists and ``overwrite`` is not given, or it cannot be written.
        """
        from bwbayes.app.running.run import copy_run

        return copy_run(self, Path(folder), overwrite).path

    @property
    def heading(self) -> str:
        """Its name, how it ended, and for which drives."""
        from bwbayes.report.run import drives_like

        name = self.config.name or ", ".join(r.origin for r in self.study.records.values())
        if self.converged:
            scope = f" {drives_like(self.facts)}" if self.standing.passed else ""
            return f"{name}: converged, validation {self.standing.status}{scope}"
        return f"{name}: {self._unconverged}"

    def report(self) -> Report:
        """Return what the page of the run says."""
        from bwbayes.report.run import run_report

        return run_report(self.result, self.numbers)


STAGES = {name: stage for name, stage in vars(Run).items() if isinstance(stage, RunStage)}

for verb in VERBS:
    setattr(Run, verb.method, verb)


def open_finished(folder: RunFolder) -> Run:
    """Return the fit that a run's folder holds, as far as its chain goes: only that is read.

    Raises InputError: the chain is missing, damaged or still in its pilot.
    """
    chain = ChainFile.read(folder.chain)
    if chain.blocks("sampling") == 0:
        raise InputError(f"{folder.path}: no draws yet; resume with {folder.resuming}")
    return Run(folder, folder.numbers().get("wall_s", 0.0)).with_cache(chain=chain)
