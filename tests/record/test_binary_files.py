"""Records in HDF5 and MATLAB files: what is accepted, one line for what is not."""

from __future__ import annotations

import os
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any, Literal

import h5py
import numpy as np
import pytest
import scipy.io

from bwbayes.errors import InputError
from bwbayes.record import Record, read_record, write_record
from bwbayes.record.io import matlab

SAMPLES = 24
TIME = 0.5 + 1e-3 * np.arange(SAMPLES)
VOLTAGE = np.sin(np.arange(SAMPLES))
DISPLACEMENT = 20 * np.cos(1.3 * np.arange(SAMPLES))
GOOD: dict[str, Any] = {"time_s": TIME, "voltage_V": VOLTAGE, "displacement_um": DISPLACEMENT}

Kind = Literal["h5", "mat", "compressed", "7.3"]
KINDS: list[Kind] = ["h5", "mat", "compressed", "7.3"]


def store(folder: Path, kind: Kind, arrays: dict[str, Any]) -> Path:
    """Store arrays as another program would, without anything of bwbayes."""
    path = folder / ("record.h5" if kind == "h5" else "record.mat")
    if kind in ("mat", "compressed"):
        scipy.io.savemat(path, arrays, do_compression=kind == "compressed")
        return path
    with h5py.File(path, "w", userblock_size=512 if kind == "7.3" else 0) as file:
        for name, values in arrays.items():
            file[name] = values
    return path


def fault(path: Path) -> str:
    with pytest.raises(InputError) as caught:
        read_record(path)
    text = str(caught.value)
    assert len(text.splitlines()) == 1
    return text.removeprefix(f"{path}")


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("shape", [(SAMPLES,), (SAMPLES, 1), (1, SAMPLES)])
def test_vectors_rows_and_columns_are_read(tmp_path: Path, kind: Kind, shape: Any) -> None:
    arrays = {name: values.reshape(shape) for name, values in GOOD.items()}
    record = read_record(store(tmp_path, kind, arrays | {"comment": "passed over"}))
    np.testing.assert_array_equal(VOLTAGE, record.voltage)
    np.testing.assert_array_equal(DISPLACEMENT, record.displacement)
    assert (0.5, "output") == (record.start, record.voltage_is)
    assert record.interval == pytest.approx(1e-3, rel=1e-12)


@pytest.mark.parametrize("kind", KINDS)
def test_prefixes_integers_and_single_precision_are_converted(tmp_path: Path, kind: Kind) -> None:
    arrays = {
        "time_ms": (1e3 + np.arange(SAMPLES)).astype(np.float32),
        "voltage_mV": np.arange(SAMPLES, dtype=np.int16),
        "displacement_nm": DISPLACEMENT.astype(np.float32),
    }
    record = read_record(store(tmp_path, kind, arrays))
    np.testing.assert_array_equal(np.arange(SAMPLES) / 1000, record.voltage)
    assert record.displacement is not None
    np.testing.assert_allclose(DISPLACEMENT / 1000, record.displacement, rtol=1e-7)
    assert (1e-3, 1.0) == (record.interval, record.start)


@pytest.mark.parametrize("name", ["none/record.csv", "none/record.h5", "none/record.mat", "a.xls"])
def test_a_place_that_cannot_be_written_to_is_an_input_error(tmp_path: Path, name: str) -> None:
    with pytest.raises(InputError, match=name):
        write_record(Record(np.arange(20.0), None, 1.0), tmp_path / name)


def test_a_version_7_3_file_bears_the_header_that_matlab_looks_for(tmp_path: Path) -> None:
    path = tmp_path / "record.mat"
    write_record(Record(VOLTAGE, DISPLACEMENT, 1.0), path, mat_version="7.3")
    assert (2, 0) == scipy.io.matlab.matfile_version(path)
    with h5py.File(path) as file:
        assert 512 == file.userblock_size
        assert b"double" == file["voltage_V"].attrs["MATLAB_class"]
        assert b"char" == file["voltage_is"].attrs["MATLAB_class"]
        assert (1, SAMPLES) == file["voltage_V"].shape


