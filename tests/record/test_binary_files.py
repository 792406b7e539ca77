"""Records in HDF5, MATLAB and NumPy files: what is accepted, one line for what is not."""

import os
import struct
import subprocess
import sys
import warnings
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any, Literal

import h5py
import numpy as np
import pytest
import scipy.io
from hypothesis import assume, example, given, strategies as st

from bwbayes.errors import InputError, InputWarning
from bwbayes.record import Record, read_record, write_record
from bwbayes.record.io import binary
from tests.record.conftest import quiet
from tests.record.makers import INSTRUMENTS

SAMPLES = 24
TIME = 0.5 + 1e-3 * np.arange(SAMPLES)
VOLTAGE = np.sin(np.arange(SAMPLES))
DISPLACEMENT = 20 * np.cos(1.3 * np.arange(SAMPLES))
GOOD: dict[str, Any] = {"time_s": TIME, "voltage_V": VOLTAGE, "displacement_um": DISPLACEMENT}

Kind = Literal["h5", "mat", "compressed", "7.3", "npz"]
KINDS: list[Kind] = ["h5", "mat", "compressed", "7.3", "npz"]


def store(folder: Path, kind: Kind, arrays: dict[str, Any]) -> Path:
    if kind == "npz":
        np.savez(folder / "record.npz", **arrays)
        return folder / "record.npz"
    path = folder / ("record.h5" if kind == "h5" else "record.mat")
    if kind in ("mat", "compressed"):
        scipy.io.savemat(path, arrays, do_compression=kind == "compressed")
        return path
    with h5py.File(path, "w", userblock_size=512 if kind == "7.3" else 0) as file:
        file.update(arrays)
    return path


def fault(path: Path) -> str:
    with pytest.raises(InputError) as caught:
        read_record(path)
    text = str(caught.value)
    assert len(text.splitlines()) == 1
    return text.removeprefix(f"{path}")


def overwrite(path: Path, form: str, offset: int, number: int) -> None:
    data = bytearray(path.read_bytes())
    struct.pack_into(form, data, offset, number)
    path.write_bytes(data)


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


@pytest.mark.parametrize("compressed", [True, False])
def test_a_version_5_file_is_read_as_scipy_wrote_it(tmp_path: Path, compressed: bool) -> None:
    kinds = ("f8", "f4", "i1", "u1", "i2", "u2", "i4", "u4", "i8", "u8")
    arrays = {kind: np.arange(24).reshape(3, 8).astype(kind) for kind in kinds}
    cells = np.empty(3, dtype=object)
    cells[:] = [np.arange(5.0), "text", {"x": np.eye(3)}]
    scipy.io.savemat(
        tmp_path / "a.mat",
        arrays | {"s": {"a": np.arange(4.0), "cells": cells}, "empty": [], "z": np.ones(3) * 1j},
        do_compression=compressed,
    )
    series = {s.name: s for s in binary.read_mat(tmp_path / "a.mat").series}
    for kind, expected in arrays.items():
        for row in range(3):
            values = series.pop(f"{kind}[{row + 1}]").numbers("")
            assert (values.dtype, True) == (np.dtype(kind), np.array_equal(values, expected[row]))
    np.testing.assert_array_equal(series["s.a"].numbers(""), np.arange(4.0))
    np.testing.assert_array_equal(series["s.cells(1)"].numbers(""), np.arange(5.0))
    assert [1.0, 0.0, 0.0] == series["s.cells(3).x[1]"].numbers("").tolist()
    assert {"s.a", "s.cells(1)", *(f"s.cells(3).x[{i}]" for i in (1, 2, 3)), "z"} == {*series}


@pytest.mark.parametrize("name", ["none/record.csv", "none/record.h5", "none/record.mat", "a.xls"])
def test_a_place_that_cannot_be_written_to_is_an_input_error(tmp_path: Path, name: str) -> None:
    with pytest.raises(InputError, match=name):
        write_record(Record(np.arange(20.0), None, interval=1.0), tmp_path / name)


def test_a_version_7_3_file_bears_the_header_that_matlab_looks_for(tmp_path: Path) -> None:
    path = tmp_path / "record.mat"
    write_record(Record(VOLTAGE, DISPLACEMENT, interval=1.0), path, mat_version="7.3")
    assert (2, 0) == scipy.io.matlab.matfile_version(path)
    with h5py.File(path) as file:
        assert 512 == file.userblock_size
        assert b"double" == file["voltage_V"].attrs["MATLAB_class"]
        assert b"char" == file["voltage_is"].attrs["MATLAB_class"]
        assert (1, SAMPLES) == file["voltage_V"].shape


