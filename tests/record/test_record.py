"""A record keeps its data, addresses it by time, and survives files and units."""

from dataclasses import astuple, replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, strategies as st
from hypothesis.extra.numpy import arrays

from bwbayes.arrays import FloatArray
from bwbayes.errors import InputError
from bwbayes.model.inputs import Span
from bwbayes.model.registry import HYSTERESIS
from bwbayes.record import Record, read_record, write_record
from bwbayes.record.instruments import EXACT, Instruments, Scales
from bwbayes.record.io.columns import Naming
from bwbayes.record.io.recognition import scale_of, unit_in
from tests.model.operators.test_every_operator import drawn_from, posterior
from tests.record.test_columns import write


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


# A written record is read as it was: through every format, in every unit, to the last bit


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


# Units are read as data sheets write them; uncertain ones say how each parameter scales


@given(
    st.sampled_from([("time", "s"), ("voltage", "V"), ("displacement", "m")]),
    st.sampled_from(["", "n", "u", "µ", "μ", "m", "k"]),
    st.sampled_from(["{} [{}]", "{} ({})", "{}_{}", "{} / {}", "{}[{}]", "{} {}", "{}_{}_"]),
    st.text("abcdefgh 1", min_size=1).map(str.strip).filter(bool),
)
def test_a_unit_is_read_from_any_usual_name(
    base: tuple[str, str], prefix: str, form: str, word: str
) -> None:
    quantity, unit = base
    assert prefix + unit == unit_in(form.format(word, prefix + unit), quantity)


@given(
    st.floats(1e-9, 1e9),
    st.sampled_from(["V", "count", "counts", "digit", "digits", "LSB"]),
    st.sampled_from(["um", "-nm", "mm", "micron"]),
    st.sampled_from(["/", " / "]),
)
def test_a_sensitivity_is_read_as_data_sheets_write_it(
    number: float, reading: str, unit: str, per: str
) -> None:
    """A length per volt or count is what 1 stands for, and volts or counts per length the inverse.

    A voltage per volt may be a gain or its inverse, and is refused.
    """
    unit, sign = unit.removeprefix("-"), "-" * unit.startswith("-")
    scale = scale_of(f"{sign}{number!r} {unit}", "displacement")
    assert scale is not None
    assert scale == scale_of(f"{sign}{number!r} {unit}{per}{reading}", "displacement")
    inverse = scale_of(f"{sign}{number!r} {reading}{per}{unit}", "displacement")
    assert inverse == (1 / scale[0], scale[1])
    volts = scale_of(f"{number!r} mV{per}{reading}", "voltage")
    assert volts == (None if reading == "V" else (number, -3))
    assert scale_of(f"{number!r} {reading}{per}{unit}{per}{reading}", "displacement") is None


SINE = np.sin(np.linspace(0.0, 20.0, 50))


@pytest.mark.parametrize(
    ("text", "unit", "uncertainty"),
    [
        ("0.35 +- 0.004 um", "0.35 um", 0.004 / 0.35),
        ("0.35 um +- 1.2 %", "0.35 um", 0.012),
        ("0.35 um ± 1.2%", "0.35 um", 0.012),
        ("-0.35 +/- 0.004um", "-0.35 um", 0.004 / 0.35),
        ("2.9 V/um +- 1 %", "2.9 V/um", 0.01),
        ("nm +- 0.5 %", "nm", 0.005),
        ("0.35 um", "0.35 um", 0.0),
    ],
)
def test_unit_may_have_an_uncertainty(text: str, unit: str, uncertainty: float) -> None:
    naming = Naming.stated(units={"displacement": text})
    assert {"displacement": unit} == naming.units
    assert uncertainty == pytest.approx(naming.instruments.sensor_scale, rel=1e-12)
    again = Naming.stated(units=naming.stated_units)
    assert again.instruments.sensor_scale == pytest.approx(uncertainty, rel=1e-5)


@pytest.mark.parametrize(
    ("units", "said"),
    [
        ({"displacement": "um +- 2"}, "cannot read 'um +- 2'; write '0.35 +- 0.004 um'"),
        ({"displacement": "um +- 30 %"}, "an uncertainty of 30 % is no calibration"),
        ({"displacement": "0 +- 1 um"}, "cannot read"),
        ({"time": "ms +- 1 %"}, "time: has no uncertainty"),
    ],
)
def test_uncertainty_that_is_none_is_refused(units: dict[str, str], said: str) -> None:
    with pytest.raises(InputError, match=said.replace("+", r"\+")):
        Naming.stated(units=units)


def test_linearity_is_a_part_of_the_range() -> None:
    assert Naming.stated(linearity="0.1 %").instruments == Instruments(linearity=0.001)
    with pytest.raises(InputError, match="is no part of the range"):
        Naming.stated(linearity="0.1 um")


