"""Times that are not uniform, and series with times or clocks of their own, become one grid."""

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
from hypothesis import assume, example, given, strategies as st
from nptdms import ChannelObject, TdmsWriter

from bwbayes.arrays import FloatArray
from bwbayes.errors import InputError, InputWarning
from bwbayes.model.inputs import VoltageIs
from bwbayes.record import Record, read_record
from bwbayes.record.io.columns import Naming, select
from bwbayes.record.io.fields import record_fields
from bwbayes.record.io.series import array_source
from tests.record.conftest import quiet


def uneven(time: FloatArray, voltage: FloatArray, displacement: FloatArray) -> Record:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", InputWarning)
        return Record.from_arrays(voltage, displacement, time=time)


@given(
    st.integers(200, 3000),
    st.floats(-5, 0),
    st.floats(-100, 100),
    st.floats(0.02, 0.14),
    st.booleans(),
    st.integers(0, 2**32),
)
def test_columns_are_what_they_were_at_the_times_of_the_grid(
    samples: int, exponent: float, start: float, jitter: float, drifts: bool, seed: int
) -> None:
    """Any scatter of any clock, about a grid or from step to step, displacements missing or not.

    A cubic is met within what central differences leave of it, twenty times better than by taking
    each sample as it is (the twin); a displacement that is linear in the voltage stays so.
    """
    rng, interval = np.random.default_rng(seed), 10.0**exponent
    scatter = jitter * interval * np.clip(rng.standard_normal(samples), -3, 3)
    time = start + interval * np.arange(samples) + (np.cumsum(scatter) if drifts else scatter / 2)

    def voltage(time: FloatArray) -> FloatArray:
        phase = (time - start) / (samples * interval)
        result: FloatArray = 100 * phase * (1 - phase) * (1.5 - phase)
        return result

    displacement = 0.3 * voltage(time) - 5.0
    displacement[2:-2][rng.random(samples - 4) < 0.05] = np.nan
    record = uneven(time, voltage(time), displacement)
    assert record.interval == pytest.approx(interval, rel=0.05)
    moved = np.abs(record.voltage - voltage(record.time))[1:-1].max()
    assert moved <= 20 * 150 / samples**2
    as_it_is = np.abs(voltage(time) - voltage(start + interval * np.arange(samples)))
    assert moved < 0.2 * as_it_is.max()
    assert record.displacement is not None
    has = record.has_reading
    np.testing.assert_allclose(
        record.displacement[has], 0.3 * record.voltage[has] - 5.0, atol=0.3 * 1200 / samples**2
    )
    lost = np.count_nonzero(~np.isnan(displacement)) - record.readings
    assert 0 <= lost <= (0.3 * samples if drifts else 0)


def test_white_noise_stays_white() -> None:
    """Over 40,000 readings: variance at most a seventh more, neighbors within 0.03 of unrelated."""
    rng = np.random.default_rng(5)
    time = np.cumsum(rng.uniform(0.75, 1.25, 40_000))
    record = uneven(time, np.sin(time / 50), rng.standard_normal(40_000))
    assert record.displacement is not None
    noise = np.nan_to_num(record.displacement)
    assert 0.98 <= np.nanvar(record.displacement) <= 1.14
    assert abs(np.corrcoef(noise[1:], noise[:-1])[0, 1]) <= 0.03


def test_what_is_done_is_said() -> None:
    rng = np.random.default_rng(3)
    time = np.arange(500) * 0.01
    voltage = np.sin(time)
    with pytest.warns(InputWarning, match=r"samples are moved by up to 0.0003. s onto a"):
        record = Record.from_arrays(voltage, voltage, time=time + rng.uniform(-3e-4, 3e-4, 500))
    assert 0.01 == record.interval
    steps = 0.01 * rng.uniform(0.7, 1.3, 499)
    time = np.concatenate([[0.0], np.cumsum(steps)])
    with (
        pytest.warns(InputWarning, match=r"\d+ are left out, where another"),
        pytest.warns(InputWarning, match=r"\d+ samples are missing, .* is interpolated there"),
    ):
        Record.from_arrays(np.sin(time), np.sin(time), time=time)


