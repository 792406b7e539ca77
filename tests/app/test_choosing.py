"""``noise = "auto"`` is the one that a record has evidence for, and the run says so."""

from __future__ import annotations

import io
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from rich.console import Console

from bwbayes.app.config.config import parse
from bwbayes.app.problem.problem import Problem, resolve
from bwbayes.app.problem.records import generator
from bwbayes.app.running.explaining import chosen_noise
from bwbayes.app.running.run import resume, start
from bwbayes.inference import map_estimate as pointfit
from bwbayes.record import Record, write_record
from tests.test_sampling_rates import records

CONFIG = '[record]\nfile = "record.h5"\ntrain = [[0.0, 4.0]]\nfrom_rest = true\n'


def thinned(record: Record) -> Record:
    assert record.displacement is not None
    return Record(record.voltage[::25], record.displacement[::25], 25 * record.interval)


def plain(sensor: float, rough: float) -> Record:
    """Return a record of a gain of 0.5 um/V, with a rough discrepancy or none."""
    rng = np.random.default_rng(3)
    record = thinned(records(2)[0])
    state, slow = 0.0, np.empty(record.samples)
    for number in range(record.samples):
        state = 0.98 * state + np.sqrt(1 - 0.98**2) * rng.standard_normal()
        slow[number] = state
    noise = rough * slow + sensor * rng.standard_normal(record.samples)
    return replace(record, displacement=0.5 * record.voltage + noise)


def problem_of(folder: Path, record: Record, noise: str = "auto") -> Problem:
    write_record(record, folder / "record.h5")
    return resolve(parse(f'{CONFIG}[model]\nnoise = "{noise}"\n', "config"), folder)


@pytest.mark.parametrize(
    ("record", "expected"),
    [
        (thinned(records(2)[0]), {"smooth"}),
        (plain(0.05, 1.0), {"discrepancy"}),
        # White noise alone is a limit of the others, which lose next to nothing by it.
        (plain(0.3, 0.0), {"discrepancy", "white"}),
    ],
    ids=["plays", "rough", "white"],
)
def test_the_noise_is_chosen_by_evidence(
    record: Record, expected: set[str], tmp_path: Path
) -> None:
    problem = problem_of(tmp_path, record)
    point = pointfit.fit(problem.posterior, generator(problem.config.seed, "point fit"))
    noise, why = chosen_noise(problem, point)
    assert noise in expected
    assert why.startswith(f"noise: {noise} (")
    assert why.count("nats against") == 2


def test_a_run_says_its_noise_and_keeps_it(tmp_path: Path) -> None:
    write_record(thinned(records(2)[0]), tmp_path / "record.h5")
    config = parse(f'{CONFIG}[model]\nnoise = "auto"\n[sampling]\nsteps = 50\n', "config")
    folder = start(config, tmp_path, tmp_path / "run")
    console = Console(file=io.StringIO(), width=200)
    fit = resume(folder, console, workers=1, files=False)
    assert fit.problem.config.model.noise == "smooth"
    assert "discrepancy_quality" in fit.problem.posterior.names
    assert 'noise = "smooth"' in folder.config.read_text(encoding="utf-8")
    said = console.file.getvalue()  # type: ignore[attr-defined]
    assert said.count("noise: smooth") == 1
    again = Console(file=io.StringIO(), width=200)
    resume(folder, again, workers=1, steps=100, files=False)
    assert "noise:" not in again.file.getvalue()  # type: ignore[attr-defined]
