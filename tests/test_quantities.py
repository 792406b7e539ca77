"""Input and output of any kind: words, units and conversions, priors, records without a time."""

import re
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from hypothesis import given, strategies as st

import bwbayes as bw
from bwbayes.app.config.keywords import config_of
from bwbayes.app.study.resolve import resolve_config
from bwbayes.arrays import FloatArray
from bwbayes.comparison.design import RivalDesign, RivalScore
from bwbayes.diagnosis.validation import ValidationSummary
from bwbayes.inference.defaults import ranges_of
from bwbayes.inference.study import every_declaration
from bwbayes.model.declaration import Context, Distribution
from bwbayes.model.inputs import Inputs, Limits
from bwbayes.quantities import DEFAULT, Quantities
from bwbayes.record import Record, read_record, write_record
from bwbayes.record.io.columns import conversion
from bwbayes.report.report import Picture

MAGNET = Quantities.of("H (A/m)", "B (T)")
SPRING = Quantities.of("displacement (mm)", "force (kN)")
PREFIXES = {"u": -6, "m": -3, "": 0, "k": 3, "M": 6}
BASES = ("A/m", "T", "N", "bar", "V/m", "C/m^2", "Pa", "N m")


@pytest.mark.parametrize(
    ("quantities", "text", "said"),
    [
        (MAGNET, "um/V, 1/V, um^(1-n)/V, um V", "T/(A/m), 1/(A/m), T^(1-n)/(A/m), T A/m"),
        (MAGNET, "Voltages: 2 µm per volt", "H values: 2 T per A/m"),
        (MAGNET, "voltage_is of results/voltage.csv", "voltage_is of results/voltage.csv"),
        (MAGNET, "Systems by A. V. Pokrovskii, 1 s, --voltage FILE", None),
        (SPRING, "the voltage moves the displacement", "the displacement moves the force"),
        (SPRING, "Displacement at zero volts, um", "Force at zero displacement, kN"),
        (Quantities.of(None, "P (uC/cm2)"), "um/V^2 at 3 V", "uC/cm2/V^2 at 3 V"),
        (Quantities.of(None, "P (uC/cm2)"), "um^-n", "(uC/cm2)^-n"),
        (Quantities.of(None, None, has_clock=False), "0 to 3 s, 1 Hz, um/s", None),
    ],
)
def test_texts_are_said_in_a_records_own_words(
    quantities: Quantities, text: str, said: str | None
) -> None:
    """None is the text itself, but for the clock."""
    timeless = {"0 to 3 s, 1 Hz, um/s": "0 to 3 samples, 1 per sample, um/sample"}
    assert quantities.say(text) == (timeless.get(text, text) if said is None else said)


@given(st.text())
def test_voltage_and_displacement_change_no_word(text: str) -> None:
    assert DEFAULT.say(text) is text
    assert Quantities.of(" voltage (V)", "displacement [um]").say(text) is text
    assert (text, text) == (DEFAULT.key(text), DEFAULT.heading(text))


def test_names_of_columns_and_keys_have_the_own_units() -> None:
    assert MAGNET.heading("voltage_V") == "H (A/m)"
    assert MAGNET.heading("displacement_lower_95_um") == "B_lower_95 (T)"
    assert MAGNET.key("loop_area_um_V") == "loop_area_T_A/m"
    assert MAGNET.rendered({"rmse_um": [1.0, "2 um"]}) == {"rmse_T": [1.0, "2 T"]}


@given(
    st.sampled_from(BASES),
    st.sampled_from(sorted(PREFIXES)),
    st.sampled_from(sorted(PREFIXES)),
    st.floats(0.01, 100.0),
    st.booleans(),
)
def test_units_convert_by_their_prefix_sensitivity_and_sign(
    base: str, before: str, after: str, number: float, turned: bool
) -> None:
    """To 1e-12; what leads back undoes it; another kind of unit does not convert."""
    values = np.array([-3.0, 0.0, 0.7, 1e5])
    sign, unit, to = "-" * turned, f"{before}{base}", f"{after}{base}"
    convert = conversion(f"{sign}{number!r} {unit}", to)
    back = conversion(to, unit)
    assert convert is not None
    assert back is not None
    power = PREFIXES[before] - PREFIXES[after]
    factor = (-number if turned else number) * 10.0**power
    np.testing.assert_allclose(convert(values), factor * values, rtol=1e-12)
    np.testing.assert_allclose(back(convert(values)) / 10.0**0, (factor / 10.0**power) * values)
    assert conversion(unit, "mol") is None


