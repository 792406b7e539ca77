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

from bwbayes.errors import ColumnsError, InputError, InputWarning
from bwbayes.record import Record, read_record
from bwbayes.record.io.columns import Naming, choose, unit_in
from bwbayes.record.io.series import Series, Source

PREFIXES = ("", "n", "u", "µ", "μ", "m", "k")

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
@pytest.mark.parametrize(
    ("columns", "units", "line"),
    [
        (
            {"displacement": "poss"},
            UNIT,
            "no column 'poss' for the displacement; choose one of There are 200 values each: '",
        ),
        (
            {},
            {},
            r"which unit has 'pos' \(displacement\)\? There .* 'pos' \(-3.*; say .*units={'displ",
        ),
        ({}, {"displacement": "in"}, "units: displacement in 'in' is unknown; write um, nm, mm, m"),
        ({}, UNIT | {"displacement": "s"}, "units: displacement in 's' is unknown"),
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
def test_columns_are_recognized_where_none_are_said(tmp_path: Path, suffix: str) -> None:
    """A unit is all that has to be said, and of a MATLAB file's, which have none, each."""
    units = UNIT | ({"time": "ms"} if suffix == ".mat" else {})
    path = write(tmp_path / f"a{suffix}")
    assert_same(read_record(path, units=units))
    with pytest.raises(InputError, match=r"which unit has .*'(pos|x)' \(displacement\)\?"):
        read_record(path)


def test_a_column_that_is_recognized_by_its_unit_alone_is_named(tmp_path: Path) -> None:
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


def test_a_file_with_one_number_a_column_is_refused_in_one_line(tmp_path: Path) -> None:
    path = tmp_path / "a.h5"
    with h5py.File(path, "w") as file:
        file.update(a=np.ones(1), b=np.ones(1), c=np.ones(1))
    with pytest.raises(InputError, match="no column has more than one number; give a row for each"):
        read_record(path)


def test_a_file_whose_cells_are_all_more_than_numbers_is_refused_in_one_line(
    tmp_path: Path,
) -> None:
    """JSON lines have as many fields as a table, each with its name."""
    path = tmp_path / "a.jsonl"
    path.write_text(
        "".join(f'{{"time_s": {t / 1000:.3f}, "voltage_V": 1.5}}\n' for t in range(300))
    )
    with pytest.raises(InputError, match="no column holds only numbers; export it as CSV"):
        read_record(path, need_displacement=False)


@pytest.mark.parametrize("suffix", [".csv", ".h5", ".mat"])
def test_all_that_is_missing_is_said_at_once(tmp_path: Path, suffix: str) -> None:
    """With a guess that reads the file, in the words of Python, a config and the command line."""
    path = tmp_path / f"a{suffix}"
    arrays = {"clock": 1e3 * TIME, "amp": VOLTAGE, "laser": DISPLACEMENT}
    if suffix == ".csv":
        rows = [",".join(map(repr, row)) for row in np.stack([*arrays.values()], axis=1).tolist()]
        path.write_text("\n".join([",".join(arrays), *rows]) + "\n")
    elif suffix == ".h5":
        with h5py.File(path, "w") as file:
            for name, values in arrays.items():
                file[name] = values
    else:
        scipy.io.savemat(path, arrays)
    with pytest.raises(ColumnsError) as caught:
        read_record(path)
    error = caught.value
    said = str(error)
    assert "which column is the time, which the voltage, which the displacement?" in said
    for name in arrays:
        assert f"'{name}' (" in said
    assert "units={'time': 's', 'voltage': 'V', 'displacement': 'um'}" in said
    assert "under [record] say columns = { time = " in str(error.in_config())
    command = str(error.in_command("bwbayes run a.csv"))
    assert "copy and correct: bwbayes run a.csv --column time=" in command
    assert command.endswith("--unit time=s --unit voltage=V --unit displacement=um")
    assert_same(
        read_record(
            path,
            columns=dict(zip(("time", "voltage", "displacement"), arrays, strict=True)),
            units={"time": "ms", "voltage": "V", "displacement": "um"},
        )
    )


def test_a_sampling_rate_takes_the_place_of_a_time_column(tmp_path: Path) -> None:
    path = tmp_path / "a.csv"
    rows = [f"{v!r},{d!r}" for v, d in zip(VOLTAGE.tolist(), DISPLACEMENT.tolist(), strict=True)]
    path.write_text("\n".join(["voltage_V,displacement_um", *rows]) + "\n")
    with pytest.raises(
        InputError,
        match=r"what is the sampling rate, Hz \(no column can be the time\)\?.*; say fs=1000",
    ):
        read_record(path)
    assert_same(read_record(path, fs=100.0))
    with pytest.raises(InputError, match=r"fs: 0 Hz is no sampling rate"):
        read_record(path, fs=0.0)


# Names and units


@given(
    st.sampled_from([("time", f"{p}s") for p in PREFIXES] + [("voltage", f"{p}V") for p in PREFIXES]
                    + [("displacement", f"{p}m") for p in PREFIXES]),
    st.sampled_from(["{} [{}]", "{} ({})", "{}_{}", "{} / {}", "{}[{}]", "{} {}"]),
    st.text("abcdefgh 1", min_size=1).map(str.strip).filter(bool),
)  # fmt: skip
def test_a_unit_is_read_from_any_usual_name(one: tuple[str, str], form: str, word: str) -> None:
    quantity, unit = one
    assert unit == unit_in(form.format(word, unit), quantity)


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
def test_columns_are_recognized(names: list[str], expected: list[str] | None) -> None:
    source = Source(Path("a"), tuple(Series(name, 9, lambda: np.arange(9.0)) for name in names))
    quantities = ("time", "voltage", "displacement")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", InputWarning)
        units = dict(zip(quantities, ("s", "V", "um"), strict=True))
        chosen = choose(source, Naming(units=units))
    assert dict(zip(quantities, expected or names, strict=True)) == {
        quantity: series.name for quantity, (series, _) in chosen.items()
    }


def test_what_two_columns_may_be_is_left_open() -> None:
    names = ["t_s", "a_V", "b_V", "c_um", "d_um"]
    with pytest.raises(InputError, match=r"which column is the voltage\? There are 20 values each"):
        Record.from_pandas(pd.DataFrame(np.ones((20, 5)), columns=names))


# Arrays and tables


@pytest.mark.parametrize("time_unit", ["s", "ms", "us"])
@pytest.mark.parametrize(("length", "scale"), [("nm", 1e3), ("-nm", -1e3), ("mm", 1e-3)])
def test_arrays_may_have_times_and_units(time_unit: str, length: str, scale: float) -> None:
    """As the columns of a file have, and the same numbers to the last bit."""
    power = {"s": 1.0, "ms": 1e3, "us": 1e6}[time_unit]
    units = {"time": time_unit, "displacement": length, "voltage": "mV"}
    time, voltage, displacement = power * TIME, 1e3 * VOLTAGE, scale * DISPLACEMENT
    record = Record.from_arrays(voltage, displacement, time=time.tolist(), units=units)
    assert_same(record)
    frame = pd.DataFrame({"time": time, "voltage": voltage, "displacement": displacement})
    assert record.sha256 == Record.from_pandas(frame, units=units).sha256
    plan = Record.from_arrays(voltage, time=time, units=units)
    assert (plan.displacement, plan.interval) == (None, record.interval)


@pytest.mark.parametrize(
    ("options", "line"),
    [
        ({}, r"arrays: give either interval \(and start\), in s, or time, a vector"),
        ({"interval": 0.01, "time": TIME}, "arrays: give either interval .*, or time, a vector"),
        ({"time": TIME, "start": 1.0}, "arrays: give either interval .*, or time, a vector"),
        ({"interval": 0.01, "units": {"time": "ms"}}, "arrays: units: interval is in s; leave"),
        ({"time": TIME[1:]}, "time: 199 samples, voltage has 200; give the same"),
        ({"time": TIME[::-1]}, "arrays:sample 1: time_s: time goes back from 1.99 s to 1.98 s"),
        ({"time": TIME**2}, "arrays:sample .*: time_s: .*resample it on a uniform grid"),
        ({"time": ["a"] * 200}, "time: not numbers"),
        ({"time": np.full(200, np.nan)}, "time: nan at sample 0; give finite numbers"),
        ({"time": TIME, "units": {"displacement": "inch"}}, "displacement in 'inch' is unknown"),
        ({"time": TIME, "units": {"speed": "m"}}, "units: no quantity 'speed'; write time"),
        ({"interval": -1.0}, "interval: -1.0 s is not a positive time"),
    ],
)
def test_times_and_units_that_cannot_be_are_one_line(options: dict[str, Any], line: str) -> None:
    with pytest.raises(InputError, match=line):
        Record.from_arrays(VOLTAGE, DISPLACEMENT, **options)


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


def test_a_tables_columns_and_index_are_recognized() -> None:
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


def test_no_column_that_does_not_rise_is_guessed_to_be_the_time(tmp_path: Path) -> None:
    """A thermometer's column is left, and it is the sampling rate that is asked for."""
    voltage = 50 * np.sin(np.arange(200) / 10)
    temperature = 20 + np.cos(np.arange(200) / 40)
    rows = zip(voltage, 0.7 * voltage, temperature, strict=True)
    text = "\n".join(["u_V,x_um,temperature_degC", *(f"{u},{x},{t}" for u, x, t in rows), ""])
    path = tmp_path / "a.csv"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(ColumnsError, match="what is the sampling rate") as caught:
        read_record(path)
    assert {"columns": {}, "units": {}} == caught.value.guess
    assert caught.value.fs is not None


def test_the_ends_of_a_time_stamps_range_can_be_told_apart(tmp_path: Path) -> None:
    lines = [f"{1.76e9 + k / 50:.3f},{k % 7},{k % 5}" for k in range(900)]
    path = tmp_path / "a.csv"
    path.write_text("\n".join(["timestamp,u (V),pos (um)", *lines]))
    with pytest.raises(InputError, match=r"'timestamp' \(1760000000 to 1760000018\)"):
        read_record(path)
