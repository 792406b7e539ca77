"""``bwbayes compensate``: the voltage for a displacement, and what is promised of it.

Into a folder of its own go the command as a record file, ``command.csv``, which a signal generator
can play; the numbers, ``compensation.json``; everything along time, ``compensation.csv``; and a
page with pictures, ``compensation.html``.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

from bwbayes.app.figures import save_one
from bwbayes.app.figures.compensation import draw_compensation, draw_compensations
from bwbayes.app.jobs.at_work import drawn, limits_of, refuse_existing
from bwbayes.app.problem.problem import Problem, generator
from bwbayes.app.report.compensation_report import render
from bwbayes.arrays import FloatArray
from bwbayes.control.compensation import Choice, Compensation, compensate
from bwbayes.control.wished import Reference
from bwbayes.data.io.formats import read_reference, write_record
from bwbayes.errors import InputError
from bwbayes.model.inverse.limits import Limits
from bwbayes.results.extrapolation import beyond_training
from bwbayes.results.outputs import write_summary
from bwbayes.results.prediction import thinned

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["Compensated", "compensate_draws", "compensate_run", "reference_of"]

FILES = ("command.csv", "compensation.json", "compensation.csv", "compensation.html")


@dataclass(frozen=True, eq=False, repr=False)
class Compensated(Compensation):
    """A command, what is promised of it, and how to look at it and keep it.

    Fields as of :class:`~bwbayes.control.compensation.Compensation`.
    """

    @classmethod
    def of(cls, made: Compensation) -> Self:
        """Return a compensation that can be drawn and saved."""
        return cls(**{one.name: getattr(made, one.name) for one in fields(Compensation)})

    def plot(self) -> Figure:
        """Draw reference, prediction and error along time."""
        return draw_compensation(self)

    def save(self, folder: str | Path, *, overwrite: bool = False) -> list[Path]:
        """Write all files to a folder, and return them.

        Raises
        ------
        InputError
            A file that exists, unless it may be replaced, or that cannot be written.
        """
        where = Path(folder)
        command, numbers, table, page = files = [where / name for name in FILES]
        refuse_existing(files, overwrite)
        try:
            where.mkdir(parents=True, exist_ok=True)
            write_record(self.record, command)
            write_summary(numbers, self.summary)
            self.to_pandas().to_csv(table, index=False, float_format="%.9g")
            pictures = {}
            for name, figure in draw_compensations(self).items():
                picture = where / f"{name}.png"
                save_one(figure, picture)
                pictures[name] = picture.read_bytes()
            page.write_text(render(self, pictures), encoding="utf-8")
        except OSError as error:
            raise InputError(f"{where}: {error.strerror}; choose another place") from None
        return files

    def __repr__(self) -> str:
        after, before = self.compensated.numbers(self.limit), self.linear.numbers(self.limit)
        low, high = after["rms_um"]["95"]
        text = (
            f"compensation for {self.reference.name}: rms error {after['rms_um']['mean']:.3g} um "
            f"(95 %: {low:.3g} to {high:.3g}), without compensation "
            f"{before['rms_um']['mean']:.3g} um"
        )
        if self.limit is not None:
            within = after["probability_below_limit"]
            text += f"; stays below {self.limit:g} um with a probability of {within:.2f}"
        return text


def compensate_run(path: Path, reference: Reference | Path, **options: Any) -> Compensated:
    """Return the command for a reference from the run in a folder.

    Options and errors are as of :func:`compensate_draws`; a run that has not converged is refused.
    """
    problem, flat = drawn(path)
    return compensate_draws(problem, flat, reference, **options)


def compensate_draws(
    problem: Problem,
    flat: FloatArray,
    reference: Any,
    *,
    command: Choice = "mean",
    from_rest: bool = False,
    voltage: tuple[float, float] | None = None,
    slew: float | None = None,
    current: float | None = None,
    capacitance: float | None = None,
    nearest: bool = False,
    limit: float | None = None,
    interval: float | None = None,
    smoothed: float | None = None,
) -> Compensated:
    """Return the command for a reference from draws, with what is promised of it.

    Parameters
    ----------
    problem
        What was fitted; of several records the first.
    flat
        Its draws, (draws, free), parameters in their own units; a thousand of them are used.
    reference
        A :class:`~bwbayes.control.wished.Reference`, a file, or displacements (samples,), um, at
        the record's sampling interval or the given ``interval``, s.
    command, from_rest, nearest, limit
        As of :func:`~bwbayes.control.compensation.compensate`.
    voltage, slew, current, capacitance
        Limits of the amplifier: lowest and highest voltage, V, by default those of all records
        fitted; its fastest change, V/s, and the largest current, A, into the actuator's
        capacitance, F, by default any.
    interval, smoothed
        Sampling interval, and sd of a smoothing, s, of displacements.

    Raises
    ------
    InputError
        A reference that cannot be read or reached.
    """
    span = limits_of(problem, voltage)
    fastest = math.inf if slew is None else slew
    limits = Limits(span.low, span.high, fastest, current, capacitance)
    alone = next(iter(problem.posterior.each(flat)))
    asked = reference_of(reference, interval or problem.record.interval, smoothed)
    seed = problem.config.seed
    made = compensate(
        alone.posterior,
        thinned(alone.draws, generator(seed, "draws")),
        asked,
        generator(seed, f"compensate {asked.name}"),
        command=command,
        from_rest=from_rest,
        limits=limits,
        nearest=nearest,
        limit=limit,
    )
    far = beyond_training(alone.posterior, made.voltage, asked.interval)
    return Compensated.of(replace(made, remarks=(*made.remarks, *far)))


def reference_of(given: Any, interval: float, smoothed: float | None = None) -> Reference:
    """Return a reference that is one already, or read from a file, or made of displacements.

    Raises
    ------
    InputError
        It cannot be used.
    """
    if isinstance(given, Reference):
        return given
    name = "reference"
    if isinstance(given, str | Path):
        given, interval = read_reference(name := str(given))
    return Reference(given, interval, Path(name).stem, smoothed or 0.0)