def test_units_are_read_as_people_write_them() -> None:
    """Powers without a sign, gauss and oersted beside the SI, offsets, and what pint knows not."""
    pairs = [
        ("uC/cm2", "C/m^2", 0.01),
        ("G", "T", 1e-4),
        ("Oe", "A/m", 79.5775),
        ("psi", "Pa", 6895),
    ]
    for unit, to, factor in pairs:
        convert = conversion(unit, to)
        assert convert is not None
        assert convert(np.ones(1)) == pytest.approx(factor, rel=1e-4)
    kelvin = conversion("degC", "K")
    assert kelvin is not None
    assert kelvin(np.array([20.0])) == pytest.approx(293.15)
    arbitrary = conversion("a.u.", "a.u.")
    assert arbitrary is not None
    assert arbitrary(np.ones(1)) == 1.0
    assert conversion("a.u.", "T") is None


def loop(samples: int = 400) -> tuple[FloatArray, FloatArray]:
    phase = np.linspace(0, 20, samples)
    return 300 * np.sin(phase) * (1 - phase / 40), np.sin(phase - 0.2) * (1 - phase / 40)


@pytest.mark.parametrize("suffix", [".csv", ".h5", ".mat"])
@pytest.mark.parametrize("interval", [None, 0.01])
def test_records_keep_their_quantities_in_files(
    tmp_path: Path, suffix: str, interval: float | None
) -> None:
    h, b = loop()
    stated: dict[str, Any] = {"input": "H (A/m)", "output": "B (T)"}
    record = Record.from_arrays(h, b, interval=interval, **stated, covariates={"t_degC": b})
    assert record.quantities.has_clock == (interval is not None)
    write_record(record, tmp_path / f"loop{suffix}")
    read = read_record(tmp_path / f"loop{suffix}")
    assert (read.quantities, read.sha256) == (record.quantities, record.sha256)


