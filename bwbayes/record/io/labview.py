"""LabVIEW's files: measurements as text (``.lvm``), and National Instruments' binary ``.tdms``.

An ``.lvm`` file has a header of its own, and one for each segment of rows, with the channels' units
and, where no column has the times, their step: :func:`plain_lvm` makes it the table that any other
text file is. ``.tdms`` files are read by npTDMS; channels are named by their group,
``group/channel``, and waveforms state their sampling interval.
"""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any

from bwbayes.errors import InputError
from bwbayes.record.io.series import Series, Source, in_seconds


def plain_lvm(path: Path, text: str) -> tuple[str, float | None]:
    """Return a measurement's rows below one header with units, and its step, s.

    The step is that of a file without a column of times. Segments follow each other; the line
    numbers of the first one stay as they are.

    Raises
    ------
    InputError
        There are no rows in it.
    """
    head, *parts = text.split("***End_of_Header***")
    separator = "," if _keys(head, ",").get("Separator") == ["Comma"] else "\t"
    x_columns = _keys(head, separator).get("X_Columns", ["One"])[0]
    if len(parts) < 2:
        raise InputError(f"{path}: no segment of samples in it; export it again")
    keys, lines = _keys(parts[0], separator), [""] * f"{head}{parts[0]}".count("\n")
    for number, segment in enumerate(parts[1:]):
        rows = segment.partition("\nChannels")[0].split("\n")[1:]
        names, *samples = [row for row in rows if row.strip(f" {separator}")]
        if number == 0:
            stride = 2 if x_columns == "Multi" else 1
            units = {1 + stride * i: unit for i, unit in enumerate(keys.get("Y_Unit_Label", []))}
            if keys.get("X_Dimension", ["Time"])[0] == "Time":
                units[0] = "s"
            columns = names.split(separator)
            named = [f"{n} [{units[i]}]" if units.get(i) else n for i, n in enumerate(columns)]
            # Of several columns of times the first one counts.
            for i in range(2, len(named) - 1, 2) if x_columns == "Multi" else ():
                named[i] += f" {i + 1}"
            lines += ["", separator.join(named)]
        lines += samples
    step = None
    if x_columns == "No":  # the column of times is there, and empty
        lines = [line.partition(separator)[2] for line in lines]
        step = float(keys["Delta_X"][0].replace(",", ".")) if keys.get("Delta_X") else None
    return "\n".join(lines) + "\n" * text.endswith("\n"), step


def _keys(header: str, separator: str) -> dict[str, list[str]]:
    """Return the values of a header's keys, one a channel."""
    rows = [line.split(separator) for line in header.split("\n")]
    return {row[0].strip(): [cell.strip() for cell in row[1:] if cell.strip()] for row in rows}


def read_tdms(path: Path) -> Source:
    """Return the channels of a TDMS file, whatever error npTDMS raises if it is damaged.

    Raises
    ------
    InputError
        npTDMS is not installed.
    """
    try:
        from nptdms import TdmsFile  # noqa: PLC0415  # an extra
    except ImportError:
        raise InputError(
            f"{path}: reading TDMS needs npTDMS; pip install 'bwbayes[tdms]'"
        ) from None

    def load(channel: Any) -> Any:
        return in_seconds(channel[:])

    channels = [c for group in TdmsFile.read(path).groups() for c in group.channels()]
    waves = [channel.properties for channel in channels if len(channel)]
    steps = {wave.get("wf_increment") for wave in waves}
    starts = {float(wave.get("wf_start_offset", 0.0)) for wave in waves}
    series = [
        Series(
            f"{channel.group_name}/{channel.name}",
            len(channel),
            partial(load, channel),
            str(channel.properties.get("unit_string", "")),
            f"{channel.group_name}/",
        )
        for channel in channels
    ]
    step = steps.pop() if len(steps) == 1 else None
    start = starts.pop() if len(starts) == 1 else 0.0
    return Source(path, tuple(series), interval=float(step) if step else None, start=start)
