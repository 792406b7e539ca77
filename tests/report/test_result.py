"""The numbers of a summary are those of the draws, and tables fit the screen that shows them."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, strategies as st

from bwbayes import Prediction, Run
from bwbayes.arrays import FloatArray
from bwbayes.diagnosis.validation import BandValidation
from bwbayes.errors import Renamed
from bwbayes.prediction.bands import Bands
from bwbayes.report.report import Report, Table, as_text, length_text
from bwbayes.report.result import Result, summary, write_bands
from bwbayes.sampling.diagnostics import check
from tests.app import example
from tests.app.example import bands
from tests.stand import autoregressive


def parameters(draws: FloatArray) -> dict[str, dict[str, float]]:
    steps, ensembles, walkers, _ = draws.shape
    accepted = np.full((steps // 50, ensembles, walkers), 20)
    run = example.run(values=draws)
    outcome = replace(run.outcome, check=check(draws, accepted, 50))
    table: Any = summary(replace(run, outcome=outcome))["parameters"]
    return dict(table)


def test_intervals_leave_two_and_a_half_percent_on_either_side() -> None:
    """Draws at k/4000, shuffled, have known quantiles."""
    generator = np.random.default_rng(1)
    even = np.stack([generator.permutation(4000) for _ in range(4)], axis=1) / 4000
    for row in parameters(even.reshape(100, 4, 10, 4)).values():
        assert 0.025 == pytest.approx(row["lower_95"], abs=1e-3)
        assert 0.5 == pytest.approx(row["median"], abs=1e-3)
        assert 0.975 == pytest.approx(row["upper_95"], abs=1e-3)
        assert 0.5 == pytest.approx(row["mean"], abs=1e-3)
        assert 12**-0.5 == pytest.approx(row["sd"], abs=1e-3)


def test_the_means_error_is_that_of_a_known_process() -> None:
    """The mean of N draws of AR(1) series has the sd s √((1 + φ)/((1 − φ) N)); within a fifth."""
    kept = 0.5
    draws = 7.0 + 3.0 * autoregressive(kept, 600, (4, 16, 4), np.random.default_rng(2))
    expected = 3.0 * np.sqrt((1 + kept) / (1 - kept) / (600 * 4 * 16))
    for row in parameters(draws).values():
        assert expected == pytest.approx(row["mcse_mean"], rel=0.2)


@pytest.mark.parametrize("passed", [True, False, None])
def test_drives_are_validated_only_where_all_bands_passed(passed: bool | None) -> None:
    run = replace(example.run(), facts={"drive": "0 to 95 V"})
    verdict = BandValidation("verification", training=False, passed=passed)
    validated = summary(replace(run, validation={"verification": verdict}))["validated_drives"]
    assert validated == ("0 to 95 V" if passed else None)


def moved(one: Bands, offset: float, factor: float) -> Bands:
    """Return bands of a displacement in other proportions, one reading of which is missing."""

    def change(values: FloatArray) -> FloatArray:
        return factor * values + offset

    assert one.measured is not None
    measured = change(one.measured)
    measured[7] = np.nan
    return replace(
        one,
        mean=change(one.mean),
        measured=measured,
        lower={key: change(edge) for key, edge in one.lower.items()},
        upper={key: change(edge) for key, edge in one.upper.items()},
    )


@pytest.mark.parametrize(
    ("offset", "factor"), [(0.0, 1.0), (12_345.6, 0.01), (-9e7, 1e-3), (5.0, 0.0)]
)
def test_bands_have_the_digits_of_their_range(tmp_path: Path, offset: float, factor: float) -> None:
    """A sensor that reads 12,345.6 um while the displacement moves by 1.2 um."""
    made = moved(bands(samples=400, lead_in=10), offset, factor)
    write_bands(tmp_path / "bands.csv", [made])
    table = np.genfromtxt(tmp_path / "bands.csv", delimiter=",", names=True)
    for name, column in made.columns():
        span = np.nanmax(column) - np.nanmin(column)
        atol = max(1e-6 * span, 1e-7 * abs(offset) * (span == 0), 1e-15 * abs(offset))
        np.testing.assert_allclose(table[name], column, rtol=0, atol=atol, err_msg=name)


@given(st.floats(1e-9, 1e5))
def test_a_length_keeps_three_digits_at_any_size(um: float) -> None:
    text = length_text(um)
    assert text.endswith(" µm")
    np.testing.assert_allclose(float(text[:-3]), um, rtol=0.0051)


@pytest.mark.parametrize(
    ("kind", "name"),
    [(k, n) for k in (Result, Run, Prediction) for n, v in vars(k).items() if type(v) is Renamed],
)
def test_an_earlier_name_is_told_the_new_one(kind: type, name: str) -> None:
    now = vars(kind)[name].now
    assert now in {*dir(kind), *getattr(kind, "__dataclass_fields__", ())}
    with pytest.raises(AttributeError, match=f"no attribute {name!r}; it is {now} now"):
        getattr(kind, name)


TEXTS = st.text("abcdefg 0123456789.+-", min_size=1, max_size=60).map(str.strip).filter(bool)


@st.composite
def tables(draw: st.DrawFn) -> Table:
    columns = draw(st.lists(TEXTS, min_size=1, max_size=9))
    row = st.lists(TEXTS, min_size=len(columns), max_size=len(columns))
    rows = draw(st.lists(row, min_size=1, max_size=4))
    return Table("name", "Caption", columns, rows, on="both")


@given(tables(), st.integers(40, 130))
def test_every_table_is_shown_whole_at_every_width(table: Table, width: int) -> None:
    lines = as_text(Report(title="", blocks=[table]), width).splitlines()
    assert max(map(len, lines)) <= width
    # All letters of wrapped texts are there, once; those of the rows' names in every part.
    shown, named = "".join(lines), 0
    parts = max(shown.count("─") // max(line.count("─") for line in lines), 1)
    for number, column in enumerate(zip(table.columns, *table.rows, strict=True)):
        named += sum(str(text).count("a") for text in column) * (1 if number else parts)
    assert shown.count("a") >= named


def test_a_table_that_fits_is_one() -> None:
    table = Table("n", "C", ["Name", "First", "Second"], [["a", "1 um", "2 um"]], on="both")
    assert 1 == sum("─" in line for line in as_text(Report(title="", blocks=[table])).splitlines())