def test_a_group_may_hold_the_datasets_and_notes_and_of_several_one_is_chosen(
    tmp_path: Path,
) -> None:
    path = tmp_path / "record.h5"
    with h5py.File(path, "w") as file:
        file["run 7/none"] = np.arange(3.0)
        file["run 7"].update(GOOD)
        file["run 7"].attrs["voltage_is"] = "command"
    assert "command" == read_record(path).voltage_is
    with h5py.File(path, "r+") as file:
        file["b/voltage_V"], file["b/displacement_um"] = 2 * VOLTAGE, 2 * DISPLACEMENT
        file["b/time_s"] = TIME
    text = fault(path)
    assert ": which column is the time, which the voltage, which the displacement?" in text
    assert "'run 7/voltage_V' (" in text
    record = read_record(path, columns={"voltage": "b/voltage_V"})
    np.testing.assert_array_equal(2 * VOLTAGE, record.voltage)
    np.testing.assert_array_equal(2 * DISPLACEMENT, record.displacement)
    assert "output" == record.voltage_is


def replaced(values: np.ndarray, sample: int, value: float) -> np.ndarray:
    changed = values.copy()
    changed[sample] = value
    return changed


FAULTS: dict[str, tuple[dict[str, Any], str]] = {
    "nan": ({"voltage_V": replaced(VOLTAGE, 23, np.nan)}, ":sample 23: voltage_V: no number"),
    "gap": ({"voltage_V": replaced(VOLTAGE, 17, np.nan)}, ":sample 18: time_s: gap of 0.002 s"),
    "inf": ({"voltage_V": replaced(VOLTAGE, 0, -np.inf)}, ":sample 0: voltage_V"),
    "lengths": ({"voltage_V": VOLTAGE[1:]}, ": voltage_V: 23 values where time has 24"),
    "complex": ({"voltage_V": VOLTAGE + 1j}, ": voltage_V: holds complex numbers"),
    "matrix": ({"voltage_V": VOLTAGE.reshape(6, 4)}, ": no column for the voltage; add it"),
    "empty": (dict.fromkeys(GOOD, np.zeros(0)), ": "),
    "twice": ({"voltage_mV": VOLTAGE}, ": which column is the voltage?"),
}


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize(("changes", "expected"), FAULTS.values(), ids=FAULTS)
def test_each_fault_is_one_line_with_its_place(
    tmp_path: Path, kind: Kind, changes: dict[str, Any], expected: str
) -> None:
    assert fault(store(tmp_path, kind, GOOD | changes)).startswith(expected)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("length", [0, 1, 100, 600, -200])
def test_a_cut_off_file_is_refused(tmp_path: Path, kind: Kind, length: int) -> None:
    path = store(tmp_path, kind, GOOD)
    path.write_bytes(path.read_bytes()[:length])
    assert "; " in fault(path)


def test_versions_that_are_not_read_are_refused_with_what_to_write(tmp_path: Path) -> None:
    scipy.io.savemat(tmp_path / "record.mat", GOOD, format="4")
    assert "save it with -v7" in fault(tmp_path / "record.mat")
    (tmp_path / "a.nc").write_bytes(b"CDF\x05" + bytes(60))
    assert "64-bit data format; write it as netCDF-4" in fault(tmp_path / "a.nc")


# Damage that a library would take the process or all memory for


def test_dimensions_beyond_the_numbers_are_refused_and_cells_not_made(tmp_path: Path) -> None:
    path = store(tmp_path, "mat", GOOD | {"cells": np.array([1.0, "b"], dtype=object)})
    data = path.read_bytes()
    overwrite(path, "<I", data.index(struct.pack("<IIII", 5, 8, 1, 2)) + 12, 10**9)
    assert SAMPLES == read_record(path).samples
    overwrite(path, "<I", data.index(struct.pack("<IIII", 5, 8, 1, SAMPLES)) + 12, 56)
    assert ": time_s: damaged or cut off (cannot reshape" in fault(path)


