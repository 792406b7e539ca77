"""A config for a record that has none: ``bwbayes init`` writes it, ``bwbayes run my.csv`` runs it.

:func:`propose` recognizes the file's columns, looks at the record, and holds out a quarter of it
that is like the rest: of every amplitude and rate that the drive has, in several windows if need
be. Issues of the record that a line of config fixes get that line. A comment asks for all that a
record cannot tell.
"""

from __future__ import annotations

import json
import os
import re
import warnings
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path
from shlex import quote
from typing import Any

import numpy as np
import scipy

from bwbayes.app.config.config import ALONE, Config, parse
from bwbayes.diagnosis.finding import Finding
from bwbayes.diagnosis.record_checks import inspect, isolated_outliers
from bwbayes.errors import InputWarning, path_text
from bwbayes.model.inputs import rate
from bwbayes.model.registry import DYNAMICS
from bwbayes.quantities import DISPLACEMENT
from bwbayes.record import Record
from bwbayes.record.io.columns import Naming
from bwbayes.record.io.fields import record_fields
from bwbayes.record.io.formats import read_table
from bwbayes.record.io.grid import decimals_of


@dataclass(frozen=True)
class ConfigProposal:
    """A config for a record, and what was seen of the record.

    ``text`` is the config in TOML with comments, ``config`` what it says, and the remarks on the
    record. ``findings`` are what is wrong with the record, ``remarks`` what was said when it was
    read. The ``config`` can be used without reading the ``record`` again.
    """

    text: str
    config: Config
    record: Record
    findings: tuple[Finding, ...]
    remarks: tuple[str, ...]

    @property
    def blocking_issue(self) -> Finding | None:
        """The first finding that makes a fit pointless, if any."""
        kinds = ("no relation", "reversed sign", "swapped columns")
        return next((finding for finding in self.findings if finding.kind in kinds), None)


def draft_config(path: Path, where: Path, naming: Naming | None = None) -> ConfigProposal:
    """Propose a config, to be in the folder ``where``, for the record in a file.

    ``naming`` has columns and units, where they are not to be recognized.

    Raises InputError: a column that is not recognized or has no unit, or a record that cannot be
    used.
    """
    naming = naming or Naming()
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", InputWarning)
        table = read_table(path, naming)
        record = Record(**record_fields(table))
    remarks = tuple(str(w.message) for w in caught if issubclass(w.category, InputWarning))
    # A reversed sign is turned without a new file.
    quantities = record.quantities
    unit = table.columns["displacement"].unit
    if quantities.output != DISPLACEMENT:
        unit = table.naming.units.get("displacement", quantities.output.unit)
    turned = unit[1:] if unit.startswith("-") else f"-{unit}"
    key = "displacement" if quantities.output == DISPLACEMENT else "output"
    here = (
        f'units = {{ {key} = "{turned}" }} under [record], or '
        f"`bwbayes init {path} --unit {key}={quote(turned)}`"
    )
    findings = tuple(
        replace(finding, fix=f"{finding.fix}, or say {here}")
        if finding.kind == "reversed sign"
        else finding
        for finding in inspect(record)
    )
    text = _text(path, where, table.naming, record, findings)
    config = parse(text, str(path))
    source = config.records[ALONE].model_copy(update={"remarks": [*remarks] or None})
    proposed = config.model_copy(update={"record": source})
    return ConfigProposal(text, proposed, record, findings, remarks)


