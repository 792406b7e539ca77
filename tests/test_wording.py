"""Errors are one line that a terminal can show, in Python to callers and in options to typists."""

from __future__ import annotations

import pickle
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

import bwbayes as bw
from bwbayes.app.commands import cli
from bwbayes.app.commands.ending import as_typed
from bwbayes.app.jobs.simulate import simulate
from bwbayes.errors import InputError, one_line


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
