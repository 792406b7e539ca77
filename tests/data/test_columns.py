"""Columns of other people's names and units become the same record, or one clear line."""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pandas as pd
import pytest
import scipy.io
from hypothesis import given
from hypothesis import strategies as st

from bwbayes.data import Record, read_record
from bwbayes.data.io.columns import UNITS, Naming, recognised, unit_in
from bwbayes.errors import InputError, InputWarning

TIME = np.arange(200) / 100
VOLTAGE = 50 * np.sin(6 * TIME)
DISPLACEMENT = 0.7 * VOLTAGE
COLUMNS: dict[str, Any] = {"time": "t [ms]", "voltage": "U_mV", "displacement": "pos"}
UNIT = {"displacement": "nm"}
VALUES = {"t [ms]": 1e3 * TIME, "U_mV": 1e3 * VOLTAGE, "pos": 1e3 * DISPLACEMENT}


def write(path: Path) -> Path:
    """Write the columns of `VALUES` to a file of any kind."""
    if path.suffix == ".csv":
        rows = zip(*VALUES.values(), strict=True)
        lines = [",".join(VALUES), *(",".join(map(repr, map(float, row))) for row in rows)]
        path.write_text("\n".join(lines) + "\n")
    elif path.suffix == ".h5":
        with h5py.File(path, "w") as file:
            for name, values in VALUES.items():
                file[name] = values
    else:
        scipy.io.savemat(path, {"t": VALUES["t [ms]"], "U_mV": VALUES["U_mV"], "x": VALUES["pos"]})
    return path


def assert_same(record: Record, sign: float = 1.0) -> None:
    assert record.interval == pytest.approx(0.01)
    np.testing.assert_allclose(record.voltage, VOLTAGE, atol=1e-9)
    assert record.displacement is not None
    np.testing.assert_allclose(record.displacement, sign * DISPLACEMENT, atol=1e-9)


@pytest.mark.parametrize("suffix", [".csv", ".h5"])
def test_a_files_own_columns_are_read(tmp_path: Path, suffix: str) -> None:
    path = write(tmp_path / f"a{suffix}")
    assert_same(read_record(path, columns=COLUMNS, units=UNIT))
    assert_same(read_record(path, columns=COLUMNS, units={"displacement": "-nm"}), -1.0)


def test_a_matlab_files_own_columns_are_read(tmp_path: Path) -> None:
    path = write(tmp_path / "a.mat")
    columns = COLUMNS | {"time": "t", "displacement": "x"}
    assert_same(read_record(path, columns=columns, units={"time": "ms", "displacement": "nm"}))


@pytest.mark.parametrize("suffix", [".csv", ".h5"])
@pytest.mark.parametrize(
    ("columns", "units", "line"),
    [
        (
            {"displacement": "poss"},
            UNIT,
            "no column 'poss' for the displacement; did you mean 'pos'",
        ),
        ({"displacement": "laser"}, UNIT, "no column 'laser' .*; there are '.*'"),
        (
            {},
            {},
            "pos: no unit of the displacement in its name; write it there, or say units = { d",
        ),
        ({}, {"displacement": "pm"}, "units: displacement in 'pm' is unknown; write one of um"),
        ({"position": "pos"}, UNIT, "columns: no quantity 'position'; write time, voltage, disp"),
        ({"voltage": "pos"}, UNIT, "columns: two quantities have the same column"),
        ({}, UNIT | {"time": "-s"}, "units: time does not run backwards"),
    ],
)
def test_a_mapping_that_is_wrong_is_one_line(
    tmp_path: Path, suffix: str, columns: dict[str, str], units: dict[str, str], line: str
) -> None:
    with pytest.raises(InputError, match=line):
        read_record(write(tmp_path / f"a{suffix}"), columns=COLUMNS | columns, units=units)


@pytest.mark.parametrize("suffix", [".csv", ".h5", ".mat"])
def test_columns_are_recognised_where_none_are_said(tmp_path: Path, suffix: str) -> None:
    """A unit is all that has to be said, and of a MATLAB file's, which have none, each."""
    units = UNIT | ({"time": "ms"} if suffix == ".mat" else {})
    path = write(tmp_path / f"a{suffix}")
    assert_same(read_record(path, units=units))
    with pytest.raises(InputError, match=r": (pos|x|t): no unit of the (displacement|time) in its"):
        read_record(path)


