"""Units as names of columns, users and data sheets write them."""

from hypothesis import given, strategies as st

from bwbayes.record.io.units import scale_of, unit_in


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