@pytest.mark.parametrize("suffix", ["csv", "h5", "mat"])
def test_record_takes_its_instruments_to_a_file(suffix: str, tmp_path: Path) -> None:
    units = {"displacement": "0.35 +- 0.004 um", "voltage": "100 V ± 0.5 %"}
    record = Record.from_arrays(SINE, 2 * SINE, interval=0.01, units=units)
    assert (0.004 / 0.35, 0.005, 0.0) == pytest.approx(astuple(record.instruments), rel=1e-12)
    assert record.displacement is not None
    np.testing.assert_allclose(0.7 * SINE, record.displacement, rtol=1e-12)
    write_record(record, tmp_path / f"record.{suffix}")
    again = read_record(tmp_path / f"record.{suffix}", linearity="0.1 %")
    assert replace(record.instruments, linearity=0.001) == again.instruments
    assert record.sha256 == again.sha256


def test_other_instruments_of_a_predicted_record_are_refused() -> None:
    record = Record.from_arrays(SINE, 2 * SINE, interval=0.01, units={"displacement": "um +- 1 %"})
    plain = replace(record, instruments=EXACT)
    assert record.instruments == plain.like(record).instruments
    with pytest.raises(InputError, match="states other uncertainties"):
        record.like(plain)


def test_units_say_the_powers_of_the_scales() -> None:
    scales = Scales(np.array([1.3]), np.array([0.8]))
    powers = {
        "um": 1.3, "V": 0.8, "um/V": 1.3 / 0.8, "um/V^2": 1.3 / 0.8**2, "1/V": 1 / 0.8,
        "um V": 1.3 * 0.8, "V/s": 0.8, "um^(1-n)/V": 1.3**-0.5 / 0.8, "-": 1.0, "s": 1.0, "%": 1.0,
    }  # fmt: skip
    for unit, factor in powers.items():
        assert factor == pytest.approx(scales.factor(unit, 1.5)[0], rel=1e-14), unit


@pytest.mark.parametrize("name", HYSTERESIS)
def test_readings_say_nothing_of_the_scales(name: str) -> None:
    """Every model with scaled parameters does the same, scaled, along a scaled voltage.

    So the likelihood is the same, and draws times the scales are draws of the true parameters.
    """
    of = posterior(name, parts=True, from_rest=True)
    dataset, theta = of.single_record, drawn_from(of, 5)
    scales = Scales(np.full(5, 1.3), np.full(5, 0.8))
    true = theta.copy()
    for column, parameter in enumerate(of.prior.parameters):
        true[:, column] *= scales.factor(parameter.unit)
    results = []
    for factor, values in ((1.0, theta), (0.8, true)):
        span, voltage = Span(-100.0 * factor, 100.0 * factor), factor * dataset.voltage
        actuator = dataset.actuator
        parts = {
            part: replace(getattr(actuator, part), reference=span)
            for part in ("nonlinearity", "creep")
        }
        actuator = replace(actuator, span=span, **parts)
        columns = dataset.table.actuator(values)
        results.append(actuator.displacement(columns, voltage, from_rest=True))
    expected, found = results
    np.testing.assert_allclose(1.3 * expected, found, rtol=1e-6, atol=1e-6 * np.ptp(expected))


def test_a_path_that_reaches_corners_leaves_out_the_readings_there() -> None:
    """A command has no corners between samples; a new record has those of the one it is like."""
    time = np.arange(60) / 10
    voltage = np.interp(time, [0.0, 1.53, 3.07, 4.62, 6.0], [0.0, 30.0, -30.0, 30.0, 0.0])
    record = Record(voltage, 0.1 * voltage, interval=0.1)
    assert np.array_equal(record.path.voltage, voltage)
    assert record.usable_displacement is record.displacement
    reached = replace(record, corners=True)
    turned = reached.path.voltage != voltage
    assert [15, 31, 46] == np.flatnonzero(turned).tolist()
    np.testing.assert_allclose(reached.path.voltage[turned], [30.0, -30.0, 30.0])
    assert np.array_equal(reached.inputs.voltage, reached.path.voltage)
    assert reached.usable_displacement is not None
    assert np.array_equal(np.isnan(reached.usable_displacement), turned)
    assert np.array_equal(reached.voltage, voltage)
    planned = Record(voltage, None, interval=0.1).like(reached)
    assert np.array_equal(planned.path.voltage, reached.path.voltage)
    command = replace(reached, voltage_is="command")
    assert np.array_equal(command.path.voltage, voltage)
    assert command.usable_displacement is not None
    assert np.isfinite(command.usable_displacement).all()