def _text(
    path: Path, where: Path, naming: Naming, record: Record, findings: tuple[Finding, ...]
) -> str:
    say = record.quantities.say
    notes: list[str] = []
    stated: dict[str, dict[str, tuple[str, str]]] = {"record": {}, "model": {}}
    for finding in findings:
        notes.append(say(f"# {finding.kind}: {finding.text}"))
        if not (fix := re.fullmatch(r"(\w+) = (.+) under \[(record|model)\]", finding.fix)):
            notes.append(say(f"#   fix: {finding.fix}"))
            continue
        key, value, table = fix.groups()
        before, kinds = stated[table].get(key, (value, finding.kind))
        if key == "exclude" and before != value:  # one list of all windows
            value, kinds = f"{before[:-1]}, {value[1:]}", f"{kinds}, {finding.kind}"
        stated[table][key] = value, kinds
    fixes = {
        table: "".join(f"{key} = {value}  # {kinds}\n" for key, (value, kinds) in keys.items())
        for table, keys in stated.items()
    }
    usable = record
    if "missing" in stated["record"]:
        usable = usable.without_values(json.loads(stated["record"]["missing"][0]))
    if "exclude" in stated["record"]:
        usable = usable.exclude(json.loads(stated["record"]["exclude"][0]))
    held = _held_out(usable)
    # No fit sets aside the spikes that are held out.
    spikes = [s for s in isolated_outliers(record).tolist() for w in held if w.start <= s < w.stop]
    if spikes and "\nexclude" not in f"\n{fixes['record']}":
        windows = _windows(record, [slice(s, s + 1) for s in spikes])
        fixes["record"] += f"exclude = {windows}  # spikes in the part that is held out\n"
    first, last = np.flatnonzero(usable.has_reading)[[0, -1]].tolist()
    edges = [first, *(edge for window in held for edge in (window.start, window.stop)), last + 1]
    train = [slice(a, b) for a, b in zip(edges[::2], edges[1::2], strict=True) if b > a]
    source = _source(path, where, naming, record)
    dynamics = '"none"  # the record has no time'
    if record.quantities.has_clock:
        others = ", ".join(_quote(name) for name in DYNAMICS if name != "lag")
        dynamics = f'"lag"  # or {others}'
    command = ""
    if naming.units.get("voltage") is None and record.voltage_is == "output":
        command = (
            '# voltage_is = "command"  # if a DAC holds the voltage between samples; it is taken '
            "for measured\n"
        )
    # No record tells whether the actuator was demagnetized.
    start = f"# from_rest = false  # {record.beginning}; "
    start += "the initial state is unknown and will be estimated"
    if record.starts_at_zero:
        start = f"# from_rest = true  # {record.beginning}; "
        start += "say so if the actuator was demagnetized and nothing moved"
    ending = f"[validation.held_out]\nwindow = {_windows(record, held)}"
    ending += f"  # {record.quantities.clock.unit}: held out, used to validate the bands"
    if not held:
        ending = """\
# Too little of the record, or of its motion, can be left out of the fit to hold bands against it:
# [validation.another]
# file = "another.csv\""""
    return f"""\
{_heading(record)}
{chr(10).join(notes or ["# No issues found."])}

[record]
{source}
train = {_windows(record, train)}  # {record.quantities.clock.unit}: fitted
{fixes["record"]}{record.quantities.say(start)}
{command}
[model]
dynamics = {dynamics}
{fixes["model"]}
# Priors come from the record's ranges; `bwbayes check` shows them. To say more:
# [parameters]
# d = {{ prior = {{ distribution = "normal", mean = 0.7, sd = 0.07 }} }}

# [sampling]
# ess = 2000  # effective draws of every parameter

{ending}
"""


def _quote(text: Any) -> str:
    # A JSON string is a TOML string too, except for DEL, which no column's name has.
    return json.dumps(text, ensure_ascii=False)


def _source(path: Path, where: Path, naming: Naming, record: Record) -> str:
    """Say where the record is, and how its file is read."""

    def relative(file: Path) -> str:
        location = Path(os.path.relpath(file.absolute(), where.absolute()))
        return _quote(path_text(location.as_posix()))

    source = f"file = {relative(path)}"
    if naming.displacement_file is not None:
        source += f"\ndisplacement_file = {relative(naming.displacement_file)}"
    for key, quantity in ("input", naming.input), ("output", naming.output):
        source += "" if quantity is None else f"\n{key} = {_quote(quantity)}"
    source += "" if naming.linearity is None else f"\nlinearity = {_quote(naming.linearity)}"
    roles = {"voltage": "input", "displacement": "output"}
    names = {} if record.quantities.are_default else roles
    tables = {"columns": naming.columns, "units": naming.stated_units}
    tables["covariates"] = naming.covariate_columns
    for key, table in tables.items():
        if table:
            pairs = ", ".join(
                f"{names.get(name, name)} = {_quote(column)}" for name, column in table.items()
            )
            source += f"\n{key} = {{ {pairs} }}"
    if naming.fs is not None and record.quantities.has_clock:
        source += f"\nfs = {naming.fs!r}"
    return source + ("" if naming.table is None else f"\ntable = {_quote(naming.table)}")


