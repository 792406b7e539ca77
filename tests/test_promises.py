"""The figures that ``tests/README.md`` quotes are those measured when the slow tests last ran.

A row is found by its command. Its figures are those of the study, in their order, as precisely as
they are printed; other numbers of the row are limits and sizes, which the tests themselves hold.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Any

import pytest

from tests.measured import measured
from tests.test_calibration_moving import PARTS

PROMISES = Path(__file__).with_name("README.md").read_text(encoding="utf-8")
NUMBER = re.compile(r"(?<![\w.])\d[\d,]*(?:\.\d+)?(?:e-?\d+)?")

STUDIES = measured()


def leaves(figure: Any, path: str) -> Iterator[tuple[str, float]]:
    """Yield the numbers of a figure by their paths; "5 of 9" is two, "#path" a list's length."""
    if isinstance(figure, str):
        counts = re.fullmatch(r"(\d+) of (\d+)", figure)
        figure = [int(count) for count in counts.groups()] if counts else []
    if isinstance(figure, int | float):
        yield path, figure
        return
    yield f"#{path}", len(figure)
    items = figure.items() if isinstance(figure, dict) else enumerate(figure)
    for key, value in items:
        yield from leaves(value, f"{path}/{key}")


LEAVES = {path: value for study, figure in STUDIES.items() for path, value in leaves(figure, study)}

OFF = "bands, standard errors off/*"
MOVING = f"calibration, [!l]*/{OFF}|calibration, lag/{OFF}"
JOINT = "joint fit of the campaign"
WIDTH = f"{JOINT}/width, of that from the loops alone"


def of_errors(study: str) -> list[str]:
    """Return the figures of a command's errors."""
    bands = [f"100 {study}/{kind} {level}/0" for kind in ("band", "rms") for level in (50, 90, 95)]
    return [*bands, f"worst {study}/*/1"]


# By the command in the row: how the numbers are reduced, what they are multiplied by, their paths.
FIGURES: dict[str, list[str]] = {
    "-m slow tests/test_coverage.py": [
        *(
            f"100 coverage {kind}/covered/{name} *"
            for kind in ("process", "none")
            for name in ("parameters", "sensor", "displacement")
        ),
        "worst coverage */errors_off/*",
    ],
    "-m slow tests/test_calibration.py`; with": [
        f"calibration/{key}"
        for key in ("replicates", "unconverged", "tests", "shortcomings", "power")
    ],
    "32 of one: `pytest tests/test_calibration_moving.py": [
        f"count {MOVING}",
        f"worst {MOVING}",
        "100 calibration, little noise/bands cover/sensor 90",
        "100 calibration, little noise/bands cover/sensor 95",
        *(
            f"calibration, {name}/{key}"
            for name in ("free exponent", "known hysteresis", "lag", "little noise", "second order")
            for key in ("unconverged", "replicates")
        ),
    ],
    "-m slow tests/test_calibration_moving.py -k part": [
        f"count calibrated part, */{OFF}",
        f"worst calibrated part, */{OFF}",
        "extent 100 calibrated part, */bands cover/other*sensor 95",
        "max calibrated part, */unconverged",
    ],
    "-m slow tests/app/test_kill.py": ["kills/kills", "kills/runs"],
    "-m slow tests/app/test_hostile_input.py": [
        "sum hostile input/*used",
        "hostile input/used",
        "hostile input/refused",
    ],
    "-m slow tests/test_steady_sine.py": [
        "steady sine/converged",
        "steady sine/records",
        "steady sine/most steps",
        "extent steady sine/covered 95/*",
        "steady sine/records",
    ],
    "-m slow tests/diagnosis/test_validation_end_to_end.py": [
        "#good runs hold/said no",
        "good runs hold/runs",
        "sum spoilt runs do not hold/*/missed",
        "sum spoilt runs do not hold/*/unsure",
        "#spoilt runs do not hold",
        "max spoilt runs do not hold/*/seen",
    ],
    "-m slow tests/app/test_front_door_study.py": [
        "ordinary records/records",
        "#ordinary records/refused",
    ],
    "-m slow tests/prediction/test_ordinary_answers.py": [
        "ordinary answers/seeds",
        "sum ordinary answers/correct/True",
        "sum ordinary answers/correct/False",
        "sum ordinary answers/other/True",
        "sum ordinary answers/other/False",
    ],
    "-m slow tests/prediction/test_moving.py -k kinds": [
        "sum moving, */cases",
        "max moving, */records of each case",
        "extent 100 moving, */coverage and t/*/95/0",
        "count moving, */coverage and t/*/*/0",
        "max moving, */largest t",
    ],
    "-m slow tests/prediction/test_moving.py -k operator": [
        "min moving operators, */records",
        "extent 100 moving operators, */coverage and t/95/0",
        "count moving operators, */coverage and t/*/0",
        "worst moving operators, */coverage and t/*/1",
        "max moving operators, */widening from rest",
    ],
    "-m slow tests/test_thinned_records.py": [
        "min every k-th sample*/smallest p",
        "min every k-th sample*/p of the family",
        "sum every k-th sample*/within one sd/*/0",
        "sum every k-th sample*/within one sd/*/1",
        "extent every k-th sample*/covered/*/95",
    ],
    "-m slow tests/test_sampling_rates.py": [
        *(f"100 one answer at any rate/{key} *" for key in ("within one", "sds within")),
        *(f"one answer at any rate/error ratio/{number}" for number in range(2)),
        "extent 100 one answer at any rate/coverage/*/95",
        *(
            f"100 a {kind} discrepancy of {time} s/coverage/95"
            for kind in ("smooth", "rough")
            for time in (0.04, 0.2, 0.5, 1.3)
        ),
    ],
    "-m slow tests/test_spoilt_readings.py": [
        "spikes set aside/found",
        "spikes set aside/spikes",
        "spikes set aside/good readings set aside",
        "spikes set aside/width over clean, least and most/*",
        "extent spikes set aside/covered 95/*",
        "spikes set aside/records",
    ],
    "-m slow tests/test_closed_loop.py": [
        "100 closed loop/least_share_of_draws",
        "closed loop/draws",
        "closed loop/seeds",
    ],
    "-m slow tests/prediction/test_forecast.py": [
        "forecasts from posteriors/records",
        "extent 100 forecasts from posteriors/95% bands cover/*",
    ],
    "-m slow tests/test_campaign_of_records.py": [
        f"{JOINT}/seeds",
        f"extent {STUDIES[JOINT]['seeds']} {JOINT}/covered/*",
        f"100 {WIDTH}/damping",
        f"extent 100 {WIDTH}/[!d]*|{WIDTH}/d",
    ],
    "-m slow tests/diagnosis/test_consistency.py": [
        "joint fits: records that agree/named",
        "100 joint fits: records that agree/named with 10% more gain",
    ],
    "times | `python -m tests.benchmarks` |": ["extent inverse over simulation/*"],
    "-m slow tests/control/test_compensation.py": of_errors("compensation"),
    "-m slow tests/control/test_command_hold.py": of_errors("compensation by a DAC"),
    "-m slow tests/test_campaign_study.py -k covers": [
        "campaign/specimens",
        "extent 100 campaign/*/own",
        "extent 100 campaign/*/shrunk",
        "100 campaign/sensor *",
    ],
    "-m slow tests/population": [
        f"100 populations/{key}" for key in ("mean", "spread", "new", "shrunk", "width")
    ],
    "-m slow tests/inference/test_prior_creep.py": [
        *(f"100 untried/coverage/{name}" for name in ("sine", "staircase", "hold", "hour")),
        "untried/wider",
    ],
    "-m slow tests/test_long_fits.py": ["long fit/gib"],
}

