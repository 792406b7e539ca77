"""The nearest tests notice each defect that is planted; and the list of defects is up to date."""

from __future__ import annotations

import ast
from pathlib import Path

import pytest

from tests.defects import PASSED, ROOT, Defect, listed, plant_all, planted_text, run_tests
from tests.measured import keep

PACKAGE = ROOT / "bwbayes"

# In a module without numba and with few tests, so that it takes seconds.
SMALL = Defect(
    "a record's length without its last sample",
    "data/record.py",
    "return self.samples * self.interval",
    "return (self.samples - 1) * self.interval",
    ("tests/data/test_record.py::test_samples_duration_and_range_are_those_of_the_voltage",),
)


@pytest.mark.parametrize("defect", listed(), ids=lambda defect: defect.what)
def test_each_defect_can_be_planted(defect: Defect) -> None:
    """What it replaces occurs exactly once, what comes out is Python, and its tests exist."""
    text = planted_text(defect, PACKAGE)
    assert text != (PACKAGE / defect.file).read_text(encoding="utf-8")
    ast.parse(text)
    for test in defect.tests:
        file, _, name = test.partition("::")
        assert f"def {name.partition('[')[0]}" in (ROOT / file).read_text(encoding="utf-8")


def test_each_defect_has_a_description_of_its_own() -> None:
    assert len({defect.what for defect in listed()}) == len(listed())


@pytest.mark.parametrize("times", [0, 2])
def test_a_place_that_is_gone_or_not_unique_is_told(tmp_path: Path, times: int) -> None:
    (tmp_path / "data").mkdir()
    (tmp_path / SMALL.file).write_text(times * SMALL.right, encoding="utf-8")
    with pytest.raises(ValueError, match=f"has {times} times, not once.*bring tests/defects.toml"):
        planted_text(SMALL, tmp_path)


def test_a_planted_defect_is_caught_and_leaves_the_package_as_it_is() -> None:
    before = (PACKAGE / SMALL.file).read_bytes()
    (outcome,) = plant_all([SMALL])
    assert outcome.caught, outcome.printed
    assert outcome.by.startswith(SMALL.tests[0])
    assert before == (PACKAGE / SMALL.file).read_bytes()


def test_twin_what_is_no_defect_is_missed() -> None:
    same = Defect("none", SMALL.file, SMALL.right, f"{SMALL.right} + 0.0", SMALL.tests)
    (outcome,) = plant_all([same])
    assert not outcome.caught
    assert "" == outcome.by


def test_tests_that_do_not_exist_are_no_catch() -> None:
    nowhere = Defect("nowhere", SMALL.file, SMALL.right, SMALL.wrong, ("tests/nowhere.py",))
    with pytest.raises(RuntimeError, match=r"pytest ended with 4"):
        list(plant_all([nowhere]))


@pytest.mark.slow
def test_the_nearest_tests_notice_every_defect() -> None:
    """They pass on the package as it is, and one at least fails with each defect."""
    every = listed()
    status, printed = run_tests(sorted({test for defect in every for test in defect.tests}))
    assert status == PASSED, printed
    outcomes = list(plant_all(every))
    missed = [outcome.defect.what for outcome in outcomes if not outcome.caught]
    keep("defects", {"planted": len(every), "caught": len(every) - len(missed)})
    assert not missed
