"""Defects that the tests must notice: each is planted by itself, and the nearest tests must fail.

A test suite promises to notice mistakes; this holds it to that. ``defects.toml`` lists small
statistical and numerical mistakes (a wrong sign, a forgotten root, a quantile off), each with the
few tests that are nearest to it. One at a time goes into a copy of the package, and those tests
run there. A mistake that they do not notice shows a test to be missing. Plant all of them, or those
whose description contains some words, by

    python -m tests.defects [WORDS]
"""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
import tempfile
import tomllib
from collections.abc import Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

__all__ = ["Defect", "Outcome", "listed", "plant_all", "planted_text", "run_tests", "spoilt"]

ROOT = Path(__file__).parents[1]

# Side by side: each is a process of its own.
TOGETHER = 2

# pytest's exit status.
PASSED, FAILED = 0, 1


@dataclass(frozen=True)
class Defect:
    """A mistake: ``right`` in ``file`` (below the package) becomes ``wrong``.

    ``tests`` are files or single tests of pytest, the ones that are nearest to it.
    """

    what: str
    file: str
    right: str
    wrong: str
    tests: tuple[str, ...]


@dataclass(frozen=True)
class Outcome:
    """What the nearest tests said of a planted defect: caught, or what they printed."""

    defect: Defect
    caught: bool
    printed: str

    @property
    def by(self) -> str:
        """The first test that failed; empty if none did."""
        failed = re.search(r"^(?:FAILED|ERROR) (\S+)", self.printed, re.MULTILINE)
        return failed[1] if failed else ""


def listed() -> tuple[Defect, ...]:
    """Read the list."""
    table = tomllib.loads((ROOT / "tests" / "defects.toml").read_text(encoding="utf-8"))
    return tuple(Defect(**one | {"tests": tuple(one["tests"])}) for one in table["defect"])


def spoilt(defect: Defect, package: Path) -> str:
    """Say why a defect cannot be planted in a package any more; empty if it can."""
    text = (package / defect.file).read_text(encoding="utf-8")
    count = text.count(defect.right)
    if count == 1:
        return ""
    return f"{defect.what}: {defect.file} has {count} times, not once: {defect.right!r}"


def planted_text(defect: Defect, package: Path) -> str:
    """Return the text of the defect's file with the defect in it."""
    problem = spoilt(defect, package)
    if problem:
        raise ValueError(f"{problem}; bring tests/defects.toml up to date")
    text = (package / defect.file).read_text(encoding="utf-8")
    return text.replace(defect.right, defect.wrong)


def run_tests(tests: Iterable[str], defect: Defect | None = None) -> tuple[int, str]:
    """Run tests in a copy of the repository, with a defect or without; exit status and output."""
    with tempfile.TemporaryDirectory() as folder:
        copy = Path(folder)
        # What numba has compiled comes along: it knows its source by date and size.
        for part in ("bwbayes", "tests", "runs"):
            shutil.copytree(ROOT / part, copy / part, ignore=shutil.ignore_patterns("*.pyc"))
        shutil.copy(ROOT / "pyproject.toml", copy)
        if defect is not None:
            file = copy / "bwbayes" / defect.file
            file.write_text(planted_text(defect, copy / "bwbayes"), encoding="utf-8")
        command = [sys.executable, "-m", "pytest", "-q", "-x", "-p", "no:cacheprovider", *tests]
        environment = os.environ | {"PYTHONPATH": folder, "PYTHONDONTWRITEBYTECODE": "1"}
        done = subprocess.run(
            command, cwd=copy, env=environment, capture_output=True, text=True, check=False
        )
        return done.returncode, done.stdout + done.stderr


def plant_all(defects: Iterable[Defect]) -> Iterator[Outcome]:
    """Plant the defects one at a time, two side by side, and yield what came of each in order.

    Raises
    ------
    RuntimeError
        The tests could not run at all, which says nothing of the defect.
    """

    def plant(defect: Defect) -> Outcome:
        status, printed = run_tests(defect.tests, defect)
        if status not in (PASSED, FAILED):
            raise RuntimeError(f"{defect.what}: pytest ended with {status}:\n{printed}")
        return Outcome(defect, status == FAILED, printed)

    with ThreadPoolExecutor(TOGETHER) as executor:
        yield from executor.map(plant, defects)


def main(words: str) -> int:
    """Plant the defects whose description contains the words; the number of those missed."""
    chosen = [defect for defect in listed() if words in defect.what]
    missed = 0
    for outcome in plant_all(chosen):
        missed += not outcome.caught
        said = f"caught by {outcome.by}" if outcome.caught else "MISSED"
        sys.stdout.write(f"{outcome.defect.what}: {said}\n")
        sys.stdout.flush()
    sys.stdout.write(f"{len(chosen)} planted, {len(chosen) - missed} caught\n")
    return missed


if __name__ == "__main__":
    sys.exit(min(main(" ".join(sys.argv[1:])), 1))
