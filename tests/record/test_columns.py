"""Columns and units of any file, pair of files, table or array: recognized, said, or asked for."""

from collections.abc import Callable
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import h5py
import numpy as np
import pandas as pd
import pytest
import scipy.io
from hypothesis import assume, given, strategies as st

from bwbayes.errors import ColumnsError, InputError, InputWarning
from bwbayes.record import Record, read_record
from bwbayes.record.io.columns import Naming, select
from bwbayes.record.io.recognition import power_of
from bwbayes.record.io.series import frame_source

TIME = np.arange(200) / 100
VOLTAGE = 50 * np.sin(6 * TIME)
DISPLACEMENT = 0.7 * VOLTAGE
COLUMNS: dict[str, Any] = {"time": "t [ms]", "voltage": "U_mV", "displacement": "pos"}
UNIT = {"displacement": "nm"}
VALUES = {"t [ms]": 1e3 * TIME, "U_mV": 1e3 * VOLTAGE, "pos": 1e3 * DISPLACEMENT}


def write(path: Path, values: dict[str, Any]) -> Path:
    if path.suffix == ".csv":
        pd.DataFrame(values).to_csv(path, index=False)
    elif path.suffix == ".h5":
        with h5py.File(path, "w") as file:
            file.update(values)
    else:  # MATLAB's names have no brackets
        scipy.io.savemat(path, {name.partition(" ")[0]: x for name, x in values.items()})
    return path


def assert_same(record: Record, sign: float = 1.0) -> None:
    assert record.interval == pytest.approx(0.01)
    np.testing.assert_allclose(record.voltage, VOLTAGE, atol=1e-9)
    assert record.displacement is not None
    np.testing.assert_allclose(record.displacement, sign * DISPLACEMENT, atol=1e-9)


@pytest.mark.parametrize(
    ("columns", "units", "line"),
    [
        ({"displacement": "poss"}, UNIT, "no column 'poss' for the displacement; choose another."),
        ({}, {}, r"which unit has 'pos' \(displacement\)\? .* 'pos' \(-3.*; say .*units={'disp"),
        (
            {},
            {"displacement": "ell"},
            "units: displacement in 'ell' is unknown; write um, nm, mm, m",
        ),
        ({}, UNIT | {"displacement": "s"}, "units: displacement in 's' is unknown"),
        ({"position": "pos"}, UNIT, "columns: no quantity 'position'; write time, voltage, disp"),
        ({"voltage": "pos"}, UNIT, "columns: two quantities have the same column"),
        ({}, UNIT | {"time": "-s"}, "units: time does not run backwards"),
    ],
)
def test_a_mapping_that_is_wrong_is_one_line(
    tmp_path: Path, columns: dict[str, str], units: dict[str, str], line: str
) -> None:
    with pytest.raises(InputError, match=line):
        read_record(write(tmp_path / "a.h5", VALUES), columns=COLUMNS | columns, units=units)


@pytest.mark.parametrize("suffix", [".csv", ".h5", ".mat"])
def test_columns_are_recognized_where_none_are_said(tmp_path: Path, suffix: str) -> None:
    units = UNIT | ({"time": "ms"} if suffix == ".mat" else {})
    path = write(tmp_path / f"a{suffix}", VALUES)
    assert_same(read_record(path, units=units))
    with pytest.raises(InputError, match=r"which unit has .*'pos' \(displacement\)\?"):
        read_record(path)


def test_a_column_that_is_recognized_by_its_unit_alone_is_named(tmp_path: Path) -> None:
    frame = pd.DataFrame(VALUES).rename(columns={"pos": "displcement_nm"})
    frame.to_csv(tmp_path / "a.csv", index=False)
    with pytest.warns(InputWarning, match=r"a.csv: taken by its unit: displacement is 'displcem"):
        assert_same(read_record(tmp_path / "a.csv"))
    with pytest.warns(InputWarning, match=r"DataFrame: taken by its unit: displacement is"):
        assert_same(Record.from_pandas(frame))


