"""Series with times or clocks of their own are put together by these, and units beside count."""

import warnings
from collections.abc import Callable
from io import BytesIO
from itertools import zip_longest
from pathlib import Path
from typing import Any, Literal

import h5py
import numpy as np
import pytest
import scipy.io
from hypothesis import given, strategies as st
from nptdms import ChannelObject, TdmsWriter

from bwbayes.errors import InputError, InputWarning
from bwbayes.record import Record, read_record
from tests.record.conftest import quiet

INTERVAL = 0.004  # s
BEGIN = np.datetime64("2026-03-03T16:00:00.000000")

type Channels = dict[str, tuple[Any, Any, str]]
"""Times, s, values and unit by the name of a channel."""

KINDS: dict[str, Callable[[Path, Channels], dict[str, str]]] = {}


def voltage_at(time: Any) -> Any:
    return 60 * np.sin(7 * time)


def displacement_at(time: Any) -> Any:
    return 3 * time + 1  # moving along the slope keeps what is linear


def _kind[T: Callable[[Path, Channels], dict[str, str]]](write: T) -> T:
    KINDS[write.__name__] = write
    return write


@_kind
def text(path: Path, channels: Channels) -> dict[str, str]:
    """Columns of times before those of values; what is shorter ends in empty cells."""
    head = [f"Time (s),{name} ({unit})" for name, (_, _, unit) in channels.items()]
    columns = [column for times, values, _ in channels.values() for column in (times, values)]
    rows = zip_longest(*columns)
    lines = [",".join("" if v is None else f"{v:.9f}" for v in row) for row in rows]
    path.write_text("\n".join([",".join(head), *lines, ""]))
    return {q: f"{q} ({unit})" for q, (_, _, unit) in channels.items()}


@_kind
def hdf5(path: Path, channels: Channels) -> dict[str, str]:
    with h5py.File(path, "w") as file:
        for name, (times, values, unit) in channels.items():
            for key, series, stated in (("t", times, "s"), ("data", values, unit)):
                file[f"{name}/{key}"] = series
                file[f"{name}/{key}"].attrs["unit"] = stated
    return {name: f"{name}/data" for name in channels}


@_kind
def mat(
    path: Path, channels: Channels, second: float = 1.0, word: str = "seconds"
) -> dict[str, str]:
    structs = {
        name: {
            **{"Time": second * times[:, None], "Data": values[:, None]},
            **{"DataInfo": {"Units": unit}, "TimeInfo": {"Units": word}},
        }
        for name, (times, values, unit) in channels.items()
    }
    scipy.io.savemat(path, structs, appendmat=False)
    return {name: f"{name}.Data" for name in channels}


@_kind
def mat_in_milliseconds(path: Path, channels: Channels) -> dict[str, str]:
    return mat(path, channels, 1e3, "milliseconds")


def _text_of(group: h5py.Group, name: str, words: str) -> None:
    codes = np.frombuffer(words.encode("utf-16-le"), dtype="<u2")
    group[name] = codes[:, np.newaxis]
    group[name].attrs["MATLAB_class"] = np.bytes_("char")


@_kind
def mat_73(path: Path, channels: Channels) -> dict[str, str]:
    content = BytesIO()
    with h5py.File(content, "w", userblock_size=512) as file:
        for name, (times, values, unit) in channels.items():
            struct = file.create_group(name)
            struct["Time"], struct["Data"] = times[np.newaxis], values[np.newaxis]
            _text_of(struct.create_group("DataInfo"), "Units", unit)
            _text_of(struct.create_group("TimeInfo"), "Units", "seconds")
    content.seek(0)
    content.write(b"MATLAB 7.3 MAT-file".ljust(116) + bytes(8) + b"\0\2IM")
    path.write_bytes(content.getvalue())
    return {name: f"{name}/Data" for name in channels}


@_kind
def tdms(path: Path, channels: Channels, by_offset: bool = False) -> dict[str, str]:
    with TdmsWriter(path) as file:
        file.write_segment(
            [
                ChannelObject(
                    *("d", name, values),
                    {
                        "wf_increment": np.median(np.diff(times)),
                        "wf_start_offset": times[0] if by_offset else 0.0,
                        "wf_start_time": BEGIN
                        + np.timedelta64(0 if by_offset else round(1e6 * times[0]), "us"),
                        "unit_string": unit,
                    },
                )
                for name, (times, values, unit) in channels.items()
            ]
        )
    return {name: name for name in channels}


@_kind
def tdms_by_offset(path: Path, channels: Channels) -> dict[str, str]:
    return tdms(path, channels, by_offset=True)


