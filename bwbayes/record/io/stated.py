"""Columns of quantities that a user or a file states, such as ``H (A/m)`` and ``B (T)``.

They are found by their name or their unit, and pint converts them to the stated unit. Then they are
read as the voltage and the displacement of any other file.
"""

from __future__ import annotations

import re
import warnings
from collections.abc import Callable, Collection
from contextlib import suppress
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING, Any
from unicodedata import normalize

import numpy as np
from numpy.typing import NDArray

from bwbayes.arrays import FloatArray
from bwbayes.errors import InputError, InputWarning, one_line
from bwbayes.quantities import DISPLACEMENT, VOLTAGE, Quantities, Quantity
from bwbayes.record.io.recognition import counts_samples, likeness, rises, series_named
from bwbayes.record.io.series import Series, Source

if TYPE_CHECKING:
    from bwbayes.record.io.columns import Naming

type Conversion = Callable[[FloatArray], FloatArray]


def conversion(unit: str, to: str) -> Conversion | None:
    """Return a function that converts numbers between two units; None if their kinds differ.

    A number before the unit is what 1 stands for, a minus turns the sign: ``-0.35 mT``. Units are
    those of pint; one that it does not know converts to itself.
    """
    import pint  # noqa: PLC0415  # slow to load, and few records need it

    match = re.fullmatch(r"\s*(-?(?:(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?)?)\s*(.*?)\s*", unit)
    assert match is not None
    factor = float({"": "1", "-": "-1"}.get(match[1], match[1]))
    if not 0 < abs(factor) < np.inf:
        return None
    if match[2] == to.strip():
        return lambda values: factor * values
    registry: Any = pint.get_application_registry()  # type: ignore[no-untyped-call]
    (source_unit, size), (target, target_size) = map(_spelled, (match[2], to))
    try:
        source_unit, target = registry.parse_units(source_unit), registry.parse_units(target)
        registry.Quantity(1.0, source_unit).to(target)
    except Exception:  # pint raises many kinds, some of them Python's own
        return None

    def convert(values: FloatArray) -> FloatArray:
        quantity = registry.Quantity(factor * size / target_size * values, source_unit)
        return np.asarray(quantity.m_as(target))

    return convert


def _spelled(unit: str) -> tuple[Any, float]:
    """Return a unit in pint's spelling, and the factor from the given unit to it.

    A number behind a letter, as in ``uC/cm2``, is a power. Gauss and oersted, which belong to
    another system in pint, become factors of tesla and A/m.
    """
    text = normalize("NFKC", unit)
    if match := re.fullmatch("([mk]?)(?:(G|gauss)|Oe|oersted)", text):
        return (f"{match[1]}T", 1e-4) if match[2] else (f"{match[1]}A/m", 250 / np.pi)
    return re.sub(r"(?<=[^\W\d])(-?\d+)(?!\w)", r"^\1", text), 1.0


def in_stated_quantities(
    source: Source, naming: Naming, needed: Collection[str]
) -> tuple[Source, Naming, Quantities]:
    """Return a source with the stated quantities as voltage and displacement, and these.

    The naming states them, or the file does, as those that the package writes. In a file without
    any possible time, the samples themselves are the clock.

    Raises InputError: a column's unit that cannot be converted.
    """
    stated = naming.input, naming.output
    if stated == (None, None):
        notes = source.notes.get("", {})
        noted = notes.get("input_is"), notes.get("output_is")
        with suppress(InputError):  # notes of another form than the package's
            Quantities.of(*noted)
            stated = noted
    if stated == (None, None):
        return source, naming, naming.quantities
    quantities = Quantities.of(*stated)
    columns, units = dict(naming.columns), dict(naming.units)
    changed = {series.name: series for series in source.series}
    series_by_key = dict[str, Series]()
    for key, quantity, default in (
        ("voltage", quantities.input, VOLTAGE),
        ("displacement", quantities.output, DISPLACEMENT),
    ):
        if quantity == default:
            continue
        series = _series_of(source, naming, key, quantity, [*series_by_key.values()])
        unit = units.pop(key, "")
        for other in source.series:  # what this quantity would be by default is none of it
            is_like = likeness(other.label, other.unit, key) is not None
            if is_like and other not in series_by_key.values():
                changed[other.name] = replace(changed[other.name], alias="other", unit="")
        if series is not None:
            series_by_key[key] = series
            columns.pop(key, None)
            changed[series.name] = _converted(source, series, key, quantity, unit)
    truth = next((s for s in source.series if _parts(s, quantities.output)[0] == "truth"), None)
    if truth is not None and quantities.output != DISPLACEMENT:
        changed[truth.name] = replace(truth, alias="truth_um", unit="")
    fs = naming.fs
    if "time" in needed and _is_timeless(source, naming, [*series_by_key.values()]):
        quantities, fs = Quantities.of(*stated, has_clock=False), 1.0
    source = replace(source, series=tuple(changed[series.name] for series in source.series))
    return source, replace(naming, columns=columns, units=units, fs=fs), quantities


