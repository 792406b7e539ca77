"""Which part of bwbayes may import which, and which module knows which library."""

from __future__ import annotations

import ast
import subprocess
import sys
from collections.abc import Iterator
from fnmatch import fnmatch
from functools import cache
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
LONGEST_FILE = 400

# Lowest first: a module imports from its own layer and from lower ones.
LAYERS = (
    ("bwbayes.errors", "bwbayes.arrays", "bwbayes.shown"),
    ("bwbayes.model",),
    ("bwbayes.data",),
    ("bwbayes.inference",),
    ("bwbayes.sampling",),
    ("bwbayes.results",),
    ("bwbayes.comparison",),
    ("bwbayes.population",),
    ("bwbayes.control",),
    ("bwbayes.app",),
)

# Libraries that few modules may know, and these modules (patterns).
KEEPERS = {
    "h5py": ("bwbayes.sampling.storage", "bwbayes.data.io.hdf5", "bwbayes.data.io.matlab"),
    "nptdms": ("bwbayes.data.io.labview",),
    # The inverse of many models, and the likelihood.
    "numba": ("bwbayes.model.inverse.compiled", "bwbayes.inference.compiled.*"),
    "emcee": ("bwbayes.sampling.ensemble", "bwbayes.sampling.moves", "bwbayes.sampling.walking"),
    "arviz": ("bwbayes.sampling.diagnostics", "bwbayes.results.*", "bwbayes.app.*"),
    "arviz_base": ("bwbayes.sampling.diagnostics", "bwbayes.results.*", "bwbayes.app.*"),
    "arviz_stats": (
        "bwbayes.sampling.diagnostics",
        "bwbayes.results.*",
        "bwbayes.population.population",
        "bwbayes.app.*",
    ),
    "matplotlib": (
        "bwbayes.app.figures*",
        "bwbayes.app.fit.plots",
        "bwbayes.app.jobs.compensate",
        "bwbayes.app.running.predictions",
    ),
    "corner": ("bwbayes.app.figures*",),
    "PIL": ("bwbayes.app.figures",),
    "bokeh": ("bwbayes.app.figures.interactive",),
    "click": ("bwbayes.app.*",),
    "rich": ("bwbayes.app.*",),
    "jinja2": ("bwbayes.app.*", "bwbayes.control.exported"),
    "pydantic": ("bwbayes.app.*",),
    "tomlkit": ("bwbayes.app.*",),
}

# What the forward model, and so `import bwbayes.model`, needs besides the standard library; what is
# compiled is loaded when it is asked for.
MODEL_LIBRARIES = {"numpy", "scipy"}
COMPILED = "bwbayes.model.inverse.compiled"

MUTABLE_LITERALS = (ast.List, ast.Dict, ast.Set, ast.ListComp, ast.DictComp, ast.SetComp)
MUTABLE_TYPES = {"list", "dict", "set", "defaultdict", "deque", "Counter", "OrderedDict"}
GENERATORS = {"default_rng", "Generator", "RandomState", "Random"}
CACHES = {"cache", "lru_cache"}

PATHS = {
    ".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__"): path
    for path in sorted((ROOT / "bwbayes").rglob("*.py"))
}
every_module = pytest.mark.parametrize("module", PATHS)


@cache
def tree(module: str) -> ast.Module:
    return ast.parse(PATHS[module].read_text(encoding="utf-8"))


def imports(module: str) -> set[str]:
    """All that a module imports, wherever in it, by full name."""
    result: set[str] = set()
    for node in ast.walk(tree(module)):
        if isinstance(node, ast.Import):
            result |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{module}:{node.lineno}: write the import in full"
            assert node.module is not None
            # `from package import name` means a module where there is one of that name.
            names = {f"{node.module}.{alias.name}" for alias in node.names}
            result |= {name if name in PATHS else node.module for name in names}
    return result


def own_imports(module: str) -> set[str]:
    return {name for name in imports(module) if name.split(".")[0] == "bwbayes"}


def libraries(module: str) -> set[str]:
    tops = {name.split(".")[0] for name in imports(module)}
    return tops - set(sys.stdlib_module_names) - {"bwbayes"}


