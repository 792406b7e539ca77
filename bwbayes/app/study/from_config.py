"""From a config to a study: records, windows, parameters, the virtual stand, the sampling.

The records of a config: from files or the virtual stand, joined, cut, split and looked at.

Where a measurement goes on in the next file, the actuator's state, the offset and the discrepancy
go on with it. Taken for a record of its own the second half would have an unknown start, and what
the discrepancy remembers over the cut would be lost. So records that say what they continue are put
together before anything else is done with them, and the fit is that of the whole.

A run stores its records under the package's own names. It notes how the columns of the original
file were read, and the names of all of them: a file beside a run that has no others is of the same
kind, and is read as the record was.

A config as a study: its model, parameters, stand and sampling.
"""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np

from bwbayes.app.config.config import (
    ALONE,
    Config,
    ParameterConfig,
    RecordConfig,
    SignalConfig,
    ValidationConfig,
)
from bwbayes.errors import ColumnsError, InputError, InputWarning, suggestion
from bwbayes.inference import resolve_engine
from bwbayes.inference.posterior import Posterior
from bwbayes.inference.study import (
    InitialConditions,
    Slices,
    Stated,
    Study,
    Validation,
    extent_of,
    generator,
    place_of,
)
from bwbayes.model.actuator import Actuator
from bwbayes.model.declaration import Distribution
from bwbayes.model.inputs import VoltageIs
from bwbayes.model.operators.bouc_wen import BoucWen
from bwbayes.quantities import Quantities
from bwbayes.record import Record
from bwbayes.record.io.columns import Naming
from bwbayes.record.io.formats import read_named, read_source
from bwbayes.record.io.series import Source
from bwbayes.record.record import Window
from bwbayes.record.teststand import VirtualTestStand
from bwbayes.record.waveforms import Waveform, signal, sine, staircase, triangle
from bwbayes.sampling.plan import SamplingPlan, best_ahead, best_ensembles_per_task, best_tries


def study_of(
    config: Config,
    records: Mapping[str, Record],
    training: Mapping[str, Slices] | None = None,
    validations: Mapping[str, Validation] | None = None,
) -> Study:
    """Return what a config fits to these records, in ``training`` windows, and holds against them.

    Raises InputError: a prior that is none.
    """
    return Study(
        config.model.spec,
        records,
        training or {},
        frozenset(name for name in records if config.records[name].from_rest),
        {name: _statement_of(name, parameter) for name, parameter in config.parameters.items()},
        tuple(config.model.per_record),
        tuple(config.model.shared),
        resolve_engine(config.sampling.engine),
        validations or {},
        config.seed,
    )


def _statement_of(name: str, parameter: ParameterConfig) -> Stated:
    """Return what a config says of a parameter."""
    prior = None
    if parameter.prior is not None:
        arguments = {key: v for key, v in parameter.prior.items() if key != "distribution"}
        try:
            # The distribution itself refuses arguments that are not numbers.
            prior = Distribution(str(parameter.prior["distribution"]), arguments)  # type: ignore[arg-type]
        except InputError as error:
            raise InputError(f"parameters.{name}.prior: {error}") from None
    others = parameter.model_dump(exclude={"prior"})
    return Stated(prior, **others)


def stand_of(config: Config, training: Sequence[Record]) -> VirtualTestStand:
    """Return the virtual stand that a config asks for.

    Gain and creep count from the range of the ``training`` records' voltages, as in a fit to them,
    so that a fit can recover their true values. Refused (InputError) are a part that does not
    exist, an option that it does not have, and a true value of no parameter of the actuator.
    """
    stand = config.stand
    try:
        first, extent = training[0], extent_of(training)
        actuator = stand.model.spec.actuator(first.interval, first.hold, extent)
    except InputError as error:
        raise InputError(f"stand.{error}") from None
    return VirtualTestStand(
        stand.discrepancy, stand.sample_rate, actuator=actuator, true=stand.parameters
    )


