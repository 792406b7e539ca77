"""Choice of the series of a file that are time, voltage and displacement, and of their units.

The package's own names carry quantity and unit (``voltage_mV``); other names are recognized by
their word (``t [ms]``, ``pos``), or else by their unit, where they can mean nothing else; a
:class:`Naming` settles the rest. One :class:`ColumnsError` lists all that is still open, with the
series in the file and a guess. Columns of other quantities, such as ``H (A/m)`` and ``B (T)``, are
found by their name or their unit, pint converts them to the stated unit, and then they are read as
the voltage and the displacement of any other file.
"""

from __future__ import annotations

import operator
import re
import warnings
from collections.abc import Callable, Collection, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any, Self
from unicodedata import normalize

import numpy as np
from numpy.typing import NDArray

from bwbayes.arrays import FloatArray, IntArray
from bwbayes.errors import InputError, InputWarning, one_line
from bwbayes.quantities import DEFAULT, DISPLACEMENT, TIME, VOLTAGE, Quantities, Quantity
from bwbayes.record.instruments import EXACT, Instruments, part_of_range, split_uncertainty
from bwbayes.record.io.recognition import (
    COMMON_UNITS,
    QUANTITIES,
    beside,
    columns_error,
    counts_samples,
    epoch_unit,
    finite,
    is_demand,
    likeness,
    rises,
    scale_of,
    series_named,
    unit_at_rate,
    unit_of,
    with_own_times,
)
from bwbayes.record.io.series import Series, Source


