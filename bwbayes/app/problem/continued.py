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
        chain, made = [_Part(root, 0.0)], records[root]
        while (name := after.get(chain[-1].name)) is not None:
            _require_next(config, chain[-1].name, name, records)
            end = made.start + made.duration
            chain.append(_Part(name, end - records[name].start))
            made = _put_together(made, records[name])
        wholes[root] = made
        tables[root] = _table(config, chain, records)
        parts |= {part.name: (root, part.shift) for part in chain}
    validation = {name: _moved(one, parts) for name, one in config.validation.items()}
    return config.model_copy(update={"record": tables, "validation": validation}), wholes


def _after(config: Config) -> dict[str, str]:
    """Return which record comes after which, by the name of the one before."""
    after: dict[str, str] = {}
    for name, one in config.records.items():
        if one.continues is None:
            continue
        place, others = f"{place_of(name)}.continues", [n for n in config.records if n != name]
        if one.continues == name:
            raise InputError(f"{place}: the record itself; name the one measured before it")
        if one.continues not in others:
            hint = suggestion(one.continues, others) if others else "remove it"
            raise InputError(f"{place}: no other record {one.continues!r}; {hint}")
        if one.continues in after:
            raise InputError(
                f"{place}: {after[one.continues]} continues {one.continues}, too; one record can"
            )
        if one.from_rest:
            raise InputError(f"{place}: it starts where {one.continues} ends; remove its from_rest")
        if one.file is None:
            raise InputError(f"{place}: the stand starts every signal at rest; give files")
        after[one.continues] = name
    for name in after.values():
        seen, at = [name], config.records[name].continues
        while at is not None and at not in seen:
            seen.append(at)
            at = config.records[at].continues
        if at is not None:
            circle = ", ".join([*seen[seen.index(at) :], at])
            raise InputError(f"{place_of(name)}.continues: a circle ({circle}); one is the first")
    return after


def _require_next(config: Config, before: str, name: str, records: Mapping[str, Record]) -> None:
    """Refuse a record that cannot go on where another ends."""
    place, one, other = f"{place_of(name)}.continues", records[before], records[name]
    if not np.isclose(one.interval, other.interval, rtol=ROUNDED, atol=0):
        raise InputError(
            f"{place}: sampled every {other.interval:g} s, {before} every {one.interval:g} s; "
            "remove it, they are two records"
        )
    if one.voltage_is != other.voltage_is:
        raise InputError(
            f"{place}: its voltage is the {other.voltage_is}, that of {before} the "
            f"{one.voltage_is}; see voltage_is, or remove it"
        )
    if config.records[before].stop is not None:
        raise InputError(f"{place}: {before} is cut by its stop; remove one of them")
    end = one.start + one.duration
    # A clock of its own begins where that of the record before did, or earlier.
    own_clock = other.start <= one.start + one.interval / 2
    if not own_clock and abs(other.start - end) > one.interval / 2:
        raise InputError(
            f"{place}: begins at {other.start:g} s, {before} ends at {end:g} s; a record can only "
            "be continued at once"
        )


def _put_together(one: Record, other: Record) -> Record:
    """Return the record of two, the second right after the first."""
    assert one.displacement is not None
    assert other.displacement is not None
    truth = None
    if one.truth is not None and other.truth is not None:
        truth = np.concatenate([one.truth, other.truth])
    return replace(
        one,
        voltage=np.concatenate([one.voltage, other.voltage]),
        displacement=np.concatenate([one.displacement, other.displacement]),
        truth=truth,
        origin=f"{one.origin}, then {other.origin}",
    )


def _table(config: Config, chain: Sequence[_Part], records: Mapping[str, Record]) -> RecordConfig:
    """Return what a config says of a whole: windows and outliers of all parts, on one clock."""
    given = [config.records[part.name] for part in chain]
    train = outliers = None
    if any(one.train is not None for one in given):
        train = [
            [edge + part.shift for edge in window]
            for part, one in zip(chain, given, strict=True)
            for window in one.train or [list(whole(records[part.name]))]
        ]
    if all(one.outliers is not None for one in given):
        outliers = [
            time + part.shift
            for part, one in zip(chain, given, strict=True)
            for time in one.outliers or ()
        ]
    remarks = [text for one in given for text in one.remarks or ()] or None
    changes = {"train": train, "outliers": outliers, "remarks": remarks, "continues": None}
    return given[0].model_copy(update=changes)


def _moved(one: ValidationConfig, parts: Mapping[str, tuple[str, float]]) -> ValidationConfig:
    """Return a validation of the whole for one of a part."""
    if one.of is None:
        return one
    root, shift = parts[one.of]
    window = one.window
    if window is not None and not one.another:
        window = [[edge + shift for edge in part] for part in window]
    return one.model_copy(update={"of": root, "window": window})
