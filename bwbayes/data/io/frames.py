"""Records in pandas tables: a column each for time, voltage and displacement, or time as index."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from bwbayes.data.io.checks import Column, Table
from bwbayes.data.io.columns import Naming, say_guesses
from bwbayes.errors import InputError

__all__ = ["frame_table"]

_MOMENTS = "mM"  # NumPy's kinds of durations and dates


def frame_table(frame: Any, naming: Naming, origin: str) -> Table:
    """Return the columns of a pandas table that ``naming`` says, or that are recognised.

    The index counts as a column if it has a name, or dates or durations.

    Raises
    ------
    InputError
        A column that is not there, comes twice, has no unit or holds no numbers; ``origin`` names
        the table.

    Warns
    -----
    InputWarning
        If a column is recognised by nothing but its unit.
    """
    if frame.index.name is not None or frame.index.dtype.kind in _MOMENTS:
        frame = frame.reset_index()
    names = [str(name) for name in frame.columns]
    columns: dict[str, Column] = {}
    given = _with_moments(frame, naming)
    try:
        naming = given.completed(names)
    except ValueError as error:
        raise InputError(f"{origin}: {error}") from None
    say_guesses(origin, given, naming)
    for name, label in zip(names, frame.columns, strict=True):
        try:
            quantity, power, sign = naming.of(name)
        except ValueError as error:
            if name in naming.columns.values():
                raise InputError(f"{origin}: {name}: {error}") from None
            continue
        if quantity in columns:
            raise InputError(f"{origin}: {name}: second {quantity} column; remove one")
        values = frame[label].to_numpy()
        if quantity == "time" and values.dtype.kind in _MOMENTS:
            values, power = (values - values[0]) / np.timedelta64(1, "ns") / 1e9, 0
        try:
            columns[quantity] = Column(name, np.asarray(values, dtype=np.float64), power, sign)
        except (TypeError, ValueError) as error:
            raise InputError(f"{origin}: {name}: not numbers ({error}); convert them") from None
    return Table(Path(origin), columns, {"origin": origin}, names=tuple(names), naming=naming)


def _with_moments(frame: Any, naming: Naming) -> Naming:
    """Take the only column of dates or durations for the time; they have their unit in them."""
    moments = [str(n) for n, kind in frame.dtypes.items() if getattr(kind, "kind", "") in _MOMENTS]
    column = naming.columns.get("time", moments[0] if len(moments) == 1 else None)
    if column not in moments:
        return naming
    return Naming({**naming.columns, "time": str(column)}, {**naming.units, "time": "s"})
