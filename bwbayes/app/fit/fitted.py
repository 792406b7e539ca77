"""A run as Python users have it: one object with the posterior, its bands, figures and remarks.

:func:`bwbayes.fit` returns a :class:`Run`, :func:`bwbayes.open_run` opens one, and ``bwbayes run``
makes the same one by the same functions. Without a folder of one's own it lives in a temporary one,
as long as the object does.
"""

from __future__ import annotations

import shutil
from functools import cached_property
from pathlib import Path
from types import MethodType
from typing import TYPE_CHECKING, Any, cast

import numpy as np

from bwbayes.app.running.folder import RunFolder
from bwbayes.app.running.stages import Stages
from bwbayes.app.verbs import VERBS, Verb
from bwbayes.errors import InputError, Renamed
from bwbayes.quantities import DEFAULT
from bwbayes.report.report import Shown
from bwbayes.sampling.chain import draws, log_densities
from bwbayes.sampling.storage import ChainFile

if TYPE_CHECKING:
    import xarray

    from bwbayes.app.fit.plots import Plots
    from bwbayes.app.jobs.control import compensate as compensate_fit
    from bwbayes.app.jobs.control import export as export_fit
    from bwbayes.app.jobs.control import track as track_fit
    from bwbayes.app.jobs.design import design as design_fit
    from bwbayes.app.jobs.fit_methods import fit_method
    from bwbayes.app.jobs.predict import predict as predict_record
    from bwbayes.app.running.predictions import Prediction
    from bwbayes.arrays import FloatArray
    from bwbayes.comparison.compared import Comparison
    from bwbayes.diagnosis.validation import ValidationSummary
    from bwbayes.quantities import Quantities
    from bwbayes.report.report import Report


class _Method:
    """A verb as the method of a fit, loaded when it is asked for."""

    def __init__(self, verb: Verb) -> None:
        self.verb = verb

    def __get__(self, fit: Run | None, _: object = None) -> Any:
        from bwbayes.app.jobs.fit_methods import fit_method

        method = fit_method(self.verb.load())
        return method if fit is None else MethodType(method, fit)


class Run(Shown, Stages):
    """A fit with all that is computed of it: posterior, bands, notes on both.

    Attributes
    ----------
    chain
        The draws.
    folder
        The run's folder.
    seconds
        Wall time of the sampling.

    Notes
    -----
    Without convergence nothing is said of an interval: whatever would need one raises
    :class:`bwbayes.NotConvergedError`. The draws stay, and :meth:`resume` continues them.
    Everything else is computed, and its libraries are loaded, when it is first asked for.
    """

    @property
    def name(self) -> str:
        """The name of its config, or else of its operator."""
        return self.problem.config.name or self.problem.config.model.hysteresis

    @property
    def quantities(self) -> Quantities:  # type: ignore[override]
        """What its records are of, in whose words it is shown."""
        return self.problem.quantities

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

    holds, verdicts = Renamed("passed"), Renamed("validation")

    @property
    def notes(self) -> tuple[str, ...]:
        """The remarks, what does not hold, and a sampling that has not converged."""
        unconverged = f"NOT CONVERGED: {self.outcome.stop_reason}; intervals are withheld"
        return (*self.remarks, *self.standing.messages, *[unconverged] * (not self.converged))

    @property
    def log_likelihood(self) -> FloatArray:
        """The log likelihood of each draw, nats, (steps, ensembles, walkers)."""
        posterior, log_density = self.problem.posterior, log_densities(self.chain)
        sampled = draws(posterior, self.chain).reshape(-1, len(posterior.names))
        _, log_prior = posterior.prior.constrain(posterior.prior.unconstrain(sampled))
        return log_density - log_prior.reshape(log_density.shape)

    @property
    def numbers(self) -> dict[str, object]:
        """The run's numbers, as its ``summary.json`` holds them."""
        from bwbayes.app.running.fingerprint import versions
        from bwbayes.report.result import summary

        numbers = summary(self.result) | {
            "seed": self.problem.config.seed,
            "go_on": None if self.converged else self.resuming,
            "wall_s": self.seconds,
            "versions": versions(self.problem.posterior.engine),
            "data_sha256": self.problem.sha256,
        }
        said: dict[str, object] = self.quantities.rendered(numbers)
        return said

    @cached_property
    def posterior(self) -> Any:
        """The draws as arviz has them, an xarray.DataTree; its ``converged`` is 1 or 0."""
        from bwbayes.report.outputs import posterior_tree

        return posterior_tree(self.sampled, self.log_likelihood, self.problem.records)

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
        from bwbayes.app.running.predictions import Prediction

        return {
            bands.name: Prediction(
                **vars(bands),
                scores=self.scores.get(bands.name),
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

        if len(self.problem.records) > 1:
            raise InputError("residuals: of several records; take fit.bands[NAME].residuals")
        record = self.problem.record
        values = np.full(record.samples, np.nan)
        for name, windows in self.problem.windows(*self.problem.records).items():
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
        from bwbayes.app.running import run
        from bwbayes.app.running.figure_worker import FigureWorker

        copied = RunFolder.create(Path(folder), self.problem, overwrite)
        with copied.locked():
            shutil.copytree(self.folder.chain, copied.chain)
            shutil.copyfile(self.folder.backend, copied.backend)
            run.write_files(self, copied, FigureWorker())
            # Predictions that were asked for now may have needed them.
            pairs = ((self.folder.search, copied.search), (self.folder.rivals, copied.rivals))
            for kept, copy in pairs:
                if kept.exists():
                    shutil.copyfile(kept, copy)
        return copied.path

    @property
    def heading(self) -> str:
        """Its name, how it ended, and for which drives."""
        from bwbayes.report.run import drives_like

        name = self.problem.config.name or ", ".join(
            r.origin for r in self.problem.records.values()
        )
        if self.converged:
            scope = f" {drives_like(self.problem.facts)}" if self.standing.passed else ""
            return f"{name}: converged, validation {self.standing.status}{scope}"
        return f"{name}: NOT CONVERGED: {self.outcome.stop_reason}; intervals are withheld"

    def report(self) -> Report:
        """Return what the page of the run says."""
        from bwbayes.report.run import run_report

        return run_report(self.result, self.numbers)


for verb in VERBS:
    setattr(Run, verb.name, _Method(verb))


def open_finished(folder: RunFolder) -> Run:
    """Return the fit that a run's folder holds, as far as its chain goes: only that is read.

    Raises InputError: the chain is missing, damaged or still in its pilot.
    """
    chain = ChainFile.read(folder.chain)
    if chain.blocks("sampling") == 0:
        raise InputError(f"{folder.path}: no draws yet; resume with {folder.resuming}")
    return Run(chain, folder, folder.numbers().get("wall_s", 0.0))


def open_converged(path: Path) -> Run:
    """Return the fit in a folder, if it is finished and has converged.

    Raises NotConvergedError if it has not, and InputError: no such run, or it is not finished.
    """
    fit = open_finished(RunFolder.open(path))
    fit.folder.require_finished()
    fit.require_converged()
    return fit
