"""What is written is what is read: through every format, in every unit, to the last bit."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, strategies as st
from hypothesis.extra.numpy import arrays

from bwbayes.arrays import FloatArray
from bwbayes.record import Record, read_record, write_record
from tests.record.test_columns import write

SUFFIXES = ("csv", "txt", "h5", "hdf5", "mat", "mat 7.3")

# Powers of ten that lead from the unit to V, um and s.
VOLTS = {"V": 0, "mV": -3, "kV": 3, "uV": -6, "µV": -6, "μV": -6}
LENGTHS = {"um": 0, "µm": 0, "μm": 0, "nm": -3, "mm": 3, "m": 6}
TIMES = {"s": 0, "ms": -3, "us": -6, "µs": -6, "μs": -6}

LAST_PLACE = float(np.finfo(np.float64).eps)

numbers = arrays(np.float64, 12, elements=st.floats(-1e9, 1e9), unique=True).filter(
    lambda values: bool(np.ptp(values) > 1e-6)
)
records = st.builds(
    Record,
    voltage=numbers,
    displacement=numbers,
    interval=st.floats(1e-6, 1e3),
    start=st.floats(-1e3, 1e3),
    voltage_is=st.sampled_from(["command", "output"]),
    origin=st.text(min_size=1).filter(lambda text: text.isprintable() and bool(text.strip("# "))),
    truth=st.none() | numbers,
)


def through(record: Record, folder: Path, suffix: str) -> Record:
    path = folder / f"same.{suffix.split(maxsplit=1)[0]}"
    write_record(record, path, mat_version="7.3" if suffix.endswith("7.3") else "5")
    return read_record(path, need_displacement=record.displacement is not None)


def assert_same(expected: Record, got: Record) -> None:
    assert expected.sha256 == got.sha256
    assert (expected.origin, expected.voltage_is) == (got.origin, got.voltage_is)
    assert (expected.truth is None) == (got.truth is None)
    if expected.truth is not None and got.truth is not None:
        np.testing.assert_array_equal(expected.truth, got.truth)


@given(record=records, way=st.lists(st.sampled_from(SUFFIXES), min_size=1, max_size=6))
def test_a_record_survives_any_way_through_the_formats(
    folder: Path, record: Record, way: list[str]
) -> None:
    got = record
    for suffix in way:
        got = through(got, folder, suffix)
    assert_same(record, got)


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_plans_gaps_and_parts_of_long_records_survive(tmp_path: Path, suffix: str) -> None:
    """Times far from zero carry the rounding of the whole record, and must be uniform still."""
    plan = Record(np.arange(20.0), None, interval=0.1, origin="a plan", voltage_is="command")
    assert_same(plan, through(plan, tmp_path, suffix))
    voltage = np.sin(0.37 * np.arange(50_000))
    whole = Record(voltage, 2 * voltage, interval=1e-3 / 3, start=-5.0, truth=voltage)
    cut = replace(whole.window(5.0, 7.0).decimate(7).exclude([(5.0, 5.1)]), origin="a part")
    assert_same(cut, through(cut, tmp_path, suffix))


def in_unit(values: FloatArray, power: int) -> FloatArray:
    """Return values in another unit, each rounded once: dividing by 1e-3 would round twice."""
    return values / 10.0**power if power >= 0 else values * 10.0**-power


@pytest.mark.parametrize("suffix", ["csv", "h5", "mat"])
@given(
    record=records,
    volt=st.sampled_from(sorted(VOLTS)),
    length=st.sampled_from(sorted(LENGTHS)),
    second=st.sampled_from(sorted(TIMES)),
)
def test_a_record_in_any_units_is_the_same_record(
    folder: Path, suffix: str, record: Record, volt: str, length: str, second: str
) -> None:
    """To one unit in the last place, which the conversion there and back may cost."""
    if suffix == "mat":  # whose names have no micro sign
        volt, length, second = (
            u.replace("µ", "u").replace("μ", "u") for u in (volt, length, second)
        )
    assert record.displacement is not None
    columns = {
        f"time_{second}": in_unit(record.time, TIMES[second]),
        f"voltage_{volt}": in_unit(record.voltage, VOLTS[volt]),
        f"displacement_{length}": in_unit(record.displacement, LENGTHS[length]),
    }
    got = read_record(write(folder / f"units.{suffix}", columns))
    assert got.displacement is not None
    np.testing.assert_allclose(got.voltage, record.voltage, rtol=LAST_PLACE, atol=1e-290)
    np.testing.assert_allclose(got.displacement, record.displacement, rtol=LAST_PLACE, atol=1e-290)
    np.testing.assert_allclose(got.time, record.time, rtol=0, atol=2e-2 * record.interval)
    assert record.interval == pytest.approx(got.interval, rel=2e-3)