def test_a_group_may_hold_the_datasets_and_attributes(tmp_path: Path) -> None:
    with h5py.File(tmp_path / "record.h5", "w") as file:
        group = file.create_group("run 7")
        file.create_group("empty")
        for name, values in GOOD.items():
            group[name] = values
        group.attrs["voltage_is"] = "command"
    record = read_record(tmp_path / "record.h5")
    np.testing.assert_array_equal(VOLTAGE, record.voltage)
    assert "command" == record.voltage_is


def test_several_groups_with_records_are_refused(tmp_path: Path) -> None:
    with h5py.File(tmp_path / "record.h5", "w") as file:
        for group, factor in (("a", 1.0), ("b", 2.0)):
            for name, values in GOOD.items():
                file[f"{group}/{name}"] = values if name == "time_s" else factor * values
    text = fault(tmp_path / "record.h5")
    assert ": which column is the time, which the voltage, which the displacement?" in text
    assert "'a/voltage_V' (" in text
    assert "'b/voltage_V' (" in text
    record = read_record(tmp_path / "record.h5", columns={"voltage": "b/voltage_V"})
    np.testing.assert_array_equal(2 * VOLTAGE, record.voltage)
    np.testing.assert_array_equal(2 * DISPLACEMENT, record.displacement)


def replaced(values: np.ndarray, sample: int, value: float) -> np.ndarray:
    changed = values.copy()
    changed[sample] = value
    return changed


FAULTS: list[tuple[str, dict[str, Any], str]] = [
    ("nan", {"voltage_V": replaced(VOLTAGE, 17, np.nan)}, ":sample 17: voltage_V: no number"),
    ("inf", {"displacement_um": replaced(DISPLACEMENT, 0, -np.inf)}, ":sample 0: displacement_um"),
    ("lengths", {"voltage_V": VOLTAGE[1:]}, ": voltage_V: 23 values where time has 24"),
    ("complex", {"voltage_V": VOLTAGE + 1j}, ": voltage_V: holds complex numbers"),
    ("matrix", {"voltage_V": VOLTAGE.reshape(6, 4)}, ": no column for the voltage; add it"),
    ("empty", dict.fromkeys(GOOD, np.zeros(0)), ": "),
    ("twice", {"voltage_mV": VOLTAGE}, ": which column is the voltage?"),
]


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize(
    ("changes", "expected"), [case[1:] for case in FAULTS], ids=[case[0] for case in FAULTS]
)
def test_each_fault_is_one_line_with_its_place(
    tmp_path: Path, kind: Kind, changes: dict[str, Any], expected: str
) -> None:
    text = fault(store(tmp_path, kind, GOOD | changes))
    assert expected == text[: len(expected)]


@pytest.mark.parametrize("value", [{"a": 1.0}, np.array([1.0, "b"], dtype=object)])
def test_structs_and_cells_without_series_are_passed_over(tmp_path: Path, value: Any) -> None:
    text = fault(store(tmp_path, "mat", GOOD | {"voltage_V": value}))
    assert ": no column for the voltage; add it" in text
    store(tmp_path, "mat", GOOD | {"more": value})
    assert SAMPLES == read_record(tmp_path / "record.mat").samples


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("part", [0, 1, 100, 600, -200])
def test_a_cut_off_file_is_refused(tmp_path: Path, kind: Kind, part: int) -> None:
    path = store(tmp_path, kind, GOOD)
    path.write_bytes(path.read_bytes()[:part])
    assert "; " in fault(path)


def test_numbers_that_are_damaged_are_refused(tmp_path: Path) -> None:
    """A MATLAB file keeps dimensions and numbers apart: here of 24 numbers as if they were 56."""
    path = store(tmp_path, "mat", GOOD)
    data = bytearray(path.read_bytes())
    dimensions = data.index(struct.pack("<IIII", 5, 8, 1, SAMPLES))
    struct.pack_into("<I", data, dimensions + 12, 56)
    path.write_bytes(data)
    assert ": time_s: damaged or cut off (cannot reshape" in fault(path)


