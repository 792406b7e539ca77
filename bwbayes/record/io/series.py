"""Named series of numbers: the content of a file or of a table in memory.

A reader of a format is a function of a path that returns a :class:`Source`;
:mod:`bwbayes.record.io.columns` chooses its series of time, voltage and displacement. Numbers are
loaded when they are needed, since a file may hold much else.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from bwbayes.errors import InputError, InputWarning, one_line

MAXIMUM_SAMPLES = 10**8
# Keys of the instruments' uncertainties, in the order of the fields of `Instruments`.
INSTRUMENT_NOTES = ("sensor_scale_sd", "amplifier_gain_sd", "sensor_linearity")
# Keys that a file may hold beside its numbers.
NOTES = (
    *("voltage_is", "origin", "interval_s", "time_offset_s", "covariates"),
    *("input_is", "output_is"),
    *INSTRUMENT_NOTES,
)
# Names, in lower case, of a number beside the series that is their sampling rate, Hz, or interval,
# s, with the power of that number that is the rate.
RATES = {
    **dict.fromkeys(("fs", "rate", "sample_rate", "samplerate", "sampling_rate"), 1),
    **dict.fromkeys(("dt", "ts", "interval", "interval_s", "sample_time", "sample_interval"), -1),
    **dict.fromkeys(("increment", "x_increment", "xincrement", "xinc", "tinc"), -1),
}


class Clock(NamedTuple):
    """Clock of a series without a time column: a sample every ``interval`` s from ``start`` on.

    The ``start``, s, counts from the file's own zero or, where the file states one, from ``zero``.
    """

    interval: float
    start: float = 0.0
    zero: np.datetime64 | None = None

    def delay(self, other: Clock) -> float:
        """Return the delay of this series' start after that of another one, s."""
        delay = self.start - other.start
        if self.zero is not None and other.zero is not None:
            delay += float((self.zero - other.zero) / np.timedelta64(1, "ns")) / 1e9
        return delay


@dataclass(frozen=True)
class Series:
    """A series of numbers: its path in the file, which begins with its group, and its loader.

    ``unit`` is the unit that the file states beside the name; ``load`` returns the ``size`` values,
    and ``load_readings``, if it is given, the same with nan in place of words, for missing
    readings. ``clock`` is stated by the file in place of a time column. ``alias`` replaces the name
    in the recognition of quantities.
    """

    name: str
    size: int
    load: Callable[[], NDArray[Any]]
    unit: str = ""
    group: str = ""
    load_readings: Callable[[], NDArray[Any]] | None = None
    clock: Clock | None = None
    alias: str = ""

    @property
    def label(self) -> str:
        """The name without the path."""
        return self.alias or self.name.removeprefix(self.group)

    def numbers(self, where: object, *, readings: bool = False) -> NDArray[Any]:
        """Load the numbers, (size,), of a series in the file ``where``; ``readings`` may be nan.

        Raises InputError: they are not real numbers, or damaged.
        """
        try:
            load = (readings and self.load_readings) or self.load
            values = np.asarray(load())
            if values.dtype.kind in "iuf" and values.shape != (self.size,):
                raise ValueError(f"{values.size} values for {self.size}")
        except (InputError, Warning):
            raise
        except Exception as error:
            raise damaged(f"{where}: {self.name}", error) from error
        if values.dtype.kind not in "iuf":
            kinds = {"c": "complex numbers", "b": "logical values"}
            problem = kinds.get(values.dtype.kind, "text or another type that is not a number")
            raise InputError(f"{where}: {self.name}: holds {problem}; store real numbers")
        return values


@dataclass(frozen=True)
class Source:
    """Content of a file: its series and its notes.

    ``notes`` are the file's notes (`NOTES`), by the group of the series that they belong to.
    ``lines`` are the line numbers of the samples in a text file, from 1 on.
    """

    path: Path
    series: tuple[Series, ...]
    notes: Mapping[str, Mapping[str, str]] = field(default_factory=dict)
    lines: Sequence[int] = ()

    def stated_rate(self) -> float:
        """Return the sampling rate, Hz, that is stated beside the series, or 0."""
        texts = {n.lower(): t for notes in self.notes.values() for n, t in notes.items()}
        for series in self.series:
            if series.size == 1 and series.label.lower() in RATES:
                with suppress(InputError):
                    texts[series.label.lower()] = str(series.numbers("")[0])
        for name, power in RATES.items():
            with suppress(ValueError):
                # A number of kHz or ms is not used.
                text = texts.get(name, "").strip(" ,;\t").removesuffix("Hz").removesuffix("s")
                if 0 < float(text) < np.inf:
                    return float(float(text) ** power)
        return 0.0


