"""The records of a config: from files or from the virtual stand, cut, split and looked at."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from pathlib import Path

import numpy as np

from bwbayes.app.config.config import (
    ALONE,
    Config,
    RecordConfig,
    SignalConfig,
    ValidationConfig,
)
from bwbayes.app.problem.parameters import place_of
from bwbayes.app.problem.stand import planned, stand_of
from bwbayes.data import Record, read_record
from bwbayes.data.io.formats import require_readable
from bwbayes.data.record import Window
from bwbayes.data.teststand import VirtualTestStand
from bwbayes.data.waveforms import (
    Carrier,
    Decay,
    Sine,
    Staircase,
    Triangle,
    Waveform,
    signal,
)
from bwbayes.diagnosis.finding import Finding
from bwbayes.diagnosis.record_checks import inspect
from bwbayes.errors import ColumnsError, InputError
from bwbayes.results.prediction import Start

__all__ = [
    "Windows",
    "findings_of",
    "generator",
    "other_record",
    "require_different",
    "sampled_waveform",
    "set_aside",
    "start_of",
    "training_records",
    "unlike",
    "whole",
    "windows_of",
]

# Times of outliers that a remark lists.
MOST_TIMES = 10


@dataclass(frozen=True)
class Windows:
    """The windows of one training record, as slices: to fit, and held out by name."""

    training: tuple[slice, ...]
    held_out: Mapping[str, tuple[slice, ...]]


def generator(seed: int, purpose: str) -> np.random.Generator:
    """Return the generator of one purpose of a run: each has a stream of its own."""
    return np.random.default_rng([seed, *purpose.encode()])


def sampled_waveform(drive: str | SignalConfig) -> Waveform:
    """Return the waveform of that name, or the one a config describes."""
    if isinstance(drive, str):
        return signal(drive)
    carrier: Carrier
    if drive.shape == "steps":
        carrier = Staircase(tuple(drive.levels or ()), drive.dwell or 0.0)
    else:
        shape = Sine if drive.shape == "sine" else Triangle
        carrier = shape(drive.amplitude or 0.0, drive.frequency or 0.0)
    return Waveform(
        carrier,
        drive.duration,
        drive.start,
        Decay(drive.decay_from, drive.decay),
    )


def training_records(
    config: Config, folder: Path, in_memory: Mapping[str, Record]
) -> tuple[dict[str, Record], VirtualTestStand | None]:
    """Return the training records by name, and the stand that made some, if one did.

    ``given`` are those that are in memory, by name.
    """
    read: dict[str, Record] = {}
    commands: dict[str, Waveform] = {}
    for name, source in config.records.items():
        if source.file is not None:
            read[name] = _read(source, folder, in_memory.get(name), place_of(name))
        else:
            assert source.signal is not None
            commands[name] = sampled_waveform(source.signal)
            read[name] = planned(config, commands[name], source.stop)
    stand = stand_of(config, list(read.values())) if commands else None
    for name, waveform in commands.items():
        assert stand is not None
        purpose = "record" if name == ALONE else f"record {name}"
        simulated = stand.run(waveform, generator(config.seed, purpose))
        read[name] = _named(simulated, config.records[name].signal)
    records = {
        name: _cut(config.records[name], record, place_of(name)) for name, record in read.items()
    }
    for name, record in records.items():
        require_readable(record, place_of(name))
    return records, stand


def _cut(source: RecordConfig, record: Record, table: str) -> Record:
    """Leave out the readings that a config leaves out."""
    if source.outliers:
        rows = np.rint((np.array(source.outliers) - record.start) / record.interval)
        if rows.min() < 0 or rows.max() >= record.samples:
            end = record.start + record.duration
            raise InputError(f"{table}.outliers: a time outside of {record.start:g} to {end:g} s")
        record = record.without(rows.astype(np.int64))
    if source.exclude is not None:
        record = record.exclude([(window[0], window[1]) for window in source.exclude])
    if source.start is not None or source.stop is not None:
        end = record.start + record.duration if source.stop is None else source.stop
        record = record.upto(end, source.start)
    if source.decimate > 1:
        record = record.decimate(source.decimate)
    return record


def _read(
    source: RecordConfig | ValidationConfig, folder: Path, in_memory: Record | None, table: str
) -> Record:
    """Return the record that is given, or else read the source's file."""
    if in_memory is not None:
        return replace(in_memory, voltage_is=source.voltage_is or in_memory.voltage_is)
    assert source.file is not None
    try:
        return read_record(
            folder / source.file,
            voltage_is=source.voltage_is,
            columns=source.columns,
            units=source.units,
            fs=source.fs,
        )
    except ColumnsError as error:
        raise error.within(table) from None


