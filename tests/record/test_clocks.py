"""Channels with clocks of their own are put together by their times."""

import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from bwbayes.errors import InputError, InputWarning
from bwbayes.record import Record, read_record

INTERVAL = 0.004  # s
BEGIN = np.datetime64("2026-03-03T16:00:00.000000")
CHOICE: Any = {
    "columns": {"voltage": "Voltage", "displacement": "Position"},
    "units": {"voltage": "V", "displacement": "um"},
}


def voltage_at(time: Any) -> Any:
    return 60 * np.sin(7 * time)


def displacement_at(time: Any) -> Any:
    return 3 * time + 1  # moving along the slope keeps what is linear


def tdms(path: Path, delay: float, ratio: float, *, by_offset: bool) -> Path:
    """Write a displacement that starts s after the voltage, at a multiple of its interval."""
    from nptdms import ChannelObject, TdmsWriter  # noqa: PLC0415  # an extra

    start = {"wf_start_offset": 0.0, "wf_start_time": BEGIN}
    later = {"wf_start_offset": delay, "wf_start_time": BEGIN}
    if not by_offset:
        later = {
            "wf_start_offset": 0.0,
            "wf_start_time": BEGIN + np.timedelta64(round(1e6 * delay), "us"),
        }
    time = INTERVAL * np.arange(300)
    read = delay + INTERVAL * ratio * np.arange(round(300 / ratio))
    channels = [
        ChannelObject("d", "Voltage", voltage_at(time), {"wf_increment": INTERVAL} | start),
        ChannelObject(
            "d", "Position", displacement_at(read), {"wf_increment": INTERVAL * ratio} | later
        ),
    ]
    with TdmsWriter(path) as file:
        file.write_segment(channels)
    return path


def lvm(path: Path, delay: float, *, x_columns: str) -> Path:
    """Write LabVIEW's text of two channels, whose first values are later than each other."""
    time = INTERVAL * np.arange(300)
    multi = x_columns == "Multi"
    pad = "\t" if multi else ""
    head = [
        *("LabVIEW Measurement\t", "Separator\tTab", "Decimal_Separator\t."),
        *(f"X_Columns\t{x_columns}", "Time_Pref\tRelative", "***End_of_Header***\t", "\t"),
        *("Channels\t2\t\t", f"Samples\t300\t{pad}300\t", f"Y_Unit_Label\tV\t{pad}um\t"),
        *(f"X_Dimension\tTime\t{pad}Time\t", f"X0\t0.0\t{pad}{delay!r}\t"),
        *(f"Delta_X\t{INTERVAL}\t{pad}{INTERVAL}\t", "***End_of_Header***\t\t\t"),
        f"X_Value\tVoltage\t{'X_Value\t' * multi}Position\tComment",
    ]
    first = [""] * 300 if x_columns == "No" else [f"{t:.6f}" for t in time]
    columns = [first, voltage_at(time), displacement_at(time + delay)]
    if multi:
        columns.insert(2, time + delay)
    rows = ["\t".join(map(str, row)) + "\t" for row in zip(*columns, strict=True)]
    path.write_text("\n".join([*head, *rows, ""]))
    return path


def check(record: Record, delay: float, ratio: float) -> None:
    np.testing.assert_allclose(record.voltage, voltage_at(record.time), atol=1e-5)
    assert record.displacement is not None
    readings = record.displacement[record.has_reading]
    # A time within 1% of an interval of the grid counts as on it.
    expected = displacement_at(record.time[record.has_reading])
    np.testing.assert_allclose(readings, expected, atol=0.0101 * 3 * INTERVAL)
    first, end = max(0.0, delay), min(300, 300 + delay / INTERVAL) * INTERVAL
    slow = max(ratio, 1.0)
    assert abs(record.start - first) <= (slow + 0.5) * INTERVAL
    assert abs(record.start + record.duration - end) <= (slow + 1.5) * INTERVAL
    assert readings.size >= record.samples / slow - 1


@given(st.floats(-0.5, 0.5), st.sampled_from([1.0, 0.2, 0.7, 2.0, 5.0]), st.booleans())
def test_tdms_channels_are_put_together_by_their_times(
    tmp_path_factory: pytest.TempPathFactory, delay: float, ratio: float, by_offset: bool
) -> None:
    delay = round(delay, 6)  # wf_start_time is written to the microsecond
    path = tdms(tmp_path_factory.getbasetemp() / "a.tdms", delay, ratio, by_offset=by_offset)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", InputWarning)
        record = read_record(path, **CHOICE)
    assert any("cut to their common" in str(one.message) for one in caught) or (
        ratio == 1 and abs(delay) <= 0.01 * INTERVAL
    )
    check(record, delay, ratio)


@given(st.integers(-100, 100), st.sampled_from(["One", "No", "Multi"]))
def test_whole_samples_between_lvm_channels_move_no_reading(
    tmp_path_factory: pytest.TempPathFactory, shift: int, x_columns: str
) -> None:
    delay = shift * INTERVAL
    path = lvm(tmp_path_factory.getbasetemp() / "a.lvm", delay, x_columns=x_columns)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", InputWarning)
        record = read_record(path, columns=CHOICE["columns"])
    check(record, delay, 1.0)
    assert record.samples == 300 - abs(shift)
    written = displacement_at(INTERVAL * np.arange(300) + delay)
    np.testing.assert_array_equal(record.displacement, written[max(-shift, 0) :][: record.samples])


def test_channels_without_a_common_time_are_refused_unless_a_rate_is_given(tmp_path: Path) -> None:
    path = tdms(tmp_path / "a.tdms", 100.0, 1.0, by_offset=False)
    with pytest.raises(InputError, match="starts 100 s after 'd/Voltage', and they have no time"):
        read_record(path, **CHOICE)
    assert 300 == read_record(path, **CHOICE, fs=250).samples
