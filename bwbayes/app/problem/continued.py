"""Records that continue another: one drive in several files, joined into one record.

Where a measurement goes on in the next file, the actuator's state, the offset and the discrepancy
go on with it. Taken for a record of its own the second half would have an unknown start, and what
the discrepancy remembers over the cut would be lost. So records that say what they continue are put
together before anything else is done with them, and the fit is that of the whole.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from bwbayes.app.config.config import Config, RecordConfig, ValidationConfig
from bwbayes.app.problem.parameters import place_of
from bwbayes.app.problem.records import whole
from bwbayes.data import Record
from bwbayes.errors import InputError, suggestion

__all__ = ["joined"]

# Sampling intervals that differ by less are one.
ROUNDED = 1e-6


@dataclass(frozen=True)
class _Part:
    """A record's name, and how much later its samples are on the clock of the whole, s."""

    name: str
    shift: float


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
    after = _after(config)
    if not after:
        return config, dict(records)
    wholes: dict[str, Record] = {}
    tables: dict[str, RecordConfig] = {}
    parts: dict[str, tuple[str, float]] = {}
    for root in records:
        if config.records[root].continues is not None:
            continue
        chain, record = [_Part(root, 0.0)], records[root]
        while (name := after.get(chain[-1].name)) is not None:
            _require_next(config, chain[-1].name, name, records)
            end = record.start + record.duration
            chain.append(_Part(name, end - records[name].start))
            record = _put_together(record, records[name])
        wholes[root] = record
        tables[root] = _table(config, chain, records)
        parts |= {link.name: (root, link.shift) for link in chain}
    validation = {name: _moved(held_out, parts) for name, held_out in config.validation.items()}
    return config.model_copy(update={"record": tables, "validation": validation}), wholes


def _after(config: Config) -> dict[str, str]:
    """Return which record comes after which, by the name of the one before."""
    after: dict[str, str] = {}
    for name, source in config.records.items():
        if source.continues is None:
            continue
        key, others = f"{place_of(name)}.continues", [n for n in config.records if n != name]
        if source.continues == name:
            raise InputError(f"{key}: the record itself; name the one measured before it")
        if source.continues not in others:
            hint = suggestion(source.continues, others) if others else "remove it"
            raise InputError(f"{key}: no other record {source.continues!r}; {hint}")
        if source.continues in after:
            raise InputError(
                f"{key}: {after[source.continues]} continues {source.continues} too; one record can"
            )
        if source.from_rest:
            raise InputError(
                f"{key}: it starts where {source.continues} ends; remove its from_rest"
            )
        if source.file is None:
            raise InputError(f"{key}: the stand starts every signal at rest; give files")
        after[source.continues] = name
    for name in after.values():
        visited, at = [name], config.records[name].continues
        while at is not None and at not in visited:
            visited.append(at)
            at = config.records[at].continues
        if at is not None:
            circle = ", ".join([*visited[visited.index(at) :], at])
            raise InputError(f"{place_of(name)}.continues: a circle ({circle}); one is the first")
    return after


def _require_next(config: Config, before: str, name: str, records: Mapping[str, Record]) -> None:
    """Refuse a record that cannot go on where another ends."""
    key, first, other = f"{place_of(name)}.continues", records[before], records[name]
    if not np.isclose(first.interval, other.interval, rtol=ROUNDED, atol=0):
        raise InputError(
            f"{key}: sampled every {other.interval:g} s, {before} every {first.interval:g} s; "
            "remove it, they are two records"
        )
    if first.voltage_is != other.voltage_is:
        raise InputError(
            f"{key}: its voltage is the {other.voltage_is}, that of {before} the "
            f"{first.voltage_is}; see voltage_is, or remove it"
        )
    if config.records[before].stop is not None:
        raise InputError(f"{key}: {before} is cut by its stop; remove one of them")
    end = first.start + first.duration
    # A clock of its own begins where that of the record before did, or earlier.
    own_clock = other.start <= first.start + first.interval / 2
    if not own_clock and abs(other.start - end) > first.interval / 2:
        raise InputError(
            f"{key}: begins at {other.start:g} s, {before} ends at {end:g} s; a record can only "
            "be continued at once"
        )


def _put_together(first: Record, other: Record) -> Record:
    """Return the record of two, the second right after the first."""
    assert first.displacement is not None
    assert other.displacement is not None
    truth = None
    if first.truth is not None and other.truth is not None:
        truth = np.concatenate([first.truth, other.truth])
    return replace(
        first,
        voltage=np.concatenate([first.voltage, other.voltage]),
        displacement=np.concatenate([first.displacement, other.displacement]),
        truth=truth,
        origin=f"{first.origin}, then {other.origin}",
    )


def _table(config: Config, chain: Sequence[_Part], records: Mapping[str, Record]) -> RecordConfig:
    """Return what a config says of a whole: windows and outliers of all parts, on one clock."""
    sources = [config.records[link.name] for link in chain]
    train = outliers = None
    if any(source.train is not None for source in sources):
        train = [
            [edge + link.shift for edge in window]
            for link, source in zip(chain, sources, strict=True)
            for window in source.train or [list(whole(records[link.name]))]
        ]
    if all(source.outliers is not None for source in sources):
        outliers = [
            time + link.shift
            for link, source in zip(chain, sources, strict=True)
            for time in source.outliers or ()
        ]
    remarks = [text for source in sources for text in source.remarks or ()] or None
    changes = {"train": train, "outliers": outliers, "remarks": remarks, "continues": None}
    return sources[0].model_copy(update=changes)


def _moved(
    validation: ValidationConfig, parts: Mapping[str, tuple[str, float]]
) -> ValidationConfig:
    """Return a validation of the whole for one of a part."""
    if validation.of is None:
        return validation
    root, shift = parts[validation.of]
    window = validation.window
    if window is not None and not validation.another:
        window = [[edge + shift for edge in edges] for edges in window]
    return validation.model_copy(update={"of": root, "window": window})
