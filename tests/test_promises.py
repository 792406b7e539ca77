"""The figures that ``tests/README.md`` quotes are those measured when the slow tests last ran.

A row is found by its claim. The column of figures holds those of the study, in their order, as
precisely as they are printed, and no others. The limits and records that a study states are checked
too; the others are numbers that the tests themselves hold.
"""

from pathlib import Path
from typing import NamedTuple

import pytest

from tests.measured import assert_quotes, figures, measured, numbers, quotes
from tests.test_calibration_moving import PARTS
from tests.test_what_drives_tell import LENGTHS

PROMISES = Path(__file__).with_name("README.md").read_text(encoding="utf-8")

STUDIES = measured()


ROWS = {
    cells[0]: cells
    for line in PROMISES.splitlines()
    if len(cells := [cell.strip() for cell in line.strip("|").split("|")]) == 5
}


class Quoted(NamedTuple):
    """Expressions of a row's figures, and of numbers among its limits and its records."""

    figures: list[str]
    beside: list[str] = []  # noqa: RUF012  # read alone


OFF = "bands, standard errors off/*"
MOVING = f"calibration, [!l]*/{OFF}|calibration, lag/{OFF}"
MODELS = ("lag", "known hysteresis", "second order", "free exponent", "little noise")
JOINT = "joint fit of the campaign"
WIDTH = f"{JOINT}/width, of that from the loops alone"
PARTS_BESIDE = ["max calibrated part, */replicates"]
RATES = "one answer at any rate"
PLANTS = [f"{RATES}/plants"]
THINNED = ["min every k-th sample*/seeds"]
FIXED = ["count causes and fixes/*/right", "causes and fixes/seeds"]
SPOILT = ["#spoilt runs do not hold", "max spoilt runs do not hold/*/seen"]
ANSWERS = ["ordinary answers/seeds"]
CHOICES = ["which model/records"]
OTHERS = ("least squares", "plays, least squares", "emcee, white noise", "bwbayes")
SPECIMENS = ["campaign/specimens"]


def coverage(kind: str, name: str) -> Quoted:
    """Return the coverage of the stand's intervals or bands."""
    return Quoted([f"100 coverage {kind}/covered/{name} *"])


def of_errors(study: str, kind: str) -> Quoted:
    """Return the coverage of a command's errors."""
    return Quoted([f"100 {study}/{kind} {level}/0" for level in (50, 90, 95)])


def of_times(kind: str) -> Quoted:
    """Return the coverage where a record is ever fewer correlation times long."""
    times = (0.04, 0.2, 0.5, 1.3)
    return Quoted([f"100 a {kind} discrepancy of {time} s/coverage/95" for time in times])


def of_cost(model: str) -> Quoted:
    """Return the core seconds of a model's fits, from short records to long ones."""
    return Quoted([f"cost of a fit/{model}/{length}/core s" for length in LENGTHS[model]])


def of_others(test: str, name: str) -> Quoted:
    """Return what each method finds in a test on the measured stack."""
    return Quoted([f"beside others/{method}/{test}/{name}" for method in OTHERS])