@pytest.mark.filterwarnings("ignore:.*taken by its unit:bwbayes.errors.InputWarning")
@pytest.mark.parametrize(
    ("names", "options"),
    [
        (("H (kA/m)", "B"), {}),
        (("field_kA/m", "flux [T]"), {}),
        (("H", "B"), {"units": {"input": "kA/m"}}),
        (("x", "y"), {"columns": {"H": "x", "output": "y"}, "units": {"H": "kA/m"}}),
    ],
)
def test_columns_are_found_by_name_or_unit_and_converted(
    tmp_path: Path, names: tuple[str, str], options: dict[str, Any]
) -> None:
    h, b = loop()
    pd.DataFrame({names[1]: b, names[0]: h / 1000}).to_csv(tmp_path / "loop.csv", index=False)
    record = read_record(tmp_path / "loop.csv", input="H (A/m)", output="B (T)", **options)
    np.testing.assert_allclose(record.voltage, h, rtol=1e-12, atol=1e-9)
    assert record.displacement is not None
    np.testing.assert_allclose(record.displacement, b, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize(
    ("stated", "options", "texts"),
    [
        (("H", "B (T)"), {}, ["input: 'H' is no name with a unit", "'H (A/m)'"]),
        (("B (T)", "b (mT)"), {}, ["output: 'b' is the input"]),
        (("H <b> (A/m)", "B (T)"), {}, ["input: 'H <b> (A/m)' is no name with a unit"]),
        (("H */ (A/m)", "B (T)"), {}, ["input: 'H */ (A/m)' is no name with a unit"]),
        (("H (A/m)", "B (T)"), {"units": {"H": "kg"}}, ["units: H in 'kg' is unknown", "A/m"]),
        (("M (J)", "F (N)"), {}, ["which column is the M, which the F", "'input': "]),
        (("H (A)", "B (T)"), {}, ["'H (A/m)'", "cannot be converted to 'A'"]),
    ],
)
def test_what_is_no_quantity_or_unit_is_refused_in_the_own_words(
    tmp_path: Path, stated: tuple[str, str], options: dict[str, Any], texts: list[str]
) -> None:
    h, b = loop()
    pd.DataFrame({"H (A/m)": h, "B (T)": b}).to_csv(tmp_path / "loop.csv", index=False)
    with pytest.raises(bw.InputError) as error:
        read_record(tmp_path / "loop.csv", input=stated[0], output=stated[1], **options)
    for text in texts:
        assert text in str(error.value)
    assert not re.search(r"\b(voltage|displacement|um)\b", str(error.value))


def test_a_files_note_that_would_be_code_is_none(tmp_path: Path) -> None:
    """A stranger's file puts no tag into a page."""
    rows = "".join(f"{i / 10},{i % 7},{i % 5}\n" for i in range(40))
    head = "# input_is: <script> (V)\n# output_is: x (um)\ntime_s,voltage_V,displacement_um\n"
    (tmp_path / "loop.csv").write_text(head + rows, encoding="utf-8")
    assert read_record(tmp_path / "loop.csv").quantities == DEFAULT


@pytest.mark.parametrize("exponent", [1.0, 1.5, 3.0])
def test_no_default_prior_knows_an_absolute_voltage_or_displacement(exponent: float) -> None:
    """In other units of input and output every default prior is the same one."""
    voltage, displacement = loop()
    covariates = {"temperature_degC": 20 + displacement, "load_N": 1 + displacement}
    per_input, per_output = 1e-3, 1e6
    ranges, scaled = (
        ranges_of(
            Inputs(own * voltage, interval=0.01, covariates=covariates),
            np.round(displacement, 6) * times,
        )
        for own, times in ((1.0, 1.0), (per_input, per_output))
    )
    compared = 0
    for declared in every_declaration():
        stated: dict[str, float | Distribution] = {"exponent": exponent, "stiffness": 1.0}
        first, second = (declared.default(Context(r, stated)) for r in (ranges, scaled))
        unit = declared.unit_in(stated)
        if unit in ("kg", "N/m", "N s/m") or isinstance(first, float | None):
            continue
        assert isinstance(second, Distribution)
        powers = {"um": 0.0, "V": 0.0}
        for over, name, power in re.findall(r"(/?)(um|V)(?:\^\(?([-\dn]+)\)?)?", unit):
            size = {"": 1.0, "1-n": 1 - exponent, "-n": -exponent}.get(power)
            powers[name] += (-1 if over else 1) * (float(power) if size is None else size)
        factor = per_output ** powers["um"] * per_input ** powers["V"]
        for name, value in first.arguments.items():
            own = value if name in ("sigma", "s") else factor * value
            assert second.arguments[name] == pytest.approx(own, rel=1e-9), declared.name
        compared += 1
    assert compared > 50


def test_a_loop_without_time_is_rate_independent_and_says_so() -> None:
    """Its dynamics, creep and noise are left out; with a time they stay."""
    h, b = loop()
    stated: dict[str, Any] = {"input": "H (A/m)", "output": "B (T)"}
    keys = {"dynamics": "lag", "creep": True, "stages": ["backlash", "sensor-lag"]}
    for interval in (None, 0.01):
        record = Record.from_arrays(h, b, interval=interval, **stated)
        config, records = config_of(record, keys, "fit")
        problem = resolve_config(config, Path(), records)
        names = {parameter.name for parameter in problem.study.parameters}
        timed = {"lag", "sensor_lag", "discrepancy_time"} & names
        assert "backlash" in names
        assert bool(timed) == (interval is not None)
        said = any("rate independent" in remark for remark in problem.record_remarks)
        assert said == (interval is None)


def test_a_design_by_rivals_is_said_in_the_runs_quantities() -> None:
    """Banners, remarks, table and numbers; none of its texts has a V or um left."""
    waves = {name: 40 * np.sin(np.arange(200) / 9) for name in ("slow", "fast")}
    scores = [
        RivalScore("slow", 0.2, 0.01, difference_um=0.3, sd_um=0.02, told_apart=0.9),
        RivalScore("fast", np.nan, np.nan, refused="changes by 400 V/s, faster than 200 V/s"),
    ]
    limits = Limits(-50.0, 50.0, 200.0)
    design = RivalDesign("run", None, None, limits, waves, 0.01, ValidationSummary(), scores)
    design.said_in(MAGNET)
    report = design.full_report().said()
    blocks = [block for block in report.blocks if not isinstance(block, Picture)]
    texts = str((report.banners, report.numbers, blocks))
    assert "differ from the model by 0.3 T" in texts
    assert texts.count("400 A/m/s") == 3
    assert not re.search(r"(?<![\w'])(um|V)\b|_um|[Vv]oltage", texts)
