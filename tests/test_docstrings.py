"""Docstrings: their examples run, and an API reference comes of them."""

from __future__ import annotations

import doctest
import importlib
import importlib.util
import inspect
import subprocess
import sys
from pathlib import Path

import pytest

import bwbayes
from tests.api_reference import every_module

ROOT = Path(__file__).parents[1]
MODULES = {module.__name__: module for module in every_module()}


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
