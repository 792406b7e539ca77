"""The report says what the summary says, needs nothing but itself, and keeps quiet if it must."""

import dataclasses
import re
from base64 import b64encode
from hashlib import sha256
from typing import Any

import hypothesis.strategies as st
import numpy as np
import pytest
from hypothesis import given

from bwbayes.diagnosis.finding import Finding
from bwbayes.diagnosis.validation import BandValidation
from bwbayes.inference.parameters import Parameter
from bwbayes.model.declaration import Distribution
from bwbayes.report.figures import interactive
from bwbayes.report.report import as_text, digits, symbol
from bwbayes.report.result import Result, summary
from bwbayes.report.run import run_report
from tests.app import example

PICTURES = {
    name: f"\x89PNG {name}".encode("latin-1")
    for name in ("loop", "bands_training", "bands_held-out", "coverage", "corner", "trace", "ranks")
}


def page(run: Result) -> str:
    return example.page(run, pictures=PICTURES)


def rows(text: str, table: str) -> dict[str, list[str]]:
    """Return a table's cells by their row's first cell, without tags."""
    body = re.findall(rf'<table id="{table}"[^>]*>.*?<tbody>(.*?)</tbody>', text, re.DOTALL)[0]
    seen = {}
    for row in re.findall(r"<tr.*?</tr>", body, re.DOTALL):
        cells = re.findall(r"<t[hd].*?>(.*?)</t[hd]>", row, re.DOTALL)
        first, *rest = (re.sub(r"<.*?>", "", cell) for cell in cells)
        seen[first] = rest
    return seen


def words(parameter: Parameter) -> str:
    return f"{parameter.description}, {symbol(parameter).striptags()}"


def test_numbers_of_the_parameters_are_the_summarys() -> None:
    """Estimates to a twentieth of the standard deviation, which is two digits of it."""
    run = example.run()
    numbers: Any = summary(run)["parameters"]
    table, of_sampling = (rows(page(run), name) for name in ("parameters", "sampling"))
    for parameter in run.free:
        expected = numbers[parameter.name]
        mean_and_sd, interval, unit, _ = table[words(parameter)]
        bulk, tail, rhat, mcse, median, _ = of_sampling[words(parameter)]
        shown = [
            float(text) for text in (*mean_and_sd.split(" ± "), median, *interval.split(" to "))
        ]
        estimates = [expected[key] for key in ("mean", "sd", "median", "lower_95", "upper_95")]
        assert estimates == pytest.approx(shown, abs=0.0503 * expected["sd"], rel=0)
        assert [round(expected["ess_bulk"]), round(expected["ess_tail"])] == [int(bulk), int(tail)]
        assert expected["rhat"] == pytest.approx(float(rhat), abs=5e-5)
        assert expected["mcse_mean"] == pytest.approx(float(mcse), rel=0.05)
        assert parameter.unit.replace("um", "µm") == unit


def test_scores_are_shown_for_each_of_the_bands() -> None:
    run = example.run()
    run = dataclasses.replace(
        run,
        predictions=(
            run.predictions[0],
            *example.scored(run.predictions[1:], example.scores(truth=False)),
        ),
    )
    text = page(run)
    coverage = "48.1 ± 4.1, 89.2 ± 2.2, 94.3 ± 1.3%"
    expected = ["–", "1.23%", "5.52 µm", "6.13 µm", coverage]
    assert {"held-out (held out)": expected, "training": expected} == rows(text, "validation")
    table = rows(text, "scores")
    assert ["0.817 µm"] * 2 == table["CRPS"]
    assert ["–", "91.5 ± 2.5%"] == table["90% displacement band covers displacement"]
    assert ["12.1%"] * 2 == table["50% sensor band: worst second"]
    assert ["6.13 µm"] * 2 == table["95% sensor band: mean width"]
    assert ["8.22 µm"] * 2 == table["90% sensor band: interval score"]