def recoverable(stand: VirtualTestStand, fitted: Actuator) -> dict[str, float]:
    """Return the true values, except those that mean something else in a fitted actuator.

    Parts that differ may have parameters of the same name.
    """
    other = set[str]()
    parts = stand.actuator.hysteresis, fitted.hysteresis
    # Whether Bouc-Wen hysteresis is passive says where its parameters may lie, not what they mean.
    if parts[0] != parts[1] and not all(isinstance(operator, BoucWen) for operator in parts):
        other |= {declared.name for declared in fitted.hysteresis.parameters}
    if fitted.creep and stand.actuator.creep and fitted.creep.times != stand.actuator.creep.times:
        other |= {declared.name for declared in fitted.creep.parameters}
    return {name: value for name, value in stand.parameters().items() if name not in other}


def plan_of(config: Config, posterior: Posterior) -> SamplingPlan:
    """Return how a posterior is sampled.

    Raises InputError: too few walkers.
    """
    settings, prior = config.sampling, posterior.prior
    fewest = 2 * prior.dimensions
    # Halves of an ensemble fill the compiled engine's lanes; with six more than the fewest
    # complementary halves span all directions.
    common = 64 if posterior.engine == "numba" else 32
    walkers = settings.walkers or max(fewest + 6, common)
    if walkers < fewest:
        raise InputError(
            f"sampling.walkers: {walkers} are too few for {prior.dimensions} free parameters; "
            f"use at least {fewest}"
        )
    samples = sum(dataset.readings.samples for dataset in posterior.datasets)
    readings = sum(len(data.readings.values) for data in posterior.datasets)
    return SamplingPlan(
        ess=settings.ess,
        ensembles=settings.ensembles,
        walkers=walkers,
        block=settings.block,
        max_steps=settings.steps,
        max_pilot_steps=settings.pilot_steps,
        ensembles_per_task=best_ensembles_per_task(settings.ensembles, walkers, samples),
        tries=best_tries(walkers, readings),
        ahead=best_ahead(walkers, samples),
    )


def sampled_waveform(drive: str | SignalConfig) -> Waveform:
    """Return the waveform of that name, or the one a config describes."""
    if isinstance(drive, str):
        return signal(drive)
    if drive.shape == "steps":
        carrier = staircase(drive.levels or (), drive.dwell or 0.0)
    else:
        shape = sine if drive.shape == "sine" else triangle
        carrier = shape(drive.amplitude or 0.0, drive.frequency or 0.0)
    return Waveform(carrier, drive.duration, drive.start, drive.decay, drive.decay_from)


def training_records(
    config: Config, folder: Path, in_memory: Mapping[str, Record]
) -> tuple[dict[str, Record], VirtualTestStand | None]:
    """Return the training records by name, and the stand that made some, if one did.

    ``in_memory`` are those that need not be read, by name; files are relative to ``folder``.
    """
    records: dict[str, Record] = {}
    signals: dict[str, str | SignalConfig] = {}
    for name, source in config.records.items():
        if source.signal is None:
            records[name] = _read_record(source, folder, in_memory.get(name), place_of(name))
        else:
            signals[name] = source.signal
            rate = config.stand.sample_rate
            command = sampled_waveform(source.signal).sample(rate)[1]
            planned = Record(command, None, interval=1 / rate, voltage_is="command")
            records[name] = planned if source.stop is None else planned.upto(source.stop)
    stand = None
    if signals:
        stand = stand_of(config, list(records.values()))
        for name, drive in signals.items():
            purpose = "record" if name == ALONE else f"record {name}"
            records[name] = _measure(stand, drive, generator(config.seed, purpose))
    for name, source in config.records.items():
        record, table = records[name], place_of(name)
        end = record.start + record.duration
        if source.outliers:
            rows = np.rint((np.array(source.outliers) - record.start) / record.interval)
            if rows.min() < 0 or rows.max() >= record.samples:
                raise InputError(
                    f"{table}.outliers: a time outside of {record.start:g} to {end:g} s"
                )
            record = record.without(rows.astype(np.int64))
        if source.exclude is not None:
            record = record.exclude([(start, stop) for start, stop in source.exclude])
        if source.start is not None or source.stop is not None:
            record = record.upto(end if source.stop is None else source.stop, source.start)
        if source.decimate > 1:
            record = record.decimate(source.decimate)
        as_read = record is records[name] and not (source.missing or source.signal)
        if name in in_memory or not as_read:
            _require_usable(record, table)
        records[name] = record
    return records, stand


