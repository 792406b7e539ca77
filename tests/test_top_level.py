"""What people and tools look for at the top: how to cite, how to contribute, shell completion."""

from __future__ import annotations

import os
import re
import subprocess
import sys
import tomllib
from pathlib import Path
from typing import Any

import pytest

ROOT = Path(__file__).parents[1]
CONTRIBUTING = (ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8")

PERSON, ENTITY = {"family-names", "given-names"}, {"name"}


@pytest.fixture(scope="module")
def citation() -> Any:
    yaml = pytest.importorskip("yaml", reason="PyYAML, which reads CITATION.cff, is not installed")
    return yaml.safe_load((ROOT / "CITATION.cff").read_text(encoding="utf-8"))


def test_the_citation_says_what_the_package_says(citation: Any) -> None:
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


@pytest.mark.parametrize("shell", ["bash", "zsh", "fish"])
def test_shells_complete_commands(shell: str) -> None:
    """As the map says: the command prints what the shell is to run."""
    assert f"_BWBAYES_COMPLETE={shell}_source" in CONTRIBUTING or f"{shell}_source" in CONTRIBUTING
    program = Path(sys.executable).with_name("bwbayes")
    environment = {**os.environ, "_BWBAYES_COMPLETE": f"{shell}_source"}
    done = subprocess.run([program], env=environment, capture_output=True, text=True, check=False)
    assert "complet" in done.stdout, done.stderr


def test_completion_knows_the_commands() -> None:
    program = Path(sys.executable).with_name("bwbayes")
    environment = {
        **os.environ,
        "_BWBAYES_COMPLETE": "bash_complete",
        "COMP_WORDS": "bwbayes re",
        "COMP_CWORD": "1",
    }
    done = subprocess.run([program], env=environment, capture_output=True, text=True, check=True)
    assert {"plain,resume", "plain,report"} <= set(done.stdout.split())
