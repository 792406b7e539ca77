"""A record keeps its data, addresses it by time, and is checked before it is used."""

from __future__ import annotations

import warnings
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from bwbayes.arrays import FloatArray
from bwbayes.data import Record, read_record, write_record
from bwbayes.errors import InputError, InputWarning

MEASURED = Path(__file__).resolve().parents[3] / "shared/data/picma_stack_open_loop.csv"


def ramp(samples: int = 100, interval: float = 0.01, start: float = 0.0) -> Record:
    voltage = np.arange(samples, dtype=np.float64)
    return Record(voltage, 2 * voltage, interval, start, truth=3 * voltage)


def test_time_is_start_plus_whole_intervals() -> None:
    np.testing.assert_allclose([1.0, 1.5, 2.0], ramp(3, 0.5, 1.0).time, rtol=1e-15)


def test_samples_duration_and_range_are_those_of_the_voltage() -> None:
    record = ramp(100, 0.01)
    assert (100, 1.0, (0.0, 99.0)) == (record.samples, record.duration, record.range_voltage)


def test_arrays_are_copies_that_cannot_be_written_to() -> None:
    voltage = np.arange(3.0)
    record = Record(voltage, None, 1.0)
    voltage[0] = 7.0
    assert record.voltage[0] == 0.0
    with pytest.raises(ValueError, match="read-only"):
        record.voltage[0] = 7.0


def test_sha256_names_the_data_and_not_the_origin() -> None:
    record = ramp()
    same = Record(record.voltage, record.displacement, 0.01, origin="elsewhere")
    assert record.sha256 == same.sha256
    others = [
        Record(record.voltage + 1, record.displacement, 0.01),
        Record(record.voltage, record.voltage, 0.01),
        Record(record.voltage, None, 0.01),
        Record(record.voltage, record.displacement, 0.02),
        Record(record.voltage, record.displacement, 0.01, start=1.0),
    ]
    assert len({record.sha256, *(other.sha256 for other in others)}) == 6


def test_origin_becomes_one_line() -> None:
    assert "a b" == Record(np.arange(3.0), None, 1.0, origin=" a\n\0b").origin


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


@settings(deadline=None)
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
    ("border", "sample"),
    [(2.0, 2), (2.49, 2), (2.5, 2), (2.51, 3), (3.5, 3), (4.5, 4), (5.0, 5)],
)
def test_times_within_half_an_interval_count_as_on_a_border(border: float, sample: int) -> None:
    """Whole numbers of quarter seconds are exact, so a half is one too."""
    record = ramp(10, 0.25, 1.0)
    assert slice(0, sample) == record.window_slice(1.0, 1.0 + border / 4)
    assert slice(sample, 10) == record.window_slice(1.0 + border / 4, 3.5)


def test_windows_that_share_a_border_partition_the_record() -> None:
    record = ramp(100, 0.01)
    cut = 0.3333
    assert slice(0, 33) == record.window_slice(0.0, cut)
    assert slice(33, 100) == record.window_slice(cut, 1.0)


@pytest.mark.parametrize(
    "window", [(-1.0, 0.5), (0.5, 1.2), (0.5, 0.5), (0.6, 0.5), (5.0, 6.0), (0.0, np.inf)]
)
def test_windows_outside_the_record_or_empty_name_its_span(window: tuple[float, float]) -> None:
    with pytest.raises(InputError, match="0 to 1 s"):
        ramp(100, 0.01).window(*window)


def test_decimate_keeps_every_factor_th_sample_from_the_first() -> None:
    record = ramp(10, 0.01, 1.0)
    thinned = record.decimate(3)
    assert [0.0, 3.0, 6.0, 9.0] == thinned.voltage.tolist()
    np.testing.assert_allclose(record.time[::3], thinned.time, rtol=1e-14)


@pytest.mark.parametrize("factor", [0, -1, 1.5])
def test_decimate_refuses_what_is_no_number_of_samples(factor: int) -> None:
    with pytest.raises(InputError, match="decimate"):
        ramp().decimate(factor)


def test_split_gives_slices_of_the_whole_record() -> None:
    split = ramp(100, 0.01).split([(0.5, 1.0)], [(0.0, 0.2), (0.1, 0.5)])
    assert (slice(50, 100),) == split.training
    assert (slice(0, 20), slice(10, 50)) == split.held_out


def test_split_puts_training_windows_in_order_of_time() -> None:
    split = ramp(100, 0.01).split([(0.5, 1.0), (0.0, 0.3)], [(0.45, 0.5), (0.3, 0.4)])
    assert (slice(0, 30), slice(50, 100)) == split.training
    assert (slice(45, 50), slice(30, 40)) == split.held_out


@pytest.mark.parametrize(
    ("training", "held_out", "kind"),
    [
        ([(0.5, 1.0)], [(0.0, 0.2), (0.4, 0.52)], "held-out window 0.4 to 0.52"),
        ([(0.0, 0.5), (0.4, 1.0)], [], "training window 0 to 0.5"),
    ],
)
def test_split_refuses_windows_that_overlap_training(
    training: list[tuple[float, float]], held_out: list[tuple[float, float]], kind: str
) -> None:
    with pytest.raises(InputError, match=f"overlaps the {kind}"):
        ramp(100, 0.01).split(training, held_out)


def reread(path: Path, voltage: FloatArray, displacement: FloatArray) -> Record:
    write_record(Record(voltage, displacement, 0.001), path / "record.h5")
    return read_record(path / "record.h5")


SINE = np.sin(np.linspace(0.0, 12 * np.pi, 3000))


@pytest.mark.parametrize("limits", [(-0.8, 2.0), (-2.0, 0.8)])
@pytest.mark.parametrize("step", [1e-6, 0.01])
def test_a_displacement_cut_off_at_its_limit_is_a_warning(
    tmp_path: Path, limits: tuple[float, float], step: float
) -> None:
    clipped = np.clip(np.round(SINE / step) * step, *limits)
    with pytest.warns(InputWarning, match=r"record\.h5:sample \d+: displacement_um: clipped"):
        reread(tmp_path, SINE, clipped)


TRAPEZOID = np.clip(SINE, -0.7, 0.7)
SQUARE = np.sign(SINE + 1e-9)


@pytest.mark.parametrize("step", [0.3, 0.1, 0.03, 0.01, 0.001])
@pytest.mark.parametrize("shift", [0.0, 0.25, 0.5, 0.99])
@pytest.mark.parametrize(
    ("voltage", "lag"),
    [(SINE, 0), (SINE, 40), (SINE, 125), (TRAPEZOID, 0), (TRAPEZOID, 20), (SQUARE, 1)],
    ids=["sine", "lagging sine", "sine a quarter late", "plateaus", "late plateaus", "late steps"],
)
def test_a_coarse_sensor_alone_is_not_taken_for_a_clipped_one(
    tmp_path: Path, step: float, shift: float, voltage: FloatArray, lag: int
) -> None:
    """Not at smooth peaks, whatever the phase, and not at rest on the highest plateau."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        reread(tmp_path, voltage, np.round(np.roll(voltage, lag) / step + shift) * step)


def test_the_measured_record_is_read_without_a_warning() -> None:
    if not MEASURED.exists():
        pytest.skip("the measured record is not in the folder shared/data beside the repository")
    record = read_record(MEASURED)
    assert (7432, 0.005, "output") == (record.samples, record.interval, record.voltage_is)
    assert (0.236332, 3.423674) == record.range_voltage
    assert MEASURED.name == record.origin
