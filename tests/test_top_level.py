"""What people and tools look for at the top: how to cite, how to contribute, shell completion."""

from __future__ import annotations

import os
import re
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
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