REDUCE: dict[str, Callable[[list[float]], list[float]]] = {
    "": list,
    "min": lambda values: [min(values)],
    "max": lambda values: [max(values)],
    "sum": lambda values: [sum(values)],
    "count": lambda values: [len(values)],
    "extent": lambda values: [min(values), max(values)],
    "worst": lambda values: [max(map(abs, values))],
}


def figures(expression: str) -> list[float]:
    """Return the numbers of an expression."""
    found = re.fullmatch(rf"(?:({'|'.join(filter(None, REDUCE))}) )?(?:(\d+) )?(.*)", expression)
    assert found is not None
    how, factor, patterns = found.groups()
    values = [
        value * int(factor or 1)
        for pattern in patterns.split("|")
        for path, value in LEAVES.items()
        if fnmatchcase(path, pattern)
    ]
    assert values or how == "sum", expression
    return REDUCE[how or ""](values)


def quotes(text: str, value: float) -> bool:
    """Tell whether a number is a value, as precisely as it is printed."""
    if "e" in text:
        return f"{value:.0e}" == text
    return f"{value:,.{len(text.partition('.')[2])}f}" == text


@pytest.mark.parametrize("command", FIGURES)
def test_the_quoted_figures_are_those_of_the_last_full_run(command: str) -> None:
    (row,) = (line for line in PROMISES.splitlines() if command in line)
    cell = re.sub(r"`[^`]*`", "", row.split(" | ")[1])
    numbers = iter(number.rstrip(",") for number in NUMBER.findall(cell))
    for expression in FIGURES[command]:
        for figure in figures(expression):
            assert any(quotes(number, figure) for number in numbers), (expression, figure, cell)


def test_twin_another_figure_is_found() -> None:
    assert quotes("1,151", 1151.2)
    assert not quotes("1.9", 1.84)


def test_no_calibration_has_a_shortcoming_and_every_part_has_one() -> None:
    failures = [value for path, value in LEAVES.items() if path.endswith("/shortcomings")]
    assert len(failures) > len(PARTS)
    assert not any(failures)
    assert all(f"calibrated part, {name}" in STUDIES for name in PARTS)


def test_the_quoted_speeds_are_those_of_the_last_benchmarks() -> None:
    rows = re.findall(r"^\| (.+) \| ([\d.,]+) \|$", PROMISES, flags=re.MULTILINE)
    quoted = {name: float(value.replace(",", "")) for name, value in rows}
    assert quoted == pytest.approx(STUDIES["benchmarks"], rel=0.01)
