"""Errors speak Python to those who call the package, and options to those who type commands."""

from __future__ import annotations

from pathlib import Path

import pytest

import bwbayes as bw
from bwbayes.app.commands import cli
from bwbayes.app.commands.wording import as_typed
from tests.app import small


@pytest.mark.parametrize(
    ("said", "typed"),
    [
        ("give `overwrite=True`", "give `--overwrite`"),
        ('resume with `engine="numpy"`', "resume with `--engine numpy`"),
        ("`lead_in=2.5, own_offset=True`", "`--lead-in 2.5 --own-offset`"),
        (
            "`bwbayes.resume('results/a b', steps=40)`",
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
    assert capsys.readouterr().err.endswith("exists; choose another name, or give `--overwrite`\n")
    with pytest.raises(bw.InputError, match=r"start one with `bwbayes\.fit\(RECORD, folder='"):
        bw.open_run("nowhere")
    monkeypatch.setattr("sys.argv", ["bwbayes", "resume", "nowhere"])
    with pytest.raises(SystemExit):
        cli.main()
    said = "nowhere: no run here; start one with `bwbayes run RECORD --out nowhere`\n"
    assert capsys.readouterr().err.endswith(said)
