"""Simulation-based calibration of a config's posterior, from first replicate to last file.

:func:`start` makes the folder: the config with every prior an explicit number, the same for all
replicates. :func:`resume` makes whatever replicates are missing, side by side, writes a line for
each, and judges them all. Each replicate depends on the config, the seed and its number alone, so
it does not matter in how many pieces or with how many workers a calibration is done. Replicates of
another config or record are refused.
"""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import replace
from hashlib import sha256
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import BaseModel, ConfigDict, PositiveInt, TypeAdapter
from rich.console import Console

from bwbayes.app.config.config import Config, dump, load
from bwbayes.app.problem.model import in_words
from bwbayes.app.problem.problem import Problem, generator, resolve
from bwbayes.app.running.fingerprint import versions
from bwbayes.app.running.folder import CalibrationFolder
from bwbayes.app.running.progress import CountProgress
from bwbayes.app.running.workers import executor, one_thread, side_by_side
from bwbayes.errors import InputError
from bwbayes.report.calibration import calibration_report
from bwbayes.report.saving import save
from bwbayes.results.calibration import Calibration, judge
from bwbayes.results.replicates import RANKED, Entry, Experiment, replicates
from bwbayes.results.simulated import OtherRecord

__all__ = ["experiment", "resume", "start"]

# Draws of the prior that show whether there is one.
TRIED = 64