def _parts(series: Series, quantity: Quantity) -> tuple[str, str]:
    """Return the name of a series in lower case, and its unit, as the file states them."""
    match = re.fullmatch(r"(.*?)[\s_]*[(\[](.*)[)\]]\s*", series.label)
    if match is not None:
        return match[1].casefold(), series.unit or match[2]
    match = re.fullmatch(r"(.+?)[\s_/]+(\S+)", series.label)
    if match is not None and conversion(match[2], quantity.unit) is not None:
        return match[1].casefold(), series.unit or match[2]
    return series.label.casefold().strip(), series.unit


def _series_of(
    source: Source, naming: Naming, key: str, quantity: Quantity, taken: list[Series]
) -> Series | None:
    """Return the series of a stated quantity: the named one, or the one with its word or unit."""
    if key in naming.columns:
        return series_named(source, naming.columns[key], quantity.name)
    others = [s for s in source.series if s not in taken and s.size > 1]
    role = {"voltage": "input", "displacement": "output"}[key]
    for word in (quantity.name.casefold(), role):
        named = [s for s in others if _parts(s, quantity)[0] == word]
        if len(named) == 1:
            return named[0]
    units = [(s, _parts(s, quantity)[1]) for s in others]
    in_unit = [s for s, unit in units if unit and conversion(unit, quantity.unit) is not None]
    if len(in_unit) != 1:
        return None
    remark = f"taken by its unit: {key} is {in_unit[0].name!r}; if not, say `columns`"
    warnings.warn(one_line(f"{source.path}: {remark}"), InputWarning, stacklevel=5)
    return in_unit[0]


def _converted(source: Source, series: Series, key: str, quantity: Quantity, unit: str) -> Series:
    """Return a series with its numbers in the stated unit, under the package's own name."""
    unit = unit or _parts(series, quantity)[1] or quantity.unit
    convert = conversion(unit, quantity.unit)
    if convert is None:
        raise InputError(
            f"{source.path}: {series.name!r}: {unit!r} cannot be converted to {quantity.unit!r}; "
            f"state the column's unit, as units {quantity.name}={quantity.unit!r}"
        )

    def loaded(load: Callable[[], NDArray[Any]], convert: Conversion) -> NDArray[Any]:
        values = np.asarray(load())
        return convert(values.astype(np.float64)) if values.dtype.kind in "iuf" else values

    readings = series.load_readings and partial(loaded, series.load_readings, convert)
    alias = {"voltage": "voltage_V", "displacement": "displacement_um"}[key]
    return replace(
        series,
        alias=alias,
        unit="",
        load=partial(loaded, series.load, convert),
        load_readings=readings,
    )


def _is_timeless(source: Source, naming: Naming, chosen: list[Series]) -> bool:
    """Tell whether nothing in a file can be its time."""
    if naming.fs is not None or "time" in naming.columns or source.stated_rate():
        return False
    others = [s for s in source.series if s not in chosen and s.size > 1]
    return not any(s.clock for s in source.series) and not any(
        likeness(s.label, s.unit, "time") is not None or (rises(s) and not counts_samples(s))
        for s in others
    )