def test_bands_that_do_not_hold_come_before_the_answer_with_the_fix() -> None:
    cause = Finding("noise", "the noise is not like that", "try another noise")
    failed = BandValidation("held-out (held out)", False, False, ("covers 60%",), cause)
    held = BandValidation("training", True, True)
    run = dataclasses.replace(example.run(), validation={"training": held, "held-out": failed})
    text = page(run)
    places = [text.index(said) for said in ("VALIDATION FAILED", "try another noise", "94.3 ± 1.3")]
    assert sorted(places) == places
    assert "Converged, and" not in text
    statuses = {row: cells[0] for row, cells in rows(text, "validation").items()}
    assert {"held-out (held out)": "failed", "training": "passed"} == statuses
    for kind, status in (("bad", "failed"), ("good", "passed")):
        assert f'<span class="mark {kind}">{status}</span>' in text


@pytest.mark.parametrize("held_out", [True, False])
def test_a_run_that_holds_nothing_out_says_so_on_page_and_screen(held_out: bool) -> None:
    validation = {"training": BandValidation("training", True, True)}
    if held_out:
        validation["held-out"] = BandValidation("held-out (held out)", False, True)
    run = dataclasses.replace(example.run(), validation=validation)
    for text in (page(run), as_text(run_report(run, {}), 400)):
        assert held_out == ("no readings are held out: the bands are validated on" not in text)
        assert held_out == ("under [validation.held_out]" not in text)


@pytest.mark.parametrize("value", [1.0, np.nan])
def test_chains_without_a_spread_can_be_reported(value: float) -> None:
    run = example.run(converged=False, values=np.full((60, 4, 10, 4), value))
    unknown = dataclasses.replace(run.outcome.check, rhat=np.full(4, np.nan))
    run = dataclasses.replace(run, outcome=dataclasses.replace(run.outcome, check=unknown))
    assert "nan" == rows(page(run), "sampling")["stiff, k"][2]


@pytest.mark.parametrize("converged", [True, False])
def test_page_needs_nothing_from_elsewhere(converged: bool) -> None:
    """Nor does it run any script but its own, which is there only if there are plots."""
    text = page(example.run(converged=converged))
    assert text.startswith("<!DOCTYPE html>")
    own = [str(script) for script in interactive.scripts()] if converged else []
    assert own == re.findall(r"<script>(.*?)</script>", text, re.DOTALL)
    digests = re.findall(r"'sha256-(.*?)'", text[: text.index("<title>")])
    assert [b64encode(sha256(script.encode()).digest()).decode() for script in own] == digests
    text = re.sub(r"<script( type=.application/json.)?>.*?</script>", "", text, flags=re.DOTALL)
    for outside in ("http:", "https:", "//", "<script", "<link", "@import", "url(", "srcset"):
        assert outside not in text.replace("base64,//", "")
    assert all(s.startswith("data:") for s in re.findall(r'src="(.*?)"', text))
    assert all(s.startswith(("#", "data:text/csv")) for s in re.findall(r'href="(.*?)"', text))


@pytest.mark.parametrize(
    ("label", "expected"),
    [
        ("d", "<i>d</i>"),
        (r"\alpha", "<i>α</i>"),
        ("h_0", "<i>h</i><sub>0</sub>"),
        (r"\tau_\mathrm{lag}", "<i>τ</i><sub>lag</sub>"),
        (r"k_{12}", "<i>k</i><sub>12</sub>"),
        (r"\frac{a}{b}", "<i>some_name</i>"),
        ("", "<i>some_name</i>"),
    ],
)
def test_labels_become_readable_symbols(label: str, expected: str) -> None:
    parameter = dataclasses.replace(example.PARAMETERS[0], name="some_name", label=label)
    assert expected == symbol(parameter)


@pytest.mark.parametrize(
    ("value", "sd", "expected"),
    [
        (0.69712, 0.0061234, "0.6971"),
        (410123.0, 1234.0, "410100"),
        (1.0, 0.5, "1.00"),
        (-0.0004, 0.12, "0.00"),
        (1.23456e-9, 1.2e-11, "1.235e-09"),
        (0.0, 1e-12, "0e+00"),
        (1.5, 0.0, "1.5"),
        (np.nan, 1.0, "nan"),
    ],
)
def test_digits_follow_the_standard_deviation(value: float, sd: float, expected: str) -> None:
    assert expected == digits(value, sd)