def require_alike(records: Mapping[str, Record]) -> None:
    """Raise an InputError if records are of different quantities or instruments."""
    first = next(iter(records.values()))
    for name, record in records.items():
        if record.quantities != first.quantities:
            of = record.quantities
            raise InputError(
                f"{place_of(name)}: is of {of.input} and {of.output} along {of.clock}, the first "
                "record of others; give records of the same quantities"
            )
        if record.instruments != first.instruments:
            raise InputError(
                f"{place_of(name)}: states other uncertainties of its units than the first record; "
                "records are fitted together by the same instruments: state the same of all"
            )


def _require_usable(record: Record, where: str) -> None:
    """Refuse a record that was not read from a file, as one with its numbers would be."""
    with warnings.catch_warnings():  # of numbers that a file has for missing readings
        warnings.simplefilter("ignore", InputWarning)
        Record.from_arrays(
            record.voltage,
            record.displacement,
            interval=record.interval,
            start=record.start,
            covariates=record.covariates,
            origin=where,
        )


def join_records(config: Config, records: Mapping[str, Record]) -> tuple[Config, dict[str, Record]]:
    """Join records that continue another to it; return the config that says the same of the whole.

    A whole has the name of its first record, and its start. Windows of the others are those of the
    whole, later by what was before; readings that a config leaves out of a part stay out.

    Raises InputError: a record that continues none of the others, itself, one that another
    continues too, or one that it cannot follow: of another interval or hold, cut at its end, with
    time in between.
    """
    wholes = dict(records)
    before = {n: s.continues for n, s in config.records.items() if s.continues is not None}
    for name, first in before.items():
        _require_next(config, first, name, records)
    while before:
        name = next((name for name, first in before.items() if first not in before), "")
        if not name:
            first, *others = before
            names = ", ".join([first, *others, first])
            raise InputError(f"{place_of(first)}.continues: a circle ({names}); one is the first")
        first = before.pop(name)
        config = _append_record(config, first, name, wholes)
        before = {n: first if b == name else b for n, b in before.items()}
    return config, wholes


def _require_next(config: Config, before: str, name: str, records: Mapping[str, Record]) -> None:
    """Refuse a record that cannot go on where the one ``before`` ends."""
    others = [other for other in config.records if other != name]
    if before not in others:
        hint = suggestion(before, others) if others else "remove it"
        raise InputError(f"{place_of(name)}.continues: no other record {before!r}; {hint}")
    rival = next(n for n, source in config.records.items() if source.continues == before)
    first, other, source = records[before], records[name], config.records[name]
    end = first.start + first.duration
    # A clock of its own begins where that of the record before did, or earlier.
    own_clock = other.start <= first.start + first.interval / 2
    wrong = {
        f"{rival} continues {before} too; one record can": rival != name,
        f"it starts where {before} ends; remove its from_rest": source.from_rest,
        "the stand starts every signal at rest; give files": source.file is None,
        f"sampled every {other.interval:g} s, {before} every {first.interval:g} s; remove it, they "
        "are two records": not np.isclose(first.interval, other.interval, rtol=1e-6, atol=0),
        f"its voltage is the {other.voltage_is}, that of {before} the {first.voltage_is}; see "
        "voltage_is, or remove it": first.voltage_is != other.voltage_is,
        f"{before} is cut by its stop; remove one of them": config.records[before].stop is not None,
        f"begins at {other.start:g} s, {before} ends at {end:g} s; a record can only be continued "
        "at once": not own_clock and abs(other.start - end) > first.interval / 2,
    }
    for reason, is_wrong in wrong.items():
        if is_wrong:
            raise InputError(f"{place_of(name)}.continues: {reason}")


def _append_record(config: Config, before: str, name: str, records: dict[str, Record]) -> Config:
    """Put a record behind another, in ``records`` too; windows and outliers are on one clock."""
    first, other = records[before], records.pop(name)
    shift = first.start + first.duration - other.start
    parts = (config.records[before], first, 0.0), (config.records[name], other, shift)
    sources = [source for source, _, _ in parts]
    changes: dict[str, Any] = {"train": None, "outliers": None}
    if any(source.train is not None for source in sources):
        changes["train"] = [
            [edge + later for edge in window]
            for source, record, later in parts
            for window in source.train or [list(whole(record))]
        ]
    if all(source.outliers is not None for source in sources):
        changes["outliers"] = [t + later for s, _, later in parts for t in s.outliers or ()]
    changes["remarks"] = [text for source in sources for text in source.remarks or ()] or None
    tables = {n: source for n, source in config.records.items() if n != name}
    tables[before] = tables[before].model_copy(update=changes)
    validation = dict(config.validation)
    for key, held_out in validation.items():
        if held_out.of == name:
            window = held_out.window
            if window is not None and not held_out.another:
                window = [[edge + shift for edge in edges] for edges in window]
            validation[key] = held_out.model_copy(update={"of": before, "window": window})
    origin = f"{first.origin}, then {other.origin}"
    records[before] = replace(first.followed_by(other), origin=origin)
    return config.model_copy(update={"record": tables, "validation": validation})