def test_a_compressed_array_cannot_unpack_to_all_memory(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(binary, "MAXIMUM_SAMPLES", 625)
    path = store(tmp_path, "compressed", {"zeros": np.zeros(10**5)} | GOOD)
    assert "damaged" in fault(path)


@pytest.mark.parametrize("kind", ["h5", "7.3"])
def test_free_blocks_that_run_in_a_circle_are_refused(tmp_path: Path, kind: Kind) -> None:
    """HDF5 2.0 would follow them until all memory is gone."""
    path = store(tmp_path, kind, GOOD)
    data = path.read_bytes()
    block, address = struct.unpack_from("<QQ", data, data.index(b"HEAP") + 16)
    overwrite(path, "<Q", (512 if kind == "7.3" else 0) + address + block, block)
    assert "a list in it has no end" in fault(path)


def test_texts_without_a_length_are_refused(tmp_path: Path) -> None:
    """HDF5 2.0 would stay at them for ever."""
    path = store(tmp_path, "h5", GOOD)
    with h5py.File(path, "r+") as file:
        file.attrs["origin"] = "a text of variable length"
    assert "a text of variable length" == read_record(path).origin
    data = path.read_bytes()
    texts = data.index(b"GCOL")
    (length,) = struct.unpack_from("<Q", data, texts + 24)
    free = texts + 32 + (length + 7) // 8 * 8
    assert 0 == struct.unpack_from("<H", data, free)[0]
    overwrite(path, "<Q", free + 8, 0)
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


@pytest.mark.parametrize(
    "refer", [external_link, soft_link_through, external_numbers, virtual], ids=lambda f: f.__name__
)
def test_a_file_cannot_have_another_file_opened(
    tmp_path: Path, refer: Callable[[Any, str, Path], None]
) -> None:
    """The other one is a pipe, at which a reader would wait for ever."""
    os.mkfifo(tmp_path / "pipe")
    path = store(tmp_path, "h5", {"time_s": TIME, "displacement_um": DISPLACEMENT})
    with h5py.File(path, "r+") as file:
        refer(file, "voltage_V", tmp_path / "pipe")
    assert ": no column for the voltage; add it" in fault(path)


def test_a_list_is_no_note(tmp_path: Path) -> None:
    """Damaged text of variable length may look like one, and reading that ends the process."""
    path = tmp_path / "a.h5"
    write_record(Record(np.arange(20.0), np.arange(20.0), interval=0.1, origin="a bench"), path)
    with h5py.File(path, "a") as file:
        del file.attrs["origin"]
        texts = np.array([np.arange(3, dtype="u1"), None], dtype=object)[:1]
        file.attrs.create("origin", texts, dtype=h5py.vlen_dtype("u1"))
    assert read_record(path).origin == "a.h5"


def test_an_array_of_columns_is_read_by_their_numbers(tmp_path: Path) -> None:
    np.save(tmp_path / "record.npy", np.column_stack([TIME, VOLTAGE, DISPLACEMENT]))
    columns = {"time": "1", "voltage": "2", "displacement": "3"}
    units = {"time": "s", "voltage": "V", "displacement": "um"}
    record = read_record(tmp_path / "record.npy", columns=columns, units=units)
    np.testing.assert_array_equal(DISPLACEMENT, record.displacement)
    rows = np.rec.fromarrays([TIME, VOLTAGE, DISPLACEMENT], names=[*GOOD])
    np.save(tmp_path / "rows.npy", rows)
    np.testing.assert_array_equal(VOLTAGE, read_record(tmp_path / "rows.npy").voltage)


def test_python_objects_in_an_archive_are_passed_over(tmp_path: Path) -> None:
    np.savez(tmp_path / "record.npz", **GOOD, settings=np.array([{}], dtype=object))
    np.testing.assert_array_equal(VOLTAGE, read_record(tmp_path / "record.npz").voltage)
    np.save(tmp_path / "alone.npy", np.array([{}], dtype=object))
    assert fault(tmp_path / "alone.npy").startswith(": damaged or cut off (")


@quiet
@given(
    st.sampled_from(["i2", "u2", "i4", "f4"]),
    st.none() | st.floats(0.01, 10) | st.just(-2e-3),
    st.floats(-50, 50),
    st.sampled_from(["_FillValue", "missing_value"]),
    st.sets(st.integers(0, SAMPLES - 1), max_size=10),
    st.sampled_from(["classic", "netCDF-4"]),
)
def test_packed_numbers_are_unpacked_and_their_marks_missing(
    folder: Path,
    dtype: str,
    scale: float | None,
    offset: float,
    mark: str,
    missing: set[int],
    version: str,
) -> None:
    """As the CF conventions have it; a mark alone leaves all other numbers as they are."""
    assume(version != "classic" or dtype != "u2")  # which it has not
    path = folder / "packed.nc"
    packed = np.arange(100, 100 + SAMPLES).astype(dtype)
    packed[[*missing]] = 9999
    expected = packed.astype(float)
    attributes: dict[str, Any] = {mark: packed.dtype.type(9999)}
    if scale is not None:
        attributes |= {"scale_factor": scale, "add_offset": offset}
        expected = scale * expected + offset
    expected[[*missing]] = np.nan
    columns = {"time": TIME, "voltage_V": VOLTAGE, "displacement_um": packed}
    if version == "classic":
        with scipy.io.netcdf_file(path, "w") as file:
            file.createDimension("sample", SAMPLES)
            for name, values in columns.items():
                file.createVariable(name, values.dtype, ("sample",))[:] = values
            file.variables["time"].units = "seconds since 2026-03-03"
            for key, value in attributes.items():
                setattr(file.variables["displacement_um"], key, np.asarray(value))
    else:
        with h5py.File(path, "w") as file:
            file.update(columns)
            file["time"].attrs["units"] = "seconds since 2026-03-03"
            file["displacement_um"].attrs.update(attributes)
    record = read_record(path)
    np.testing.assert_array_equal(expected, record.displacement)
    np.testing.assert_array_equal(VOLTAGE, record.voltage)


WRITER = """
import sys, h5py, numpy as np
file = h5py.File(sys.argv[1], "w", libver="latest" if sys.argv[2] == "swmr" else None)
for name in ("time_s", "voltage_V", "displacement_um"):
    file[name] = np.arange(24.0)
if sys.argv[2] == "swmr":
    file.swmr_mode = True
if sys.argv[2] != "open":
    file.flush()
print("open", flush=True)
sys.stdin.read()
"""


@pytest.mark.parametrize("state", ["flushed", "swmr", "open"])
def test_a_file_that_its_writer_holds_open_is_read_as_far_as_it_is_written(
    tmp_path: Path, state: str
) -> None:
    path = tmp_path / "a.h5"
    with subprocess.Popen(
        [sys.executable, "-c", WRITER, str(path), state],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
    ) as writer:
        assert writer.stdout is not None
        writer.stdout.readline()
        if state == "open":
            assert fault(path).startswith(": another program has it open, or ended without")
        else:
            with pytest.warns(InputWarning, match="another program has it open; what that has"):
                assert SAMPLES == read_record(path).samples


def element(kind: int, content: bytes) -> bytes:
    return struct.pack("<II", kind, len(content)) + content.ljust(-(-len(content) // 8) * 8, b"\0")


def test_a_matlab_object_is_named_with_how_to_save_it(tmp_path: Path) -> None:
    """In version 5 and 7.3; the nameless array that MATLAB keeps of objects is no series."""
    path = store(tmp_path, "mat", GOOD)
    opaque = element(6, struct.pack("<II", 17, 0))
    opaque += b"".join(element(1, text) for text in (b"log", b"MCOS", b"timetable"))
    nameless = element(6, struct.pack("<II", 9, 0)) + element(5, struct.pack("<ii", 1, 24))
    nameless += element(1, b"") + element(2, bytes(24))
    path.write_bytes(path.read_bytes() + element(14, opaque) + element(14, nameless))
    with pytest.warns(InputWarning, match=r"log: a MATLAB timetable.*timetable2table\(log\)"):
        assert {*GOOD} == {series.name for series in binary.read_mat(path).series}
    path = store(tmp_path, "7.3", GOOD)
    with h5py.File(path, "r+") as file:
        file["log"] = np.zeros(6, dtype="u4")
        file["log"].attrs.update({"MATLAB_class": np.bytes_("table"), "MATLAB_object_decode": 3})
    with pytest.warns(InputWarning, match=r"log: a MATLAB table.*table2struct\(log"):
        assert SAMPLES == read_record(path).samples


@quiet
@given(st.integers(4, 500), st.lists(st.integers(0, 255), max_size=6), st.booleans())
@example(275, [0, 0, 0], False)  # a second time of 7e-310 s
def test_a_damaged_netcdf_file_is_read_or_refused_in_a_line(
    folder: Path, at: int, damage: list[int], is_cut: bool
) -> None:
    content = bytearray(INSTRUMENTS["netCDF-3 of SciPy, packed"](folder).path.read_bytes())
    content[at : at + len(damage)] = bytes(damage)
    (folder / "b.nc").write_bytes(content[:at] if is_cut else content)
    with suppress(InputError):
        read_record(folder / "b.nc")


@pytest.mark.parametrize("name", ["gain", "Scale", "offset", "calibration"])
@pytest.mark.parametrize("factor", [0.0, 1.0, 0.01])
def test_an_attribute_that_may_scale_the_numbers_is_said_not_to(
    tmp_path: Path, name: str, factor: float
) -> None:
    """Unless it changes nothing, whatever is meant by it; the numbers stay as they are."""
    write_record(Record(VOLTAGE, DISPLACEMENT, interval=1.0), tmp_path / "a.h5")
    with h5py.File(tmp_path / "a.h5", "a") as file:
        file["voltage_V"].attrs[name] = factor
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", InputWarning)
        record = read_record(tmp_path / "a.h5")
    remarks = [str(warning.message) for warning in caught]
    is_neutral = factor == 0 or (factor == 1 and name != "offset")
    assert len(remarks) == (not is_neutral)
    assert all(f"voltage_V: attribute {name} = {factor:g} is not applied" in r for r in remarks)
    np.testing.assert_array_equal(record.voltage, VOLTAGE)