@given(st.floats(-1e6, 1e6), st.floats(1e-15, 1e9))
def test_rounding_costs_at_most_a_twentieth_of_a_standard_deviation(
    value: float, sd: float
) -> None:
    assert abs(float(digits(value, sd)) - value) <= 0.0503 * sd + 1e-15 * abs(value)


def test_a_stored_summary_and_the_truth_are_shown() -> None:
    run = example.run()
    stored: Any = summary(run)
    stored["parameters"]["d"] |= {"mean": 0.12345, "sd": 0.001}
    text = example.page(run, stored)
    table = rows(text, "parameters")
    assert table["coefficient, d"][0].startswith("0.1235 ± 0.0010")
    assert ("0.7", "–") == (table["coefficient, d"][3], table["part, α"][3])
    assert "<i>τ</i><sub>lag</sub>" in text
    assert "Truth" not in page(dataclasses.replace(run, truth={}))


def test_priors_are_listed_with_what_the_constraints_leave_of_them() -> None:
    """The bound d takes the upper part of a prior of alpha that reaches beyond it."""
    bounded = dataclasses.replace(example.PARAMETERS[0], lower=0.1, upper=2.0)
    close = dataclasses.replace(
        example.PARAMETERS[1], prior=Distribution("normal", {"mean": 0.7, "sd": 0.1})
    )
    text = page(example.run(parameters=(bounded, close, *example.PARAMETERS[2:])))
    table = rows(text, "priors")
    assert len(example.PARAMETERS) == len(table)
    assert "normal(mean = 0.7, sd = 0.1), at least 0.1, at most 2" == table["coefficient, d"][0]
    assert ["fixed at 1", ""] == table["smoothness, n"][:2]
    median, upper = (float(text) for text in re.findall(r"[\d.]+", table["part, α"][1])[::2])
    assert 0.62 < median < 0.67
    assert upper < 0.83
    assert '<span id="constraints">0 &lt; alpha &lt; d</span>' in text
    without = example.run(parameters=example.PARAMETERS[:1], values=example.draws()[..., :1])
    assert 'id="constraints"' not in page(without)


def test_what_is_not_known_has_no_row() -> None:
    run = example.run()
    unknown = example.scored(run.predictions, example.scores(truth=False))
    table = rows(page(dataclasses.replace(run, predictions=unknown)), "scores")
    assert 10 == len(table)
    assert not any("displacement" in row or {"–"} >= set(cells) for row, cells in table.items())
    without = dataclasses.replace(run.outcome.check, pareto_k=None)
    text = example.page(
        dataclasses.replace(
            example.run(every=(example.bands(measured=False),)),
            outcome=dataclasses.replace(run.outcome, check=without),
        )
    )
    assert "No mixture proposed these draws" in text
    assert "Pareto k of" not in text
    assert 'id="validation"' not in text
    assert "There are no readings to check the bands against." in text


def test_verdict_says_why_and_what_to_do() -> None:
    text = page(example.run())
    assert "<strong>Converged" in text
    assert "NOT CONVERGED" not in text
    assert "two good checks" in text
    run = example.run(converged=False)
    resuming = {"go_on": "bwbayes resume results/a --steps 40000"}
    text = example.page(run, summary(run) | resuming, PICTURES)
    assert "<strong>NOT CONVERGED</strong>" in text
    assert "step limit 120 reached: R-hat 1.2" in text
    assert "<code>bwbayes resume results/a --steps 40000</code>" in text
    assert {"#trace", "#ranks"} <= set(re.findall(r'href="(.*?)"', text))


def test_page_without_convergence_speaks_of_the_chains_alone() -> None:
    """Which parameter lags; nothing of the others, even if their pictures are handed in."""
    text = page(example.run(converged=False))
    assert ["2103", "2203", "1.0040"] == rows(text, "sampling")["stiff, k"]
    assert ["trace", "ranks"] == re.findall(r'<figure id="(.*?)">', text)
    text = re.sub(r'src="data:[^"]*"', "", text).lower()
    for word in ("95", "band", "median</th>", "coverage", "validation", "mcse", "truth"):
        assert word not in text