def test_a_column_that_is_recognised_by_its_unit_alone_is_named(tmp_path: Path) -> None:
    path = write(tmp_path / "a.csv")
    path.write_text(path.read_text().replace("pos", "displcement_nm").replace("U_mV", "u_mV"))
    with pytest.warns(InputWarning, match=r"taken by its unit: displacement is 'displcement_nm';"):
        assert_same(read_record(path))
    frame = pd.DataFrame(VALUES).rename(columns={"pos": "displcement_nm"})
    with pytest.warns(InputWarning, match=r"DataFrame: taken by its unit: displacement is"):
        assert_same(Record.from_pandas(frame))


def test_the_packages_own_names_come_before_others(tmp_path: Path) -> None:
    """And a simulated record's truth is never taken for a displacement."""
    path = tmp_path / "a.h5"
    with h5py.File(path, "w") as file:
        for name, values in {"time_s": TIME, "voltage_V": VOLTAGE, "truth_um": VOLTAGE}.items():
            file[name] = values
    assert read_record(path, need_displacement=False).displacement is None
    with h5py.File(path, "a") as file:
        file["displacement_um"], file["pos (um)"] = DISPLACEMENT, VOLTAGE
    assert_same(read_record(path))


def test_a_column_that_is_mapped_counts_and_its_namesake_does_not(tmp_path: Path) -> None:
    path = tmp_path / "a.csv"
    rows = [f"{t},{v},{2 * v},{d}" for t, v, d in zip(TIME, VOLTAGE, DISPLACEMENT, strict=True)]
    path.write_text("\n".join(["time_s,u_V,voltage_V,displacement_um", *rows]) + "\n")
    with pytest.warns(InputWarning, match="ignored columns: voltage_V"):
        assert_same(read_record(path, columns={"voltage": "u_V"}))


# Names and units


@given(
    st.sampled_from([(quantity, unit) for quantity in ("time", "voltage", "displacement")
                     for unit in UNITS[quantity]]),
    st.sampled_from(["{} [{}]", "{} ({})", "{}_{}", "{} / {}", "{}[{}]", "{} {}"]),
    st.text("abcdefgh 1", min_size=1).map(str.strip).filter(bool),
)  # fmt: skip
def test_a_unit_is_read_from_any_usual_name(one: tuple[str, str], form: str, word: str) -> None:
    quantity, unit = one
    assert unit == unit_in(form.format(word, unit), quantity)


@pytest.mark.parametrize("name", ["pos", "t", "U_cmd", "V", "x [px]", "time_", ""])
def test_a_name_without_a_unit_has_none(name: str) -> None:
    assert [None] * 3 == [unit_in(name, q) for q in ("time", "voltage", "displacement")]


@pytest.mark.parametrize(
    ("names", "expected"),
    [
        (["t [ms]", "U_mV", "pos (nm)"], ["t [ms]", "U_mV", "pos (nm)"]),
        (["Timestamp [s]", "Command [V]", "Sensor [µm]"], None),
        (["t/s", "a/V", "b/um"], None),
        (["a/V", "b/um", "t/s", "temperature [C]"], ["t/s", "a/V", "b/um"]),
        (["Time", "Volt", "x"], None),
    ],
)
def test_columns_are_recognised(names: list[str], expected: list[str] | None) -> None:
    assert recognised(names) == dict(
        zip(("time", "voltage", "displacement"), expected or names, strict=True)
    )


def test_what_two_columns_may_be_is_left_open() -> None:
    names = ["t_s", "a_V", "b_V", "c_um", "d_um"]
    assert {"time": "t_s"} == recognised(names)
    with pytest.raises(InputError, match=r"which column is the voltage\? There are 'a_V', 'b_V'"):
        Record.from_pandas(pd.DataFrame(np.ones((20, 5)), columns=names))


