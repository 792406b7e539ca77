"""A fit as Python users have it: one object with the posterior, its bands, figures and remarks.

A :class:`Fit` is a run's folder with the run in memory; ``bwbayes run`` makes the same folder by
the same functions. Without a folder of one's own it lives in a temporary one, as long as the fit
does. What the command line prints as a remark is a warning here
(:class:`~bwbayes.errors.InputWarning`).
"""

from __future__ import annotations

import shutil
from dataclasses import dataclass, field
from functools import cached_property
from io import StringIO
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich.console import Console

from bwbayes.app.fit.advice import Advice, require_converged
from bwbayes.app.fit.plots import Plots
from bwbayes.app.fit.surroundings import Scratch, console_of, warn
from bwbayes.app.problem.problem import Problem
from bwbayes.app.report.page import template
from bwbayes.app.running.folder import RunFolder
from bwbayes.app.running.predictions import Prediction, predict_another, residuals_along
from bwbayes.app.running.run import (
    Run,
    assemble,
    go_on,
    log_likelihood,
    write_files,
)
from bwbayes.app.screen import (
    PARAMETER_COLUMNS,
    SCORE_COLUMNS,
    parameter_rows,
    score_texts,
    show_result,
)
from bwbayes.data import Record, read_record
from bwbayes.inference.engine import Engine
from bwbayes.results.loops import Loops
from bwbayes.results.outputs import posterior_tree
from bwbayes.results.prediction import Start
from bwbayes.results.result import Result, summary
from bwbayes.results.standing import Standing
from bwbayes.results.verdict import Verdict
from bwbayes.sampling.sampler import Outcome
from bwbayes.sampling.storage import ChainFile
from bwbayes.shown import head

if TYPE_CHECKING:
    import xarray

__all__ = ["Fit", "carried_on", "to_know"]


