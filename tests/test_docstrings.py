"""Docstrings: their examples run, what they refer to exists, and an API reference comes of them."""

from __future__ import annotations

import doctest
import importlib
import importlib.util
import inspect
import re
import subprocess
import sys
from pathlib import Path
from types import ModuleType

import pytest

import bwbayes
from tests.api_reference import every_module

ROOT = Path(__file__).parents[1]
MODULES = {module.__name__: module for module in every_module()}
ROLE = re.compile(r":(?:class|func|meth|mod|attr|data|exc):`(?:[^<`]*<([^>]+)>|~?([^`<]+))`")

# Public names whose docstring shows them at work.
SHOWN = {
    "Distribution",
    "Record",
    "hysteresis",
    "inspect",
    "noise_model",
    "parse_config",
    "signal",
}


def test_examples_do_what_they_say_and_entry_points_have_one() -> None:
    assert [] == [name for name, module in MODULES.items() if doctest.testmod(module).failed]
    assert [] == [
        name for name in SHOWN if ">>> " not in (inspect.getdoc(getattr(bwbayes, name)) or "")
    ]


def exists(module: ModuleType, target: str) -> bool:
    """Tell whether a name means something in a module, or in full, or in one of its classes."""
    parts = target.removesuffix("()").split(".")
    for cut in range(len(parts), 0, -1):
        try:
            thing: object = importlib.import_module(".".join(parts[:cut]))
        except ImportError:
            continue
        return all_attributes(thing, parts[cut:])
    if all_attributes(module, parts):
        return True
    # A method or attribute goes without its class, within it.
    classes = [one for one in vars(module).values() if isinstance(one, type)]
    return any(all_attributes(one, parts) for one in classes)


def all_attributes(thing: object, names: list[str]) -> bool:
    for name in names:
        annotated = name in inspect.get_annotations(thing) if isinstance(thing, type) else False
        if not hasattr(thing, name) and not annotated:
            return False
        thing = getattr(thing, name, None)
    return True


def test_what_a_docstring_refers_to_exists() -> None:
    missing = [
        (name, full or short)
        for name, module in MODULES.items()
        for full, short in ROLE.findall(inspect.getsource(module))
        if not exists(module, full or short)
    ]
    assert [] == missing


@pytest.mark.slow
@pytest.mark.skipif(
    importlib.util.find_spec("pdoc") is None, reason="pdoc is not installed: pip install '.[docs]'"
)
def test_the_api_reference_is_built_without_a_warning(tmp_path: Path) -> None:
    """In a process of its own, because pdoc runs what is meant for type checkers alone."""
    command = [sys.executable, "-m", "tests.api_reference", str(tmp_path)]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert (0, "") == (done.returncode, done.stdout), done.stderr
    pages = {str(page.relative_to(tmp_path)) for page in tmp_path.rglob("*.html")}
    assert pages >= {f"{name.replace('.', '/')}.html" for name in MODULES}
    front = (tmp_path / "bwbayes.html").read_text(encoding="utf-8")
    for name in bwbayes.__all__:
        assert f'id="{name}"' in front
