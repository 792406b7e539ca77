"""Units are read as data sheets write them; uncertain ones say how each parameter scales."""

from dataclasses import astuple, replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, strategies as st

from bwbayes.errors import InputError
from bwbayes.model.inputs import Span
from bwbayes.model.registry import HYSTERESIS
from bwbayes.record import Record, read_record, write_record
from bwbayes.record.instruments import EXACT, Instruments, Scales
from bwbayes.record.io.columns import Naming
from bwbayes.record.io.recognition import scale_of, unit_in
from tests.model.operators.test_every_operator import drawn_from, posterior


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