def _measure(
    stand: VirtualTestStand, drive: str | SignalConfig, rng: np.random.Generator
) -> Record:
    record = stand.run(sampled_waveform(drive), rng)
    name = drive if isinstance(drive, str) else drive.shape
    return replace(record, origin=f"{record.origin}, {name} signal")


def _read_record(
    source: RecordConfig | ValidationConfig, folder: Path, in_memory: Record | None, table: str
) -> Record:
    """Return the record that is in memory, or else read the source's file."""
    naming = Naming.stated(
        columns=source.columns,
        units=source.units,
        fs=source.fs,
        table=source.table,
        displacement_file=source.displacement_file and folder / source.displacement_file,
        covariates=source.covariates,
        input=source.input,
        output=source.output,
        linearity=source.linearity,
    )
    if in_memory is not None:
        record = replace(in_memory, voltage_is=source.voltage_is or in_memory.voltage_is)
        record = replace(record, instruments=record.instruments.updated(naming.instruments))
        return record.without_values(source.missing or ())
    assert source.file is not None
    try:
        record = read_named(folder / source.file, naming, source.voltage_is)
    except ColumnsError as error:
        raise error.within(table) from None
    return record.without_values(source.missing or ())


def validations_of(
    config: Config,
    folder: Path,
    training: Mapping[str, Record],
    held_out: Mapping[str, Slices],
    in_memory: Mapping[str, Record],
) -> dict[str, Validation]:
    """Return what is held out, by name: windows, and records from memory, files or the stand.

    Raises InputError: a record that cannot be used; a lead-in or window that does not fit into it,
    which is said now: it would be a pity after the sampling.
    """
    validations = {}
    for name, source in config.validation.items():
        of, table = source.of or next(iter(training)), f"validation.{name}"
        if not source.another:
            validations[name] = Validation(held_out[name], of=of)
            continue
        if source.signal is None:
            covariates = source.covariates or config.records[of].covariates
            stated = {"covariates": covariates}
            for key in ("input", "output"):
                stated[key] = getattr(source, key) or getattr(config.records[of], key)
            told_source = source.model_copy(update=stated)
            record = _read_record(told_source, folder, in_memory.get(name), table).like(
                training[of]
            )
            if source.missing is None:
                record = record.without_values(config.records[of].missing or ())
        else:
            stand = stand_of(config, list(training.values()))
            record = _measure(stand, source.signal, generator(config.seed, f"record {name}"))
        if source.file is None or name in in_memory:
            _require_usable(record, table)
        lead_in = source.lead_in, source.lead_in_start
        hold = config.model.stated_hold  # its own, unless given
        start = InitialConditions(source.from_rest, source.estimate_offset, *lead_in, hold)
        judged, key = None, "lead_in: "
        try:
            start.window(record)
            key = ""
            for edges in source.window or ():
                judged = edges[0], edges[1]
                record.window_slice(*judged)
        except InputError as error:
            raise InputError(f"{table}.{key}{error}") from None
        validations[name] = Validation((), record, start, judged, of)
    return validations


def whole(record: Record) -> Window:
    """Return the window in s of all readings of a record."""
    first, last = np.flatnonzero(record.has_reading)[[0, -1]]
    return float(record.time[first]), float(record.time[last]) + record.interval


def windows_of(
    config: Config, records: Mapping[str, Record]
) -> tuple[dict[str, Slices], dict[str, Slices]]:
    """Return the windows of training records, as slices: to fit by record, held out by validation.

    Raises InputError: a window outside of its record, windows that overlap, or one without a
    reading; a measurement under two names that is fitted twice, in windows that overlap.
    """
    training: dict[str, Slices] = {}
    held_out: dict[str, Slices] = {}
    for name, record in records.items():
        training[name], windows = _windows_of(config, name, record)
        held_out |= windows
    for name, other in combinations(records, 2):
        overlap = any(
            a.start < b.stop and b.start < a.stop for a in training[name] for b in training[other]
        )
        if overlap and records[name].sha256 == records[other].sha256:
            raise InputError(
                f"{place_of(other)}: the same measurement as {place_of(name)}, whose readings "
                "would count twice; remove one, or give them other windows"
            )
    return training, held_out


