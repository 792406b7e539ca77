"""What people and tools look for: how to cite and contribute, shell completion, docstrings."""

from __future__ import annotations

import doctest
import importlib.util
import inspect
import os
import re
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

import bwbayes
from tests.api_reference import every_module

ROOT = Path(__file__).parents[1]
MODULES = {module.__name__: module for module in every_module()}
CONTRIBUTING = (ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8")


def test_the_citation_says_what_the_package_says() -> None:
    yaml = pytest.importorskip("yaml", reason="PyYAML, which reads CITATION.cff, is not installed")
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text(encoding="utf-8"))
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    assert project["name"] == citation["title"]
    assert project["license"] == citation["license"]
    assert [author["name"] for author in project["authors"]] == [
        author["name"] for author in citation["authors"]
    ]
    assert project["version"] == str(citation["version"])


def test_what_the_map_names_exists() -> None:
    named = re.findall(r"`((?:bwbayes|tests|notebooks|\.ci)/[\w./]*)`", CONTRIBUTING)
    assert len(named) > 20
    assert [] == [path for path in named if not (ROOT / path).exists()]


def completion(instruction: str, **environment: str) -> str:
    """Return what the command prints for a shell."""
    done = subprocess.run(
        [Path(sys.executable).with_name("bwbayes")],
        env={**os.environ, "_BWBAYES_COMPLETE": instruction, **environment},
        capture_output=True,
        text=True,
        check=False,
    )
    return done.stdout


def test_shells_complete_commands() -> None:
    """As the map says: the command prints what the shell is to run, and knows the commands."""
    for shell in ("bash", "zsh", "fish"):
        assert f"{shell}_source" in CONTRIBUTING
        assert "complet" in completion(f"{shell}_source")
    words = completion("bash_complete", COMP_WORDS="bwbayes re", COMP_CWORD="1").split()
    assert {"plain,resume", "plain,report"} <= set(words)


@pytest.mark.parametrize("name", [n for n, m in MODULES.items() if ">>> " in inspect.getsource(m)])
def test_examples_do_what_they_say(name: str) -> None:
    assert not doctest.testmod(MODULES[name]).failed


@pytest.mark.slow
@pytest.mark.skipif(
    importlib.util.find_spec("pdoc") is None, reason="pdoc is not installed: pip install '.[docs]'"
)
def test_the_api_reference_has_every_module_and_every_public_name(tmp_path: Path) -> None:
    """In a process of its own, because pdoc runs what is meant for type checkers alone."""
    command = [sys.executable, "-m", "tests.api_reference", str(tmp_path)]
    subprocess.run(command, cwd=ROOT, capture_output=True, check=True)
    pages = {str(page.relative_to(tmp_path)) for page in tmp_path.rglob("*.html")}
    assert pages >= {f"{name.replace('.', '/')}.html" for name in MODULES}
    front = (tmp_path / "bwbayes.html").read_text(encoding="utf-8")
    assert [] == [name for name in bwbayes.__all__ if f'id="{name}"' not in front]
