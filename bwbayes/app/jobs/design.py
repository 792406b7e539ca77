"""``bwbayes design``: what to measure next, from a finished run.

Candidates come from a file, a table of a signal each, or are a preset within the amplifier's
limits. They are ranked by what they would leave of a parameter's standard deviation, or of a
parameter band's width along a drive; the best goes into a file for the signal generator.
"""

from __future__ import annotations

import tomllib
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path

import numpy as np
from pydantic import ValidationError
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from bwbayes.app.config.config import SignalConfig
from bwbayes.app.config.keys import one_line
from bwbayes.app.config.proposal import read_recognised
from bwbayes.app.problem.problem import Problem, generator, sampled_waveform
from bwbayes.app.running.folder import RunFolder
from bwbayes.app.running.run import finished
from bwbayes.arrays import ArrayLike, FloatArray
from bwbayes.comparison.design import Promise, promises, ranked
from bwbayes.data import Record, write_record
from bwbayes.data.waveforms import Decay, Sine, Staircase, Triangle, Waveform, signal, signal_names
from bwbayes.errors import InputError, NotConvergedError
from bwbayes.model.drive import time_between_turns
from bwbayes.model.inverse.limits import Limits
from bwbayes.results.outputs import write_summary
from bwbayes.sampling.sampler import draws

__all__ = [
    "PRESET",
    "amplifier_of",
    "candidates_of",
    "design",
    "design_draws",
    "preset",
    "promised",
]

PRESET = "standard"

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
        Where ``design.json`` and ``best.csv`` go.
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
    for name in ("design.json", "best.csv"):
        if (out / name).exists() and not overwrite:
            raise InputError(f"{out / name}: exists; choose another --out, or give --overwrite")
    if (parameter is None) == (drive is None):
        raise InputError("design: give either --parameter or --drive")
    problem, chain, outcome = finished(RunFolder.open(path))
    if not outcome.converged:
        raise NotConvergedError(f"{path}: has not converged, so nothing is known to start from")
    flat = draws(problem.posterior, chain).reshape(-1, len(problem.posterior.names))
    amplifier = amplifier_of(problem, voltage, slew, current, capacitance)
    signals = candidates_of(candidates, problem, amplifier)
    target = parameter if drive is None else _drive(drive, problem)
    assert target is not None
    made = promised(problem, flat, signals, target, amplifier)
    if made[0].refused:
        raise InputError(
            f"design: the amplifier can make none of the candidates; {made[0].name} "
            f"{made[0].refused}"
        )
    best = Record(signals[made[0].name], None, problem.record.interval, voltage_is="command")
    try:
        out.mkdir(parents=True, exist_ok=True)
        write_record(best, out / "best.csv")
        write_summary(
            out / "design.json",
            {
                "target": parameter or drive,
                "best": made[0].name,
                "amplifier": asdict(amplifier),
                "candidates": [asdict(one) for one in made],
            },
        )
    except OSError as error:
        raise InputError(f"{out}: {error.strerror}; choose another folder with --out") from None
    table = Table("candidate", f"sd left of {escape(str(parameter or drive))}", "remark")
    for one in made:
        left = "-" if one.refused else f"{one.left:.1%} ± {one.error:.1%}"
        table.add_row(escape(one.name), left, escape(one.refused))
    console.print(table)
    console.print(f"wrote {out / 'best.csv'}: {made[0].name}", highlight=False, soft_wrap=True)
    return made


def design_draws(
    problem: Problem,
    flat: FloatArray,
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
    problem, flat
        What was fitted, and its draws (draws, free).
    target
        A parameter's name, or a drive (samples,), V, whose parameter band is to be narrow.
    candidates
        Voltages (samples,) by name, V, at the fitted record's interval, from rest; by default the
        preset.
    voltage, slew, current, capacitance
        What the amplifier can do: V, V/s, A, F.

    Raises
    ------
    InputError
        A target that is not a free parameter of the actuator, or limits that leave nothing.
    """
    amplifier = amplifier_of(problem, voltage, slew, current, capacitance)
    if candidates is None:
        signals = candidates_of(PRESET, problem, amplifier)
    else:
        signals = {n: np.asarray(v, dtype=np.float64) for n, v in candidates.items()}
    asked = target if isinstance(target, str) else np.asarray(target, dtype=np.float64)
    return promised(problem, flat, signals, asked, amplifier)


def promised(
    problem: Problem,
    flat: FloatArray,
    signals: Mapping[str, FloatArray],
    target: str | FloatArray,
    amplifier: Limits,
) -> list[Promise]:
    """Return what signals (samples,) promise, the best first."""
    source = generator(problem.config.seed, "design")
    # Of several records, what all of them taught of the actuator, seen from the first.
    first = next(iter(problem.records))
    posterior = problem.posterior.alone(first)
    its = problem.posterior.its(flat, first)
    return ranked(promises(posterior, its, signals, target, amplifier, source))


def amplifier_of(
    problem: Problem,
    voltage: tuple[float, float] | None,
    slew: float | None,
    current: float | None,
    capacitance: float | None,
) -> Limits:
    """Return the amplifier; by default with the voltages of the fitted record alone."""
    known = problem.record.voltage
    low, high = voltage or (float(np.min(known)), float(np.max(known)))
    return Limits(low, high, np.inf if slew is None else slew, current, capacitance)


def candidates_of(candidates: str, problem: Problem, amplifier: Limits) -> dict[str, FloatArray]:
    """Return the candidates' voltages (samples,) by name, V, at the fitted record's interval.

    Raises
    ------
    InputError
        A file that cannot be read, or has no signal.
    """
    rate = 1 / problem.record.interval
    given = candidates != PRESET
    waveforms = _from_file(Path(candidates)) if given else preset(problem, amplifier)
    return {name: waveform.sample(rate)[1] for name, waveform in waveforms.items()}


def preset(problem: Problem, amplifier: Limits) -> dict[str, Waveform]:
    """Return sines and triangles, steady and decaying, small and slow, and a staircase.

    They are as long as the fitted record, about the middle of the amplifier's range, and turn as
    often as the fitted drive, or as often as the amplifier allows.
    """
    record = problem.record
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
    """Return the voltage of a signal's name or of a record's file, at the fitted interval."""
    rate = 1 / problem.record.interval
    if name in signal_names():
        return signal(name).sample(rate)[1]
    record = read_recognised(Path(name))
    if not np.isclose(record.interval, problem.record.interval, rtol=1e-6):
        times = np.arange(0.0, record.duration, problem.record.interval)
        since = record.interval * np.arange(record.samples)
        along: FloatArray = np.interp(times, since, record.voltage)
        return along
    return record.voltage
