"""Public names, and what people and tools look for: docstrings, errors, metadata."""

import ast
import doctest
import importlib.util
import inspect
import os
import pickle
import re
import subprocess
import sys
import tomllib
from importlib import import_module
from pathlib import Path

import pytest
from hypothesis import given, strategies as st

import bwbayes
import bwbayes as bw
from bwbayes.app.commands import cli
from bwbayes.app.commands.cli import as_typed
from bwbayes.app.commands.runs import simulate
from bwbayes.app.verbs import VERBS
from bwbayes.errors import InputError, one_line
from tests.api_reference import every_module

HELP = (
    "from bwbayes.app.commands.cli import cli; cli(['--help'], standalone_mode=False); "
    "cli(['run', '--help'], standalone_mode=False)"
)
# Help loads no more than reads a command line.
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


def test_type_checkers_see_the_methods_that_come_from_verbs() -> None:
    """The package says that it is typed, and a line in ``Run`` stands for a verb in the table."""
    assert Path(bwbayes.__file__).with_name("py.typed").exists()
    source = Path(inspect.getfile(bw.Run)).read_text(encoding="utf-8")
    typed = set(re.findall(r"^        (\w+) = fit_method\(\w+\)$", source, re.MULTILINE))
    assert typed
    assert typed <= {verb.method for verb in VERBS}
    for verb in VERBS:
        method, function = getattr(bw.Run, verb.method), verb.load()
        assert inspect.signature(method) == inspect.signature(function)
        assert inspect.getdoc(method) == inspect.getdoc(function)


def test_a_name_that_does_not_exist_is_an_attribute_error() -> None:
    with pytest.raises(AttributeError, match="no attribute 'hysterese'"):
        _ = bwbayes.hysterese  # type: ignore[attr-defined]  # this must be an error there too


def test_an_earlier_name_is_told_the_new_one() -> None:
    with pytest.raises(AttributeError, match=r"no attribute 'Fit'; it is bwbayes\.Run now"):
        _ = bwbayes.Fit  # type: ignore[attr-defined]


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


# People and tools find what they look for: how to cite and contribute, shell completion, docstrings

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


# Errors are one line that a terminal can show, in Python to callers and in options to typists


@pytest.mark.parametrize(
    ("said", "typed"),
    [
        ("give `overwrite=True`", "give `--overwrite`"),
        ('resume with `engine="numpy"`', "resume with `--engine numpy`"),
        ("`lead_in=2.5, estimate_offset=True`", "`--lead-in 2.5 --estimate-offset`"),
        ("`bwbayes.resume('results/a b', steps=40)`", "`bwbayes resume results/a b --steps 40`"),
        ("`bwbayes.fit(RECORD, folder='a')`", "`bwbayes run RECORD --out a`"),
        # As they are: TOML, names, commands, what is no code at all, and what is not in backticks.
        ("`thresholds = 4`", "`thresholds = 4`"),
        ("`columns`", "`columns`"),
        ("`bwbayes check my.toml`", "`bwbayes check my.toml`"),
        ("`a b=c`, `(`, ``", "`a b=c`, `(`, ``"),
        ("overwrite=True", "overwrite=True"),
    ],
)
def test_python_becomes_what_is_typed(said: str, typed: str) -> None:
    assert typed == as_typed(said)


def test_the_same_error_in_python_and_on_the_command_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def refused(*arguments: str) -> str:
        monkeypatch.setattr("sys.argv", ["bwbayes", *arguments])
        with pytest.raises(SystemExit):
            cli.main()
        return capsys.readouterr().err

    monkeypatch.setattr("signal.signal", lambda *_: None)
    record = tmp_path / "a.csv"
    record.write_text("")
    line = refused("simulate", str(record))
    assert line.endswith("exists; choose another name, or give `--overwrite`\n")
    with pytest.raises(bw.InputError, match=r"exists; .* or give `overwrite=True`$"):
        simulate(record)
    line = refused("resume", "nowhere")
    assert line.endswith("no run here; start one with `bwbayes run RECORD --out nowhere`\n")
    with pytest.raises(bw.InputError, match=r"start one with `bwbayes\.fit\(RECORD, folder='"):
        bw.open_run("nowhere")


@given(st.text())
def test_any_text_becomes_one_line_that_prints(text: str) -> None:
    got = str(InputError(text))
    assert got.isprintable()
    assert [got] == (got.splitlines() or [""])


@given(st.text(st.characters(categories=("L", "N", "P")), min_size=1))
def test_a_text_that_prints_stays_as_it_is(text: str) -> None:
    assert text == one_line(text)


def test_a_long_text_keeps_its_beginning_and_its_end() -> None:
    got = str(InputError("my.toml: " + "x" * 100_000 + "; fix it"))
    assert got.startswith("my.toml: xxx")
    assert got.endswith("xxx; fix it")
    assert len(got) < 700


def test_an_error_survives_the_way_from_another_process() -> None:
    error = InputError("my.toml: " + "x" * 100_000)
    assert error.args == pickle.loads(pickle.dumps(error)).args
