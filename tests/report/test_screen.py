"""A table fits the screen, or the log, that it is shown on: nothing of it is cut off."""

import hypothesis.strategies as st
from hypothesis import given

from bwbayes.report.report import Report, Table, as_text

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
    # Of wrapped texts the letters are all there, once; those of the rows' names in every part.
    shown, named = "".join(lines), 0
    parts = max(shown.count("─") // max(line.count("─") for line in lines), 1)
    for number, column in enumerate(zip(table.columns, *table.rows, strict=True)):
        named += sum(str(text).count("a") for text in column) * (1 if number else parts)
    assert shown.count("a") >= named


def test_a_table_that_fits_is_one() -> None:
    table = Table("n", "C", ["Name", "First", "Second"], [["a", "1 um", "2 um"]], on="both")
    assert 1 == sum("─" in line for line in as_text(Report(title="", blocks=[table])).splitlines())