def vectors(
    group: str,
    leaf: str,
    shape: Any,
    dtype: Any,
    load: Callable[[], Any],
    unit: str = "",
    columns: Mapping[str, tuple[Sequence[str], Sequence[str]]] | None = None,
) -> Iterator[Series]:
    """Yield the series in an array: the array, its columns, or a table's fields.

    ``group`` and ``leaf`` are the path of the array, with a separator at its end, and its name.
    Shape and type are those of the array that ``load()`` returns; one without a shape, too large,
    or with more than 64 columns (a picture, or samples in another order) is skipped. ``columns``
    are names and units of the columns, by the name of the array or the table's field, where as many
    are stated; else columns are numbered.
    """
    sides = [n for n in shape or () if n != 1]
    if shape is None or max(sides, default=1) > MAXIMUM_SAMPLES:
        return
    if dtype.names:
        for name in dtype.names:
            inner = partial(lambda name: load()[name], name)
            kind, inside = dtype[name].base, (*shape, *dtype[name].shape)
            yield from vectors(f"{group}{leaf}.", name, inside, kind, inner, unit, columns)
    elif len(sides) == 2 and min(sides) <= 64 and dtype.kind in "iuf":
        across = int(sides[0] >= sides[1])
        count, within = min(sides), f"{group}{leaf}."
        names, units = (columns or {}).get(leaf, ((), ()))
        for i in range(count):
            column = partial(lambda i: np.squeeze(load()).take(i, across), i)
            stated = units[i] if len(units) == count else unit
            if len({*names}) == len(names) == count:
                yield Series(f"{within}{names[i]}", max(sides), column, stated, within)
            else:
                yield Series(f"{group}{leaf}[{i + 1}]", max(sides), column, stated, group)
    elif len(sides) <= 1 or dtype.kind not in "iuf":
        size = int(np.prod(sides, dtype=np.int64))
        yield Series(f"{group}{leaf}", size, lambda: np.ravel(load()), unit, group)


def with_units_beside(series: Sequence[Series], texts: Mapping[str, str]) -> tuple[Series, ...]:
    """Return the series of a MATLAB file with the units that texts beside them state.

    ``texts`` are given by their paths. In a struct with one series besides its times, the field
    ``units`` or, in a timeseries saved as a struct, ``DataInfo.Units`` states the unit of that
    series; ``TimeInfo`` states the unit of ``Time``.
    """
    by_path = {path.replace("/", ".").lower(): text for path, text in texts.items()}
    described = []
    for each in series:
        struct, is_time = each.group.replace("/", ".").lower(), each.label == "Time"
        words = ("timeinfo.units",) if is_time else ("unit", "units", "datainfo.units")
        beside = {s.label.partition("[")[0] for s in series if s.group == each.group and s.size > 1}
        stated = [by_path[struct + word] for word in words if struct + word in by_path]
        is_alone = bool(struct) and len(beside - {"Time", "time"}) <= 1
        unit = stated[0] if stated and not each.unit and (is_time or is_alone) else each.unit
        described.append(replace(each, unit=unit))
    return tuple(described)


def note(value: Any) -> str:
    """Return a note of a file as text, whatever type it has there."""
    first = np.ravel(value)[0] if np.size(value) else ""
    if isinstance(first, bytes):
        return first.decode("utf-8", errors="replace")
    # Write a number with the digits of its own type: one of 32 bits has fewer.
    return repr(float(str(first))) if np.asarray(first).dtype.kind in "iuf" else str(first)


def notes_of(value: Any) -> list[str]:
    """Return each of several notes as text; split a single text at its commas."""
    texts = [note(item).strip() for item in np.ravel(value)]
    return [text.strip() for text in texts[0].split(",")] if len(texts) == 1 else texts


