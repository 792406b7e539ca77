"""Errors speak Python to those who call the package, and options to those who type commands."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

import bwbayes as bw
from bwbayes.app.commands import cli
from bwbayes.app.commands.wording import as_typed
from tests.app import small

PACKAGE = Path(bw.__file__).parent
OPTIONS = sorted(
    {name for one in cli.cli.commands.values() for option in one.params for name in option.opts}
)
OPTION = re.compile(rf"(?<![\w-])({'|'.join(one for one in OPTIONS if one.startswith('--'))})\b")

# What is raised or warned of, by the name that is called for it.
SAID = {"InputError", "NotConvergedError", "warn"}

# The commands, and the hints of a file's columns, which are those of `bwbayes init`.
COMMANDS = ("app/commands/", "data/io/columns.py")


def messages(source: str) -> Iterator[str]:
    """Yield all texts in calls that make an error or a warning."""
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Call):
            name = node.func.attr if isinstance(node.func, ast.Attribute) else ""
            name = node.func.id if isinstance(node.func, ast.Name) else name
            for part in ast.walk(node) if name in SAID else ():
                if isinstance(part, ast.Constant) and isinstance(part.value, str):
                    yield part.value


def test_no_error_names_an_option_but_in_the_commands() -> None:
    found = [
        (file, text)
        for path in PACKAGE.rglob("*.py")
        if not (file := path.relative_to(PACKAGE).as_posix()).startswith(COMMANDS)
        for text in messages(path.read_text("utf-8"))
        if OPTION.search(text)
    ]
    assert [] == found


def test_twin_an_option_in_an_error_is_found() -> None:
    source = 'raise InputError(f"{path}: exists; give --overwrite")'
    assert [True] == [bool(OPTION.search(text)) for text in messages(source) if "give" in text]


@pytest.mark.parametrize(
    ("said", "typed"),
    [
        ("give `overwrite=True`", "give `--overwrite`"),
        ('resume with `engine="numpy"`', "resume with `--engine numpy`"),
        ("`lead_in=2.5, own_offset=True`", "`--lead-in 2.5 --own-offset`"),
        (
            "`bwbayes.resume_run('results/a b', steps=40)`",
            "`bwbayes resume results/a b --steps 40`",
        ),
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
    tmp_path_factory: pytest.TempPathFactory,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    run = small.finished(tmp_path_factory)
    fit = bw.open_run(run)
    fit.export(tmp_path / "out")
    with pytest.raises(bw.InputError, match=r"model\.json: exists; .* or give `overwrite=True`$"):
        fit.export(tmp_path / "out")
    monkeypatch.setattr("sys.argv", ["bwbayes", "export", str(run), "--out", str(tmp_path / "out")])
    with pytest.raises(SystemExit):
        cli.main()
    assert capsys.readouterr().err.endswith(
        "exists; choose another folder, or give `--overwrite`\n"
    )
    with pytest.raises(bw.InputError, match=r"start one with `bwbayes\.fit\(RECORD, folder='"):
        bw.open_run("nowhere")
    monkeypatch.setattr("sys.argv", ["bwbayes", "resume", "nowhere"])
    with pytest.raises(SystemExit):
        cli.main()
    said = "nowhere: no run here; start one with `bwbayes run RECORD --out nowhere`\n"
    assert capsys.readouterr().err.endswith(said)