class _Request(BaseModel):
    """The first line, and any that asks for more: how many replicates, of what."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    replicates: PositiveInt
    of: str

    @property
    def line(self) -> bytes:
        return self.model_dump_json().encode() + b"\n"


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
    request = _Request(replicates=count, of=_identity(problem))
    return CalibrationFolder.create(out, problem, overwrite, request.line)


def experiment(problem: Problem) -> Experiment:
    """Return what the replicates of a problem have in common.

    Held out are the validation windows of its own record; other records are made again with each
    replicate's truth, at the times and with the voltage that they have.

    Raises
    ------
    InputError
        Its voltage shows no loop, or its prior leaves hardly anything.
    """
    problem.posterior.prior.draw(np.random.default_rng(0), TRIED)
    windows = {
        f"{name} {i}" if i else name: window
        for name, v in problem.validations.items()
        for i, window in enumerate(v.windows)
    }
    others = {
        name: OtherRecord(v.record, v.start, v.judged, v.of)
        for name, v in problem.validations.items()
        if v.record is not None
    }
    belongs = {name: problem.validations[name.partition(" ")[0]].of for name in windows}
    return Experiment(problem.posterior, problem.plan, windows, others, belongs=belongs)


def resume(
    folder: CalibrationFolder,
    console: Console,
    *,
    workers: int | None = None,
    count: int | None = None,
    backend: str | Executor | None = None,
) -> Calibration:
    """Make the missing replicates, judge all, and write the calibration's files.

    Parameters
    ----------
    folder
        The calibration's folder.
    console
        Where progress goes.
    workers
        Replicates side by side, in processes if more than one; by default as many as cores. The
        result does not depend on it.
    count
        A new number of replicates, if given; none is thrown away.
    backend
        Which executor, as in :func:`~bwbayes.app.running.workers.executor`.

    Raises
    ------
    InputError
        The folder's files do not fit together, or another process is writing them.
    """
    with folder.locked(), one_thread():
        problem = resolve(load(folder.config), folder.path)
        common = experiment(problem)
        request, entries = _read(folder, common, _identity(problem))
        if count is not None and count != request.replicates:
            request = request.model_copy(update={"replicates": count})
            _append(folder, request.line)
        missing = [number for number in range(request.replicates) if number not in entries]
        # It is written last, as the sign that all is done; now there is more to do.
        _clear(folder)
        if missing:
            _make(folder, common, problem.config.seed, missing, entries, workers, console, backend)
        console.print("judging and drawing ...", highlight=False)
        ordered = [entries[number] for number in sorted(entries)]
        provenance = {
            "seed": problem.config.seed,
            "data_sha256": problem.sha256,
            "versions": versions(problem.posterior.engine),
        }
        calibration = replace(
            judge(ordered, generator(problem.config.seed, "ranks")),
            name=problem.config.name or "calibration",
            parameters=problem.parameters,
            facts=_facts(problem, provenance),
            provenance=provenance,
        )
        # Nothing in its files depends on when or how it was computed.
        save(calibration_report(calibration), folder.path, "calibration", pictures="figures")
    return calibration


def _identity(problem: Problem) -> str:
    """Return a digest of everything that replicates depend on."""
    return sha256((dump(problem.config) + problem.sha256).encode()).hexdigest()


def _make(
    folder: CalibrationFolder,
    common: Experiment,
    seed: int,
    missing: Sequence[int],
    entries: dict[int, Entry],
    workers: int | None,
    console: Console,
    backend: str | Executor | None,
) -> None:
    """Add the missing replicates to the entries, and write each as soon as it is done."""
    count = min(workers or os.cpu_count() or 1, len(missing))
    unconverged = sum(not entry["converged"] for entry in entries.values())
    # Processes, also for the compiled engine: most of a replicate's time goes into Python.
    with (
        executor(count, backend=backend) as pool,
        CountProgress(
            console, "replicate", len(entries), len(missing), {"not converged": unconverged}
        ) as progress,
    ):
        together = side_by_side(pool, workers, len(missing))
        for replicate in replicates(common, seed, missing, pool, together):
            entry = entries[replicate.number] = replicate.entry()
            _append(folder, json.dumps(entry).encode() + b"\n")
            progress("" if replicate.converged else "not converged")


def _append(folder: CalibrationFolder, line: bytes) -> None:
    """Write a line so that it survives a crash."""
    with folder.replicates.open("ab") as file:
        file.write(line)
        file.flush()
        os.fsync(file.fileno())


def _read(
    folder: CalibrationFolder, common: Experiment, identity: str
) -> tuple[_Request, dict[int, Entry]]:
    """Read how many replicates were requested, and those that are written; cut off half a line."""
    content = folder.replicates.read_bytes()
    end = content.rfind(b"\n") + 1
    if end < len(content):
        os.truncate(folder.replicates, end)
    first, *others = content[:end].splitlines() or [b""]
    request = _request(folder, first, identity)
    entries: dict[int, Entry] = {}
    for number, line in enumerate(others, start=2):
        if line.startswith(b'{"replicates"'):
            request = _request(folder, line, identity)
            continue
        try:
            entry = _entry(line, common, entries)
        except ValueError:
            raise InputError(
                f"{folder.replicates}:{number}: is not one of these replicates; delete this line"
            ) from None
        entries[entry["number"]] = entry
    return request, entries


def _request(folder: CalibrationFolder, line: bytes, identity: str) -> _Request:
    """Read the line that says how many replicates were requested, and check that they are these."""
    try:
        request = _Request.model_validate_json(line)
    except ValueError:
        raise InputError(
            f"{folder.replicates}: does not say how many replicates were requested; "
            "start again with `overwrite=True`"
        ) from None
    if request.of != identity:
        raise InputError(
            f"{folder.replicates}: these are replicates of another config or record than the "
            "folder's; restore that, or start again with `overwrite=True`"
        )
    return request


def _entry(line: bytes, common: Experiment, others: Mapping[int, Entry]) -> Entry:
    """Read a line, and check that it is a replicate of this experiment, and a new one."""
    entry = TypeAdapter(Entry).validate_json(line)
    stored = [*entry["ranks"]], [*entry["covered"]]
    if stored not in (([*common.statistics], [*common.bands]), ([], [])):
        raise ValueError("has other statistics")
    if not all(0 <= rank <= RANKED for rank in entry["ranks"].values()):
        raise ValueError("has a rank that there is not")
    if entry["number"] in others:
        raise ValueError("is there already")
    return entry


def _clear(folder: CalibrationFolder) -> None:
    """Remove what an earlier run has written."""
    for path in (folder.summary, folder.path / "calibration.html"):
        path.unlink(missing_ok=True)
    shutil.rmtree(folder.path / "figures", ignore_errors=True)


def _facts(problem: Problem, provenance: Mapping[str, Any]) -> list[tuple[str, str]]:
    model, plan = problem.config.model, problem.plan
    held_out = [window for v in problem.validations.values() for window in v.windows]
    judged = sum(window.stop - window.start for window in held_out)
    windows = [window for dataset in problem.posterior.datasets for window in dataset.training]
    fitted = sum(window.stop - window.start for window in windows)
    return [
        *(
            (
                "voltage" if len(problem.records) == 1 else f"voltage, {name}",
                f"{record.origin}: {record.samples} samples every {record.interval:g} s",
            )
            for name, record in problem.records.items()
        ),
        ("fitted, held out", f"{fitted} samples, {judged} samples"),
        ("model", in_words(model)),
        ("noise", model.noise),
        (
            "sampling",
            f"{plan.ensembles} ensembles of {plan.walkers} walkers, to ESS {plan.ess:g}, "
            f"at most {plan.most_steps} steps",
        ),
        ("seed", str(provenance["seed"])),
        ("data, SHA-256", str(provenance["data_sha256"])),
        ("versions", ", ".join(f"{name} {text}" for name, text in provenance["versions"].items())),
    ]