def test_the_packages_own_names_come_before_others(tmp_path: Path) -> None:
    """And a simulated record's truth is never taken for a displacement."""
    path = write(tmp_path / "a.h5", {"time_s": TIME, "voltage_V": VOLTAGE, "truth_um": VOLTAGE})
    assert read_record(path, need_displacement=False).displacement is None
    with h5py.File(path, "a") as file:
        file["displacement_um"], file["pos (um)"] = DISPLACEMENT, VOLTAGE
    assert_same(read_record(path))


def test_a_file_without_series_of_numbers_is_refused_in_one_line(tmp_path: Path) -> None:
    """One number a name, or JSON lines, which have as many fields as a table, each named."""
    path = write(tmp_path / "a.h5", dict.fromkeys("abc", np.ones(1)))
    with pytest.raises(InputError, match="no column has more than one number; give a row for each"):
        read_record(path)
    path = tmp_path / "a.jsonl"
    path.write_text("".join(f'{{"t": {t / 1000:.3f}, "voltage_V": 1.5}}\n' for t in range(300)))
    with pytest.raises(InputError, match="no column holds only numbers; export it as CSV"):
        read_record(path, need_displacement=False)


@pytest.mark.parametrize("suffix", [".csv", ".h5", ".mat"])
def test_all_that_is_missing_is_said_at_once(tmp_path: Path, suffix: str) -> None:
    """With a guess, in the words of Python, a config and the command line, to copy and correct."""
    arrays = {"clock": 1e3 * TIME, "amp": VOLTAGE, "laser": DISPLACEMENT}
    path = write(tmp_path / f"a{suffix}", arrays)
    with pytest.raises(ColumnsError) as caught:
        read_record(path)
    error = caught.value
    text = str(error)
    assert "which column is the time, which the voltage, which the displacement?" in text
    assert all(f"'{name}' (" in text for name in arrays)
    assert "units={'time': 's', 'voltage': 'V', 'displacement': 'um'}" in text
    assert "under [record] say columns = { time = " in str(error.in_config())
    command = str(error.in_command("bwbayes run a.csv"))
    assert "copy and correct: bwbayes run a.csv --column time=" in command
    assert command.endswith("--unit time=s --unit voltage=V --unit displacement=um")
    columns = dict(zip(COLUMNS, arrays, strict=True))
    units = {"time": "ms", "voltage": "V", "displacement": "um"}
    assert_same(read_record(path, columns=columns, units=units))


def test_a_sampling_rate_takes_the_place_of_a_time_column(tmp_path: Path) -> None:
    values = {"voltage_V": VOLTAGE, "displacement_um": DISPLACEMENT, "temp_C": np.cos(TIME)}
    path = write(tmp_path / "a.h5", values)
    line = r"what is the sampling rate, Hz \(no column can be .* mean nothing\)\?.*; say fs=HZ"
    with pytest.raises(ColumnsError, match=line) as caught:
        read_record(path)
    assert {"columns": {}, "units": {}} == caught.value.guess
    assert_same(read_record(path, fs=100.0))
    with pytest.raises(InputError, match=r"fs: 0 Hz is no sampling rate"):
        read_record(path, fs=0.0)


@given(st.floats(-300, 300))
def test_a_rate_has_the_limits_of_times(exponent: float) -> None:
    """Whether it is given as times, an interval or a rate: from 1e-10 s on, for 1e12 s at most."""
    interval = 10.0**exponent
    frame = pd.DataFrame({"voltage_V": VOLTAGE, "displacement_um": DISPLACEMENT})
    arrays = VOLTAGE, DISPLACEMENT
    readings: list[Callable[[], Record]] = [
        lambda: Record.from_pandas(frame, fs=1 / interval),
        lambda: Record.from_arrays(*arrays, interval=interval),
        lambda: Record.from_arrays(*arrays, time=interval * np.arange(200)),
    ]
    for read in readings:
        if 1.1e-10 <= interval <= 0.9e12 / 200:
            assert read().interval == pytest.approx(interval)
        elif not 0.9e-10 <= interval <= 1.1e12 / 200:
            with pytest.raises(InputError, match=r"is absurd; check|absurdly large; check"):
                read()


