"""Every form in which a bench writes a record is read, with as little said as possible."""

import warnings
from datetime import UTC, datetime, timedelta
from pathlib import Path

import h5py
import numpy as np
import pytest
import scipy.io
from hypothesis import example, given, strategies as st

from bwbayes.errors import ColumnsError, InputError, InputWarning
from bwbayes.record import Record, read_record
from tests.record.conftest import quiet
from tests.record.instruments import DISPLACEMENT, INTERVAL, TIME, VOLTAGE, Written
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

    What nobody can guess, a sensitivity or a rate, is left open, and refused as it is.
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
            # Of columns without names, which of two is meant nobody can guess.
            assert np.corrcoef(np.asarray(values), right)[0, 1] > 0.99
        timeless = {"no times at all", "no names and no times", "numbered samples"}
        timeless |= {name for name in INSTRUMENTS if name.startswith("recorder, settings above")}
        assert (error.fs is not None) == (name in timeless | {"data recorder of PI"})
    else:
        assert error is None


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
    """Of days and months; also minutes and seconds alone, as Excel writes them, after an hour."""
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
    """Of the file, of a group and of a dataset; none is taken from what is no rate."""
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
