"""Calibration of a config's posterior, from its first replicate to its last file.

:func:`start` makes the folder: the config with every prior an explicit number, the same for all
replicates. :func:`carry_on` makes whatever replicates are missing, side by side, writes a line for
each, and judges them all. Each replicate depends on the config, the seed and its number alone, so
it does not matter in how many pieces or with how many workers a calibration is done.
"""

from __future__ import annotations

import json
import os
import shutil
from pathlib import Path
from typing import Any

from rich.console import Console

from bwbayes.app.calibration_report import render
from bwbayes.app.config import Config, load
from bwbayes.app.figures import save
from bwbayes.app.figures.calibration import draw_calibration
from bwbayes.app.folder import CalibrationFolder
from bwbayes.app.problem import Problem, generator, resolve
from bwbayes.app.progress import ReplicateProgress
from bwbayes.app.run import versions
from bwbayes.app.workers import executor, one_thread
from bwbayes.errors import InputError
from bwbayes.results.calibration import Calibration, judge, summary
from bwbayes.results.files import write_summary
from bwbayes.results.replicates import Entry, Experiment, replicates

__all__ = ["carry_on", "experiment", "start"]


def start(
    config: Config, where: Path, out: Path, count: int, *, overwrite: bool = False
) -> CalibrationFolder:
    """Make the folder of a new calibration with ``count`` replicates.

    The config's files are relative to the folder ``where``.

    Raises
    ------
    InputError
        The config, its records or the folder cannot be used.
    """
    problem = resolve(config, where)
    experiment(problem)
    folder = CalibrationFolder.create(out, problem, overwrite)
    _append(folder, {"replicates": count})
    return folder


def experiment(problem: Problem) -> Experiment:
    """Return what the replicates of a problem have in common.

    Held out are the validation windows of its own record; other records take no part.

    Raises
    ------
    InputError
        Its voltage shows no loop.
    """
    windows = {n: v.window for n, v in problem.validations.items() if v.window is not None}
    return Experiment(problem.posterior, problem.plan, windows)


def carry_on(
    folder: CalibrationFolder,
    console: Console,
    *,
    workers: int | None = None,
    count: int | None = None,
) -> Calibration:
    """Make the missing replicates, judge all, and write the calibration's files.

    Parameters
    ----------
    folder
        The calibration's folder.
    console
        Where progress goes.
    workers
        Processes for the replicates; by default one a core. The result does not depend on it.
    count
        A new number of replicates, if given; none is thrown away.

    Raises
    ------
    InputError
        The folder's files do not fit together, or another process is writing them.
    """
    with folder.locked(), one_thread():
        problem = resolve(load(folder.config), folder.path)
        wanted, entries = _read(folder)
        if count is not None and count != wanted:
            _append(folder, {"replicates": count})
            wanted = count
        # It is written last, as the sign that all is there; now something is to come.
        folder.summary.unlink(missing_ok=True)
        if len(entries) < wanted:
            entries += _made(folder, problem, range(len(entries), wanted), workers, console)
        console.print("judging and drawing ...", highlight=False)
        calibration = judge(entries, generator(problem.config.seed, "ranks"))
        _write(folder, problem, calibration)
    return calibration


def _made(
    folder: CalibrationFolder,
    problem: Problem,
    numbers: range,
    workers: int | None,
    console: Console,
) -> list[Entry]:
    """Make replicates, and write each as soon as all before it are written."""
    entries = []
    common, seed = experiment(problem), problem.config.seed
    # Always processes: most of a replicate's time goes into Python, not into compiled code.
    with (
        executor(min(workers or os.cpu_count() or 1, len(numbers))) as pool,
        ReplicateProgress(console, numbers.start, numbers.stop) as progress,
    ):
        for made in replicates(common, seed, numbers, pool):
            entries.append(made.entry())
            _append(folder, entries[-1])
            progress(made.converged)
    return entries


def _append(folder: CalibrationFolder, line: Any) -> None:
    """Write a line that is there after a crash."""
    with folder.replicates.open("ab") as file:
        file.write(json.dumps(line).encode() + b"\n")
        file.flush()
        os.fsync(file.fileno())


def _read(folder: CalibrationFolder) -> tuple[int, list[Entry]]:
    """Read how many replicates are wanted, and those that are there; cut off half a line."""
    content = folder.replicates.read_bytes()
    whole = content.rfind(b"\n") + 1
    if whole < len(content):
        os.truncate(folder.replicates, whole)
    wanted = 0
    entries: list[Entry] = []
    for number, text in enumerate(content[:whole].splitlines(), start=1):
        try:
            line = json.loads(text)
            if line.keys() == {"replicates"}:
                wanted = int(line["replicates"])
                continue
            entries.append(_entry(line, len(entries)))
        except (ValueError, TypeError, AttributeError):
            raise InputError(
                f"{folder.replicates}:{number}: is no replicate; delete this line and all after it"
            ) from None
    if not wanted:
        raise InputError(
            f"{folder.replicates}: does not say how many replicates there are to be; "
            "calibrate anew with --overwrite"
        )
    return wanted, entries


def _entry(line: Any, number: int) -> Entry:
    """Check that a line is the replicate of that number."""
    if line.keys() != Entry.__annotations__.keys() or line["number"] != number:
        raise ValueError("not the next replicate")
    entry: Entry = line
    return entry


def _write(folder: CalibrationFolder, problem: Problem, calibration: Calibration) -> None:
    """Write everything that a calibration leaves; the summary last, as the sign that all is there.

    Nothing in it depends on when or how it was computed.
    """
    numbers = summary(calibration) | {
        "seed": problem.config.seed,
        "data_sha256": problem.record.sha256,
        "versions": versions(problem.posterior.engine),
    }
    shutil.rmtree(folder.path / "figures", ignore_errors=True)
    figures = draw_calibration(calibration, problem.parameters)
    pictures = save(figures, folder.path / "figures")
    page = render(problem, calibration, numbers, pictures)
    (folder.path / "calibration.html").write_text(page, encoding="utf-8")
    write_summary(folder.summary, numbers)