def test_a_cell_array_of_more_elements_than_it_has_is_refused(tmp_path: Path) -> None:
    """SciPy would make an array of so many, whatever the memory."""
    path = store(tmp_path, "mat", GOOD | {"cells": np.array([1.0, "b"], dtype=object)})
    data = bytearray(path.read_bytes())
    struct.pack_into("<I", data, data.index(struct.pack("<IIII", 5, 8, 1, 2)) + 12, 10**9)
    path.write_bytes(data)
    assert "elements of an array are missing" in fault(path)


def test_version_4_is_refused_by_name(tmp_path: Path) -> None:
    scipy.io.savemat(tmp_path / "record.mat", GOOD, format="4")
    assert "save it with -v7" in fault(tmp_path / "record.mat")


@pytest.mark.parametrize("kind", ["h5", "7.3"])
def test_free_blocks_that_run_in_a_circle_are_refused(tmp_path: Path, kind: Kind) -> None:
    """HDF5 2.0 would follow them until all memory is gone."""
    path = store(tmp_path, kind, GOOD)
    data = bytearray(path.read_bytes())
    heap = data.index(b"HEAP")
    block, address = struct.unpack_from("<QQ", data, heap + 16)
    struct.pack_into("<Q", data, (512 if kind == "7.3" else 0) + address + block, block)
    path.write_bytes(data)
    assert "a list in it has no end" in fault(path)


def test_texts_without_a_length_are_refused(tmp_path: Path) -> None:
    """HDF5 2.0 would stay at them for ever."""
    path = store(tmp_path, "h5", GOOD)
    with h5py.File(path, "r+") as file:
        file.attrs["origin"] = "a text of variable length"
    assert "a text of variable length" == read_record(path).origin
    data = bytearray(path.read_bytes())
    texts = data.index(b"GCOL")
    (length,) = struct.unpack_from("<Q", data, texts + 24)
    free = texts + 32 + (length + 7) // 8 * 8
    assert 0 == struct.unpack_from("<H", data, free)[0]
    struct.pack_into("<Q", data, free + 8, 0)
    path.write_bytes(data)
    assert "a list in it has no end" in fault(path)


def external_link(file: Any, name: str, other: Path) -> None:
    file[name] = h5py.ExternalLink(other, "/voltage_V")


def soft_link_through(file: Any, name: str, other: Path) -> None:
    file["way"] = h5py.ExternalLink(other, "/")
    file[name] = h5py.SoftLink("/way/voltage_V")


def external_numbers(file: Any, name: str, other: Path) -> None:
    file.create_dataset(name, (SAMPLES,), "f8", external=[(str(other), 0, 8 * SAMPLES)])


def virtual(file: Any, name: str, other: Path) -> None:
    layout = h5py.VirtualLayout((SAMPLES,), "f8")
    layout[:] = h5py.VirtualSource(str(other), "voltage_V", (SAMPLES,))
    file.create_virtual_dataset(name, layout)


@pytest.mark.parametrize("kind", ["h5", "7.3"])
@pytest.mark.parametrize(
    "refer", [external_link, soft_link_through, external_numbers, virtual], ids=lambda f: f.__name__
)
def test_a_file_cannot_have_another_file_opened(
    tmp_path: Path, kind: Kind, refer: Callable[[Any, str, Path], None]
) -> None:
    """The other one is a pipe, at which a reader would wait for ever."""
    os.mkfifo(tmp_path / "pipe")
    path = store(tmp_path, kind, {"time_s": TIME, "displacement_um": DISPLACEMENT})
    with h5py.File(path, "r+") as file:
        refer(file, "voltage_V", tmp_path / "pipe")
    assert ": no column for the voltage; add it" in fault(path)


def test_a_compressed_array_cannot_unpack_to_all_memory(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(matlab, "_LARGEST_ELEMENT", 10_000)
    path = store(tmp_path, "compressed", {"zeros": np.zeros(10**5)} | GOOD)
    assert "damaged" in fault(path)
