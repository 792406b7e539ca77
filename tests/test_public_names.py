"""What ``import bwbayes`` offers: documented names, typed, and nothing loaded for them."""

from __future__ import annotations

import ast
import inspect
import subprocess
import sys
from importlib import import_module
from pathlib import Path

import pytest

import bwbayes

HELP = (
    "from bwbayes.app.commands.cli import cli; cli(['--help'], standalone_mode=False); "
    "cli(['run', '--help'], standalone_mode=False)"
)
# What reads a command line is all that help loads.
HEAVY = {"arviz", "emcee", "h5py", "matplotlib", "numba", "pandas", "pydantic", "xarray"}


def test_each_public_name_is_documented_and_loaded_from_where_type_checkers_find_it() -> None:
    source = Path(bwbayes.__file__).read_text(encoding="utf-8")
    (checking,) = (node for node in ast.parse(source).body if isinstance(node, ast.If))
    homes = {
        alias.asname or alias.name: (node.module, alias.name)
        for node in checking.body
        if isinstance(node, ast.ImportFrom) and node.module
        for alias in node.names
    }
    assert sorted(homes) == sorted(bwbayes.__all__)
    assert set(homes) <= set(dir(bwbayes))
    for name, (module, original) in homes.items():
        result = getattr(bwbayes, name)
        assert result is getattr(import_module(module), original)
        assert module == result.__module__, f"{name} is defined in {result.__module__}"
        # A dataclass without a docstring of its own gets its signature for one.
        assert not (inspect.getdoc(result) or f"{name}(").startswith(f"{name}("), name


def test_a_name_that_does_not_exist_is_an_attribute_error() -> None:
    with pytest.raises(AttributeError, match="no attribute 'hysterese'"):
        _ = bwbayes.hysterese  # type: ignore[attr-defined]  # this must be an error there too


@pytest.mark.parametrize(
    ("code", "unwanted"),
    [
        ("import bwbayes", HEAVY | {"numpy", "scipy"}),
        (HELP, HEAVY | {"numpy", "scipy"}),
        ("import bwbayes.model.actuator", HEAVY | {"bokeh", "click", "jinja2", "rich", "tomlkit"}),
    ],
    ids=["package", "help", "model"],
)
def test_importing_little_loads_little(code: str, unwanted: set[str]) -> None:
    code += "; import sys; print(*{name.split('.')[0] for name in sys.modules})"
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert not set(run.stdout.splitlines()[-1].split()) & unwanted


def test_the_docstrings_example_runs() -> None:
    assert bwbayes.__doc__ is not None
    example = bwbayes.__doc__.split("::\n\n")[1].split("\n\nThe names")[0]
    names: dict[str, object] = {}
    exec(inspect.cleandoc(example), names)
    assert (2, 2000) == getattr(names["h"], "shape", None)
