"""Every form in which a bench writes a record is read, with as little said as possible."""

import gzip
import math
import warnings
from codecs import BOM_UTF8
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
import scipy.io
from hypothesis import assume, example, given, strategies as st
from openpyxl import Workbook

from bwbayes.errors import ColumnsError, InputError, InputWarning
from bwbayes.record import Record, read_record
from bwbayes.record.io import formats
from bwbayes.record.io.series import Source, array_source
from tests.record.conftest import quiet
from tests.record.instruments import DISPLACEMENT, INTERVAL, TEXTS, TIME, VOLTAGE, Written
from tests.record.makers import INSTRUMENTS


def read(written: Written) -> Record:
    path, columns, units, fs = written
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", InputWarning)
        return read_record(path, columns=columns, units=units, fs=fs)


@pytest.mark.parametrize("name", INSTRUMENTS)
def test_every_form_is_the_same_record(tmp_path: Path, name: str) -> None:
    record = read(INSTRUMENTS[name](tmp_path))
    assert record.interval == pytest.approx(INTERVAL, rel=1e-9)
    assert 0.0 == record.start
    np.testing.assert_allclose(record.voltage, VOLTAGE, rtol=1e-6, atol=1e-6)
    assert record.displacement is not None
    np.testing.assert_allclose(record.displacement, DISPLACEMENT, rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize("name", INSTRUMENTS)
def test_what_is_left_open_is_asked_for_once(tmp_path: Path, name: str) -> None:
    """Without a word from the user a file is read, or one message has a guess that reads it.

    A sensitivity or a rate, which nobody can guess, is left open, and refused as it is.
    """
    written = INSTRUMENTS[name](tmp_path)
    alone, error = written._replace(columns={}, units={}, fs=None), None
    try:
        read(alone)
    except InputError as raised:
        error = raised
    if isinstance(error, ColumnsError):
        columns, units = error.guess["columns"], error.guess["units"]
        if any(unit.startswith("? ") for unit in units.values()):
            with pytest.raises(InputError, match=r"in '\? \w+' is unknown; write .*'0.35 um'"):
                read(Written(written.path, columns, units))
        units = {quantity: unit.replace("? ", "1 ") for quantity, unit in units.items()}
        fs = 1000.0 if isinstance(error.fs, str) else error.fs
        record = read(Written(written.path, columns, units, fs))
        assert 600 == record.samples
        for values, right in ((record.voltage, VOLTAGE), (record.displacement, DISPLACEMENT)):
            # Nobody can guess which of two columns without names is meant.
            assert np.corrcoef(np.asarray(values), right)[0, 1] > 0.99
        timeless = {"no times at all", "no names and no times", "numbered samples"}
        timeless |= {name for name in INSTRUMENTS if name.startswith("recorder, settings above")}
        assert (error.fs is not None) == (name in timeless | {"data recorder of PI"})
    else:
        assert error is None


@pytest.mark.parametrize("name", INSTRUMENTS)
def test_every_text_may_be_packed_by_gzip_and_no_other_file(tmp_path: Path, name: str) -> None:
    written = INSTRUMENTS[name](tmp_path)
    packed = written.path.with_name(f"{written.path.name}.gz")
    packed.write_bytes(gzip.compress(written.path.read_bytes()))
    if name in TEXTS:
        record = read(written._replace(path=packed))
        np.testing.assert_array_equal(record.voltage, read(written).voltage)
    else:
        with pytest.raises(InputError, match=r"\.gz: packed by gzip, .*; unpack it$"):
            read(written._replace(path=packed))


def read_marked(path: Path) -> Source:
    """Read a text with a mark above its rows of V and um at a known interval."""
    _, *rows = path.read_text(encoding="utf-8-sig").splitlines()
    voltage, displacement = np.array([row.split() for row in rows], dtype=float).T
    return array_source(path.name, {"voltage_V": voltage, "displacement_um": displacement}, 5e-3)


def test_a_text_format_is_told_by_its_mark_behind_a_byte_order_mark(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its reader gets it, and none of it is taken for columns by the reader of any text."""
    added = formats.Format(b"SCOPE TEXT", ".scp", f"{__name__}:read_marked")
    monkeypatch.setattr(formats, "FORMATS", (*formats.FORMATS, added))
    rows = [f"{v} {d}" for v, d in zip(VOLTAGE, DISPLACEMENT, strict=True)]
    content = "\n".join(["SCOPE TEXT", *rows]).encode()
    for before in (b"", BOM_UTF8):
        (tmp_path / "a.txt").write_bytes(before + content)
        record = read_record(tmp_path / "a.txt")
        assert record.interval == INTERVAL
        np.testing.assert_array_equal(record.displacement, DISPLACEMENT)
        (tmp_path / "a.gz").write_bytes(gzip.compress(before + content))
        with pytest.raises(InputError, match=r"a\.gz: packed by gzip, .*; unpack it$"):
            read_record(tmp_path / "a.gz")


def test_a_clock_counts_from_the_first_sample_and_is_kept(tmp_path: Path) -> None:
    record = read(INSTRUMENTS["Unix time in ms"](tmp_path))
    assert (0.0, 1_772_539_199.0) == (record.start, record.time_offset)
    dated = read(INSTRUMENTS["logger with dates"](tmp_path))
    assert (0.0, 1_772_539_199.0) == (dated.start, dated.time_offset)


@given(st.integers(0, 86_399), st.sampled_from(["{:%H:%M:%S.%f}", "{:%H:%M:%S.%f},{:%Y-%m-%d}"]))
def test_times_of_day_go_on_after_midnight(folder: Path, start: int, form: str) -> None:
    names = f"Time,{'Date,' * ('%Y' in form)}voltage_V,displacement_um"
    begin = datetime(2026, 3, 3, tzinfo=UTC) + timedelta(seconds=start)
    rows = [
        f"{form.format(*2 * [begin + timedelta(seconds=t)])},{v},{d}"
        for t, v, d in zip(TIME, VOLTAGE, DISPLACEMENT, strict=True)
    ]
    path = folder / "clock.csv"
    path.write_text("\n".join([names, *rows]) + "\n")
    record = read(Written(path))
    assert (INTERVAL, float(start)) == (record.interval, record.start)
    np.testing.assert_allclose(record.voltage, VOLTAGE)


@given(
    st.datetimes(datetime(2001, 1, 2), datetime(2059, 12, 29)),
    st.sampled_from(
        ["{:%d.%m.%Y %H:%M:%S.%f}", "{:%m/%d/%Y %H:%M:%S.%f}", "{:%d/%m/%y %H:%M:%S,%f}"]
    ),
    st.booleans(),
)
@example(datetime(2026, 5, 3), "{:%d.%m.%Y %H:%M:%S.%f}", True)
def test_dates_go_on_after_midnight_whatever_their_order(
    folder: Path, day: datetime, form: str, over_midnight: bool
) -> None:
    """Days and months; also minutes and seconds alone, as Excel writes them, after an hour."""
    begin = day.replace(hour=0, minute=0, second=0, microsecond=0)
    begin -= timedelta(seconds=1 * over_midnight)
    for written in (form, "{:%M:%S.%f}"):
        rows = [
            f'"{written.format(begin + timedelta(seconds=t))}",{v},{d}'
            for t, v, d in zip(TIME, VOLTAGE, DISPLACEMENT, strict=True)
        ]
        path = folder / "dates.csv"
        path.write_text("\n".join(["Time,voltage_V,displacement_um", *rows]) + "\n")
        record = read(Written(path))
        assert (INTERVAL, TIME.size) == (record.interval, record.samples)
        np.testing.assert_array_equal(record.voltage, VOLTAGE)


@pytest.mark.parametrize(
    ("name", "value"), [("fs", 200.0), ("Sample_Rate", 200.0), ("dt", 0.005), ("gain", None)]
)
def test_a_rate_beside_the_numbers_is_the_one_to_copy(
    tmp_path: Path, name: str, value: float | None
) -> None:
    log = {"u_V": VOLTAGE, "x_um": DISPLACEMENT, name: value or 200.0}
    scipy.io.savemat(tmp_path / "a.mat", {"log": log})
    with pytest.raises(ColumnsError) as caught:
        read_record(tmp_path / "a.mat")
    assert (200.0 if value else "HZ") == caught.value.fs


@pytest.mark.parametrize("place", ["/", "/run", "/run/u_V"])
@pytest.mark.parametrize(("name", "value"), [("fs", 200), ("Sampling_Rate", 200.0), ("dt", 0.005)])
def test_a_rate_among_the_attributes_is_the_one_to_copy(
    tmp_path: Path, place: str, name: str, value: float
) -> None:
    """Rates of the file, of a group and of a dataset; none is taken from what is no rate."""
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["run/u_V"], file["run/x_um"] = VOLTAGE, DISPLACEMENT
        file[place].attrs[name] = value
        file["run"].attrs["rate"] = "fast"
        file["run/x_um"].attrs["interval"] = 0.0
    with pytest.raises(ColumnsError, match="; say fs=200") as caught:
        read_record(tmp_path / "a.h5")
    assert 200.0 == caught.value.fs


@quiet
def test_a_rate_in_a_line_above_the_header_is_the_one_to_copy(tmp_path: Path) -> None:
    rows = [f"{v:.3f},{d:.6f}" for v, d in zip(VOLTAGE, DISPLACEMENT, strict=True)]
    for line in ("# dt: 0.005", "# SAMPLE_TIME = 5e-3 s", "Sample Rate (Hz): 200", "fs,200 Hz,"):
        (tmp_path / "a.csv").write_text("\n".join([line, "u_V,x_um", *rows, ""]))
        with pytest.raises(ColumnsError, match="; say fs=200"):
            read_record(tmp_path / "a.csv")


def test_lines_above_the_header_are_skipped_with_a_remark(tmp_path: Path) -> None:
    path = INSTRUMENTS["Excel, German, cp1252, preamble"](tmp_path).path
    with (
        pytest.warns(InputWarning, match=r"a.csv:1: 3 lines above the header skipped"),
        pytest.warns(InputWarning, match=r"a.csv:5: ignored columns: Bemerkung"),
    ):
        read_record(path)


def test_tdms_needs_its_extra(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = INSTRUMENTS["TDMS waveforms"](tmp_path).path
    monkeypatch.setitem(__import__("sys").modules, "nptdms", None)
    with pytest.raises(InputError, match=r"npTDMS; pip install 'bwbayes\[tdms\]'"):
        read_record(path)


def test_a_rate_above_the_header_is_asked_for_unless_the_length_beside_it_is_right(
    tmp_path: Path,
) -> None:
    """Else the preamble may be that of another record; the units stand in any case."""
    written = INSTRUMENTS["oscilloscope, rate above the header in place of times"](tmp_path)
    text = written.path.read_text()
    for length in ("Record Length,599", "Points,600"):
        written.path.write_text(text.replace("Record Length,600", length))
        with pytest.raises(ColumnsError, match="sampling rate") as caught:
            read(written)
        assert ({}, 200.0) == (caught.value.guess["units"], caught.value.fs)


# One of several tables in a file is read, the one that is chosen; cells give their values


HEADERS = ("time_s,voltage_V,displacement_um", "t [s],U [V],x [um]", "Time,Drive,Pos\ns,V,um")
Cells = list[tuple[float, float, float]]


def tables(lengths: list[int]) -> list[Cells]:
    """Return so many rows of the record, from its start on in each table but other voltages."""
    return [
        [
            (float(t), float(scale * v), float(d))
            for t, v, d in zip(TIME[:n], VOLTAGE, DISPLACEMENT, strict=False)
        ]
        for scale, n in enumerate(lengths, start=1)
    ]


def written(path: Path, headers: list[str], titles: list[str], content: list[Cells]) -> None:
    lines = []
    for header, title, rows in zip(headers, titles, content, strict=True):
        lines += [title, header, *(",".join(map(repr, row)) for row in rows), ""]
    path.write_text("\n".join(lines))


def assert_holds(path: Path, table: Any, rows: Cells) -> None:
    record = read_record(path, table=table)
    assert record.displacement is not None
    _, voltage, displacement = np.array(rows).T
    np.testing.assert_allclose(record.voltage, voltage, rtol=1e-15)
    np.testing.assert_allclose(record.displacement, displacement, rtol=1e-15)


@quiet
@given(
    st.lists(
        st.tuples(
            st.sampled_from(HEADERS),
            st.sampled_from(["", "Run 7", "3.3.2026 12:00", "Sample Interval,0.005", "# new run"]),
            st.integers(12, 40),
        ),
        min_size=2,
        max_size=4,
    ),
    st.data(),
)
def test_a_table_of_a_text_is_read_as_if_it_stood_alone(
    folder: Path, blocks: list[tuple[str, str, int]], data: st.DataObject
) -> None:
    headers, titles, lengths = ([block[i] for block in blocks] for i in range(3))
    path = folder / "tables.csv"
    content = tables(lengths)  # type: ignore[arg-type]
    written(path, headers, titles, content)  # type: ignore[arg-type]
    number = data.draw(st.integers(1, len(blocks)))
    assert_holds(path, data.draw(st.sampled_from([number, str(number)])), content[number - 1])
    with pytest.raises(InputError, match=rf"{len(blocks)} tables with numbers: 1 .*, as `table=1`"):
        read_record(path)
    for wrong in (0, len(blocks) + 1, "Run 8"):
        with pytest.raises(InputError, match=f"no table {wrong!r}; choose from 1 "):
            read_record(path, table=wrong)


@quiet
@given(
    st.lists(st.integers(12, 40), min_size=2, max_size=4),
    st.sampled_from([*HEADERS[:2], ""]),
    st.sampled_from(["", "\n"]),
    st.sampled_from([",", "\t", ";"]),
    st.data(),
)
def test_a_block_below_an_empty_line_in_which_times_begin_again_is_a_table(
    folder: Path, lengths: list[int], header: str, between: str, separator: str, data: st.DataObject
) -> None:
    content = tables(lengths)
    blocks = ["\n".join(separator.join(map(repr, row)) for row in rows) for rows in content]
    path = folder / "blocks.csv"
    header = header.replace(",", separator)
    path.write_text(f"{header}\n{f'\n{between}\n'.join(blocks)}\n")
    number = data.draw(st.integers(1, len(blocks)))
    naming: dict[str, Any] = {
        "columns": {"time": 1, "voltage": 2, "displacement": 3},
        "units": {"time": "s", "voltage": "V", "displacement": "um"},
    }
    record = read_record(path, table=number, **({} if header else naming))
    np.testing.assert_allclose(record.voltage, np.array(content[number - 1])[:, 1], rtol=1e-15)
    listed = ", ".join(rf"{i} '.*' \({n} rows.*\)" for i, n in enumerate(lengths, start=1))
    with pytest.raises(InputError, match=f"tables with numbers: {listed}; choose one"):
        read_record(path)


@quiet
@pytest.mark.parametrize("between", ["", "# paused", HEADERS[0], "\n\n"])
def test_a_table_goes_on_after_a_pause(tmp_path: Path, between: str) -> None:
    """With the header once more, an empty line or a comment, and alone it has number 1."""
    (rows,) = tables([60])
    lines = [",".join(map(repr, row)) for row in rows]
    text = "\n".join([HEADERS[0], *lines[:30], between, *lines[30:], ""])
    (tmp_path / "a.csv").write_text(text)
    for table in (None, 1, "1"):
        assert_holds(tmp_path / "a.csv", table, rows)


@quiet
def test_an_error_in_a_table_names_the_line_of_the_file(tmp_path: Path) -> None:
    written(tmp_path / "a.csv", [HEADERS[0]] * 2, ["one", "two"], tables([20, 20]))
    lines = (tmp_path / "a.csv").read_text().split("\n")
    lines[30] = "0.03,what,1.0"
    (tmp_path / "a.csv").write_text("\n".join(lines))
    with pytest.raises(InputError, match=r"a\.csv:31: voltage_V: 'what'"):
        read_record(tmp_path / "a.csv", table="two")


@quiet
def test_a_sheet_is_chosen_by_number_or_name_among_those_with_numbers(tmp_path: Path) -> None:
    from openpyxl import Workbook  # noqa: PLC0415  # an extra

    book, content = Workbook(), tables([20, 30, 40])
    book.active.title = "Notes"
    book.active.append(["bench", 3])
    for title, rows in zip(("up", "2", "down"), content, strict=True):
        sheet = book.create_sheet(title)
        for row in (["t [s]", "U [V]", "x [um]"], *rows):
            sheet.append(row)
    path = tmp_path / "a.xlsx"
    book.save(path)
    for table, rows in zip((1, "2", "down", 3), [*content, content[2]], strict=True):
        assert_holds(path, table, rows)
    with pytest.raises(InputError, match=r"3 tables with numbers: 1 'up', 2 '2', 3 'down'; choose"):
        read_record(path)
    with pytest.raises(InputError, match="no table 'Note'; choose from 1 'up'"):
        read_record(path, table="Note")


EPOCH = datetime(1899, 12, 30)  # cells have no zone
FORMATS = {
    "duration": "[h]:mm:ss.000",
    "time of day": "hh:mm:ss.0",
    "date": "yyyy-mm-dd hh:mm:ss",
    "minutes": "[mm]:ss",
}


@given(
    st.sampled_from([*FORMATS]),
    st.sampled_from([1e-5, 2e-5, 1e-4, 4e-4, 5e-3, 0.25]),
    st.floats(0, 0.9).map(lambda days: round(days, 5)),
    st.booleans(),
)
@example("duration", 0.25, 0.99999, False)  # beyond a day
@example("date", 1e-5, 0.0, True)
@example("date", 2e-5, 0.45039, True)
def test_times_are_as_fine_as_their_numbers_however_they_are_shown(
    folder: Path, shown: str, dt: float, start: float, by_python: bool
) -> None:
    """As 15 digits of days, or as openpyxl writes Python's times; both far below 1 ms."""
    # 15 digits of a date's days are 9 us.
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