@dataclass(frozen=True)
class Naming:
    """Columns of a file that hold the quantities, and their units.

    The fields are the keyword arguments of :func:`~bwbayes.record.io.formats.read_record`; columns
    and units go by "time", "voltage" and "displacement". ``instruments`` have the uncertainties
    that the units and the linearity state.

    Raises InputError: a quantity that does not exist, a unit that it cannot have, one column for
    two quantities, or a rate that is none.
    """

    columns: Mapping[str, str | int] = field(default_factory=dict)
    units: Mapping[str, str] = field(default_factory=dict)
    fs: float | None = None
    table: int | str | None = None
    displacement_file: Path | None = None
    covariates: Mapping[str, str] | Sequence[str] = ()
    input: str | None = None
    output: str | None = None
    linearity: str | None = None
    instruments: Instruments = EXACT

    def __post_init__(self) -> None:
        if wrong := {*QUANTITIES, "truth", ""} & self.covariate_columns.keys():
            raise InputError(f"covariates: {wrong.pop()!r} is none; say what, with its unit")
        for key, table in (("columns", self.columns), ("units", self.units)):
            for quantity in table:
                if quantity not in QUANTITIES:
                    allowed = self.quantities.say(", ".join(QUANTITIES))
                    raise InputError(f"{key}: no quantity {quantity!r}; write {allowed}")
        self._split_units()
        self._require_units()
        for quantity, column in self.columns.items():
            if not isinstance(column, str) and (
                isinstance(column, bool) or not hasattr(column, "__index__")
            ):
                raise InputError(f"columns: {quantity}: {column!r} is no name and no number")
        columns = {
            q: c if isinstance(c, str) else operator.index(c) for q, c in self.columns.items()
        }
        object.__setattr__(self, "columns", columns)
        beside = [
            c for q, c in columns.items() if q != "displacement" or not self.displacement_file
        ]
        if len(set(beside)) < len(beside):
            raise InputError("columns: two quantities have the same column; give each its own")
        if self.fs is not None and not 0 < self.fs < np.inf:
            raise InputError(f"fs: {self.fs:g} Hz is no sampling rate; give a number above 0")
        if self.fs is not None and "time" in self.columns:
            raise InputError("fs: takes the place of the time column; give one of the two")

    def _split_units(self) -> None:
        """Take the uncertainties out of the units, to the instruments."""
        units, uncertainties = dict(self.units), dict[str, float]()
        names = {"displacement": "sensor_scale", "voltage": "amplifier_gain"}
        for quantity, text in units.items():
            units[quantity], uncertainty = split_uncertainty(text, f"units: {quantity}")
            if uncertainty is not None:
                if quantity not in names:
                    raise InputError(f"units: {quantity}: has no uncertainty; give its unit alone")
                uncertainties[names[quantity]] = uncertainty
        if self.linearity is not None:
            uncertainties["linearity"] = part_of_range(self.linearity, "linearity")
        object.__setattr__(self, "units", units)
        object.__setattr__(self, "instruments", replace(self.instruments, **uncertainties))

    @property
    def stated_units(self) -> dict[str, str]:
        """The units with their uncertainties, as a user states them."""
        uncertain = {
            "displacement": self.instruments.sensor_scale,
            "voltage": self.instruments.amplifier_gain,
        }
        units = dict(self.units)
        for quantity, sd in uncertain.items():
            if sd and quantity in units:
                units[quantity] += f" +- {100 * sd:.6g} %"
        return units

    def _require_units(self) -> None:
        """Refuse a unit that its quantity cannot have."""
        for quantity, unit in self.units.items():
            expected = self.quantities.of_key(quantity)
            if expected not in (VOLTAGE, DISPLACEMENT, TIME):
                if conversion(unit, expected.unit) is None:
                    raise InputError(
                        f"units: {expected.name} in {unit!r} is unknown; write {expected.unit}, a "
                        f"unit that converts to it, or a number of them, as '0.35 {expected.unit}'"
                    )
                continue
            if (scale := scale_of(unit, quantity)) is None:
                allowed = ", ".join(COMMON_UNITS[quantity])
                raise InputError(
                    f"units: {quantity} in {unit!r} is unknown; write {allowed}, with another SI "
                    f"prefix, or a number of them, as '0.35 {COMMON_UNITS[quantity][0]}'"
                )
            if quantity == "time" and scale[0] < 0:
                raise InputError("units: time does not run backwards; remove the minus")

    @classmethod
    def stated(
        cls,
        *,
        columns: Mapping[str, str | int] | None = None,
        units: Mapping[str, str] | None = None,
        displacement_file: str | Path | None = None,
        covariates: Mapping[str, str] | Sequence[str] | None = None,
        **others: Any,
    ) -> Self:
        """Return the naming of a user, who may call the quantities input and output, or H and B."""
        names = Quantities.of(others.get("input"), others.get("output")).by_key
        return cls(
            {names.get(q.casefold(), q): column for q, column in (columns or {}).items()},
            {names.get(q.casefold(), q): unit for q, unit in (units or {}).items()},
            displacement_file=None if displacement_file is None else Path(displacement_file),
            covariates=covariates or (),
            **others,
        )

    @property
    def quantities(self) -> Quantities:
        """The quantities that stand for voltage and displacement."""
        return Quantities.of(self.input, self.output)

    @property
    def covariate_columns(self) -> dict[str, str]:
        """The columns of the covariates, by name."""
        named = self.covariates
        return dict(named) if isinstance(named, Mapping) else {name: name for name in named}

    def of_file(self, source: Source, quantity: str) -> Naming:
        """Return the naming for one of two files; its only column besides times is the quantity."""
        columns = {q: c for q, c in self.columns.items() if q in ("time", quantity)}
        if len(source.series) == 1:
            columns.pop("time", None)
        others = [s for s in source.series if likeness(s.label, s.unit, "time") is None]
        if quantity not in columns and len(others) == 1:
            columns[quantity] = others[0].name
        units = {q: unit for q, unit in self.units.items() if q in ("time", quantity)}
        covariates = self.covariates if quantity == "voltage" else ()
        return replace(
            self, columns=columns, units=units, covariates=covariates, displacement_file=None
        )