def layer(module: str) -> int:
    """Place in the list of layers; the package itself, which offers what all have, is the last."""
    for place, members in enumerate(LAYERS):
        if any(module == member or module.startswith(f"{member}.") for member in members):
            return place
    assert module in ("bwbayes", "bwbayes.__main__"), f"{module} belongs to no layer"
    return len(LAYERS)


@every_module
def test_a_module_imports_from_its_own_layer_and_those_below(module: str) -> None:
    above = {name for name in own_imports(module) if layer(name) > layer(module)}
    assert set() == above


@every_module
def test_imports_lead_to_modules_that_exist(module: str) -> None:
    assert set() == own_imports(module) - set(PATHS)


def test_no_module_imports_itself_in_the_end() -> None:
    graph = {module: own_imports(module) for module in PATHS}
    try:
        TopologicalSorter(graph).prepare()
    except CycleError as error:
        pytest.fail(" <- ".join(error.args[1]))


@every_module
def test_a_library_is_known_to_its_keepers_alone(module: str) -> None:
    for library in libraries(module) & set(KEEPERS):
        assert any(fnmatch(module, keeper) for keeper in KEEPERS[library]), library


@pytest.mark.parametrize("library", KEEPERS)
def test_every_named_keeper_is_there(library: str) -> None:
    """A pattern that fits no module is a leftover."""
    for keeper in KEEPERS[library]:
        assert any(fnmatch(module, keeper) for module in PATHS), keeper


@pytest.mark.parametrize("module", [name for name in PATHS if name.startswith("bwbayes.model")])
def test_the_model_needs_numpy_and_scipy_alone(module: str) -> None:
    others = {"numba"} if module.startswith(COMPILED) else set()
    assert set() == libraries(module) - MODEL_LIBRARIES - others


def test_importing_the_model_loads_no_other_library() -> None:
    code = (
        "import sys, bwbayes.model.actuator; print(*{name.split('.')[0] for name in sys.modules})"
    )
    run = [sys.executable, "-c", code]
    loaded = subprocess.run(run, cwd=ROOT, capture_output=True, text=True, check=True).stdout
    assert set() == set(KEEPERS) & set(loaded.split())


@every_module
def test_a_module_opens_with_what_it_is_for(module: str) -> None:
    assert ast.get_docstring(tree(module))


@every_module
def test_a_file_can_be_read_in_one_sitting(module: str) -> None:
    assert len(PATHS[module].read_text(encoding="utf-8").splitlines()) <= LONGEST_FILE


def top_level_values(module: str) -> Iterator[tuple[str, ast.expr]]:
    for node in tree(module).body:
        if isinstance(node, ast.Assign):
            for target in node.targets:
                yield ast.unparse(target), node.value
        elif isinstance(node, ast.AnnAssign) and node.value is not None:
            yield ast.unparse(node.target), node.value


def called(node: ast.AST) -> str:
    """Last name of what is called or decorates, `default_rng` for `np.random.default_rng()`."""
    function = node.func if isinstance(node, ast.Call) else node
    return ast.unparse(function).split(".")[-1]


@every_module
def test_no_module_keeps_state(module: str) -> None:
    """No mutable variable, generator, `global` or cache; a mutable constant is UPPER_CASE."""
    for name, value in top_level_values(module):
        calls = {called(node) for node in ast.walk(value) if isinstance(node, ast.Call)}
        assert not calls & GENERATORS, name
        mutable = isinstance(value, MUTABLE_LITERALS) or (
            isinstance(value, ast.Call) and called(value) in MUTABLE_TYPES
        )
        assert not mutable or name == "__all__" or name.isupper(), name
    for node in ast.walk(tree(module)):
        assert not isinstance(node, ast.Global), f"global in line {node.lineno}"
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            assert not CACHES & {called(decorator) for decorator in node.decorator_list}, node.name


@every_module
def test_randomness_comes_as_an_argument(module: str) -> None:
    """No draw from NumPy's or Python's own hidden generators, and no seed taken from the system."""
    for node in ast.walk(tree(module)):
        if isinstance(node, ast.Call):
            name = ast.unparse(node.func)
            hidden = name.startswith(("np.random.", "numpy.random.")) and called(node).islower()
            assert not hidden or called(node) == "default_rng", f"{name} in line {node.lineno}"
            seeded = called(node) not in GENERATORS or node.args or node.keywords
            assert seeded, f"{name} without a seed in line {node.lineno}"
    assert "random" not in imports(module)