@given(
    st.integers(200, 3000),
    st.sampled_from([1e-6, 1e-3, 0.01, 1 / 64]),
    st.floats(-1.5, 1),
    st.sampled_from([np.rint, np.floor]),
    st.integers(0, 10**6),
)
@example(224, 1e-6, 0.17543864867674341, np.floor, 0)
def test_samples_are_uniform_whose_clock_ticks_too_slowly(
    samples: int, tick: float, ratio: float, rounded: np.ufunc, start: int
) -> None:
    """As written in milliseconds, or by Windows: nothing is left out or moved, nothing missing."""
    interval = tick * 10**ratio
    ticks = rounded(np.arange(samples) * 10**ratio)
    steps = np.diff(ticks)
    assume(np.count_nonzero(steps != np.median(steps)) >= 10)
    voltage = np.random.default_rng(start).standard_normal(samples)
    record = uneven(tick * (start + ticks), voltage, 0.3 * voltage)
    np.testing.assert_array_equal(record.voltage, voltage)
    assert samples == record.readings
    # The times of both ends are uncertain by a tick.
    length = record.interval * (samples - 1)
    assert length == pytest.approx(interval * (samples - 1), abs=1.1 * tick)


@given(
    st.integers(100, 4000),
    st.floats(0.01, 1e6),
    st.integers(3, 9),
    st.sampled_from("ge"),
    st.sampled_from([0.0, -0.5, 0.2, 3.0]),
    st.booleans(),
)
@example(20_000, 44_100.0, 5, "g", 0.0, False)
@example(127, 152_000.0, 3, "g", 0.0, True)  # the stated rate, not a rounder interval
@example(100, 20_800.0, 3, "g", 0.0, True)  # 39 samples are 1.875 ms, a tie of three digits
@example(100, 1 / 3, 3, "g", 0.2, True)  # late times are rounded to the second
def test_times_of_a_fixed_number_of_digits_are_uniform(
    samples: int, rate: float, digits: int, form: str, start: float, is_stated: bool
) -> None:
    """Any rate, length and start, as C prints them with %g and %e: no reading is moved, no remark.

    The last digit is at most 0.8 intervals long. A rate that the file states is met exactly.
    """
    rate = float(f"{rate:.3g}")
    start *= samples / rate
    time = start + np.arange(samples) / rate
    printed = [f"{t:.{digits - (form == 'e')}{form}}" for t in time]
    voltage = np.random.default_rng(samples).standard_normal(samples)
    table = {"time_s": np.array(printed, dtype=np.float64), "voltage_V": voltage}
    notes = {"sample_rate": f"{rate!r} Hz"} if is_stated else {}
    source = array_source("file", table | {"displacement_um": voltage}, notes=notes)
    coarsest = 10 ** (np.floor(np.log10(np.abs(time).max())) - digits + 1)
    assume(coarsest <= 0.8 / rate)
    with warnings.catch_warnings():
        warnings.simplefilter("error", InputWarning)
        record = Record(**record_fields(select(source, Naming())))
    np.testing.assert_array_equal(record.voltage, voltage)
    assert record.interval == pytest.approx(1 / rate, abs=0.6 / rate / samples)
    assert not is_stated or 1 / rate == record.interval


def test_samples_are_missing_beside_times_of_a_fixed_number_of_digits() -> None:
    index = np.delete(np.arange(5000), [10, 700, 701, 4990])
    time = np.array([float(f"{t:.6g}") for t in index / 44_100])
    record = uneven(time, np.sin(index / 100), np.cos(index / 100))
    assert (5000, 4996) == (record.samples, record.readings)
    np.testing.assert_array_equal(record.voltage[index], np.sin(index / 100))