def test_the_ends_of_a_time_stamps_range_can_be_told_apart(tmp_path: Path) -> None:
    stamps = np.round(1.76e9 + np.arange(900) / 50, 3)
    values = {"timestamp": stamps, "u (V)": np.arange(900) % 7, "pos (um)": np.arange(900) % 5}
    with pytest.raises(InputError, match=r"'timestamp' \(1760000000 to 1760000018\)"):
        read_record(write(tmp_path / "a.csv", values))


@pytest.mark.parametrize("columns", [{}, {"time": "t"}])
def test_units_of_time_are_asked_for_with_their_rates(
    tmp_path: Path, columns: dict[str, str]
) -> None:
    name = "t" if columns else "clock"
    values = {name: 2 * np.arange(200), "voltage_V": VOLTAGE, "displacement_um": DISPLACEMENT}
    line = rf"{name}' is 0.5 Hz for 398 s in s, 500 Hz for 0.398 s in ms, 500000 Hz for"
    with pytest.raises(ColumnsError, match=line):
        read_record(write(tmp_path / "a.csv", values), columns=columns)


@given(
    st.sampled_from([("time", "ms"), ("time", "us"), ("voltage", "mV"), ("displacement", "nm")]),
    st.sampled_from(["{}_since_midnight", "logged {} of it", "raw.{}-now", "a ({}) b"]),
    st.booleans(),
)
def test_a_unit_anywhere_in_a_name_is_the_guess(
    unit: tuple[str, str], form: str, is_named: bool
) -> None:
    """It is only suggested, whether its column is named or guessed as well."""
    quantity, name = unit[0], form.format(unit[1])
    values = {"time_s": TIME, "voltage_V": VOLTAGE, "displacement_um": DISPLACEMENT}
    usual = next(key for key in values if key.startswith(quantity))
    frame = pd.DataFrame(values).rename(columns={usual: name})
    with pytest.raises(ColumnsError) as caught:
        select(frame_source(frame, "a"), Naming({quantity: name} if is_named else {}))
    assert f"--unit {quantity}={unit[1]}" in str(caught.value.in_command("bwbayes run a.csv"))


def test_a_sensors_volts_are_asked_for_with_their_sensitivity(tmp_path: Path) -> None:
    values = {"time_s": TIME, "amplifier [V]": VOLTAGE, "gauge [mV]": DISPLACEMENT}
    line = r"which the displacement, and how many um is 1 mV of 'gauge \[mV\]'\? .*t': '\? um'}$"
    with pytest.raises(ColumnsError, match=line):
        read_record(write(tmp_path / "a.csv", values))


@pytest.mark.parametrize(
    "form",
    [
        *("{} /10\u207b\u2076 {}", "{} (10^-6 {})", "{} (x10-6 {})", "{} 1e-6 {}", "{} [1E-3 {}]"),
        *("{} x10 ({})", "{} \u00d7100 [{}]", "{}/10 ({})", "{} 1:20 [{}]", "{} *1000 / {}"),
    ],
)
@pytest.mark.parametrize("unit_in_row", [False, True])
def test_a_factor_in_a_name_leaves_open_what_its_numbers_stand_for(
    tmp_path: Path, form: str, unit_in_row: bool
) -> None:
    """It may be of the unit or of the numbers; a sensitivity from the user settles it."""
    name = form.format("stage", "um")
    rows = [f"{t},{v},{d}" for t, v, d in zip(TIME, VOLTAGE, DISPLACEMENT, strict=True)]
    head = [f"t,U,{name}", "s,V,um"] if unit_in_row else [f"t (s),U (V),{name}"]
    (tmp_path / "a.csv").write_text("\n".join([*head, *rows, ""]))
    with pytest.raises(ColumnsError) as caught:
        read_record(tmp_path / "a.csv")
    assert "--unit displacement='? " in str(caught.value.in_command("bwbayes run a.csv"))
    said: Any = {"columns": {"displacement": name}, "units": {"displacement": "10 um"}}
    displacement = read_record(tmp_path / "a.csv", **said).displacement
    assert displacement is not None
    np.testing.assert_allclose(displacement.tolist(), [10 * value for value in DISPLACEMENT])


