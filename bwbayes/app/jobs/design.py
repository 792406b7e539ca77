"""``bwbayes design``: what to measure next, from a finished run.

Candidates come from a file, a table of a signal each, or are a preset within the amplifier's
limits. They are ranked by what they would leave of a parameter's standard deviation, or of a
parameter band's width along a drive; the best goes into a file for the signal generator.
"""

from __future__ import annotations

import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path

import numpy as np
from pydantic import ValidationError
from rich import box
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from bwbayes.app.config.config import SignalConfig
from bwbayes.app.config.keys import one_line
from bwbayes.app.figures import save_one
from bwbayes.app.figures.design import draw_design
from bwbayes.app.jobs.at_work import RunDraws, drawn, limits_of, refuse_existing
from bwbayes.app.problem.problem import Problem, generator, sampled_waveform
from bwbayes.app.report.design_report import render
from bwbayes.app.screen import show_standing
from bwbayes.arrays import ArrayLike, FloatArray
from bwbayes.comparison.design import Asked, Promise, promises, ranked
from bwbayes.data import Record, read_record, write_record
from bwbayes.data.waveforms import Decay, Sine, Staircase, Triangle, Waveform, signal, signal_names
from bwbayes.errors import InputError
from bwbayes.model.drive import time_between_turns, turning_points
from bwbayes.model.inverse.limits import Limits
from bwbayes.results.outputs import write_summary

__all__ = [
    "PRESET",
    "amplifier_of",
    "candidates_of",
    "design",
    "design_draws",
    "liveliest",
    "preset",
    "promised",
]

PRESET = "standard"

FILES = ("best.csv", "design.html", "design.json")

# A decaying drive loses all but this part of its amplitude by its end.
LEFT = 0.1

# Levels of a staircase, as parts of half the range, in their order.
STAIRS = (1.0, -1.0, 0.6, -0.6, 0.3, -0.3, 0.8, -0.2, 0.5, 0.0)


def design(
    path: Path,
    out: Path,
    console: Console,
    *,
    candidates: str = PRESET,
    parameter: str | None = None,
    drive: str | None = None,
    voltage: tuple[float, float] | None = None,
    slew: float | None = None,
    current: float | None = None,
    capacitance: float | None = None,
    overwrite: bool = False,
) -> list[Promise]:
    """Rank candidates for a finished run; write and show what came of it.

    Parameters
    ----------
    path
        The run's folder.
    out
        Where ``best.csv``, ``design.json`` and the page ``design.html`` with its pictures go.
    console
        Where the table goes.
    candidates
        A TOML file with a table for each signal, of the keys of a config's [record.signal]; or
        ``"standard"``.
    parameter, drive
        What is to be known better: a parameter, or the band along a record's voltage or a signal.
    voltage, slew, current, capacitance
        What the amplifier can do: V, V/s, A, F; by default the voltages of the fitted record.

    Raises
    ------
    InputError
        No such run, candidates that cannot be read, none that the amplifier can make, or files that
        are there already.
    NotConvergedError
        The run has not converged.
    """
    refuse_existing([out / name for name in FILES], overwrite)
    if (parameter is None) == (drive is None):
        raise InputError("design: give either a parameter or a drive")
    run = drawn(path)
    problem = run.problem
    amplifier = amplifier_of(problem, voltage, slew, current, capacitance)
    signals = candidates_of(candidates, problem, amplifier)
    target = parameter if drive is None else _drive(drive, problem)
    assert target is not None
    made = promised(run, signals, target, amplifier)
    if made[0].refused:
        raise InputError(
            f"design: the amplifier can make none of the candidates; {made[0].name} "
            f"{made[0].refused}"
        )
    interval = problem.records[liveliest(problem)].interval
    asked = Asked(path.name, parameter, drive, amplifier, signals, interval, run.standing)
    write(asked, made, out)
    show_standing(run.standing, console)
    table = Table("candidate", asked.left, "remark", box=box.SIMPLE_HEAD)
    for one in made:
        left = "-" if one.refused else f"{one.left:.1%} ± {one.error:.1%}"
        table.add_row(escape(one.name), left, escape(one.refused))
    console.print(table)
    console.print(f"wrote {out / 'best.csv'}: {made[0].name}", highlight=False, soft_wrap=True)
    console.print(f"report: {out / 'design.html'}", highlight=False, soft_wrap=True)
    return made


def write(asked: Asked, made: Sequence[Promise], out: Path) -> None:
    """Write the best signal's file, the page and the numbers to a folder.

    Raises
    ------
    InputError
        The folder cannot be written.
    """
    best = Record(asked.signals[made[0].name], None, asked.interval, voltage_is="command")
    command, page, numbers = (out / name for name in FILES)
    try:
        out.mkdir(parents=True, exist_ok=True)
        write_record(best, command)
        pictures = {}
        for name, figure in draw_design(asked, made).items():
            picture = out / f"{name}.png"
            save_one(figure, picture)
            pictures[name] = picture.read_bytes()
        page.write_text(render(asked, made, pictures), encoding="utf-8")
        write_summary(
            numbers,
            {
                "validation": asked.standing.numbers,
                "target": asked.target,
                "best": made[0].name,
                "amplifier": asdict(asked.amplifier),
                "candidates": [asdict(one) for one in made],
            },
        )
    except OSError as error:
        raise InputError(f"{out}: {error.strerror}; choose another folder") from None