@dataclass(frozen=True)
class ColumnTable:
    """The columns of a file by quantity ("time", "voltage", "displacement", "truth") or covariate.

    ``columns`` are the file's series, with the units that count; a unit may have a factor, which
    may be negative. ``values`` are their numbers in these units. ``notes`` are the notes in the
    file. ``naming`` finds the same columns again; without a time column, the times come from its
    rate or from the source. ``rows`` are the indices of the file's samples that are in the table,
    or None for all.
    """

    source: Source
    columns: Mapping[str, Series]
    values: Mapping[str, NDArray[Any]]
    notes: Mapping[str, str]
    naming: Naming
    rows: IntArray | None = None
    quantities: Quantities = DEFAULT

    def error(self, problem: str, quantity: str = "", sample: int | None = None) -> InputError:
        """Return the error ``file:line: column: problem``; sample and quantity may be left out."""
        where, lines = str(self.source.path), self.source.lines
        if sample is not None:
            sample = sample if self.rows is None else int(self.rows[sample])
            where += f":{lines[sample]}" if lines else f":sample {sample}"
        if quantity:
            name = self.columns[quantity].name if quantity in self.columns else quantity
            where += f": {name}" if self.quantities.are_default else f": {name!r}"
        return InputError(f"{where}: {problem}")

    def only(self, rows: IntArray) -> ColumnTable:
        """Return the table of some of its rows."""
        values = {quantity: column[rows] for quantity, column in self.values.items()}
        return replace(self, values=values, rows=rows if self.rows is None else self.rows[rows])

    def convert(self, values: FloatArray, quantity: str) -> FloatArray:
        """Convert values from a column's unit to the package's; without a unit, keep them."""
        unit = self.columns[quantity].unit
        if not unit:
            return values
        factor, power = scale_of(unit, quantity) or (1.0, 0)
        # Dividing by 1e3 rounds once, multiplying by the inexact 1e-3 would round twice.
        return factor * (values * 10.0**power if power >= 0 else values / 10.0**-power)


def select(source: Source, naming: Naming, needed: Collection[str] = QUANTITIES) -> ColumnTable:
    """Return the columns of a file that are time, voltage, displacement and truth.

    Raises ColumnsError: a column that is needed and not known, or one whose unit is not;
    InputError: a column that is named and not there, or whose values are not real numbers.
    Warns InputWarning: if a column is recognized by nothing but its unit, or columns of a text are
    ignored.
    """
    as_asked = naming
    source, naming, quantities = in_stated_quantities(source, naming, needed)
    chosen = {q: series_named(source, name, q) for q, name in naming.columns.items()}
    by_unit = _recognize(source, chosen, naming)
    if "voltage" in needed:
        chosen = with_own_times(source, chosen, naming)
    timed = [series for quantity, series in chosen.items() if quantity != "time"] or source.series
    has_rate = naming.fs is not None or all(series.clock for series in timed)
    missing = [q for q in needed if q not in chosen and not (q == "time" and has_rate)]
    units = {q: naming.units.get(q) or unit_of(s.label, s.unit, q) for q, s in chosen.items()}
    if "time" in units:
        label, times = chosen["time"].label, finite(chosen["time"])
        units["time"] = units["time"] or epoch_unit(label, times)
        units["time"] = units["time"] or unit_at_rate(times, source.stated_rate())
    for series in (chosen[q] for q in chosen if "V" in naming.units.get(q, "") and q != "voltage"):
        if (stated := unit_of(series.label, series.unit, "voltage")) not in (None, "V"):
            advice = f"say how many um is 1 {stated}, as '0.35 um'"
            raise InputError(f"{source.path}: {series.name}: in {stated}, not in V; {advice}")
    unknown = [q for q in QUANTITIES if q in chosen and units[q] is None]
    if missing or unknown:
        error = columns_error(source, naming, chosen, missing, unknown)
        raise error if quantities.are_default else quantities.asked(error)
    path = source.path
    if by_unit:
        reasons = ", ".join(f"{quantity} is {chosen[quantity].name!r}" for quantity in by_unit)
        _warn(f"{path}: taken by its unit: {reasons}; if not, say `columns`")
    columns = {q: replace(chosen[q], unit=unit) for q, unit in units.items() if unit}
    values = {
        quantity: series.numbers(path, readings=quantity == "displacement")
        for quantity, series in columns.items()
    }
    group = next(iter(chosen.values())).group
    notes = {**source.notes.get("", {}), **source.notes.get(group, {})}
    covariates = naming.covariate_columns
    if not covariates and "covariates" in notes:
        covariates = {name: name for name in notes["covariates"].split(", ")}
    for name, column in covariates.items():
        series = series_named(source, column, name)
        columns[name], values[name] = replace(series, unit=""), series.numbers(path)
    names = {q: column.name for q, column in columns.items()}
    has_clocks = "time" not in chosen and naming.fs is None
    others = [
        s.name
        for s in source.series
        if s.name not in names.values()
        # Times that became clocks are not ignored.
        and not (has_clocks and likeness(s.label, s.unit, "time") is not None)
    ]
    if others and source.lines:
        shown = ", ".join(others[:10]) + ", ..." * (len(others) > 10)
        _warn(f"{path}:{max(source.lines[0] - 1, 1)}: ignored columns: {shown}")
    foreign = {
        q: name for q, name in names.items() if q in QUANTITIES and likeness(name, "", q) != 0
    }
    used = replace(as_asked, columns={**foreign, **as_asked.columns}, fs=naming.fs)
    return ColumnTable(source, columns, values, notes, used, quantities=quantities)


