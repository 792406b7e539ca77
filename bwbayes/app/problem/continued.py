"""Records that continue another: one drive in several files, joined into one record.

Where a measurement goes on in the next file, the actuator's state, the offset and the discrepancy
go on with it. Taken for a record of its own the second half would have an unknown start, and what
the discrepancy remembers over the cut would be lost. So records that say what they continue are put
together before anything else is done with them, and the fit is that of the whole.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from itertools import pairwise
from typing import Any

import numpy as np

from bwbayes.app.config.config import Config, RecordConfig, ValidationConfig
from bwbayes.app.problem.parameters import place_of
from bwbayes.app.problem.records import whole
from bwbayes.errors import InputError, suggestion
from bwbayes.record import Record

__all__ = ["joined"]


def joined(config: Config, records: Mapping[str, Record]) -> tuple[Config, dict[str, Record]]:
    """Join records that continue another to it; return the config that says the same of the whole.

    A whole has the name of its first record, and its start. Windows of the others are those of the
    whole, later by what was before; readings that a config leaves out of a part stay out.

    Parameters
    ----------
    config
        Its ``[record.NAME]`` say what they continue.
    records
        The training records by name, with what is left out of them.

    Raises
    ------
    InputError
        A record that continues none of the others, itself, one that another continues too, or one
        that it cannot follow: of another interval or hold, cut at its end, with time in between.
    """
    following = _following(config)
    if not following:
        return config, dict(records)
    wholes: dict[str, Record] = {}
    tables: dict[str, RecordConfig] = {}
    # The whole that each record belongs to, and how much later it is on the clock of that, s.
    roots: dict[str, str] = {}
    shifts: dict[str, float] = {}
    for root in records:
        if config.records[root].continues is not None:
            continue
        names = [root]
        while names[-1] in following:
            names.append(following[names[-1]])
        joint = records[root]
        shifts[root] = 0.0
        for before, name in pairwise(names):
            _require_next(config, before, name, records)
            shifts[name] = joint.start + joint.duration - records[name].start
            joint = _put_together(joint, records[name])
        roots |= dict.fromkeys(names, root)
        wholes[root] = joint
        tables[root] = _table(config, {name: shifts[name] for name in names}, records)
    circle = [name for name in records if name not in roots]
    if circle:
        names_of_it = ", ".join([*circle, circle[0]])
        place = place_of(circle[0])
        raise InputError(f"{place}.continues: a circle ({names_of_it}); one is the first")
    validation = {name: _moved(v, roots, shifts) for name, v in config.validation.items()}
    return config.model_copy(update={"record": tables, "validation": validation}), wholes


def _following(config: Config) -> dict[str, str]:
    """Return which record comes after which, by the name of the one before."""
    following: dict[str, str] = {}
    for name, source in config.records.items():
        before = source.continues
        if before is None:
            continue
        others = [other for other in config.records if other != name]
        hint = suggestion(before, others) if others else "remove it"
        wrong = {
            "the record itself; name the one measured before it": before == name,
            f"no other record {before!r}; {hint}": before not in others,
            f"{following.get(before)} continues {before} too; one record can": before in following,
            f"it starts where {before} ends; remove its from_rest": source.from_rest,
            "the stand starts every signal at rest; give files": source.file is None,
        }
        _refuse(name, wrong)
        following[before] = name
    return following


def _refuse(name: str, wrong: Mapping[str, bool]) -> None:
    """Refuse what a record continues, for the first reason that is true."""
    for reason, true in wrong.items():
        if true:
            raise InputError(f"{place_of(name)}.continues: {reason}")


def _require_next(config: Config, before: str, name: str, records: Mapping[str, Record]) -> None:
    """Refuse a record that cannot go on where another ends."""
    first, other = records[before], records[name]
    end = first.start + first.duration
    # A clock of its own begins where that of the record before did, or earlier.
    own_clock = other.start <= first.start + first.interval / 2
    wrong = {
        f"sampled every {other.interval:g} s, {before} every {first.interval:g} s; remove it, they "
        "are two records": not np.isclose(first.interval, other.interval, rtol=1e-6, atol=0),
        f"its voltage is the {other.voltage_is}, that of {before} the {first.voltage_is}; see "
        "voltage_is, or remove it": first.voltage_is != other.voltage_is,
        f"{before} is cut by its stop; remove one of them": config.records[before].stop is not None,
        f"begins at {other.start:g} s, {before} ends at {end:g} s; a record can only be continued "
        "at once": not own_clock and abs(other.start - end) > first.interval / 2,
    }
    _refuse(name, {reason: bool(true) for reason, true in wrong.items()})


def _put_together(first: Record, other: Record) -> Record:
    """Return the record of two, the second right after the first."""
    series: dict[str, Any] = {}
    for name in ("voltage", "displacement", "truth"):
        values = getattr(first, name), getattr(other, name)
        series[name] = None if any(v is None for v in values) else np.concatenate(values)
    return replace(first, **series, origin=f"{first.origin}, then {other.origin}")


def _table(
    config: Config, shifts: Mapping[str, float], records: Mapping[str, Record]
) -> RecordConfig:
    """Return what a config says of a whole: windows and outliers of all parts, on one clock."""
    sources = {name: config.records[name] for name in shifts}
    train = outliers = None
    if any(source.train is not None for source in sources.values()):
        train = [
            [edge + shifts[name] for edge in window]
            for name, source in sources.items()
            for window in source.train or [list(whole(records[name]))]
        ]
    if all(source.outliers is not None for source in sources.values()):
        outliers = [
            time + shifts[name]
            for name, source in sources.items()
            for time in source.outliers or ()
        ]
    remarks = [text for source in sources.values() for text in source.remarks or ()] or None
    changes = {"train": train, "outliers": outliers, "remarks": remarks, "continues": None}
    return next(iter(sources.values())).model_copy(update=changes)


def _moved(
    validation: ValidationConfig, roots: Mapping[str, str], shifts: Mapping[str, float]
) -> ValidationConfig:
    """Return a validation of the whole for one of a part."""
    of, window = validation.of, validation.window
    if of is None:
        return validation
    if window is not None and not validation.another:
        window = [[edge + shifts[of] for edge in edges] for edges in window]
    return validation.model_copy(update={"of": roots[of], "window": window})