CLAIMS: dict[str, Quoted] = {
    "50/90/95% intervals of parameters cover, %": coverage("process", "parameters"),
    "... without a model discrepancy, %": coverage("none", "parameters"),
    "Rank tests that fail, from rest": Quoted(
        ["calibration/shortcomings", "calibration/tests"],
        ["calibration/replicates", "calibration/unconverged"],
    ),
    "An SD a fifth too small in one parameter is found, probability": Quoted(
        ["calibration/power"], ["calibration/replicates"]
    ),
    "Rank tests that fail, moving, five kinds of models": Quoted(
        ["sum #calibration, */shortcomings"],
        ["min calibration, */replicates", "max calibration, */replicates"],
    ),
    "Bands of moving records, standard errors off at most": Quoted(
        [f"worst {MOVING}"], [f"count {MOVING}"]
    ),
    "90/95% sensor bands, held out, where the discrepancy is nearly all of the noise, cover, %": (
        Quoted(
            [f"100 calibration, little noise/bands cover/sensor {level}" for level in (90, 95)],
            ["calibration, little noise/replicates"],
        )
    ),
    "Not converged in their budget: lag, known hysteresis, second order, free exponent, "
    "little noise": Quoted(
        [f"calibration, {name}/unconverged" for name in MODELS],
        [f"calibration, {name}/replicates" for name in MODELS],
    ),
    "Rank tests that fail, each operator, creep, polynomial nonlinearity": Quoted(
        ["sum #calibrated part, */shortcomings"], PARTS_BESIDE
    ),
    "... their bands, standard errors off at most": Quoted(
        [f"worst calibrated part, */{OFF}"], [f"count calibrated part, */{OFF}"]
    ),
    "... 95% sensor bands of another record cover, %": Quoted(
        ["extent 100 calibrated part, */bands cover/other*sensor 95"], PARTS_BESIDE
    ),
    "... not converged in their budget, at most": Quoted(
        ["max calibrated part, */unconverged"], PARTS_BESIDE
    ),
    "... 300 readings: 95% intervals of each quantity cover, %": Quoted(
        ["extent 100 calibrated run/cover/*"], ["calibrated run/replicates"]
    ),
    "95% intervals cover where a stage is drawn, too, and the search may find it, %": Quoted(
        ["100 selection/of all models"], ["selection/actuators"]
    ),
    "... those of the chosen model alone, %": Quoted(
        ["100 selection/of the chosen one"], ["selection/actuators"]
    ),
    "95% intervals cover where the scales of sensor and monitor are drawn too, %": Quoted(
        ["extent 100 uncertain scales/cover/*"], ["uncertain scales/records"]
    ),
    "Joint fit of loops and steps: 95% intervals of eight parameters cover, of 40": Quoted(
        [f"extent {STUDIES[JOINT]['seeds']} {JOINT}/covered/*"], [f"{JOINT}/seeds"]
    ),
    "... the damping's interval, % of that from the loops alone": Quoted(
        [f"100 {WIDTH}/damping"], [f"{JOINT}/seeds"]
    ),
    "... the other parameters'": Quoted(
        [f"extent 100 {WIDTH}/[!d]*|{WIDTH}/d"], [f"{JOINT}/seeds"]
    ),
    "Consistent records that are called inconsistent": Quoted(
        ["joint fits: records that agree/named"]
    ),
    "Records with a tenth more gain that are named, %": Quoted(
        ["100 joint fits: records that agree/named with 10% more gain"]
    ),
    "50/90/95% sensor bands cover, %": coverage("process", "sensor"),
    "50/90/95% displacement bands cover, %": coverage("process", "displacement"),
    "... sensor bands without a model discrepancy, %": coverage("none", "sensor"),
    "... displacement bands without a model discrepancy, %": coverage("none", "displacement"),
    "... and parameters, standard errors off at most": Quoted(["worst coverage */errors_off/*"]),
    "Moving records, 95% bands cover, %": Quoted(
        ["extent 100 moving, */coverage and t/*/95/0"],
        ["max moving, */records of each case", "sum moving, */cases"],
    ),
    "... standard errors off at most": Quoted(
        ["max moving, */largest t"], ["count moving, */coverage and t/*/*/0"]
    ),
    "Moving records, any operator, 95% bands cover, %": Quoted(
        ["extent 100 moving operators, */coverage and t/95/0"], ["min moving operators, */records"]
    ),
    "... of any operator, standard errors off at most": Quoted(
        ["worst moving operators, */coverage and t/*/1"],
        ["count moving operators, */coverage and t/*/0"],
    ),
    "... their width over that from rest, at most": Quoted(
        ["max moving operators, */widening from rest"], ["min moving operators, */records"]
    ),
    "Steady sine: 95% intervals of eight parameters cover, of 40": Quoted(
        ["extent steady sine/covered 95/*"], ["steady sine/records"]
    ),
    "Forecasts, 95% bands at five distances cover, %": Quoted(
        ["extent 100 forecasts from posteriors/95% bands cover/*"],
        ["forecasts from posteriors/records"],
    ),
    "Creep not tried: 95% displacement bands cover, slow sine/staircase/hold/hour, %": Quoted(
        [f"100 untried/coverage/{name}" for name in ("sine", "staircase", "hold", "hour")]
    ),
    "... the least covered of all plans, %": Quoted(["min 100 untried/worst/*"]),
    "... width of bands of fast drives, over that without": Quoted(["untried/wider"]),
    "... after a fit of the wrong model, %": Quoted(
        ["100 corrected bands/corrected covers"], ["corrected bands/corrected"]
    ),
    "Every 2nd, 5th and 20th sample: smallest p of the differences": Quoted(
        ["min every k-th sample*/smallest p"], ["min every k-th sample*/p of the family", *THINNED]
    ),
    "... means within one SD": Quoted(
        [f"sum every k-th sample*/within one sd/*/{place}" for place in (0, 1)], THINNED
    ),
    "... 95% bands cover, every rate, %": Quoted(
        ["extent every k-th sample*/covered/*/95"], THINNED
    ),
    "50 Hz to 5 kHz, wrong model, smooth noise: means within one SD, %": Quoted(
        [f"100 {RATES}/within one sd"], PLANTS
    ),
    "... SDs within a factor of 1.5, %": Quoted([f"100 {RATES}/sds within 1.5"], PLANTS),
    "... error at 5 kHz over that at 200 Hz, median and largest": Quoted(
        [f"{RATES}/error ratio/*"], PLANTS
    ),
    "... 95% sensor bands of another record cover, each rate, %": Quoted(
        [f"extent 100 {RATES}/coverage/*/95"], PLANTS
    ),
    "... the sensor's SD over the truth, from 200 Hz on": Quoted(
        [f"extent {RATES}/sensor/200/*|{RATES}/sensor/1000/*|{RATES}/sensor/5000/*"], PLANTS
    ),
    "4 s of 100/20/8/3 correlation times, smooth: 95% bands of the next cover, %": (
        of_times("smooth")
    ),
    "4 s of 100/20/8/3 correlation times, rough: 95% bands of the next cover, %": (
        of_times("rough")
    ),
    "Isolated spikes that are set aside": Quoted(
        ["spikes set aside/found", "spikes set aside/spikes"], ["spikes set aside/records"]
    ),
    "... good readings that are": Quoted(["spikes set aside/good readings set aside"]),
    "... width of bands over that without spikes": Quoted(
        ["spikes set aside/width over clean, least and most/*"]
    ),
    "... 95% intervals of nine parameters cover, of 100": Quoted(
        ["extent spikes set aside/covered 95/*"], ["spikes set aside/records"]
    ),
    "Steady sine, runs that converge": Quoted(["steady sine/converged"], ["steady sine/records"]),
    "... steps, at most": Quoted(["steady sine/most steps"]),
    "Good runs whose bands are said to fail": Quoted(
        ["#good runs hold/said no"], ["good runs hold/runs"]
    ),
    "Spoilt runs that are missed": Quoted(["sum spoilt runs do not hold/*/missed"], SPOILT),
    "... left open": Quoted(["sum spoilt runs do not hold/*/unsure"], SPOILT),
    "Wrong actuators: the likely cause is right or tied": Quoted(
        ["sum causes and fixes/*/right"], FIXED
    ),
    "... of the hardest kind (a wrong hold between samples)": Quoted(
        ["min causes and fixes/*/right"], ["causes and fixes/seeds"]
    ),
    "... after its fix, the next record's 95% band covers 90 to 99%": Quoted(
        ["sum causes and fixes/*/covered"], FIXED
    ),
    "... bands that pass and cover less than 85% of the next record": Quoted(
        ["sum causes and fixes/*/false green"], FIXED
    ),
    "Good actuators that get a cause": Quoted(
        ["causes and fixes/good with a cause"], ["causes and fixes/good"]
    ),
    "All defaults, a correct actuator: bands that pass": Quoted(
        ["ordinary answers/correct/True"], ANSWERS
    ),
    "... that fail": Quoted(["sum ordinary answers/correct/False"], ANSWERS),
    "... another actuator with a fifth more gain: pass and fail": Quoted(
        ["ordinary answers/other/True", "ordinary answers/other/False"], ANSWERS
    ),
    "Ordinary records that are refused": Quoted(
        ["#ordinary records/refused"], ["ordinary records/records"]
    ),
    "Spoilt files are used, or refused in one line; nothing else": Quoted(
        ["hostile input/used", "hostile input/refused"], ["sum hostile input/*used"]
    ),
    "A kill at any moment loses no block and changes no bit": Quoted(
        ["kills/kills"], ["kills/runs"]
    ),
    "A killed campaign continues to the same tables": Quoted(["campaign kills/kills"]),
    "A million samples, a whole fit to its report, GiB": Quoted(["long fit/gib"]),
    "The right model is named or left open": Quoted(["which model/named or left open"], CHOICES),
    "... it alone is named": Quoted(["which model/named alone"], CHOICES),
    "... error on a fresh record within a tenth of the best candidate's": Quoted(
        ["which model/error within a tenth of the best"], CHOICES
    ),
    "... times the best candidate's, at most": Quoted(["which model/largest ratio of errors"]),
    "A designed measurement leaves the SD that was expected, times": Quoted(
        ["extent design/[!r]*"], ["count design/[!r]*"]
    ),
    "... rank correlation of the signals": Quoted(["design/rank"]),
    "Commands: 50/90/95% bands of the error cover, %": of_errors("compensation", "band"),
    "... intervals of its rms, %": of_errors("compensation", "rms"),
    "... standard errors off at most, commands": Quoted(["worst compensation/*/1"]),
    "Commands by a DAC at 200 Hz: 50/90/95% bands of the error cover, %": of_errors(
        "compensation by a DAC", "band"
    ),
    "... intervals of its rms by a DAC, %": of_errors("compensation by a DAC", "rms"),
    "... by a DAC, standard errors off at most": Quoted(["worst compensation by a DAC/*/1"]),
    "PID with feedforward beats either alone, up to 20 Hz, % of draws": Quoted(
        ["100 closed loop/least_share_of_draws"], ["closed loop/draws", "closed loop/seeds"]
    ),
    "95% intervals of four parameters cover, %": Quoted(["extent 100 campaign/*/own"], SPECIMENS),
    "... shrunk to the population, %": Quoted(["extent 100 campaign/*/shrunk"], SPECIMENS),
    "... 50/90/95% sensor bands, %": Quoted(["100 campaign/sensor *"], SPECIMENS),
    "95% intervals of population mean/spread/next specimen cover, %": Quoted(
        [f"100 populations/{key}" for key in ("mean", "spread", "new")]
    ),
    "... of shrunk specimens cover, %, and their width over the unshrunk": Quoted(
        ["100 populations/shrunk", "populations/width"]
    ),
    "Inverse over simulation, time for 1,000 draws": Quoted(
        ["extent inverse over simulation/*"], ["count inverse over simulation/*"]
    ),
    "Core s of a Bouc-Wen fit of 100/1,000/10,000/100,000 readings": of_cost("bouc-wen"),
    "... with creep, of 100/1,000/10,000 readings": of_cost("bouc-wen, creep"),
    "... of four Maxwell-slip elements, 100/1,000/10,000 readings": of_cost("maxwell-slip"),
    "... simulations for an effective draw, burn-in included": Quoted(
        ["extent cost of a fit/*/evaluations a draw"]
    ),
    "Error on loops as fitted, least squares/plays/emcee/bwbayes, % of the range": of_others(
        "large loops", "error_percent"
    ),
    "... on a decay and a hold": of_others("decay and hold", "error_percent"),
    "... their 95% bands cover, loops, %": of_others("large loops", "covered_percent"),
    "... their 95% bands cover, decay and hold, %": of_others("decay and hold", "covered_percent"),
    "Log evidence less that of nested sampling (dynesty)": Quoted(
        ["log evidence of the measured record/less dynesty's"]
    ),
    **{name: Quoted([f"benchmarks/{name}"]) for name in STUDIES["benchmarks"]},
}


