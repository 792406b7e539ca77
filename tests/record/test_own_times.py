"""Series with times of their own beside them are put together by these, and units beside count."""

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
from hypothesis import given, settings
from hypothesis import strategies as st

from bwbayes.errors import InputError, InputWarning
from bwbayes.record import Record, read_record
from tests.record.test_clocks import INTERVAL, check, displacement_at, voltage_at

type Channels = dict[str, tuple[Any, Any, str]]
"""Times, s, values and unit by the name of a channel."""

KINDS: dict[str, Callable[[Path, Channels], dict[str, str]]] = {}


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
def mat(path: Path, channels: Channels) -> dict[str, str]:
    structs = {
        name: {
            **{"Time": times[:, None], "Data": values[:, None]},
            "DataInfo": {"Units": unit},
            "TimeInfo": {"Units": "seconds"},
        }
        for name, (times, values, unit) in channels.items()
    }
    scipy.io.savemat(path, structs, appendmat=False)
    return {name: f"{name}.Data" for name in channels}


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


def channels(delay: float, ratio: float) -> Channels:
    """Return a displacement that starts s after the voltage, at a multiple of its interval."""
    time = INTERVAL * np.arange(300)
    read = delay + INTERVAL * ratio * np.arange(round(300 / ratio))
    return {
        "voltage": (time, voltage_at(time), "V"),
        "displacement": (read, displacement_at(read), "um"),
    }


def quiet(path: Path, **naming: Any) -> tuple[Record, str]:
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", InputWarning)
        record = read_record(path, **naming)
    return record, " ".join(str(warning.message) for warning in caught)


@pytest.mark.parametrize("kind", KINDS)
@settings(max_examples=25)
@given(delay=st.floats(-0.5, 0.5), ratio=st.sampled_from([1.0, 0.2, 0.7, 2.0, 5.0]))
def test_each_channel_has_the_times_beside_it(
    tmp_path_factory: pytest.TempPathFactory, kind: str, delay: float, ratio: float
) -> None:
    path = tmp_path_factory.getbasetemp() / kind
    columns = KINDS[kind](path, channels(round(delay, 6), ratio))
    record, remarks = quiet(path, columns=columns)
    is_same = ratio == 1 and abs(delay) <= 0.0099 * INTERVAL
    assert is_same or "cut to their common" in remarks or abs(delay) < 0.0101 * INTERVAL
    check(record, round(delay, 6), ratio)


@pytest.mark.parametrize("kind", KINDS)
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
    first = {"text": "1", "hdf5": "voltage/t", "mat": "voltage.Time", "mat_73": "voltage/Time"}
    record, remarks = quiet(tmp_path / "a", columns=columns | {"time": first[kind]})
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
    record, _ = quiet(path)
    assert record.displacement is not None
    np.testing.assert_allclose(record.displacement, displacement_at(time), rtol=1e-12)
    np.testing.assert_array_equal(record.voltage, values["u"][0])
