"""A config for a record that has none: ``bwbayes init`` writes it, ``bwbayes run my.csv`` runs it.

:func:`propose` recognises the file's columns, looks at the record, and holds out its last quarter,
or another part that the rest of the drive covers. What is wrong with the record and has a line of
config as its remedy gets that line; what cannot be told from a record is asked in a comment.
"""

from __future__ import annotations

import json
import os
import re
import warnings
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from bwbayes.app.config.config import Config, parse
from bwbayes.data import Record, read_record
from bwbayes.data.inspection import Finding, inspect, isolated_outliers
from bwbayes.data.io.checks import Table
from bwbayes.data.io.columns import Naming, unit_in
from bwbayes.data.io.formats import read_table
from bwbayes.errors import InputWarning
from bwbayes.model.registry import DYNAMICS

__all__ = ["Proposal", "propose"]

# Of the record's readings: what is held out, first choice first, and the fewest of either part.
QUARTERS = ((0.75, 1.0), (0.5, 0.75))
FEWEST_FITTED, FEWEST_HELD_OUT = 100, 25

# Part of the voltages' range that a held-out drive may lie beyond the fitted one.
SLACK = 0.02

# Parts of its range by which a voltage starts away from zero, and moves at its first steps.
AWAY, MOVES = 0.01, 0.01

# What makes a fit pointless; a run without a config does not begin one.
POINTLESS = ("wrong units", "no relation", "reversed sign", "swapped columns")


@dataclass(frozen=True)
class Proposal:
    """A config for a record, and what was seen of the record.

    ``text`` is the config in TOML with comments, ``config`` what it says. ``findings`` are what is
    wrong with the record, ``remarks`` what was said when it was read.
    """

    text: str
    config: Config
    record: Record
    findings: tuple[Finding, ...]
    remarks: tuple[str, ...]

    @property
    def pointless(self) -> Finding | None:
        """What makes a fit pointless, if anything."""
        return next((one for one in self.findings if one.kind in POINTLESS), None)


def propose(
    path: Path,
    where: Path,
    units: Mapping[str, str] | None = None,
    columns: Mapping[str, str] | None = None,
) -> Proposal:
    """Propose a config for a record.

    Parameters
    ----------
    path
        The record's file.
    where
        The folder in which the config is going to be.
    units
        Units by quantity, where the names of the columns do not say them.
    columns
        Names of columns by quantity, where they are not to be recognised.

    Raises
    ------
    InputError
        A column that is not recognised or has no unit, or a record that cannot be used.
    """
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", InputWarning)
        record = read_record(path, columns=columns, units=units)
    remarks = tuple(str(w.message) for w in caught if issubclass(w.category, InputWarning))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", InputWarning)
        table = read_table(path, Naming(columns or {}, units or {}))
    findings = tuple(_with_sign(one, path, table) for one in inspect(record))
    text = _text(path, where, table.naming, record, findings)
    return Proposal(text, parse(text, str(path)), record, findings, remarks)


def _with_sign(finding: Finding, path: Path, table: Table) -> Finding:
    """Return a finding; of a reversed sign with the command that turns it without a new file."""
    if finding.kind != "reversed sign":
        return finding
    name = table.columns["displacement"].name
    unit = table.naming.units.get("displacement") or unit_in(name, "displacement") or "um"
    turned = unit[1:] if unit.startswith("-") else f"-{unit}"
    here = (
        f'units = {{ displacement = "{turned}" }} under [record], or '
        f"`bwbayes init {path} --unit displacement={turned}`"
    )
    return replace(finding, remedy=f"{finding.remedy}, or say {here}")


def _text(
    path: Path, where: Path, naming: Naming, record: Record, findings: tuple[Finding, ...]
) -> str:
    """Write the config."""
    lines: dict[str, list[str]] = {"record": [], "model": []}
    notes = []
    for one in findings:
        notes.append(f"# {one.kind}: {one.text}")
        remedy = re.fullmatch(r"(\w+ = .+) under \[(record|model)\]", one.remedy)
        if remedy:
            lines[remedy[2]].append(f"{remedy[1]}  # {one.kind}")
        else:
            notes.append(f"#   what to do: {one.remedy}")
    held = _held_out(record)
    first, last = _span(record)
    train = [(first, last)] if held is None else _rest((first, last), held)
    aside = [] if held is None else _spikes(record, held)
    if aside and not any(line.startswith("exclude") for line in lines["record"]):
        lines["record"].append(
            f"exclude = {_windows(aside)}  # spikes in the part that is held out"
        )
    file = Path(os.path.relpath(path.absolute(), where.absolute())).as_posix()
    written = [
        *_facts(record),
        *(notes or ["# Nothing wrong shows in it."]),
        "",
        "[record]",
        f"file = {_quoted(file)}",
        *_tables(naming),
        f"train = {_windows(train)}  # s: the part that is fitted",
        *lines["record"],
        *_start(record),
    ]
    if naming.units.get("voltage") is None and record.voltage_is == "output":
        written.append(
            '# voltage_is = "command"  # if a DAC holds the voltage between samples; it is taken '
            "for measured"
        )
    written += [
        "",
        "[model]",
        f'dynamics = "lag"  # or {", ".join(_quoted(n) for n in DYNAMICS if n != "lag")}',
        *lines["model"],
        "",
        "# Priors come from the record's ranges; `bwbayes check` shows them. To say more:",
        "# [parameters]",
        '# d = { prior = { distribution = "normal", mean = 0.7, sd = 0.07 } }',
        "",
        "# [sampling]",
        "# ess = 2000  # effective draws of every parameter",
        "",
    ]
    if held is None:
        written += [
            "# Too little of the record can be left out of the fit to hold bands against it:",
            "# [validation.another]",
            '# file = "another.csv"',
        ]
    else:
        written += [
            "[validation.held_out]",
            f"window = {_windows([held])[1:-1]}  # s: not fitted; the bands are held against it",
        ]
    return "\n".join(written) + "\n"


