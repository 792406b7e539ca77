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

# Of the Citation File Format, version 1.2.0: what must be there, and what there may be.
REQUIRED = {"cff-version", "message", "title", "authors"}
OPTIONAL = {"type", "abstract", "version", "license", "keywords", "references", "doi", "url"}
REQUIRED_OF_REFERENCE = {"type", "title", "authors"}
OPTIONAL_OF_REFERENCE = {
    "journal",
    "volume",
    "start",
    "end",
    "year",
    "doi",
    "url",
    "notes",
}
PERSON, ENTITY = {"family-names", "given-names"}, {"name"}


@pytest.fixture(scope="module")
def citation() -> Any:
    yaml = pytest.importorskip("yaml", reason="PyYAML, which reads CITATION.cff, is not installed")
    return yaml.safe_load((ROOT / "CITATION.cff").read_text(encoding="utf-8"))


def assert_authors(authors: Any) -> None:
    assert authors
    for author in authors:
        assert set(author) in (PERSON, ENTITY)
        assert all(isinstance(value, str) and value for value in author.values())


def test_the_citation_is_of_its_format(citation: Any) -> None:
    assert set(citation) >= REQUIRED
    assert set(citation) <= REQUIRED | OPTIONAL
    assert "1.2.0" == citation["cff-version"]
    assert "software" == citation["type"]
    assert_authors(citation["authors"])
    for reference in citation["references"]:
        assert set(reference) >= REQUIRED_OF_REFERENCE
        assert set(reference) <= REQUIRED_OF_REFERENCE | OPTIONAL_OF_REFERENCE
        assert_authors(reference["authors"])
        assert reference["type"] in ("article", "book")
        assert isinstance(reference.get("year", 2000), int)
        assert re.fullmatch(r"10\.\d{4,}/\S+", reference.get("doi", "10.1000/1"))
        assert reference.get("url", "https://").startswith("https://")


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


def test_the_map_names_every_room() -> None:
    rooms = {path.parent.name for path in (ROOT / "bwbayes").glob("*/__init__.py")}
    assert rooms == set(re.findall(r"^\| `bwbayes/(\w+)/` \|", CONTRIBUTING, flags=re.MULTILINE))


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