def _heading(record: Record) -> str:
    """Say what is in the record."""
    assert record.displacement is not None
    low, high = record.range_voltage
    missing = record.samples - record.readings
    clock = ", without a time"
    if record.quantities.has_clock:
        clock = f" every {record.interval:g} s from {record.start:g} s on"
    extent = (
        f"# voltage {low:.4g} to {high:.4g} V, displacement {np.nanmin(record.displacement):.4g} "
        f"to {np.nanmax(record.displacement):.4g} um"
    )
    heading = f"# {record.origin}: {record.samples} samples{clock}"
    heading += f", {missing} readings missing" if missing else ""
    return f"{heading}\n{record.quantities.say(extent)}"


def _held_out(record: Record) -> list[slice]:
    """Return the windows of a quarter of the record whose drive is as the rest's, if there are any.

    A quarter of the whole record, or of each of so many equal parts: the fewest windows that are
    alike to 0.15, or else those that come nearest to it.
    """
    first, last = np.flatnonzero(record.has_reading)[[0, -1]].tolist()
    candidates = []
    for parts, begin in product((1, 2, 3, 4, 5, 6, 8), (0.75, 0.625, 0.5)):
        edges = first + (last + 1 - first) / parts * np.add.outer(
            np.arange(parts), [begin, begin + 0.25]
        )
        windows = [slice(*edge) for edge in np.rint(edges).astype(np.int64).tolist()]
        difference = _difference(record, windows)
        if difference <= 0.15:
            return windows
        candidates.append((difference, windows))
    difference, windows = min(candidates, key=lambda candidate: candidate[0])
    return windows if difference < 1 else []


def _difference(record: Record, windows: list[slice]) -> float:
    """Return how far windows are from being like the rest of a record; 1 where they will not do.

    The largest difference of the distribution functions of voltages and rates, or half of the part
    of the voltages' range that is missing. A single step or ramp has to be fitted, so that the rest
    has to move by half of the range, and the windows have to move by a tenth, all stretches
    together.
    """
    held = np.zeros(record.samples, dtype=np.bool_)
    for window in windows:
        held[window] = True
    readings = record.has_reading
    fitted, other = record.voltage[readings & ~held], record.voltage[readings & held]
    if fitted.size < 100 or other.size < 25:
        return 1.0
    slack = 0.02 * float(np.ptp(fitted))
    inside = other.min() >= fitted.min() - slack and other.max() <= fitted.max() + slack
    assert record.displacement is not None
    if not inside or np.ptp(record.displacement[readings & held]) == 0:
        return 1.0
    voltage, is_tested = record.voltage[readings], held[readings]
    edges = np.flatnonzero(np.diff(is_tested)) + 1
    motions = np.array([np.ptp(stretch) for stretch in np.split(voltage, edges)])
    is_tested = is_tested[np.append(0, edges)]
    extent, tested = float(np.ptp(voltage)), float(np.sum(motions[is_tested]))
    if np.sum(motions[~is_tested]) < extent / 2 or tested < max(extent / 10, 1e-300):
        return 1.0
    thinned = slice(None, None, 1 + record.samples // 20_000)
    held = held[thinned]
    drive = record.voltage[thinned], np.abs(rate(record.voltage, record.interval))[thinned]
    differences = [scipy.stats.ks_2samp(x[held], x[~held])[0] for x in drive]
    return float(max(*differences, (1 - np.ptp(other) / np.ptp(fitted)) / 2))


def _windows(record: Record, windows: list[slice]) -> str:
    """Write windows of samples in s."""
    digits = decimals_of(record.interval) + 1
    edges = [[record.start + record.interval * s for s in (w.start, w.stop)] for w in windows]
    return str([[round(edge, digits) for edge in window] for window in edges])