def _facts(record: Record) -> list[str]:
    low, high = record.range_voltage
    assert record.displacement is not None
    missing = record.samples - record.readings
    return [
        f"# {record.origin}: {record.samples} samples every {record.interval:g} s from "
        f"{record.start:g} s on" + (f", {missing} readings missing" if missing else ""),
        f"# voltage {low:.4g} to {high:.4g} V, displacement {np.nanmin(record.displacement):.4g} "
        f"to {np.nanmax(record.displacement):.4g} um",
    ]


def _start(record: Record) -> list[str]:
    """Say how the drive starts, and what no record tells of it."""
    extent = float(np.ptp(record.voltage))
    away = abs(float(record.voltage[0])) > AWAY * extent
    few = record.voltage[: max(record.samples // 100, 2)]
    moving = float(np.ptp(few)) > MOVES * extent
    how = f"at {record.voltage[0]:.3g} V, {'moving' if moving else 'at rest'}"
    if away:
        return [f"# from_rest = false  # it starts {how}: its history is unknown, and estimated"]
    return [
        f"# from_rest = true  # it starts {how}; say so if the actuator was demagnetised and "
        "nothing moved"
    ]


def _tables(naming: Naming) -> list[str]:
    """Write which columns are meant, and their units."""
    both = {"columns": naming.columns, "units": naming.units}
    return [
        f"{key} = {{ {', '.join(f'{q} = {_quoted(name)}' for q, name in table.items())} }}"
        for key, table in both.items()
        if table
    ]


def _span(record: Record) -> tuple[float, float]:
    """Return the times (s) of the first reading and of the end of the last."""
    first, last = np.flatnonzero(record.has_reading)[[0, -1]]
    time = record.time
    return float(time[first]), float(time[last]) + record.interval


def _held_out(record: Record) -> tuple[float, float] | None:
    """Return a window (s) whose drive the rest of the record covers; None if there is none."""
    begin, end = _span(record)
    for part in QUARTERS:
        edges = [_on_grid(record, begin + p * (end - begin)) for p in part]
        held = record.window_slice(edges[0], edges[1])
        kept = np.ones(record.samples, dtype=np.bool_)
        kept[held] = False
        readings = record.has_reading
        if (readings & kept).sum() < FEWEST_FITTED or readings[held].sum() < FEWEST_HELD_OUT:
            continue
        fitted, other = record.voltage[kept], record.voltage[held]
        slack = SLACK * float(np.ptp(fitted))
        inside = other.min() >= fitted.min() - slack and other.max() <= fitted.max() + slack
        assert record.displacement is not None
        moves = np.ptp(other) > 0 and np.nanmax(record.displacement[held]) > np.nanmin(
            record.displacement[held]
        )
        if inside and moves:
            return edges[0], edges[1]
    return None


def _spikes(record: Record, held: tuple[float, float]) -> list[tuple[float, float]]:
    """Return a window (s) around each spike that is held out, where no fit sets it aside."""
    times = record.time[isolated_outliers(record)]
    inside = times[(held[0] <= times) & (times < held[1])].tolist()
    return [(time, time + record.interval) for time in inside]


def _on_grid(record: Record, time: float) -> float:
    """Return the time (s) of the nearest sample, without the noise of rounding."""
    sample = round((time - record.start) / record.interval)
    return float(f"{record.start + sample * record.interval:.9g}")


def _rest(whole: tuple[float, float], held: tuple[float, float]) -> list[tuple[float, float]]:
    parts = [(whole[0], held[0]), (held[1], whole[1])]
    return [part for part in parts if part[1] > part[0]]


def _windows(windows: list[tuple[float, float]]) -> str:
    texts = (f"[{float(f'{a:.9g}')}, {float(f'{b:.9g}')}]" for a, b in windows)
    return f"[{', '.join(texts)}]"


def _quoted(text: str) -> str:
    # A JSON string is a TOML string too, except for DEL, which no column's name has.
    return json.dumps(text, ensure_ascii=False)