@pytest.mark.parametrize("named", ["um", "nm", "mm"])
@pytest.mark.parametrize("stated", ["um", "nm", "mm", "\u339b"])
def test_a_unit_that_a_name_and_a_row_state_differently_is_asked_for(
    tmp_path: Path, named: str, stated: str
) -> None:
    """Also where it is one character, as micrometers are in some alphabets."""
    rows = [f"{t},{v},{d}" for t, v, d in zip(TIME, VOLTAGE, DISPLACEMENT, strict=True)]
    head = [f"t (s),U (V),x ({named})", f"s,V,{stated}"]
    (tmp_path / "a.csv").write_text("\n".join([*head, *rows, ""]), encoding="utf-8")
    if power_of(named, "displacement") == power_of(stated, "displacement"):
        assert read_record(tmp_path / "a.csv").samples == len(TIME)
        return
    with pytest.raises(ColumnsError, match=f"how many .m is 1 {stated} of 'x \\({named}\\)'"):
        read_record(tmp_path / "a.csv")


@pytest.mark.parametrize("command", ["command (V)", "Command [mV]"])
def test_a_command_is_taken_for_the_voltage_unless_an_output_may_be_there(
    tmp_path: Path, command: str
) -> None:
    values = {"time_s": TIME, command: VOLTAGE, "x (um)": DISPLACEMENT}
    assert read_record(write(tmp_path / "a.csv", values)).samples == len(TIME)
    values["monitor (V)"] = VOLTAGE
    with pytest.raises(ColumnsError, match="which column is the voltage"):
        read_record(write(tmp_path / "a.csv", values))


@pytest.mark.filterwarnings("ignore:.* above the header skipped")
@given(
    st.sampled_from([("s", 1.0), ("ms", 1e3), ("us", 1e6)]),
    st.sampled_from([1.0, 60.0, 3600.0]),
    st.floats(-10, 1000),
)
def test_times_at_a_stated_interval_need_no_unit(
    unit: tuple[str, float], other: float, start: float
) -> None:
    """An interval that none of the usual units has tells nothing."""
    times = (round(start, 3) + 0.005 * np.arange(VOLTAGE.size)) * unit[1]
    rows = np.column_stack([times, VOLTAGE, DISPLACEMENT]).tolist()
    lines = [",".join(map(repr, row)) for row in rows]
    with TemporaryDirectory() as folder:
        path = Path(folder, "a.csv")
        head = [f"Sample Interval,{0.005 * other}", "", "TIME,voltage (V),displacement (um)"]
        path.write_text("\n".join(head + lines) + "\n", encoding="utf-8")
        if other == 1:
            assert read_record(path).interval == pytest.approx(0.005, rel=1e-9)
        else:
            with pytest.raises(ColumnsError, match="which unit has 'TIME'"):
                read_record(path)


@given(
    st.sampled_from(["unix_time", "Unix Timestamp", "epoch"]),
    st.sampled_from([("s", 1), ("ms", 10**3), ("us", 10**6), ("ns", 10**9)]),
    st.integers(315_600_000, 7_100_000_000),
)
def test_times_from_1970_need_no_unit(name: str, unit: tuple[str, int], start: int) -> None:
    """If their column says that they are such: in other units they are no dates of our time."""
    frame = pd.DataFrame({"voltage_V": VOLTAGE, "displacement_um": DISPLACEMENT})
    frame[name] = start * unit[1] + np.arange(200) * unit[1] // 100
    if unit[1] == 1:
        frame[name] = start + np.round(TIME, 2)
    assert_same(Record.from_pandas(frame))
    with pytest.raises(ColumnsError, match="which unit has"):
        Record.from_pandas(frame.assign(**{name: frame[name] / 1e11}))


def test_a_position_that_was_read_is_proposed_before_one_that_was_asked_for(tmp_path: Path) -> None:
    for demand in ("Target Position", "Set Point", "Commanded Position", "Reference"):
        values = {"time_s": TIME, "voltage_V": VOLTAGE, demand: VOLTAGE, "Actual Position": TIME**2}
        with pytest.raises(ColumnsError) as caught:
            read_record(write(tmp_path / "a.csv", values))
        assert caught.value.guess["columns"] == {"displacement": "Actual Position"}


