"""A record keeps its data, addresses it by time, and is checked before it is used."""

import numpy as np
import pytest
from hypothesis import given, strategies as st

from bwbayes.errors import InputError
from bwbayes.record import Record


def ramp(samples: int = 100, interval: float = 0.01, start: float = 0.0) -> Record:
    voltage = np.arange(samples, dtype=np.float64)
    return Record(voltage, 2 * voltage, interval=interval, start=start, truth=3 * voltage)


def test_masked_readings_are_missing() -> None:
    voltage = np.sin(np.arange(300.0))
    masked = np.ma.masked_array(voltage, voltage > 0.9)
    record = Record.from_arrays(voltage, masked, interval=0.01)
    np.testing.assert_array_equal(record.has_reading, voltage <= 0.9)
    with pytest.raises(InputError, match="voltage"):
        Record.from_arrays(masked, voltage, interval=0.01)


def test_arrays_are_copies_that_cannot_be_written_to() -> None:
    voltage = np.arange(3.0)
    record = Record(voltage, None, interval=1.0)
    voltage[0] = 7.0
    assert record.voltage[0] == 0.0
    with pytest.raises(ValueError, match="read-only"):
        record.voltage[0] = 7.0


def test_sha256_names_the_data_and_not_the_origin() -> None:
    record = ramp()
    same = Record(record.voltage, record.displacement, interval=0.01, origin="elsewhere")
    assert record.sha256 == same.sha256
    others = [
        Record(record.voltage + 1, record.displacement, interval=0.01),
        Record(record.voltage, record.voltage, interval=0.01),
        Record(record.voltage, None, interval=0.01),
        Record(record.voltage, record.displacement, interval=0.02),
        Record(record.voltage, record.displacement, interval=0.01, start=1.0),
    ]
    assert len({record.sha256, *(other.sha256 for other in others)}) == 6


@pytest.mark.parametrize(
    ("arguments", "place"),
    [
        ({"voltage": np.zeros((2, 2))}, "voltage: shape"),
        ({"voltage": np.zeros(0)}, "voltage: shape"),
        ({"displacement": np.zeros(4)}, "displacement: 4 samples"),
        ({"truth": np.array([0.0, np.nan, 0.0])}, "truth: nan at sample 1"),
        ({"interval": 0.0}, "interval"),
        ({"interval": np.inf}, "interval"),
        ({"start": np.nan}, "start"),
        ({"voltage_is": "comand"}, "voltage_is: 'comand'"),
    ],
)
def test_impossible_records_are_refused_by_name(arguments: dict[str, object], place: str) -> None:
    good: dict[str, object] = {"voltage": np.zeros(3), "displacement": None, "interval": 1.0}
    with pytest.raises(InputError, match=place):
        Record(**(good | arguments))  # type: ignore[arg-type]


@given(
    interval=st.floats(1e-5, 10.0),
    start=st.floats(-100.0, 100.0),
    cuts=st.tuples(st.integers(0, 50), st.integers(0, 50)).filter(lambda c: c[0] < c[1]),
)
def test_window_holds_the_samples_from_start_to_before_stop(
    interval: float, start: float, cuts: tuple[int, int]
) -> None:
    record = ramp(50, interval, start)
    first, last = cuts
    window = record.window(start + first * interval, start + last * interval)
    np.testing.assert_array_equal(record.voltage[first:last], window.voltage)
    assert window.displacement is not None
    assert window.truth is not None
    np.testing.assert_array_equal(2 * window.voltage, window.displacement)
    np.testing.assert_array_equal(3 * window.voltage, window.truth)
    np.testing.assert_allclose(record.time[first:last], window.time, atol=1e-6 * interval)


@pytest.mark.parametrize(
    "window", [(-1.0, 0.5), (0.5, 1.2), (0.5, 0.5), (0.6, 0.5), (5.0, 6.0), (0.0, np.inf)]
)
def test_windows_outside_the_record_or_empty_name_its_span(window: tuple[float, float]) -> None:
    with pytest.raises(InputError, match="0 to 1 s"):
        ramp(100, 0.01).window(*window)


@pytest.mark.parametrize(
    ("window", "gone"),
    [
        ((1.60, 1.67), [32, 33]),
        ((1.63, 1.67), [32, 33]),
        ((1.60, 1.65), [32]),
        ((1.61, 1.62), [32]),
        ((0.0, 0.05), [0]),
    ],
)
def test_exclude_takes_every_sample_that_it_touches(
    window: tuple[float, float], gone: list[int]
) -> None:
    record = ramp(100, 0.05).exclude([window, (3.0, 3.1)])
    assert [*gone, 60, 61] == np.flatnonzero(~record.has_reading).tolist()
    np.testing.assert_array_equal(ramp().voltage, record.voltage)
    with pytest.raises(InputError, match="reaches outside the record"):
        record.exclude([(0.5, 5.5)])


def test_a_record_needs_one_reading_and_all_missing_ones_are_alike() -> None:
    voltage = np.arange(3.0)
    with pytest.raises(InputError, match="displacement: holds no reading"):
        Record(voltage, np.full(3, np.nan), interval=1.0)
    other_nan = np.array([0x7FF8000000000001], dtype=np.uint64).view(np.float64)[0]
    one, other = (
        Record(voltage, np.array([1.0, x, 2.0]), interval=1.0) for x in (np.nan, -other_nan)
    )
    assert one.sha256 == other.sha256
    assert [True, False, True] == one.has_reading.tolist()
    with pytest.raises(InputError, match="displacement: inf at sample 1"):
        Record(voltage, np.array([np.nan, np.inf, 2.0]), interval=1.0)
    with pytest.raises(InputError, match="voltage: nan at sample 1"):
        Record(np.array([1.0, np.nan, 2.0]), voltage, interval=1.0)


@pytest.mark.parametrize("factor", [0, -1, 1.5])
def test_decimate_refuses_what_is_no_number_of_samples(factor: int) -> None:
    with pytest.raises(InputError, match="decimate"):
        ramp().decimate(factor)
