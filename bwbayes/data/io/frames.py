"""Records in pandas tables: a column each for time, voltage and displacement."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from bwbayes.data.io.checks import Column, Table
from bwbayes.data.io.columns import Naming
from bwbayes.errors import InputError

__all__ = ["frame_table"]


def frame_table(frame: Any, naming: Naming, origin: str) -> Table:
    """Return the columns of a pandas table that ``naming`` says.

    Raises
    ------
    InputError
        A column that is not there, comes twice, has no unit or holds no numbers; ``origin`` names
        the table.
    """
    names = [str(name) for name in frame.columns]
    columns: dict[str, Column] = {}
    problems = []
    try:
        naming.require_in(names)
    except ValueError as error:
        raise InputError(f"{origin}: {error}") from None
    for name, label in zip(names, frame.columns, strict=True):
        try:
            quantity, power, sign = naming.of(name)
        except ValueError as error:
            problems.append(f"{origin}: {name}: {error}")
            continue
        if quantity in columns:
            raise InputError(f"{origin}: {name}: second {quantity} column; remove one")
        values = frame[label].to_numpy()
        if quantity == "time" and values.dtype.kind in "mM":
            # Dates and durations have their unit in themselves.
            values, power = (values - values[0]) / np.timedelta64(1, "ns") / 1e9, 0
        try:
            columns[quantity] = Column(name, np.asarray(values, dtype=np.float64), power, sign)
        except (TypeError, ValueError) as error:
            raise InputError(f"{origin}: {name}: not numbers ({error}); convert them") from None
    # An unknown name is most likely the missing one, misspelt.
    if problems and {"time", "voltage"} - set(columns):
        raise InputError(problems[0])
    return Table(Path(origin), columns, {"origin": origin}, names=tuple(names))