def test_a_slow_clock_is_named_and_samples_may_be_missing_beside_it() -> None:
    index = np.arange(1000)
    voltage = np.sin(index / 100)
    with pytest.warns(InputWarning, match=r"in ticks of 0.001 s; .* uniform, every 0.0004 s"):
        Record.from_arrays(voltage, voltage, time=np.floor(0.4 * index) * 1e-3)
    kept = np.sort(np.random.default_rng(1).permutation(index[1:-1])[20:])
    with pytest.warns(InputWarning, match=r"20 samples are missing"):
        record = Record.from_arrays(voltage[kept], voltage[kept], time=kept * 1e-3)
    assert 1e-3 == record.interval
    # Many that are repeated at once are no clock's doing.
    time = 1e-3 * np.sort(np.concatenate([index, range(200, 600)]))[:1000]
    with pytest.raises(InputError, match=r"400 times are repeated, first 0.2 s; remove one of two"):
        Record.from_arrays(voltage, voltage, time=time)


@given(
    st.integers(400, 2000),
    st.sets(st.integers(1, 19), min_size=1),
    st.lists(st.sampled_from(["copied", "late", "early", "added"]), min_size=19, max_size=19),
    st.sampled_from([0.0, -3.0, 1.7e9]),
)
# One more row than times, and steps of no, one and two ticks of what might be a clock.
@example(400, {1, 2, 5, 13, 15, 16}, [*["late"], *["copied"] * 3, *["early"] * 15], 0.0)
def test_repeated_times_leave_a_record_as_it_was(
    samples: int, places: set[int], kinds: list[str], start: float
) -> None:
    """Whether rows are copied, times written late or early, or other samples beside them.

    A remark counts them all, and names the first.
    """
    index = np.arange(samples)
    voltage = np.sin(index / 40)
    rows, stamps, added = index.copy(), index.copy(), []
    for place in places:
        row = place * samples // 20
        if kinds[place - 1] in ("copied", "added"):
            rows = np.sort(np.append(rows, row))
            added += [row] * (kinds[place - 1] == "added")
        else:
            stamps[row] += -1 if kinds[place - 1] == "late" else 1
    displacement = 0.4 * voltage[rows]
    repeats = np.flatnonzero(np.diff(rows) == 0) + 1
    displacement[repeats[np.isin(rows[repeats], added)]] = 7.0
    time = start + np.round(0.002 * stamps[rows], 3)
    first = rf"arrays:sample {np.flatnonzero(np.diff(stamps[rows]) == 0)[0] + 1}: time: "
    said = rf"{first}{len(places)} times? (is|are) repeated, first"
    with pytest.warns(InputWarning, match=said):
        record = Record.from_arrays(voltage[rows], displacement, time=time)
    assert (0.002, samples) == (record.interval, record.readings)
    np.testing.assert_array_equal(record.voltage, voltage)
    np.testing.assert_array_equal(np.asarray(record.displacement), 0.4 * voltage)


@given(
    st.integers(20, 600),
    st.sampled_from(["all", "some", "one"]),
    st.sampled_from([0.005, 0.0013, 0.0031]),
    st.sampled_from([0.0, -3.0, 1.7e9]),
    st.integers(0, 2**32),
)
@example(2000, "all", 0.005, 0.0, 0)
def test_copied_rows_leave_a_record_as_it_was(
    samples: int, which: str, interval: float, start: float, seed: int
) -> None:
    """Whether every row is written twice or some are any number of times, of a clock of 1 ms."""
    rng = np.random.default_rng(seed)
    index = np.arange(samples)
    time = start + np.round(interval * index, 3)
    voltage = 30 * np.sin(index / 40)
    displacement = 0.4 * voltage + rng.normal(size=samples)
    displacement[rng.random(samples) < 0.05] = np.nan
    counts = np.full(samples, 2)
    if which != "all":
        counts = 1 + rng.integers(0, 3, samples) * (which == "some")
        counts[rng.integers(samples)] = 2
    rows = np.repeat(index, counts)
    try:
        whole = uneven(time, voltage, displacement)
    except InputError:  # too short for its clock
        return
    with warnings.catch_warnings(record=True) as remarks:
        warnings.simplefilter("always")
        record = Record.from_arrays(voltage[rows], displacement[rows], time=time[rows])
    assert f": {rows.size - samples} equal to the row above" in str(remarks[0].message)
    assert whole.sha256 == record.sha256


