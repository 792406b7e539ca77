"""Records that continue another: one drive in several files, joined into one record.

Where a measurement goes on in the next file, the actuator's state, the offset and the discrepancy
go on with it. Taken for a record of its own the second half would have an unknown start, and what
the discrepancy remembers over the cut would be lost. So records that say what they continue are put
together before anything else is done with them, and the fit is that of the whole.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from bwbayes.app.config.config import Config
from bwbayes.app.problem.parameters import place_of
from bwbayes.app.problem.records import whole
from bwbayes.errors import InputError, suggestion
from bwbayes.record import Record


def joined(config: Config, records: Mapping[str, Record]) -> tuple[Config, dict[str, Record]]:
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
        config = _appended(config, first, name, wholes)
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


def _appended(config: Config, before: str, name: str, records: dict[str, Record]) -> Config:
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
    series: dict[str, Any] = {}
    for kind in ("voltage", "displacement", "truth"):
        values = getattr(first, kind), getattr(other, kind)
        series[kind] = None if any(v is None for v in values) else np.concatenate(values)
    origin = f"{first.origin}, then {other.origin}"
    records[before] = replace(first, **series, origin=origin)
    return config.model_copy(update={"record": tables, "validation": validation})
