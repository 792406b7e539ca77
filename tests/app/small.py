"""A small run: a few hundred samples of the virtual test stand that converge within seconds."""

import json
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import click
import numpy as np
import pytest
from filelock import FileLock
from matplotlib.figure import Figure
from rich.console import Console

from bwbayes.app.config.config import Config, parse
from bwbayes.app.running.folder import RunFolder
from bwbayes.app.study.resolve import resolve_config
from bwbayes.report.figures import picture_of

TEXT = """\
seed = 3

[record]
signal = { amplitude = 100.0, frequency = 1.0, duration = 6.0, decay = 0.1, decay_from = 1.0 }
train = [[0.0, 5.0]]

[stand]
sample_rate = 50.0
discrepancy = "none"

[parameters]
initial = { fixed = 0.0 }
gamma = { fixed = 0.0172 }

[sampling]
ess = 200
block = 25
walkers = 18

[validation.held-out]
window = [5.0, 6.0]

[validation.sine]
signal = { amplitude = 75.0, frequency = 0.5, duration = 4.0 }
from_rest = true
"""


# The command line in a process of its own, which explains no misfit; and one without pictures too.
UNEXPLAINED = """
import pytest
from bwbayes.app.commands.cli import main
from tests.app import small
small.without_explanations(pytest.MonkeyPatch())
main()
"""
BLANK = UNEXPLAINED.replace("main()\n", "small.without_pictures(pytest.MonkeyPatch())\nmain()\n")


def config(*changes: tuple[str, str], text: str = TEXT) -> Config:
    """Return the small config, or another one, with parts of its text replaced."""
    for old, new in changes:
        assert old in text
        text = text.replace(old, new)
    return parse(text, "small.toml")


def begun(path: Path, *changes: tuple[str, str]) -> RunFolder:
    return RunFolder.create(path, resolve_config(config(*changes), path.parent))


def typed(command: click.Command, *words: object) -> int:
    status: int = command.main([str(word) for word in words], standalone_mode=False)
    return status


def without_pictures(patch: pytest.MonkeyPatch) -> None:
    """Spare the time that pictures take, where they are not what is tested: products' are blank."""
    patch.setattr("bwbayes.app.running.workers._works", lambda _: {})
    for module in ("bwbayes.report.result", "bwbayes.app.jobs.predict"):
        patch.setattr(f"{module}.picture_of", lambda *_: picture_of(Figure))


def without_explanations(patch: pytest.MonkeyPatch) -> None:
    """Spare the time that fits of every defect take, where none is looked for."""
    patch.setattr("bwbayes.app.running.explaining.explain", lambda *_, **__: ())


def quiet() -> Console:
    return Console(quiet=True)


def command(*arguments: str | Path) -> list[str]:
    """Return the command line that a person would type."""
    return [str(Path(sys.executable).with_name("bwbayes")), *map(str, arguments)]


def finished(factory: pytest.TempPathFactory) -> Path:
    """Return the folder of the small run, made once by its command for all test processes.

    Its misfit is not explained. It is for reading; copy it to change it.
    """
    shared = factory.getbasetemp()
    if "PYTEST_XDIST_WORKER" in os.environ:
        shared = shared.parent
    path = shared / "small-run" / "results" / "small"
    with FileLock(shared / "small-run.lock"):
        if not path.exists():
            where = shared / "small-run"
            shutil.rmtree(where, ignore_errors=True)
            where.mkdir()
            (where / "small.toml").write_text(TEXT)
            done = subprocess.run(
                [sys.executable, "-c", UNEXPLAINED, "run", "small.toml", "--workers=1", "--quiet"],
                cwd=where,
                capture_output=True,
                text=True,
                check=False,
            )
            assert (0, "", "") == (done.returncode, done.stdout, done.stderr)
    return path


def numbers(folder: Path) -> dict[str, Any]:
    result: dict[str, Any] = json.loads((folder / "summary.json").read_text())
    del result["wall_s"]
    return result


def lowest_ess(folder: Path) -> float:
    parameters = numbers(folder)["parameters"].values()
    return float(min(min(one["ess_bulk"], one["ess_tail"]) for one in parameters))


def assert_same_end(expected: Path, got: Path) -> None:
    """Compare two runs bit by bit: chain, acceptance, random state, summary, bands."""
    first, second = (sorted((folder / "chain").glob("*-*.npz")) for folder in (expected, got))
    assert [file.name for file in first] == [file.name for file in second]
    for one, two in zip(first, second, strict=True):
        with np.load(one) as left, np.load(two) as right:
            for name in left:
                np.testing.assert_array_equal(left[name], right[name], err_msg=f"{one} {name}")
    assert numbers(expected) == numbers(got)
    assert (expected / "bands.csv").read_bytes() == (got / "bands.csv").read_bytes()


def without_progress(text: str) -> str:
    """Leave out how far a step is, which is said after ten seconds, as a busy machine may take."""
    return re.sub(r"^.*   ETA .*\n", "", text, flags=re.MULTILINE)
