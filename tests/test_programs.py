"""A missing program skips a test, and fails it where programs are required, as in CI."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from tests import programs
from tests.programs import PROGRAMS, REQUIRED, VARIABLE, needs

ROOT = Path(__file__).parents[1]
every_program = pytest.mark.parametrize("program", PROGRAMS)


@every_program
def test_a_missing_program_skips_the_test(program: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PATH", "")
    monkeypatch.delenv(VARIABLE, raising=False)
    with pytest.raises(pytest.skip.Exception, match="apt-get install"):
        needs(program)


@every_program
def test_a_missing_program_fails_where_it_is_required(
    program: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("PATH", "")
    monkeypatch.setenv(VARIABLE, REQUIRED)
    with pytest.raises(pytest.fail.Exception, match="apt-get install"):
        needs(program)


def test_what_is_here_is_not_installed_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for program in PROGRAMS.values():
        (tmp_path / program.names[-1]).touch(mode=0o755)
    monkeypatch.setenv("PATH", str(tmp_path))
    assert [] == programs.missing()
    assert str(tmp_path / "gcc") == needs("cc")
    (tmp_path / "gcc").unlink()
    assert ["gcc", "libc6-dev"] == programs.missing()


def test_ci_installs_what_is_missing_and_requires_it() -> None:
    script = (ROOT / ".ci/run").read_text(encoding="utf-8")
    assert f"export {VARIABLE}={REQUIRED}\n" in script
    assert "python3 tests/programs.py" in script
    command = [sys.executable, "-I", "tests/programs.py"]
    alone = subprocess.run(
        command, cwd=ROOT, env={"PATH": ""}, capture_output=True, text=True, check=True
    )
    every = [package for program in PROGRAMS.values() for package in program.packages]
    assert every == alone.stdout.split()