def other_record(
    config: Config,
    name: str,
    folder: Path,
    training: Mapping[str, Record],
    in_memory: Record | None,
) -> Record:
    """Return the record of a validation: from memory, a file, or the virtual stand."""
    source = config.validation[name]
    if source.file is not None:
        record = _read(source, folder, in_memory, f"validation.{name}")
        if in_memory is not None:
            require_readable(record, f"validation.{name}")
    else:
        assert source.signal is not None
        waveform = sampled_waveform(source.signal)
        stand = stand_of(config, list(training.values()))
        record = _named(
            stand.run(waveform, generator(config.seed, f"record {name}")), source.signal
        )
        require_readable(record, f"validation.{name}")
    # Said now: it would be a pity after the sampling.
    try:
        start_of(config, name).window(record)
    except InputError as error:
        raise InputError(f"validation.{name}.lead_in: {error}") from None
    if source.window is not None:
        try:
            record.window_slice(*source.window[0])
        except InputError as error:
            raise InputError(f"validation.{name}.{error}") from None
    return record


def start_of(config: Config, name: str) -> Start:
    """Return what a config knows of another record's start; its hold is its own, unless given."""
    source, hold = config.validation[name], config.model.hold
    return Start(
        source.from_rest,
        source.own_offset,
        source.lead_in,
        source.lead_in_from,
        None if hold == "auto" else hold,
    )


def _named(record: Record, drive: str | SignalConfig | None) -> Record:
    name = drive.shape if isinstance(drive, SignalConfig) else drive
    return replace(record, origin=f"{record.origin}, {name} signal")


def whole(record: Record) -> Window:
    """Return the window in s of all readings of a record."""
    first, last = np.flatnonzero(record.has_reading)[[0, -1]]
    return float(record.time[first]), float(record.time[last]) + record.interval


def windows_of(config: Config, name: str, record: Record) -> Windows:
    """Return the windows of a training record.

    Raises
    ------
    InputError
        A window outside of the record, windows that overlap, or one without a reading.
    """
    source, table = config.records[name], place_of(name)
    held_out = {
        f"validation.{n}.window": sorted((window[0], window[1]) for window in v.window)
        for n, v in config.validation.items()
        if v.window and not v.another and v.of in (name, None)
    }
    if source.train is None:
        train = [whole(record)]
    else:
        train = [(window[0], window[1]) for window in source.train]
    named = {f"{table}.train": train, **held_out}
    for where, window in [(key, window) for key in named for window in named[key]]:
        try:
            record.window_slice(*window)
        except InputError as error:
            raise InputError(f"{where}: {error}") from None
    try:
        split = record.split(train, [window for windows in held_out.values() for window in windows])
    except InputError as error:
        raise InputError(str(error).replace("record.train", f"{table}.train")) from None
    slices = {
        where: tuple(record.window_slice(*window) for window in windows)
        for where, windows in held_out.items()
    }
    for where, parts in {f"{table}.train": split.training, **slices}.items():
        for stretch in parts:
            if not record.has_reading[stretch].any():
                begin, end = record.time[stretch][[0, -1]]
                raise InputError(
                    f"{where}: no readings from {record.clock(begin)} to {record.clock(end)} s; "
                    f"choose another window, or see start, exclude and decimate in [{table}]"
                )
    names = [where.removeprefix("validation.").removesuffix(".window") for where in slices]
    return Windows(split.training, dict(zip(names, slices.values(), strict=True)))


def require_different(records: Mapping[str, Record], windows: Mapping[str, Windows]) -> None:
    """Refuse readings that would count twice: one record under two names.

    Raises
    ------
    InputError
        The same measurement is fitted twice, in windows that overlap.
    """
    for (name, first), (other, second) in combinations(records.items(), 2):
        overlap = any(
            a.start < b.stop and b.start < a.stop
            for a in windows[name].training
            for b in windows[other].training
        )
        if overlap and first.sha256 == second.sha256:
            raise InputError(
                f"{place_of(other)}: the same measurement as {place_of(name)}, whose readings "
                "would count twice; remove one, or give them other windows"
            )


def findings_of(record: Record, windows: Sequence[slice]) -> tuple[Finding, ...]:
    """Return what is wrong with a record, but for places that no window looks at."""
    # Borders that differ by less than half a sample are the same.
    times = [
        record.start + record.interval * np.array([w.start + 0.5, w.stop - 0.5]) for w in windows
    ]
    return tuple(
        finding
        for finding in inspect(record)
        if any(finding.start < stop and start < finding.stop for start, stop in times)
    )


def unlike(name: str, record: Record) -> Iterator[str]:
    """Yield what is wrong with a record that is predicted."""
    for finding in inspect(record):
        if finding.kind == "switch-on transient":
            fix = f"lead_in_from = {record.clock(finding.stop)} under [validation.{name}]"
            finding = replace(finding, fix=fix)  # noqa: PLW2901  # nothing here is fitted
        if finding.kind not in ("one amplitude", "few readings"):
            yield f"{name}: {finding}"


def set_aside(times: Sequence[float], record: Record) -> str:
    """Say which readings were set aside as outliers."""
    if not times:
        return "no reading is an isolated outlier: none was set aside"
    first = ", ".join(record.clock(time) for time in times[:MOST_TIMES])
    more = f" and {len(times) - MOST_TIMES} more" if len(times) > MOST_TIMES else ""
    plural = "s" if len(times) > 1 else ""
    return f"{len(times)} reading{plural} set aside as isolated outliers, at {first} s{more}"
