"""What a fit advises: which model to take, what to measure next, and which voltage to apply."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from bwbayes.app.fit.compared import Compared, FinishedFit, compared, named
from bwbayes.app.fit.options import options_of
from bwbayes.app.fit.surroundings import warn
from bwbayes.app.jobs.at_work import RunDraws
from bwbayes.app.jobs.compensate import Compensated, compensate_draws
from bwbayes.app.jobs.design import design_draws
from bwbayes.app.jobs.export import export_draws
from bwbayes.app.jobs.track import Setup, track_draws
from bwbayes.arrays import ArrayLike
from bwbayes.comparison.design import Promise
from bwbayes.control.exported import Exported
from bwbayes.control.tracking import Tracking
from bwbayes.errors import NotConvergedError
from bwbayes.sampling.sampler import draws

__all__ = ["Advice", "require_converged"]


class Advice:
    """Comparison, design and control, for whatever has a problem, a chain and an outcome."""

    @options_of(compared)
    def compare(self: FinishedFit, *others: FinishedFit, **options: Any) -> Compared:
        """Compare this fit with others of the same readings, to tell which model to take.

        Parameters
        ----------
        others
            Fits of the same readings with other models.
        {options}

        Raises
        ------
        InputError
            Fits of different readings.
        """
        return compared([named(fit) for fit in (self, *others)], **options)

    @options_of(design_draws)
    def design(self: FinishedFit, target: str | ArrayLike, **options: Any) -> list[Promise]:
        """Rank signals by what they would leave of an sd, or of a band's width; the best first.

        Parameters
        ----------
        target
            A parameter's name, or a drive (samples,), V, whose parameter band is to be narrow.
        {options}

        Raises
        ------
        NotConvergedError
            The sampling has not converged.
        InputError
            A target that is not a free parameter of the actuator, or limits that leave nothing.
        """
        return design_draws(_drawn(self), target, **options)

    @options_of(compensate_draws)
    def compensate(self: FinishedFit, reference: Any, **options: Any) -> Compensated:
        """Return the voltage for a displacement, and its predicted error.

        ``fit.compensate("triangle", amplitude=30, frequency=1)`` is what
        ``bwbayes compensate FOLDER triangle --amplitude 30 --frequency 1`` writes.

        Parameters
        ----------
        reference
            What the displacement is to be: one of the shapes ``"sine"``, ``"triangle"``,
            ``"staircase"`` and ``"raster"``; a file with time and displacement; displacements
            (samples,), um; or the ``reference`` of an earlier command. 0 um is where the actuator
            stands at zero volts as the command begins: there a command begins too, and a reference
            that begins elsewhere gets a way from there before it.
        {options}

        Raises
        ------
        NotConvergedError
            The sampling has not converged.
        InputError
            A reference that cannot be used or reached.

        Warns
        -----
        InputWarning
            A reference that was smoothed or led to, a command beyond what was fitted.
        """
        made = compensate_draws(_drawn(self), reference, **options)
        warn(made.remarks, 4)
        return made

    @options_of(export_draws)
    def export(self: FinishedFit, folder: str | Path, **options: Any) -> Exported:
        """Write the posterior's mean model for a controller: ``model.json`` and ``actuator.c``.

        0 um is where the demagnetized actuator stands at zero volts. What is returned has the
        ``linear`` part as a discrete ``scipy.signal`` system.

        Parameters
        ----------
        folder
            Where the files go.
        {options}

        Raises
        ------
        NotConvergedError
            The sampling has not converged.
        InputError
            A hysteresis without a step of bounded time, or files that exist or cannot be written.
        """
        return export_draws(_drawn(self), Path(folder), **options)[0]

    @options_of(Setup)
    def track(self: FinishedFit, **options: Any) -> Tracking:
        """Say how well a closed loop would follow, with and without the model.

        Parameters
        ----------
        {options}

        Raises
        ------
        NotConvergedError
            The sampling has not converged.
        InputError
            A model that cannot be stepped or inverted, or options that make no sense.
        """
        return track_draws(_drawn(self), Setup(**options))


def require_converged(fit: FinishedFit) -> None:
    """Refuse a fit whose sampling has not converged.

    Raises
    ------
    NotConvergedError
        It has not.
    """
    if not fit.outcome.converged:
        steps = 2 * fit.problem.config.sampling.steps
        raise NotConvergedError(
            f"not converged: {fit.outcome.stop_reason}; no interval is given. Go on with "
            f"fit.resume(steps={steps}), and look at fit.plot.trace()"
        )


def _drawn(fit: FinishedFit) -> RunDraws:
    """Return what a fit that has converged gives; warn if its validation did not pass."""
    require_converged(fit)
    posterior, standing = fit.problem.posterior, fit.result.standing
    warn(standing.said, 5)
    flat = draws(posterior, fit.chain).reshape(-1, len(posterior.names))
    return RunDraws(fit.problem, flat, standing)