@pytest.mark.parametrize(
    ("unit", "factor"), [("Å", 1e-4), ("mil", 25.4), ("in", 25_400.0), ("um", 1.0)]
)
@pytest.mark.parametrize(("clock", "seconds"), [("min", 60.0), ("h", 3600.0), ("ms", 1e-3)])
def test_units_beside_those_of_the_si_are_known(
    unit: str, factor: float, clock: str, seconds: float
) -> None:
    """In brackets; an ending alone may mean something else, and is only guessed."""
    values = (TIME / seconds, VOLTAGE, DISPLACEMENT / factor)
    names = [f"t [{clock}]", "U [V]", f"pos ({unit})"]
    assert_same(Record.from_pandas(pd.DataFrame(dict(zip(names, values, strict=True)))))
    frame = pd.DataFrame({"t_min": TIME, "voltage_V": VOLTAGE, "stroke_in": DISPLACEMENT})
    with pytest.raises(ColumnsError) as caught:
        select(frame_source(frame, "a"), Naming())
    assert caught.value.guess["units"] == {"time": "min", "displacement": "in"}


def test_a_unit_that_is_none_of_the_quantity_is_said(tmp_path: Path) -> None:
    values = {"time_s": TIME, "Spannung (%)": VOLTAGE, "Weg (Inkr)": DISPLACEMENT}
    line = r"how many V is 1 % of 'Spannung \(%\)', and how many um is 1 Inkr of 'Weg \(Inkr\)'\?"
    with pytest.raises(ColumnsError, match=line):
        read_record(write(tmp_path / "a.csv", values))


@given(st.permutations(["time", "voltage", "displacement"]))
def test_a_number_is_that_of_a_column_whatever_the_names_are(order: list[str]) -> None:
    values = dict(
        zip(["time", "voltage", "displacement"], (TIME, VOLTAGE, DISPLACEMENT), strict=True)
    )
    frame = pd.DataFrame({str(3 - i): values[quantity] for i, quantity in enumerate(order)})
    columns: Any = {quantity: np.int64(order.index(quantity) + 1) for quantity in order}
    table = select(
        frame_source(frame, "a"),
        Naming(columns, {"time": "s", "voltage": "V", "displacement": "um"}),
    )
    np.testing.assert_array_equal(table.values["voltage"], VOLTAGE)
    with pytest.raises(InputError, match=r"columns: displacement: 1.5 is no name and no number"):
        Naming({"displacement": 1.5})  # type: ignore[dict-item]


@given(
    st.floats(1e-9, 1e9),
    st.sampled_from(["{:.17g} {}", "-{:.17e}{}", "{:.17f}  {}"]),
    st.sampled_from(["um", "nm", "mm", "µm", "micron"]),
    st.sampled_from(["V", "kV", "millivolt"]),
)
def test_a_number_of_units_is_a_sensitivity(number: float, form: str, unit: str, volt: str) -> None:
    """For a displacement in volts or counts, or an amplifier's monitor, with a sign or without."""
    sensitivity = form.format(number, unit)
    units = {"displacement": sensitivity, "voltage": f"{number!r} {volt}", "time": "0.1 ms"}
    sign = -1.0 if form.startswith("-") else 1.0
    counts = sign * DISPLACEMENT / number / 10.0 ** (power_of(unit, "displacement") or 0)
    volts = VOLTAGE / number / 10.0 ** (power_of(volt, "voltage") or 0)
    assert_same(Record.from_arrays(volts, counts, time=1e4 * TIME, units=units))


def test_a_sensitivity_per_volt_is_not_taken_for_one_per_millivolt() -> None:
    """Which a column that states its unit would be read by a thousand times too large."""
    frame = pd.DataFrame({"time_s": TIME, "drive [V]": VOLTAGE, "gauge [mV]": DISPLACEMENT})
    assert_same(Record.from_pandas(frame, displacement="gauge [mV]", units={"displacement": "um"}))
    for unit in ("1 um/V", "1 V/um"):
        with pytest.raises(InputError, match=r"gauge \[mV\]: in mV, not in V; say how many um is"):
            Record.from_pandas(frame, displacement="gauge [mV]", units={"displacement": unit})
    frame = frame.rename(columns={"gauge [mV]": "gauge [V]"})
    assert_same(Record.from_pandas(frame, displacement="gauge [V]", units={"displacement": "um/V"}))