def _warn(remark: str) -> None:
    warnings.warn(one_line(remark), InputWarning, stacklevel=5)


def _recognize(source: Source, chosen: dict[str, Series], naming: Naming) -> list[str]:
    """Add the series that can be meant by one quantity alone; return those known by their unit."""
    settled = {*chosen, *(["time"] if naming.fs is not None else [])}
    long = [s for s in source.series if s.size > 1] or source.series
    by_unit = []
    for rank in range(3):
        for quantity in (*QUANTITIES, "truth"):
            names = [series.name for series in chosen.values()]
            candidates = [
                s
                for s in long
                if s.name not in names
                and likeness(s.label, s.unit, quantity) == rank
                # Exclude sample numbers, commanded displacements and empty columns of times.
                and not (rank and quantity != "time" and counts_samples(s))
                and not (rank == 2 and quantity == "displacement" and is_demand(s))
                and not (quantity == "time" and s.clock and not finite(s).size)
            ]
            if rank == 1 and quantity == "voltage" and any(map(is_demand, candidates)):
                # Take the command as the voltage only if no other column may be the output.
                candidates += [s for s in long if likeness(s.label, s.unit, quantity) == 2]
            if quantity in settled or not candidates:
                continue
            settled.add(quantity)
            candidates = beside(candidates, chosen)
            if len(candidates) == 1:  # several candidates leave it open, whatever their units
                chosen[quantity] = candidates[0]
                if rank == 2 and quantity != "time":  # seconds leave no doubt
                    by_unit.append(quantity)
    return by_unit


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
    registry: Any = pint.get_application_registry()
    (source_unit, size), (target, target_size) = map(_spell_unit, (match[2], to))
    try:
        source_unit, target = registry.parse_units(source_unit), registry.parse_units(target)
        registry.Quantity(1.0, source_unit).to(target)
    except Exception:  # pint raises many kinds, some of them Python's own
        return None

    def convert(values: FloatArray) -> FloatArray:
        quantity = registry.Quantity(factor * size / target_size * values, source_unit)
        return np.asarray(quantity.m_as(target))

    return convert


def _spell_unit(unit: str) -> tuple[Any, float]:
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
            changed[series.name] = _convert(source, series, key, quantity, unit)
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


def _convert(source: Source, series: Series, key: str, quantity: Quantity, unit: str) -> Series:
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