def channels(delay: float, ratio: float) -> Channels:
    """Return a displacement that starts s after the voltage, at a multiple of its interval."""
    time = INTERVAL * np.arange(300)
    read = delay + INTERVAL * ratio * np.arange(round(300 / ratio))
    return {
        "voltage": (time, voltage_at(time), "V"),
        "displacement": (read, displacement_at(read), "um"),
    }


def remarked(path: Path, **naming: Any) -> tuple[Record, str]:
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", InputWarning)
        record = read_record(path, **naming)
    return record, " ".join(str(warning.message) for warning in caught)


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


@pytest.mark.parametrize("kind", KINDS)
@given(delay=st.floats(-0.5, 0.5), ratio=st.sampled_from([1.0, 0.2, 0.7, 2.0, 5.0]))
def test_each_channel_has_the_times_beside_it(
    folder: Path, kind: str, delay: float, ratio: float
) -> None:
    path = folder / kind
    columns = KINDS[kind](path, channels(round(delay, 6), ratio))
    record, remarks = remarked(path, columns=columns)
    assert "cut to their common" in remarks or (ratio == 1 and abs(delay) < 0.0101 * INTERVAL)
    check(record, round(delay, 6), ratio)


@pytest.mark.parametrize("kind", [kind for kind in KINDS if not kind.startswith("tdms")])
def test_times_that_differ_and_are_not_uniform_are_refused_unless_one_counts(
    tmp_path: Path, kind: str
) -> None:
    both = channels(0.0, 1.0)
    rng, time = np.random.default_rng(3), both["voltage"][0]
    scattered = time + 0.3 * INTERVAL * rng.uniform(-1, 1, time.size)
    both["displacement"] = (scattered, displacement_at(scattered), "um")
    columns = KINDS[kind](tmp_path / "a", both)
    with pytest.raises(InputError, match=r"not the times of .*, and not uniform; write both"):
        read_record(tmp_path / "a", columns=columns)
    first = {"text": "1", "hdf5": "voltage/t", "mat_73": "voltage/Time"}
    record, remarks = remarked(
        tmp_path / "a", columns=columns | {"time": first.get(kind, "voltage.Time")}
    )
    assert "counts for both" in remarks
    np.testing.assert_allclose(record.voltage, both["voltage"][1], atol=1e-9)


@pytest.mark.parametrize("version", ["5", "7.3"])
@pytest.mark.parametrize(("unit", "factor"), [("nm", 1e3), ("um", 1.0), ("mm", 1e-3), ("m", 1e-6)])
@pytest.mark.parametrize("word", ["units", "Unit"])
def test_a_unit_in_a_field_of_its_struct_is_that_of_a_series(
    tmp_path: Path, version: Literal["5", "7.3"], unit: str, factor: float, word: str
) -> None:
    time = INTERVAL * np.arange(300)
    values = {"u": (voltage_at(time), "V"), "x": (factor * displacement_at(time), unit)}
    path = tmp_path / "a.mat"
    if version == "5":
        structs = {
            name: {"values": v[:, None], word: stated} for name, (v, stated) in values.items()
        }
        scipy.io.savemat(path, structs | {"t_s": time[:, None]})
    else:
        with h5py.File(path, "w", userblock_size=512) as file:
            file["t_s"] = time[np.newaxis]
            for name, (numbers, stated) in values.items():
                file[f"{name}/values"] = numbers[np.newaxis]
                _text_of(file[name], word, stated)
    record, _ = remarked(path)
    assert record.displacement is not None
    np.testing.assert_allclose(record.displacement, displacement_at(time), rtol=1e-12)
    np.testing.assert_array_equal(record.voltage, values["u"][0])


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


@quiet
@given(st.integers(-100, 100), st.sampled_from(["One", "No", "Multi"]))
def test_whole_samples_between_lvm_channels_move_no_reading(
    folder: Path, shift: int, x_columns: str
) -> None:
    delay = shift * INTERVAL
    path = lvm(folder / "a.lvm", delay, x_columns=x_columns)
    record = read_record(path, columns={"voltage": "Voltage", "displacement": "Position"})
    check(record, delay, 1.0)
    assert record.samples == 300 - abs(shift)
    written = displacement_at(INTERVAL * np.arange(300) + delay)
    np.testing.assert_array_equal(record.displacement, written[max(-shift, 0) :][: record.samples])


def test_channels_without_a_common_time_are_refused_unless_a_rate_is_given(tmp_path: Path) -> None:
    columns = tdms(tmp_path / "a.tdms", channels(100.0, 1.0))
    with pytest.raises(InputError, match="starts 100 s after 'd/voltage', and they have no time"):
        read_record(tmp_path / "a.tdms", columns=columns)
    assert 300 == read_record(tmp_path / "a.tdms", columns=columns, fs=250).samples
