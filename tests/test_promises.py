"""The figures that ``tests/README.md`` quotes are those measured when the slow tests last ran.

A row is found by its command. Its figures are those of the study, in their order, as precisely as
they are printed; other numbers of the row are limits and sizes, which the tests themselves hold.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Callable, Collection, Mapping
from itertools import chain
from pathlib import Path
from typing import Any

import pytest

from bwbayes.results.bands import LEVELS
from tests.measured import measured
from tests.test_calibration_moving import PARTS

PROMISES = Path(__file__).with_name("README.md").read_text(encoding="utf-8")
NUMBER = re.compile(r"(?<![\w.])\d[\d,]*(?:\.\d+)?(?:e-?\d+)?")

STUDIES = measured()


def of_kind(start: str) -> dict[str, Any]:
    """Return the figures of all studies of a kind, by what is varied."""
    return {n.removeprefix(start): one for n, one in STUDIES.items() if n.startswith(start)}


def extent(values: Collection[float], scale: float = 1.0) -> list[float]:
    """Return the least and the largest value."""
    return [scale * min(values), scale * max(values)]


def worst_band(studies: Mapping[str, Any]) -> float:
    """Return how far the worst band is off, in standard errors."""
    offs = [x["bands, standard errors off"].values() for x in studies.values()]
    return float(max(map(abs, chain.from_iterable(offs))))


def coverage() -> list[float]:
    kinds = [STUDIES[f"coverage {kind}"] for kind in ("process", "none")]
    names = [f"{n} {level}" for n in ("parameters", "sensor", "displacement") for level in LEVELS]
    covered = [100 * kind["covered"][name] for kind in kinds for name in names]
    return [*covered, max(abs(off) for kind in kinds for off in kind["errors_off"].values())]


def calibration() -> list[float]:
    figures = STUDIES["calibration"]
    keys = ("replicates", "unconverged", "tests", "shortcomings", "power")
    return [figures[key] for key in keys]


def variants() -> list[float]:
    studies = of_kind("calibration, ")
    counts = [(x["unconverged"], x["replicates"]) for _, x in sorted(studies.items())]
    little = studies.pop("little noise")
    assert not any(study["shortcomings"] for study in [*studies.values(), little])
    wide = [100 * little["bands cover"][f"sensor {level}"] for level in (90, 95)]
    return [18 * len(studies), worst_band(studies), *wide, *chain.from_iterable(counts)]


def parts() -> list[float]:
    studies = of_kind("calibrated part, ")
    assert set(PARTS) == set(studies)
    assert not any(study["shortcomings"] for study in studies.values())
    covers = [
        cover
        for study in studies.values()
        for name, cover in study["bands cover"].items()
        if name.startswith("other") and name.endswith("sensor 95")
    ]
    unconverged = max(study["unconverged"] for study in studies.values())
    return [18 * len(studies), worst_band(studies), *extent(covers, 100), unconverged]


def hostile() -> list[float]:
    used, refused = (STUDIES["hostile input"][key] for key in ("used", "refused"))
    return [used + refused, used, refused]


def steady() -> list[float]:
    figures = STUDIES["steady sine"]
    runs = [figures["converged"], figures["records"], figures["most steps"]]
    return [*runs, *extent(figures["covered 95"].values()), figures["records"]]


def verdicts() -> list[float]:
    good, spoilt = STUDIES["good runs hold"], STUDIES["spoilt runs do not hold"].values()
    missed, unsure = (sum(kind.get(n, 0) for kind in spoilt) for n in ("missed", "unsure"))
    runs = {sum(kind.get(n, 0) for n in ("seen", "right", "unsure", "missed")) for kind in spoilt}
    return [len(good["said no"]), good["runs"], missed, unsure, len(spoilt), *runs]


def ordinary() -> list[float]:
    figures = STUDIES["ordinary answers"]
    right, wrong = (Counter(figures[kind]) for kind in ("correct", "other"))
    return [figures["seeds"], right["True"], right["False"], wrong["True"], wrong["False"]]


def moving() -> list[float]:
    studies = list(of_kind("moving, ").values())
    cells = [cell for study in studies for cell in study["coverage and t"].values()]
    return [
        sum(study["cases"] for study in studies),
        studies[0]["records of each case"],
        *extent([cell["95"][0] for cell in cells], 100),
        3 * len(cells),
        max(study["largest t"] for study in studies),
    ]


def moving_operators() -> list[float]:
    studies = of_kind("moving operators, ").values()
    cells = [cell for study in studies for cell in study["coverage and t"].values()]
    return [
        min(study["records"] for study in studies),
        *extent([study["coverage and t"]["95"][0] for study in studies], 100),
        len(cells),
        max(abs(t) for _, t in cells),
        max(study["widening from rest"] for study in studies),
    ]


def nested() -> list[float]:
    studies = of_kind("every k-th sample").values()
    counts = [text.split(" of ") for x in studies for text in x["within one sd"].values()]
    covers = [cover["95"] for study in studies for cover in study["covered"].values()]
    return [
        min(study["smallest p"] for study in studies),
        min(study["p of the family"] for study in studies),
        *(sum(int(count[i]) for count in counts) for i in (0, 1)),
        *extent(covers),
    ]


def spikes() -> list[float]:
    figures = STUDIES["spikes set aside"]
    found = [figures[key] for key in ("found", "spikes", "good readings set aside")]
    width, covered = figures["width over clean, least and most"], figures["covered 95"].values()
    return [*found, *width, *extent(covered), figures["records"]]


def closed_loop() -> list[float]:
    figures = STUDIES["closed loop"]
    return [100 * figures["least_share_of_draws"], figures["draws"], figures["seeds"]]


def forecasts() -> list[float]:
    figures = STUDIES["forecasts from posteriors"]
    return [figures["records"], *extent(figures["95 % bands cover"].values(), 100)]


def specimens() -> list[float]:
    figures = STUDIES["campaign"]
    parameters = [each for each in figures.values() if isinstance(each, dict)]
    covers = [extent([each[kind] for each in parameters], 100) for kind in ("own", "shrunk")]
    sensor = [100 * figures[f"sensor {level}"] for level in LEVELS]
    return [figures["specimens"], *chain.from_iterable(covers), *sensor]


def populations() -> list[float]:
    figures = STUDIES["populations"]
    return [100 * figures[key] for key in ("mean", "spread", "new", "shrunk", "width")]


def joint() -> list[float]:
    figures = STUDIES["joint fit of the campaign"]
    covered = [round(part * figures["seeds"]) for part in figures["covered"].values()]
    widths = dict(figures["width, of that from the loops alone"])
    return [
        figures["seeds"],
        *extent(covered),
        100 * widths.pop("damping"),
        *extent(widths.values(), 100),
    ]


def agreement() -> list[float]:
    figures = STUDIES["joint fits: records that agree"]
    return [figures["named"], 100 * figures["named with 10 % more gain"]]


def compensation(study: str) -> Callable[[], list[float]]:
    def figures() -> list[float]:
        names = [f"{kind} {level}" for kind in ("band", "rms") for level in LEVELS]
        errors = [abs(off) for _, off in STUDIES[study].values()]
        return [*(100 * STUDIES[study][name][0] for name in names), max(errors)]

    return figures


# By the command in the row.
FIGURES: dict[str, Callable[[], list[float]]] = {
    "-m slow tests/test_coverage.py": coverage,
    "-m slow tests/test_calibration.py`; with": calibration,
    "50 of one: `pytest tests/test_calibration_moving.py": variants,
    "-m slow tests/test_calibration_moving.py -k part": parts,
    "-m slow tests/app/test_kill.py": lambda: [STUDIES["kills"][n] for n in ("kills", "runs")],
    "-m slow tests/app/test_hostile_input.py": hostile,
    "-m slow tests/test_steady_sine.py": steady,
    "-m slow tests/results/test_verdicts_end_to_end.py": verdicts,
    "-m slow tests/app/test_front_door_study.py": lambda: [
        STUDIES["ordinary records"]["records"],
        len(STUDIES["ordinary records"]["refused"]),
    ],
    "-m slow tests/results/test_ordinary_answers.py": ordinary,
    "-m slow tests/results/test_moving.py": moving,
    "-m slow tests/results/test_moving_operators.py": moving_operators,
    "-m slow tests/test_thinned_records.py": nested,
    "-m slow tests/test_spoilt_readings.py": spikes,
    "-m slow tests/test_closed_loop.py": closed_loop,
    "-m slow tests/results/test_forecasts_calibrated.py": forecasts,
    "-m slow tests/test_campaign_of_records.py": joint,
    "-m slow tests/results/test_agreement.py": agreement,
    "times | `python -m tests.benchmarks` |": lambda: extent(
        STUDIES["inverse over simulation"].values()
    ),
    "-m slow tests/control/test_compensation.py": compensation("compensation"),
    "-m slow tests/control/test_command_hold.py": compensation("compensation by a DAC"),
    "-m slow tests/test_campaign_study.py -k covers": specimens,
    "-m slow tests/population": populations,
    "-m slow tests/inference/test_untried.py": lambda: [
        *(100 * STUDIES["untried"]["coverage"][n] for n in ("sine", "staircase", "hold", "hour")),
        STUDIES["untried"]["wider"],
    ],
    "-m slow tests/test_long_fits.py": lambda: [STUDIES["long fit"]["gib"]],
}


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
    for figure in FIGURES[command]():
        assert any(quotes(number, figure) for number in numbers), (figure, cell)


def test_twin_another_figure_is_found() -> None:
    assert quotes("1,151", 1151.2)
    assert not quotes("1.9", 1.84)


def test_the_quoted_speeds_are_those_of_the_last_benchmarks() -> None:
    rows = re.findall(r"^\| (.+) \| ([\d.,]+) \|$", PROMISES, flags=re.MULTILINE)
    quoted = {name: float(value.replace(",", "")) for name, value in rows}
    assert quoted == pytest.approx(STUDIES["benchmarks"], rel=0.01)
