"""The sdist and the wheel hold what they must, and the wheel works where nothing else is.

The wheel is installed, with its dependencies, in an empty environment, and run away from the
checkout: with what it brings along (templates), and without numba. Where no package index answers,
that is skipped.
"""

import os
import subprocess
import sys
import tarfile
import tomllib
import venv
from pathlib import Path
from zipfile import ZipFile

import pytest

from tests.app import small
from tests.oldest import constraints

ROOT = Path(__file__).parents[1]
LONGEST = 900  # s

hatchling = pytest.importorskip("hatchling", reason="hatchling, which builds, is not installed")


def done(*command: str | Path, cwd: Path) -> str:
    """Run a command where no checkout is importable, and return what it prints."""
    environment = {k: v for k, v in os.environ.items() if not k.startswith(("PYTHON", "VIRTUAL"))}
    run = subprocess.run(
        [str(part) for part in command],
        cwd=cwd,
        env=environment,
        capture_output=True,
        text=True,
        check=False,
        timeout=LONGEST,
    )
    assert run.returncode == 0, run.stdout + run.stderr
    return run.stdout


@pytest.fixture(scope="module")
def sdist(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("sdist")
    code = (
        f"import hatchling.build as b, os; os.chdir({str(ROOT)!r}); b.build_sdist({str(folder)!r})"
    )
    subprocess.run([sys.executable, "-c", code], check=True, capture_output=True)
    (path,) = folder.iterdir()
    return path


@pytest.fixture(scope="module")
def wheel(sdist: Path) -> Path:
    with tarfile.open(sdist) as archive:
        archive.extractall(sdist.parent, filter="data")
    (source,) = (path for path in sdist.parent.iterdir() if path.is_dir())
    folder = sdist.parent / "wheel"
    folder.mkdir()
    code = f"import hatchling.build as b; b.build_wheel({str(folder)!r})"
    subprocess.run([sys.executable, "-c", code], cwd=source, check=True, capture_output=True)
    (path,) = folder.iterdir()
    return path


@pytest.fixture(scope="module")
def installed(wheel: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Install the wheel in an empty environment, and return the folder of its programs."""
    folder = tmp_path_factory.mktemp("installed")
    venv.create(folder / "env", with_pip=True)
    programs = folder / "env" / "bin"
    quiet = ("--quiet", "--disable-pip-version-check")
    probe = subprocess.run(
        [programs / "python", "-m", "pip", "download", *quiet, "--no-deps", "-d", folder, "click"],
        capture_output=True,
        check=False,
        timeout=LONGEST,
    )
    if probe.returncode != 0:
        pytest.skip("no package index answers, so nothing can be installed")
    done(programs / "python", "-m", "pip", "install", *quiet, wheel, cwd=folder)
    return programs


def test_the_sdist_holds_all_that_the_wheel_is_built_from(sdist: Path, wheel: Path) -> None:
    """And all that a reader wants: tests, runs, notebooks."""
    with tarfile.open(sdist) as archive:
        names = {name.split("/", 1)[1] for name in archive.getnames() if "/" in name}
    for name in ("pyproject.toml", "README.md", "LICENSE", "runs/ring_bender.toml"):
        assert name in names
    assert {path.relative_to(ROOT).as_posix() for path in (ROOT / "tests").glob("*.py")} <= names
    with ZipFile(wheel) as archive_of_wheel:
        packed = {name for name in archive_of_wheel.namelist() if name.startswith("bwbayes/")}
    of_package = {
        path.relative_to(ROOT).as_posix()
        for path in (ROOT / "bwbayes").rglob("*")
        if path.is_file() and "__pycache__" not in path.parts
    }
    assert of_package == packed
    assert packed <= names


def test_every_dependency_says_its_oldest_version() -> None:
    """Which the commands of oldest.py install; newer ones are not excluded."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    pinned = constraints(project["dependencies"])
    assert len(pinned) == len(project["dependencies"])
    assert "emcee==3.1.6" in pinned
    assert any(line.startswith("numba==") for line in pinned)
    with pytest.raises(ValueError, match="write a lower bound"):
        constraints(["numpy<3"])


@pytest.mark.slow
def test_the_wheel_works_in_an_empty_environment(installed: Path) -> None:
    """A tiny config comes to a report; a check works without numba, from nothing of a checkout."""
    folder = installed.parents[1] / "elsewhere"
    folder.mkdir()
    (folder / "small.toml").write_text(small.TEXT)
    where = done(installed / "python", "-c", "import bwbayes; print(bwbayes.__file__)", cwd=folder)
    assert Path(where.strip()).is_relative_to(installed.parent)
    done(installed / "bwbayes", "run", "small.toml", "--quiet", "--workers", "1", cwd=folder)
    page = folder / "results" / "small" / "report.html"
    assert "<style>" in page.read_text(encoding="utf-8")
    for reference in ("config", "models"):
        assert len(done(installed / "bwbayes", reference, cwd=folder)) > 500
    done(installed / "python", "-m", "pip", "uninstall", "--yes", "--quiet", "numba", cwd=folder)
    said = done(installed / "bwbayes", "check", "small.toml", cwd=folder)
    assert "point fit" in said
