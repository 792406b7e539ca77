"""An error for people is one line that a terminal can show."""

from __future__ import annotations

import pickle

from hypothesis import given
from hypothesis import strategies as st

from bwbayes.errors import InputError, one_line


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