def design_draws(
    run: RunDraws,
    target: str | ArrayLike,
    *,
    candidates: Mapping[str, ArrayLike] | None = None,
    voltage: tuple[float, float] | None = None,
    slew: float | None = None,
    current: float | None = None,
    capacitance: float | None = None,
) -> list[Promise]:
    """Rank candidates by what they would teach; the best first.

    Parameters
    ----------
    run
        What is built on.
    target
        A parameter's name, or a drive (samples,), V, whose parameter band is to be narrow.
    candidates
        Voltages (samples,) by name, V, at the fitted record's interval (of several that whose
        voltage turns most), from rest; by default the preset.
    voltage, slew, current, capacitance
        What the amplifier can do: V, V/s, A, F.

    Raises
    ------
    InputError
        A target that is not a free parameter of the actuator, or limits that leave nothing.
    """
    amplifier = amplifier_of(run.problem, voltage, slew, current, capacitance)
    if candidates is None:
        signals = candidates_of(PRESET, run.problem, amplifier)
    else:
        signals = {n: np.asarray(v, dtype=np.float64) for n, v in candidates.items()}
    asked = target if isinstance(target, str) else np.asarray(target, dtype=np.float64)
    return promised(run, signals, asked, amplifier)


def promised(
    run: RunDraws,
    signals: Mapping[str, FloatArray],
    target: str | FloatArray,
    amplifier: Limits,
) -> list[Promise]:
    """Return what signals (samples,) promise, the best first."""
    problem, flat, _ = run
    source = generator(problem.config.seed, "design")
    # Of several records, what all of them taught of the actuator, seen from one.
    name = liveliest(problem)
    posterior = problem.posterior.alone(name)
    its = problem.posterior.its(flat, name)
    return ranked(promises(posterior, its, signals, target, amplifier, source))


def liveliest(problem: Problem) -> str:
    """Return the name of the fitted record whose voltage turns most: the new one is to be alike."""
    return max(problem.records, key=lambda name: turning_points(problem.records[name].voltage).size)


def amplifier_of(
    problem: Problem,
    voltage: tuple[float, float] | None,
    slew: float | None,
    current: float | None,
    capacitance: float | None,
) -> Limits:
    """Return the amplifier; by default with the voltages that were fitted alone."""
    if voltage is None:
        span = limits_of(problem, None)
        voltage = span.low, span.high
    return Limits(*voltage, np.inf if slew is None else slew, current, capacitance)


def candidates_of(candidates: str, problem: Problem, amplifier: Limits) -> dict[str, FloatArray]:
    """Return the candidates' voltages (samples,) by name, V, at the liveliest record's interval.

    Raises
    ------
    InputError
        A file that cannot be read, or has no signal.
    """
    rate = 1 / problem.records[liveliest(problem)].interval
    given = candidates != PRESET
    waveforms = _from_file(Path(candidates)) if given else preset(problem, amplifier)
    return {name: waveform.sample(rate)[1] for name, waveform in waveforms.items()}


def preset(problem: Problem, amplifier: Limits) -> dict[str, Waveform]:
    """Return sines and triangles, steady and decaying, small and slow, and a staircase.

    They are as long as the fitted record, of several the liveliest, about the middle of the
    amplifier's range, and turn as often as its drive, or as often as the amplifier allows.
    """
    record = problem.records[liveliest(problem)]
    duration = record.duration
    half, middle = (amplifier.high - amplifier.low) / 2, (amplifier.high + amplifier.low) / 2
    usual = 0.5 / time_between_turns(record.voltage, record.interval)
    # A sine changes fastest, by 2π f times its amplitude.
    fastest = min(usual, amplifier.rate / (2 * np.pi * half))
    fading = Decay(0.0, (1 - LEFT) / duration)
    made = {
        "steady sine": Waveform(Sine(half, fastest), duration, bias=middle),
        "decaying sine": Waveform(Sine(half, fastest), duration, decay=fading, bias=middle),
        "small steady sine": Waveform(Sine(half / 2, fastest), duration, bias=middle),
        "slow steady sine": Waveform(Sine(half, fastest / 4), duration, bias=middle),
        "slow decaying sine": Waveform(
            Sine(half, fastest / 4), duration, decay=fading, bias=middle
        ),
        "steady triangle": Waveform(Triangle(half, fastest), duration, bias=middle),
        "decaying triangle": Waveform(Triangle(half, fastest), duration, decay=fading, bias=middle),
    }
    if not np.isfinite(amplifier.rate):
        levels = tuple(half * part for part in STAIRS)
        stairs = Staircase(levels, duration / len(levels))
        made["staircase"] = Waveform(stairs, duration, bias=middle)
    return made


def _from_file(path: Path) -> dict[str, Waveform]:
    try:
        tables = tomllib.loads(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeError) as error:
        reason = getattr(error, "strerror", None) or "is not UTF-8 text"
        raise InputError(f'{path}: {reason}; give a file of candidates, or "{PRESET}"') from None
    except (ValueError, RecursionError) as error:
        raise InputError(f"{path}: invalid TOML: {error}; correct the file") from None
    if not tables:
        raise InputError(f"{path}: has no candidate; write a table for each signal")
    made = {}
    for name, given in tables.items():
        try:
            made[name] = sampled_waveform(SignalConfig.model_validate(given))
        except ValidationError as error:
            raise InputError(one_line(f"{path}: {name}", error, SignalConfig)) from None
        except InputError as error:
            raise InputError(f"{path}: {name}: {error}") from None
    return made


def _drive(name: str, problem: Problem) -> FloatArray:
    """Return the voltage of a signal's name or of a record's file, at the liveliest's interval."""
    interval = problem.records[liveliest(problem)].interval
    if name in signal_names():
        return signal(name).sample(1 / interval)[1]
    record = read_record(Path(name), need_displacement=False)
    if not np.isclose(record.interval, interval, rtol=1e-6):
        times = np.arange(0.0, record.duration, interval)
        since = record.interval * np.arange(record.samples)
        along: FloatArray = np.interp(times, since, record.voltage)
        return along
    return record.voltage