def test_the_packages_own_names_need_no_mapping() -> None:
    assert ("voltage", -3, 1) == Naming().of("voltage_mV")
    assert ("displacement", 0, -1) == Naming(units={"displacement": "-um"}).of("displacement_um")


# Arrays and tables


def test_arrays_are_a_record() -> None:
    assert_same(Record.from_arrays(VOLTAGE.tolist(), DISPLACEMENT, interval=0.01))
    assert Record.from_arrays(VOLTAGE, interval=0.01).displacement is None


@pytest.mark.parametrize(
    ("arrays", "line"),
    [
        ((VOLTAGE, DISPLACEMENT[1:]), "displacement: 199 samples, voltage has 200"),
        ((VOLTAGE[:5], DISPLACEMENT[:5]), "too short, samples: 5"),
        ((0 * VOLTAGE, DISPLACEMENT), "voltage_V: constant at 0"),
        ((VOLTAGE * np.nan, DISPLACEMENT), "voltage: nan at sample 0; give finite numbers"),
        ((["a"] * 200, DISPLACEMENT), "voltage: not numbers"),
        ((1e12 * VOLTAGE, DISPLACEMENT), "is absurdly large; check the unit"),
    ],
)
def test_arrays_that_are_no_record_are_one_line(arrays: tuple[Any, Any], line: str) -> None:
    with pytest.raises(InputError, match=line):
        Record.from_arrays(*arrays, interval=0.01)


def test_a_table_is_a_record() -> None:
    frame = pd.DataFrame(VALUES)
    assert_same(Record.from_pandas(frame, **COLUMNS, units=UNIT))
    own = pd.DataFrame({"time_s": TIME, "voltage_V": VOLTAGE, "displacement_um": DISPLACEMENT})
    assert_same(Record.from_pandas(own))
    plan = Record.from_pandas(own.drop(columns="displacement_um"))
    assert plan.displacement is None


def test_a_tables_columns_and_index_are_recognised() -> None:
    frame = pd.DataFrame(VALUES)
    assert_same(Record.from_pandas(frame, units=UNIT))
    assert_same(Record.from_pandas(frame.set_index("t [ms]"), units=UNIT))
    moments = pd.to_timedelta(VALUES["t [ms]"], unit="ms")
    assert_same(Record.from_pandas(frame.drop(columns="t [ms]").set_index(moments), units=UNIT))


@pytest.mark.parametrize("kind", ["datetime64[ns]", "datetime64[us]", "timedelta64[ns]"])
def test_a_table_may_have_dates_for_times(kind: str) -> None:
    """They need no unit."""
    dates = (TIME * 1e9).round().astype("timedelta64[ns]")
    if kind.startswith("date"):
        dates = np.datetime64("2024-01-01", "ns") + dates
    frame = pd.DataFrame(VALUES).drop(columns="t [ms]").assign(when=dates.astype(kind))
    assert_same(Record.from_pandas(frame, **COLUMNS | {"time": "when"}, units=UNIT))
    assert_same(Record.from_pandas(frame, units=UNIT))


@pytest.mark.parametrize(
    ("change", "line"),
    [
        (
            {"displacement": "poss"},
            "DataFrame: no column 'poss' for the displacement; did you mean",
        ),
        ({"displacement": "U_mV"}, "columns: two quantities have the same column"),
    ],
)
def test_a_tables_column_that_is_misspelt_is_one_line(change: dict[str, Any], line: str) -> None:
    with pytest.raises(InputError, match=line):
        Record.from_pandas(pd.DataFrame(VALUES), **COLUMNS | change, units=UNIT)


def test_a_gap_in_a_table_is_one_line_or_held() -> None:
    frame = pd.DataFrame(VALUES).drop(index=range(50, 60))
    with pytest.raises(InputError, match=r"sample 50: t \[ms\]: gap of 0.11 s after 0.49 s"):
        Record.from_pandas(frame, **COLUMNS, units=UNIT)
    with pytest.warns(InputWarning, match="10 samples are missing"):
        held = Record.from_pandas(frame, **COLUMNS, units=UNIT, voltage_is="command")
    assert (200, 190) == (held.samples, held.readings)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        Record.from_pandas(pd.DataFrame(VALUES), **COLUMNS, units=UNIT)