@given(
    st.integers(1, 60),
    st.floats(12, 400),
    st.floats(0, 2 * np.pi),
    st.sampled_from([0.0, 0.05]),
    st.integers(0, 10),
)
@example(40, 300, 0.0, 0.05, 5)
@example(1, 12.0, 0.0, 0.0, 0)
def test_a_gap_in_a_smooth_output_is_bridged_right_and_another_refused(
    missing: int, period: float, phase: float, noise: float, others: int
) -> None:
    """Wherever it is in a sine, with noise and other samples missing too: to 1.5% of the range.

    With a dozen samples a period or more, a quarter of it is bridged, and half is refused.
    """
    rng = np.random.default_rng(missing)
    lost = {*range(1000, 1000 + missing), *rng.integers(1, 1999, others).tolist()}
    index = np.setdiff1d(np.arange(2000), [*lost])
    voltage = 50 * np.sin(2 * np.pi * np.arange(2000) / period + phase)
    arrays = (voltage + noise * rng.standard_normal(2000))[index], voltage[index] * 0.4
    is_sure = missing + 1 <= 0.25 * period and not others
    try:
        record = uneven(0.001 * index.astype(np.float64), *arrays)
    except InputError:
        if is_sure:
            raise
        return
    assert missing < 0.5 * period
    assert (2000, index.size) == (record.samples, record.readings)
    np.testing.assert_allclose(record.voltage, voltage, atol=1.5)
    np.testing.assert_array_equal(record.voltage[index], arrays[0])


@given(
    st.sets(st.integers(1, 1998), min_size=1, max_size=200),
    st.sampled_from([0, 3, 10]),
    st.sampled_from([0.0, 0.1]),
    st.sampled_from(["command", "output"]),
    st.integers(0, 2**32),
)
def test_a_time_without_a_voltage_is_a_missing_sample(
    places: set[int], every: int, jitter: float, kind: VoltageIs, seed: int
) -> None:
    """Wherever they are, at random or every few samples, of any clock, with other samples missing.

    They are bridged as other gaps are, and have no reading; at an end, or without times, refused.
    """
    rng, index = np.random.default_rng(seed), np.delete(np.arange(2000), [100, 1500])
    missing = sorted({*places, *range(1, 1999, every or 2000)} - {100, 1500})
    voltage = 50 * np.sin(np.arange(2000) / 300)
    is_missing = np.isin(index, missing)
    time = 0.005 * (index + jitter * rng.uniform(-1, 1, index.size))
    stated = np.where(is_missing, np.nan, voltage[index])
    with warnings.catch_warnings(record=True) as remarks:
        warnings.simplefilter("always")
        record = Record.from_arrays(stated, 0.4 * voltage[index], time=time, voltage_is=kind)
    assert f"{len(missing) + 2} samples are missing" in str(remarks[-1].message)
    assert record.interval == pytest.approx(0.005, rel=1e-3)
    assert sorted([*missing, 100, 1500]) == np.flatnonzero(~record.has_reading).tolist()
    np.testing.assert_allclose(record.voltage, voltage, atol=0.5 if kind == "output" else 3.0)
    stated[0] = np.nan
    with pytest.raises(InputError, match=r"arrays:sample 0: voltage: no number \(empty or nan\)"):
        uneven(time, stated, voltage[index])
    with pytest.raises(InputError, match=r"voltage: no number \(empty or nan\)"):
        Record.from_arrays(np.where(is_missing, np.nan, voltage[index]), voltage[index], interval=1)


def test_a_gap_in_an_output_of_pulses_or_noise_is_refused() -> None:
    index = np.delete(np.arange(2000), np.arange(1000, 1005))
    for voltage in (np.arange(2000) % 50 // 47, np.random.default_rng(1).normal(size=2000)):
        with pytest.raises(
            InputError, match=r"gap of 0.006 s after 0.999 s, about 5 missing; give"
        ):
            Record.from_arrays(voltage[index], voltage[index], time=index * 0.001)


# Series with times or clocks of their own are put together by these, and units beside count


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