@pytest.mark.parametrize(
    "unit", ["0 um", "0.35", "1e999 um", "1 2 um", "--um", "x um", "1 V/V", "0 V/um", "1/um"]
)
def test_a_number_without_a_unit_or_with_a_strange_one_is_refused(unit: str) -> None:
    with pytest.raises(InputError, match=r"is unknown; write um, .* as '0.35 um'"):
        Record.from_arrays(VOLTAGE, DISPLACEMENT, interval=0.01, units={"displacement": unit})


@pytest.mark.parametrize(("second", "scale"), [("s", 1.0), ("ms", 1e3), ("us", 1e6)])
@pytest.mark.parametrize(("length", "size"), [("nm", 1e3), ("-nm", -1e3), ("mm", 1e-3)])
def test_arrays_may_have_times_and_units(
    second: str, scale: float, length: str, size: float
) -> None:
    """As the columns of a file have, and the same numbers to the last bit."""
    units = {"time": second, "displacement": length, "voltage": "mV"}
    time, voltage, displacement = scale * TIME, 1e3 * VOLTAGE, size * DISPLACEMENT
    record = Record.from_arrays(voltage, displacement, time=time.tolist(), units=units)
    assert_same(record)
    frame = pd.DataFrame({"time": time, "voltage": voltage, "displacement": displacement})
    assert record.sha256 == Record.from_pandas(frame, units=units).sha256
    plan = Record.from_arrays(voltage, time=time, units=units)
    assert (plan.displacement, plan.interval) == (None, record.interval)


@pytest.mark.parametrize(
    ("changes", "line"),
    [
        ({"time": None}, r"arrays: give either interval \(and start\), in s, or time, a vector"),
        ({"interval": 0.01}, "arrays: give either interval .*, or time, a vector"),
        ({"start": 1.0}, "arrays: give either interval .*, or time, a vector"),
        (
            {"time": None, "interval": 0.01, "units": {"time": "ms"}},
            "arrays: units: interval is in",
        ),
        ({"time": None, "interval": -1.0}, "interval: -1.0 s is not a positive time"),
        ({"time": TIME[1:]}, "arrays: voltage: 200 values where time has 199; store one"),
        ({"time": ["a"] * 200}, "time: not numbers"),
        ({"time": np.full(200, np.nan)}, "arrays:sample 0: time: no number .*; give one, or leave"),
        ({"voltage": ["a"] * 200}, "voltage: not numbers"),
        ({"voltage": VOLTAGE.reshape(2, 100)}, r"voltage: shape \(2, 100\) is no vector; give"),
    ],
)
def test_arrays_that_are_no_record_are_one_line(changes: dict[str, Any], line: str) -> None:
    arrays = {"time": TIME, "voltage": VOLTAGE, "displacement": DISPLACEMENT}
    with pytest.raises(InputError, match=line):
        Record.from_arrays(**arrays | changes)


@given(st.lists(st.sampled_from([(-1,), (-1, 1), (1, -1)]), min_size=3, max_size=3))
def test_rows_and_columns_are_vectors(shapes: list[tuple[int, ...]]) -> None:
    arrays = [x.reshape(s) for x, s in zip((TIME, VOLTAGE, DISPLACEMENT), shapes, strict=True)]
    time, voltage, displacement = arrays
    assert_same(Record.from_arrays(voltage, displacement, time=time))


