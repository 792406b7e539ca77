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

import numpy as np

from bwbayes.app.figures import save_one
from bwbayes.app.figures.compensation import draw_compensation, draw_compensations
from bwbayes.app.jobs.at_work import RunDraws, command_limits, refuse_existing
from bwbayes.app.problem.problem import generator
from bwbayes.app.report.compensation_report import render
from bwbayes.control.compensation import compensate
from bwbayes.control.predicted import Choice, Compensation
from bwbayes.control.wished import SHAPES, Reference, shaped
from bwbayes.data.io.formats import read_reference, write_record
from bwbayes.errors import InputError, suggestion
from bwbayes.model.inverse.limits import Limits
from bwbayes.model.linear import parse_hold
from bwbayes.results.extrapolation import beyond_training
from bwbayes.results.outputs import write_summary
from bwbayes.results.prediction import thinned

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["Compensated", "compensate_draws", "reference_of"]

FILES = ("command.csv", "compensation.json", "compensation.csv", "compensation.html")


@dataclass(frozen=True, eq=False, repr=False)
class Compensated(Compensation):
    """A command, its predicted errors, and how to look at it and keep it.

    ``voltage`` (samples,), V, is the command for the ``asked`` reference, um, which it follows as
    ``smoothed``; ``compensated`` what it does, ``linear`` what a command without compensation does:
    the ``rms`` and ``largest`` error (draws,), um, with ``bands`` of the displacement. ``between``
    is how far the displacement leaves straight lines between samples, um, and ``difference`` the
    largest difference, V, from the other ``command`` that could have been taken.
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
        return "\n".join([*self.standing.said, text])


def compensate_draws(
    run: RunDraws,
    reference: Any,
    *,
    command: Choice = "mean",
    hold: str = "zoh",
    from_rest: bool = False,
    voltage: tuple[float, float] | None = None,
    slew: float | None = None,
    current: float | None = None,
    capacitance: float | None = None,
    nearest: bool = False,
    limit: float | None = None,
    interval: float | None = None,
    smoothed: float | None = None,
    amplitude: float | None = None,
    frequency: float | None = None,
    middle: float | None = None,
    periods: float | None = None,
    levels: int | None = None,
) -> Compensated:
    """Return the command for a reference from draws, with what is promised of it.

    Parameters
    ----------
    run
        What is built on; of several records the first, and a thousand of the draws.
    reference
        As of :func:`reference_of`.
    command
        ``"mean"``, the inverse of the mean model; or ``"expected"``, the voltage whose squared
        error, expected over the draws, is least.
    hold
        What the command does between samples: ``"zoh"``, it is held, as a DAC does (zero-order
        hold); ``"foh"``, it goes in straight lines (first-order hold), as the output of a generator
        that interpolates does. It need not be that of the record.
    from_rest
        The actuator starts demagnetized; otherwise it has waited at zero volts, in a state of its
        hysteresis that nothing tells.
    voltage, slew, current, capacitance
        Limits of the amplifier: lowest and highest voltage, V, by default zero and those of all
        records fitted; its fastest change, V/s, and the largest current, A, into the actuator's
        capacitance, F, by default any.
    nearest
        Give the nearest command where the limits do not allow for the one that is asked for.
    limit
        Of the error, um: the probability that it is kept is given.
    interval, smoothed
        Sampling interval, s, by default that of the record, and SD of a smoothing, s; a file has an
        interval of its own.
    amplitude, frequency, middle, periods, levels
        Of a shape: um and Hz, which it needs; um (default: 0); how many periods or lines (default:
        3), and steps of a staircase from the middle to either end (default: 5).

    Raises
    ------
    InputError
        A reference that cannot be read or reached.
    """
    problem, flat, standing = run
    span = command_limits(problem, voltage)
    fastest = math.inf if slew is None else slew
    limits = Limits(span.low, span.high, fastest, current, capacitance)
    alone = next(iter(problem.posterior.each(flat)))
    asked = reference_of(
        reference,
        problem.record.interval,
        interval=interval,
        smoothed=smoothed,
        amplitude=amplitude,
        frequency=frequency,
        middle=middle,
        periods=periods,
        levels=levels,
    )
    seed = problem.config.seed
    made = compensate(
        alone.posterior,
        thinned(alone.draws, generator(seed, "draws")),
        asked,
        generator(seed, f"compensate {asked.name}"),
        command=command,
        hold=parse_hold(hold),
        from_rest=from_rest,
        limits=limits,
        nearest=nearest,
        limit=limit,
    )
    far = beyond_training(alone.posterior, made.voltage, asked.interval)
    remarks = (*made.remarks, *(one.line for one in far))
    return Compensated.of(replace(made, remarks=remarks, standing=standing))


def reference_of(given: Any, default: float, **options: Any) -> Reference:
    """Return a reference: one that is made already, a shape, a file's, or displacements.

    Parameters
    ----------
    given
        A reference; the name of a shape; a file; or displacements (samples,), um.
    default
        Sampling interval, s, where neither the file nor ``options`` say it.
    options
        ``interval``, ``smoothed`` and those of :func:`~bwbayes.control.wished.shaped`; what is None
        is not given.

    Raises
    ------
    InputError
        It is none of these or cannot be used, or options that it cannot have.
    """
    options = {name: value for name, value in options.items() if value is not None}
    shapes = ", ".join(SHAPES)
    if isinstance(given, str) and given in SHAPES:
        for name, unit in (("amplitude", "um"), ("frequency", "Hz")):
            if name not in options:
                raise InputError(f"{given}: has no {name}; give it, in {unit}")
        return shaped(given, **{"interval": default, **options})
    kind, allowed = "displacements take", {"smoothed", "interval"}
    if isinstance(given, Reference):
        kind, allowed = "one that is made already takes", set()
    elif isinstance(given, str | Path):
        kind, allowed = "a file takes", {"smoothed"}
    for name in options:
        if name not in allowed:
            raise InputError(f"reference: {kind} no {name}; leave it out, or give one of {shapes}")
    if isinstance(given, Reference):
        return given
    smoothed = options.get("smoothed", 0.0)
    if isinstance(given, str | Path):
        path = Path(given)
        if isinstance(given, str) and not path.suffix and not path.exists():
            raise InputError(
                f"reference: {given!r} is neither a shape nor a file; {suggestion(given, SHAPES)}"
            )
        values, interval = read_reference(path)
        return Reference(values, interval, path.stem, smoothed)
    try:
        values = np.asarray(given, dtype=np.float64)
    except (TypeError, ValueError):
        values = np.empty(())
    if values.ndim == 0:
        raise InputError(
            f"reference: {type(given).__name__} is none; give one of {shapes}, a file, or "
            "displacements in um"
        )
    return Reference(values, options.get("interval", default), smoothed=smoothed)