@pytest.mark.parametrize("claim", CLAIMS)
def test_the_quoted_figures_are_those_of_the_last_full_run(claim: str) -> None:
    _, cell, limit, records, _ = ROWS[claim]
    assert_quotes(cell, *CLAIMS[claim].figures)
    beside = iter(numbers(f"{limit} {records}"))
    for figure in figures(*CLAIMS[claim].beside):
        assert any(quotes(number, figure) for number in beside), (figure, limit, records)


def test_every_figure_is_that_of_a_study_and_every_claim_has_a_command() -> None:
    rows = [line for line in PROMISES.splitlines() if line.startswith("| ")]
    headers = [line for line in rows if line.startswith(("| claim |", "| --- |"))]
    assert len(rows) - len(headers) == len(ROWS) - 2  # no claim stands twice
    for claim, figure, _, _, command in ROWS.values():
        if claim not in ("claim", "---"):
            assert command.startswith("`"), claim
            assert bool(numbers(figure)) == (claim in CLAIMS), claim


def test_twin_another_figure_is_found() -> None:
    assert quotes("1,151", 1151.2)
    assert not quotes("1.9", 1.84)


def test_no_calibration_has_a_shortcoming_and_every_part_has_one() -> None:
    failures = figures("*/shortcomings|#*/shortcomings")
    assert len(failures) > len(PARTS)
    assert not any(failures)
    assert all(f"calibrated part, {name}" in STUDIES for name in PARTS)