@given(
    st.sampled_from([-9999.0, 9999.0, 1e30, -32768.0, 1.7e308, -120.0]),
    st.sets(st.integers(0, 199), min_size=2, max_size=150),
    st.sampled_from(["um", "nm", "mm"]),
)
def test_a_number_far_from_all_readings_that_is_repeated_is_a_missing_one(
    mark: float, where: set[int], unit: str
) -> None:
    """As loggers write where there is nothing to read, however often, in any unit; it is said."""
    rows = sorted(where)
    inside = (VOLTAGE[rows] >= np.delete(VOLTAGE, rows).min()) & (
        VOLTAGE[rows] <= np.delete(VOLTAGE, rows).max()
    )
    assume(np.mean(inside) > 0.5)
    displacement = np.round(DISPLACEMENT, 4)
    displacement[rows] = mark
    arrays: dict[str, Any] = {"voltage": VOLTAGE, "displacement": displacement, "interval": 0.01}
    line = rf"arrays:sample {rows[0]}: displacement: .* {len(where)} times, far from all other"
    with pytest.warns(InputWarning, match=line):
        record = Record.from_arrays(**arrays, units={"displacement": unit})
    assert rows == np.flatnonzero(~record.has_reading).tolist()


def test_a_number_that_may_be_a_reading_stays_one() -> None:
    step = np.where(np.arange(200) < 20, 0.0, 50.0 + 0.1 * np.sin(TIME))
    cases: list[tuple[Any, list[int], float]] = [
        (VOLTAGE, [50], -9999.0),
        (VOLTAGE, [50, 60, 70], -80.0),
        (step, [*range(20)], -9999.0),
    ]
    for voltage, rows, mark in cases:
        displacement = 0.7 * voltage + 0.1 * np.cos(50 * TIME)
        displacement[rows] = mark
        record = Record.from_arrays(voltage, displacement, interval=0.01)
        assert 200 == record.readings


@pytest.mark.parametrize("kind", ["datetime64[ns]", "datetime64[us]", "timedelta64[ns]"])
def test_a_table_may_have_dates_or_an_index_for_times(kind: str) -> None:
    frame = pd.DataFrame(VALUES)
    assert_same(Record.from_pandas(frame.set_index("t [ms]"), units=UNIT))
    dates = (TIME * 1e9).round().astype("timedelta64[ns]")
    if kind.startswith("date"):
        dates = np.datetime64("2024-01-01", "ns") + dates
    frame = frame.drop(columns="t [ms]")
    assert_same(Record.from_pandas(frame.set_index(dates.astype(kind)), units=UNIT))
    frame = frame.assign(when=dates.astype(kind))
    assert_same(Record.from_pandas(frame, units=UNIT))
    assert_same(Record.from_pandas(frame, **COLUMNS | {"time": "when"}, units=UNIT))


def test_a_gap_in_a_table_is_one_line_or_held() -> None:
    frame = pd.DataFrame(VALUES).drop(index=range(50, 120))
    with pytest.raises(InputError, match=r"sample 50: t \[ms\]: gap of 0.71 s after 0.49 s"):
        Record.from_pandas(frame, **COLUMNS, units=UNIT)
    with pytest.warns(InputWarning, match="70 samples are missing"):
        held = Record.from_pandas(frame, **COLUMNS, units=UNIT, voltage_is="command")
    assert (200, 130) == (held.samples, held.readings)


# Voltage and displacement in files of their own are one record


SAMPLES = 40
PAIR_TIME = 0.5 + 0.005 * np.arange(SAMPLES)
STEPS = np.arange(SAMPLES)
PAIR_VALUES = {"voltage": 30.0 * np.sin(STEPS), "displacement": 9.0 * np.cos(STEPS)}
UNITS = {"voltage": "V", "displacement": "um"}
HEADERS = {
    "voltage": ["U [V]", "amp (V)"],
    "displacement": ["sensor / um", "gauge (um)", "y in um"],
}


def written(
    path: Path, quantity: str, header: str, separator: str, decimal: str, *, timed: bool
) -> Path:
    columns = [PAIR_TIME, PAIR_VALUES[quantity]] if timed else [PAIR_VALUES[quantity]]
    rows = [
        separator.join(f"{x:.6f}".replace(".", decimal) for x in row)
        for row in zip(*columns, strict=True)
    ]
    head = [separator.join(["t (s)"] * timed + [header])] if header else []
    path.write_text("\n".join([*head, *rows]) + "\n")
    return path