def pass_over_object(path: Path, name: str, kind: str) -> None:
    """Warn that a MATLAB object, such as a timeseries, is not read, and say how to save it."""
    struct = "s = table2struct({}, 'ToScalar', true)"
    ways = {
        "timeseries": f"s.Time = {name}.Time; s.Data = {name}.Data",
        "table": struct.format(name),
        "timetable": struct.format(f"timetable2table({name})"),
    }
    advice = "save its numbers as variables"
    if kind in ways:
        advice = f"{ways[kind]}; save('record.mat', '-struct', 's')"
    # A damaged file may have anything for a name.
    what = f"{name}: a MATLAB {kind}" if f"{name}{kind}".isidentifier() else "a MATLAB object"
    text = f"{path}: {what}, which only MATLAB reads, is left out; {advice}"
    warnings.warn(one_line(text), InputWarning, stacklevel=5)


def in_seconds(times: Any) -> NDArray[Any]:
    """Return dates, from 1970 on, or durations (samples,) in s; other values as they are."""
    values: NDArray[Any] = np.asarray(times)
    if values.dtype.kind not in "mM":
        return values
    zero = np.datetime64(0, "ns") if values.dtype.kind == "M" else np.timedelta64(0, "ns")
    # Round only once: a date in ns has more digits than a double.
    with np.errstate(invalid="ignore"):  # of a missing date, which becomes nan
        seconds, rest = np.divmod(values - zero, np.timedelta64(1, "s"))
    return np.asarray(seconds + rest / np.timedelta64(1, "s"))


def damaged(where: object, error: Exception) -> InputError:
    """Return the error for a damaged file, from any exception that its reader raised."""
    reason = " ".join(str(error).split())[:80] or type(error).__name__
    return InputError(f"{where}: damaged or cut off ({reason}); write it again")


def array_source(
    origin: str,
    arrays: Mapping[str, Any],
    interval: float | None = None,
    start: float = 0.0,
    notes: Mapping[str, str] | None = None,
) -> Source:
    """Return arrays (samples,), or a row or a column, by name as a file called ``origin``."""
    clock = None if interval is None else Clock(interval, start)
    series = [
        Series(name, np.size(values), partial(_vector, values, origin, name), clock=clock)
        for name, values in arrays.items()
        if values is not None
    ]
    groups = {"": {"origin": origin, **(notes or {})}}
    return Source(Path(origin), tuple(series), groups)


def read_numpy(path: Path) -> Source:
    """Return the series of NumPy's ``.npy`` or ``.npz``; a damaged file may raise any exception."""
    with path.open("rb") as file:
        loaded = np.load(file, allow_pickle=False)
        arrays = {"array": loaded} if isinstance(loaded, np.ndarray) else {}
        for name in () if arrays else loaded.files:
            try:
                arrays[name] = loaded[name]
            except ValueError as error:  # of Python's objects, which are passed over
                if "allow_pickle" not in str(error):
                    raise
    notes = {name: note(values) for name, values in arrays.items() if name in NOTES}
    series = [
        one
        for name, values in arrays.items()
        if name not in notes
        for one in vectors(
            *("", name, values.shape, values.dtype, partial(in_seconds, values)),
            unit="s" if values.dtype.kind in "mM" else "",
        )
    ]
    return Source(path, tuple(series), {"": notes})


def frame_source(frame: Any, origin: str) -> Source:
    """Return the columns of a pandas table, called ``origin``.

    The index counts as a column if it has a name, or dates or durations.
    """
    if frame.index.name is not None or frame.index.dtype.kind in "mM":
        frame = frame.reset_index()
    series = []
    for number, (label, kind) in enumerate(frame.dtypes.items()):
        values = frame.iloc[:, number].to_numpy()
        unit = "s" if getattr(kind, "kind", "") in ("m", "M") else ""
        load = partial(_vector, values, origin, str(label))
        series.append(Series(str(label), len(frame), load, unit))
    return Source(Path(origin), tuple(series), {"": {"origin": origin}})


def _vector(values: Any, origin: str, name: str) -> NDArray[Any]:
    """Return numbers, in s if they are dates or durations, or raise an error that names them."""
    if np.ma.isMaskedArray(values):
        values = np.ma.filled(values.astype(np.float64), np.nan)
    try:
        vector = np.asarray(in_seconds(values), dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise InputError(f"{origin}: {name}: not numbers ({error}); convert them") from None
    if not vector.ndim or sum(side != 1 for side in vector.shape) > 1:
        raise InputError(f"{origin}: {name}: shape {vector.shape} is no vector; give (samples,)")
    return vector.ravel()