@dataclass(frozen=True, eq=False, repr=False)
class Fit(Advice):
    """A record that was fitted: its posterior, its bands, and what to know of them.

    Parameters
    ----------
    problem
        What was fitted: config in explicit numbers, record, priors.
    chain, outcome
        The draws, and how the sampling ended.
    folder
        The run's folder.
    seconds
        Wall time of the sampling.

    Notes
    -----
    Without convergence nothing is said of an interval: whatever would need one raises
    :class:`bwbayes.NotConvergedError`. The draws stay, and :meth:`resume` goes on.
    """

    problem: Problem
    chain: ChainFile
    outcome: Outcome
    folder: RunFolder
    seconds: float = 0.0
    _scratch: Scratch | None = field(default=None, repr=False)

    @property
    def converged(self) -> bool:
        """Whether the sampling has converged."""
        return self.outcome.converged

    @property
    def holds(self) -> bool | None:
        """Whether all bands hold on their readings; None if that is inconclusive anywhere."""
        return self.result.standing.holds if self.converged else None

    @property
    def verdicts(self) -> dict[str, Verdict]:
        """Whether the bands hold, and why not, by the bands' name."""
        return dict(self.result.verdicts)

    @property
    def remarks(self) -> tuple[str, ...]:
        """What to know of the record, the priors and the fit, one line each."""
        return self.result.remarks

    @cached_property
    def result(self) -> Result:
        """The run in numbers and arrays, as the report is made of."""
        return assemble(self.problem, self.chain, self.outcome)

    @cached_property
    def posterior(self) -> Any:
        """The draws and their densities as arviz has them, an xarray.DataTree.

        Its attribute ``converged`` is 1 or 0.
        """
        density = log_likelihood(self.problem.posterior, self.result)
        return posterior_tree(self.result, density, self.problem.records)

    @property
    def draws(self) -> xarray.Dataset:
        """The draws (chain, draw) of each free parameter, in its own unit; converged or not."""
        drawn: xarray.Dataset = self.posterior["posterior"].to_dataset()
        return drawn

    @property
    def summary(self) -> Any:
        """A pandas.DataFrame with a row for each free parameter.

        Mean, sd, median, 95 % interval, effective draws, R-hat, Monte Carlo error, unit, and the
        truth of a simulated record.

        Raises
        ------
        NotConvergedError
            The sampling has not converged.
        """
        import pandas as pd  # noqa: PLC0415  # slow to load, and only needed here

        numbers: Any = summary(self._converged())["parameters"]
        return pd.DataFrame.from_dict(numbers, orient="index")

    @cached_property
    def bands(self) -> dict[str, Prediction]:
        """The bands of the training windows and of all that was held out, by name.

        Raises
        ------
        NotConvergedError
            The sampling has not converged.
        """
        result = self._converged()
        return {
            one.name: Prediction.of(one, result.scores.get(one.name), result.verdicts.get(one.name))
            for one in result.bands
        }

    @property
    def residuals(self) -> xarray.DataArray:
        """Readings less the mean along the training record, (time,), um.

        nan where nothing was predicted, and where there is no reading. Those of several records
        are those of their bands: ``fit.bands["step_10"].residuals``.

        Raises
        ------
        NotConvergedError
            The sampling has not converged.
        InputError
            Several records were fitted.
        """
        import xarray as xr  # noqa: PLC0415  # slow to load, and only needed here

        values = residuals_along(self.problem, self.bands)
        time = ("time", self.problem.record.time, {"units": "s"})
        return xr.DataArray(
            values, coords={"time": time}, dims="time", name="residual", attrs={"units": "um"}
        )

    @property
    def loops(self) -> Loops | None:
        """The major and a minor loop and the initial curve: ``fit.loops.major.estimates``."""
        return self._converged().loops

    @property
    def plot(self) -> Plots:
        """The figures: ``fit.plot.loop()``, ``bands()``, ``corner()``, ``trace()`` and more."""
        return Plots(self.problem, self.result, self._converged)

    def predict(
        self,
        record: Record | str | Path,
        *,
        name: str | None = None,
        window: tuple[float, float] | None = None,
        from_rest: bool = False,
        own_offset: bool = True,
        lead_in: float | None = None,
        lead_in_from: float | None = None,
        after: bool = False,
        of: str | None = None,
    ) -> Prediction:
        """Predict another record, or a planned voltage without a displacement.

        Parameters
        ----------
        record
            The record or its file, at any sampling interval.
        name
            Name of the bands; by default the file's, or "prediction".
        window
            Start and stop in s of the part that is predicted and judged; by default all of it.
        from_rest, own_offset, lead_in, lead_in_from, after, of
            What is known of its start, as of a config's [validation.NAME]; see
            :class:`bwbayes.Start`. With ``after`` what comes after the lead-in is a
            forecast.

        Raises
        ------
        NotConvergedError
            The sampling has not converged.
        InputError
            A lead-in or window that does not fit into the record.

        Warns
        -----
        InputWarning
            A drive beyond what was fitted; bands that do not hold, with the likeliest cause.
        """
        result = self._converged()
        other = record
        if not isinstance(other, Record):
            name = name or Path(other).stem
            other = read_record(other, need_displacement=False)
        hold = self.problem.config.model.hold
        known = None if hold == "auto" else hold
        start = Start(from_rest, own_offset, lead_in, lead_in_from, known, after)
        name = name or "prediction"
        made = predict_another(self.problem, result.flat_draws, other, start, name, window, of)
        warn([f"{name}: {remark}" for remark in made.remarks], 3)
        warn(Standing.of([made.verdict] if made.verdict else []).said, 3)
        return made

    def resume(
        self,
        *,
        ess: float | None = None,
        steps: int | None = None,
        engine: Engine | None = None,
        workers: int | None = None,
        executor: Any = None,
        progress: bool = True,
    ) -> Fit:
        """Go on sampling, with a new target or budget, and return what comes of it.

        Parameters and errors are as in :func:`bwbayes.resume_run`.
        """
        made = carried_on(
            self.folder, self._scratch, progress, workers, ess, steps, engine, executor
        )
        warn(to_know(made), 3)
        return made

    def save(self, folder: str | Path, *, overwrite: bool = False) -> Path:
        """Write the run to a folder of its own, all that ``bwbayes run`` writes, and return it.

        Raises
        ------
        InputError
            The folder exists and ``overwrite`` is not given, or it cannot be written.
        """
        made = RunFolder.create(Path(folder), self.problem, overwrite)
        with made.locked():
            shutil.copyfile(self.folder.chain, made.chain)
            write_files(made, self.problem, self.result, self.seconds)
        return made.path

    def _converged(self) -> Result:
        """Return the result, or refuse."""
        require_converged(self)
        return self.result

    @property
    def _title(self) -> str:
        name = self.problem.config.name or ", ".join(
            record.origin for record in self.problem.records.values()
        )
        if not self.converged:
            return f"{name}: NOT CONVERGED: {self.outcome.stop_reason}; intervals are withheld"
        return f"{name}: converged, validation {self.result.standing.status}"

    def __repr__(self) -> str:
        return head(str(self))

    def __str__(self) -> str:
        said = StringIO()
        console = Console(file=said, width=110, force_jupyter=False, color_system=None)
        console.print(self._title, highlight=False, markup=False, soft_wrap=True)
        show_result(self.result, None, console)
        return said.getvalue().rstrip()

    def _repr_html_(self) -> str:
        scores = self.result.scores
        return template("fit.html.j2").render(
            title=self._title,
            standing=self.result.standing,
            parameter_columns=PARAMETER_COLUMNS,
            parameters=list(parameter_rows(self.result)),
            score_columns=list(SCORE_COLUMNS),
            scores=[
                (name, self.verdicts[name].status, *score_texts(one))
                for name, one in scores.items()
            ],
            remarks=self.remarks,
        )


def carried_on(
    folder: RunFolder,
    scratch: Scratch | None,
    progress: bool,
    workers: int | None,
    ess: float | None = None,
    steps: int | None = None,
    engine: Engine | None = None,
    how: Any = None,
) -> Fit:
    """Finish a run; in a temporary folder, without the files that ``save`` writes."""
    run: Run = go_on(
        folder,
        console_of(progress),
        workers=workers,
        ess=ess,
        steps=steps,
        engine=engine,
        files=scratch is None,
        how=how,
    )
    made = Fit(run.problem, run.chain, run.outcome, folder, run.seconds, scratch)
    # It is known already, and a cached property is a plain attribute.
    made.__dict__["result"] = run.result
    return made


def to_know(made: Fit) -> list[str]:
    """Return what the command line would print of a finished run."""
    lines = [*made.remarks, *made.result.standing.said]
    if not made.converged:
        lines.append(f"NOT CONVERGED: {made.outcome.stop_reason}; intervals are withheld")
    return lines
