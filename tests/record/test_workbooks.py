"""What a cell of a workbook shows and what it holds are two things: what it holds is read."""

import math
from datetime import datetime, timedelta
from pathlib import Path

import numpy as np
import pytest
from hypothesis import assume, example, given, settings, strategies as st
from openpyxl import Workbook

from bwbayes.errors import InputError
from bwbayes.record import read_record
from tests.record.instruments import DISPLACEMENT, VOLTAGE
from tests.record.makers import INSTRUMENTS

EPOCH = datetime(1899, 12, 30)  # cells have no zone
FORMATS = {
    "duration": "[h]:mm:ss.000",
    "time of day": "hh:mm:ss.0",
    "date": "yyyy-mm-dd hh:mm:ss",
    "minutes": "[mm]:ss",
}


@settings(max_examples=25)
@given(
    st.sampled_from([*FORMATS]),
    st.sampled_from([1e-5, 2e-5, 1e-4, 4e-4, 5e-3, 0.25]),
    st.floats(0, 0.9).map(lambda days: round(days, 5)),
    st.booleans(),
)
@example("duration", 0.25, 0.99999, False)  # beyond a day
@example("date", 1e-5, 0.0, True)
def test_times_are_as_fine_as_their_numbers_however_they_are_shown(
    folder: Path, shown: str, dt: float, start: float, by_python: bool
) -> None:
    """As 15 digits of days, or as openpyxl writes Python's times; both far below 1 ms."""
    # Of a date 15 digits of days are 9 us.
    assume(by_python or shown != "date" or dt > 2e-5)
    book = Workbook()
    book.active.append(["Time", "U [V]", "x [um]"])
    whole_days = 46_084 if shown == "date" else 0
    for i, (v, d) in enumerate(zip(VOLTAGE[:60], DISPLACEMENT[:60], strict=True)):
        delta = timedelta(days=whole_days + start, seconds=i * dt)
        days = float(f"{whole_days + start + i * dt / 86400:.15g}")
        value = (EPOCH + delta if shown == "date" else delta) if by_python else days
        book.active.append([value, v, d])
        book.active.cell(i + 2, 1).number_format = FORMATS[shown]
    path = folder / "times.xlsx"
    book.save(path)
    record = read_record(path)
    assert record.interval == pytest.approx(dt, rel=1e-9)
    np.testing.assert_allclose(record.voltage, VOLTAGE[:60], rtol=1e-12)
    since = (datetime(1970, 1, 1) - EPOCH) / timedelta(seconds=1)
    expected = (whole_days + start) * 86400 - (since if shown == "date" else 0)
    assert math.isclose(record.start + record.time_offset, expected, rel_tol=0, abs_tol=2e-5)


def test_a_workbook_needs_its_extra(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = INSTRUMENTS["pandas to Excel, with dates"](tmp_path).path
    monkeypatch.setitem(__import__("sys").modules, "openpyxl", None)
    with pytest.raises(InputError, match=r"a\.xlsx: .* openpyxl; pip install 'bwbayes\[xlsx\]'"):
        read_record(path)


def test_a_workbook_without_numbers_or_that_is_cut_off_is_refused_in_a_line(tmp_path: Path) -> None:
    book = Workbook()
    book.active.append(["nothing", "here"])
    book.save(tmp_path / "a.xlsx")
    with pytest.raises(InputError, match="no sheet has columns of numbers"):
        read_record(tmp_path / "a.xlsx")
    content = INSTRUMENTS["pandas to Excel, with dates"](tmp_path).path.read_bytes()
    (tmp_path / "a.xlsx").write_bytes(content[: len(content) // 2])
    with pytest.raises(InputError, match="damaged or cut off"):
        read_record(tmp_path / "a.xlsx")