@given(
    headers=st.tuples(*(st.sampled_from([*HEADERS[q], ""]) for q in PAIR_VALUES)),
    timed=st.tuples(st.booleans(), st.booleans()),
    separator=st.sampled_from([";", "\t", " "]),
    decimal=st.sampled_from(".,"),
)
def test_two_files_are_a_record_whatever_their_only_columns_are_called(
    folder: Path, headers: tuple[str, str], timed: tuple[bool, bool], separator: str, decimal: str
) -> None:
    """With times in both, one or neither; a column without a name has no unit either."""
    files = {}
    for quantity, header, has_times in zip(PAIR_VALUES, headers, timed, strict=True):
        # Times need a name, or nothing tells them from values.
        files[quantity] = written(
            folder / f"{quantity}.txt",
            quantity,
            header,
            separator,
            decimal,
            timed=has_times and bool(header),
        )
    is_timed = any(has_times and header for has_times, header in zip(timed, headers, strict=True))
    options: dict[str, Any] = {
        "units": {q: UNITS[q] for q, header in zip(UNITS, headers, strict=True) if not header}
    }
    options |= {} if is_timed else {"fs": 200.0}
    record = read_record(files["voltage"], displacement_file=files["displacement"], **options)
    np.testing.assert_allclose(record.voltage, PAIR_VALUES["voltage"], atol=1e-6)
    np.testing.assert_allclose(
        np.asarray(record.displacement), PAIR_VALUES["displacement"], atol=1e-6
    )
    assert record.interval == pytest.approx(0.005)
    assert record.start == (0.5 if is_timed else 0.0)
    assert record.origin == "voltage.txt, displacement.txt"


def test_all_that_is_open_of_both_files_is_asked_at_once(tmp_path: Path) -> None:
    form: dict[str, Any] = {"header": "", "separator": ";", "decimal": "."}
    files = [written(tmp_path / f"{q}.txt", q, **form, timed=False) for q in PAIR_VALUES]
    with pytest.raises(ColumnsError) as caught:
        read_record(files[0], displacement_file=files[1])
    command = str(caught.value.in_command("bwbayes run"))
    assert "--unit voltage=V --unit displacement=um --fs" in command
    assert "--column" not in command
    for file in files:
        written(file, file.stem, **form, timed=True)
    with pytest.raises(ColumnsError) as caught:
        read_record(files[0], displacement_file=files[1])
    guess: dict[str, Any] = caught.value.guess
    assert guess["columns"] == {"time": "1", "voltage": "2", "displacement": "2"}
    record = read_record(files[0], displacement_file=files[1], **guess)
    np.testing.assert_allclose(
        np.asarray(record.displacement), PAIR_VALUES["displacement"], atol=1e-6
    )


@pytest.mark.parametrize(
    ("spoil", "problem"),
    [
        (lambda rows: rows[:-3], "displacement.txt: 37 displacements for 40 voltages in "),
        (
            lambda rows: [row.replace("0.550", "0.552") for row in rows],
            "displacement.txt: t (s): sample 10 is at 0.552 s, in ",
        ),
        (lambda rows: [*rows[:5], "0.520000;1.5x", *rows[6:]], "txt:6: y (um): '1.5x' is not a nu"),
    ],
)
def test_files_that_do_not_fit_together_are_one_line(
    tmp_path: Path, spoil: Any, problem: str
) -> None:
    form: dict[str, Any] = {"separator": ";", "decimal": ".", "timed": True}
    voltage = written(tmp_path / "voltage.txt", "voltage", "u (V)", **form)
    other = written(tmp_path / "displacement.txt", "displacement", "y (um)", **form)
    other.write_text("\n".join(spoil(other.read_text().splitlines())))
    with pytest.raises(InputError) as caught:
        read_record(voltage, displacement_file=other)
    assert problem in str(caught.value)
    assert "; " in str(caught.value)


def test_a_file_of_the_voltage_alone_needs_another(tmp_path: Path) -> None:
    form: dict[str, Any] = {"separator": ";", "decimal": ".", "timed": True}
    voltage = written(tmp_path / "voltage.txt", "voltage", "u (V)", **form)
    with pytest.raises(InputError, match="no column for the displacement; add it, or say in which"):
        read_record(voltage)
    assert read_record(voltage, need_displacement=False).samples == SAMPLES