def _windows_of(config: Config, name: str, record: Record) -> tuple[Slices, dict[str, Slices]]:
    """Return the windows of one training record, which overlap none that is fitted."""
    train, table = config.records[name].train, place_of(name)
    stated = {"": [list(whole(record))] if train is None else train}
    for key, validation in config.validation.items():
        if validation.window and not validation.another and validation.of in (name, None):
            stated[key] = validation.window
    slices: dict[str, Slices] = {}
    for key, pairs in stated.items():
        where = f"validation.{key}.window" if key else f"{table}.train"
        cuts: list[slice] = []
        for start, stop in sorted((a, b) for a, b in pairs):
            try:
                cut = record.window_slice(start, stop)
            except InputError as error:
                raise InputError(f"{where}: {error}") from None
            for other in slices.get("", cuts):
                if cut.start < other.stop and other.start < cut.stop:
                    edges = record.start + record.interval * np.array([other.start, other.stop])
                    window = " to ".join(map(record.clock, edges.tolist()))
                    raise InputError(
                        f"{where}: {start:g} to {stop:g} s overlaps the training window {window} s "
                        f"({table}.train); move one of them"
                    )
            if not record.has_reading[cut].any():
                first, last = (record.clock(time) for time in record.time[cut][[0, -1]])
                raise InputError(
                    f"{where}: no readings from {first} to {last} s; choose another window, or see "
                    f"start, exclude and decimate in [{table}]"
                )
            cuts.append(cut)
        slices[key] = tuple(cuts)
    return slices.pop(""), slices


# Options by which another file of the same columns is read, too.
KEPT = ("units", "fs", "voltage_is", "input", "output", "linearity")


def record_naming(source: RecordConfig, record: Record) -> dict[str, Any] | None:
    """Return what to note of how a record was read from its file, if anything."""
    stated = {
        key: getattr(source, key)
        for key in (*KEPT, "columns", "covariates")
        if getattr(source, key) is not None
    }
    if not stated or source.file is None:
        return None
    by_key, names = Quantities.of(source.input, source.output).by_key, record.read_as["columns"]
    quantities = {key: by_key.get(key.casefold(), key) for key in source.columns or {}}
    columns = {
        key: names[quantity]
        for key, quantity in quantities.items()
        if quantity != "displacement" or source.displacement_file is None
    }
    return {**stated, "columns": columns, "all_columns": record.read_as["all_columns"]}


def open_like(
    path: str | Path, noted: Mapping[str, Any] | None, reading: Mapping[str, Any] | None = None
) -> tuple[Source, Naming, VoltageIs | None]:
    """Return a file's content, its naming and the kind of its voltage, by what was noted.

    A file that has other columns than the record had is named by itself. It may lack some, as a
    planned voltage lacks the displacement. The user's own ``reading``, keyword arguments of
    ``read_record``, comes first: with columns, units or a rate no note counts.

    Raises InputError: the file cannot be read, or the user's reading is wrong.
    """
    options = {key: value for key, value in (reading or {}).items() if value not in (None, {})}
    source, noted = read_source(Path(path), options.get("table")), noted or {}
    # The same quantities in whatever columns.
    options = {key: noted[key] for key in ("input", "output") if key in noted} | options
    names = {series.name for series in source.series}
    is_like = bool(noted) and names <= {*noted.get("all_columns", ())}
    if is_like and not options.keys() & {"columns", "units", "fs"}:
        columns = {q: name for q, name in noted.get("columns", {}).items() if name in names}
        further = Naming(covariates=noted.get("covariates", ())).covariate_columns
        covariates = {name: column for name, column in further.items() if column in names}
        kept = {key: noted[key] for key in noted if key in KEPT}
        options = {"covariates": covariates} | kept | options | {"columns": columns}
    voltage_is = options.pop("voltage_is", None)
    return source, Naming.stated(**options), voltage_is
