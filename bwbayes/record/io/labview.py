"""LabVIEW's files: measurements as text (``.lvm``), and National Instruments' binary ``.tdms``.

An ``.lvm`` file has a header of its own, and one for each segment of rows, with the channels' units
and clocks: :func:`plain_lvm` makes it the table that any other text file is. ``.tdms`` files are
read by npTDMS; channels are named by their group, ``group/channel``, and waveforms state clocks.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from bwbayes.errors import InputError
from bwbayes.record.io.series import Clock, Series, Source, in_seconds


def plain_lvm(path: Path, text: str) -> tuple[str, dict[int, Clock]]:
    """Return a measurement's rows below one header with units, and the clocks of its columns.

    Segments follow each other; the line numbers of the first one stay as they are, and its header
    counts.

    Raises InputError: there are no rows in it.
    """
    head, *parts = text.split("***End_of_Header***")
    separator = "," if "Comma" in _keys(head, ",").get("Separator", []) else "\t"
    settings = _keys(head, separator)
    x_columns, time_pref = ("".join(settings.get(key, [])) for key in ("X_Columns", "Time_Pref"))
    if len(parts) < 2:
        raise InputError(f"{path}: no segment of samples in it; export it again")
    keys, lines = _keys(parts[0], separator), [""] * f"{head}{parts[0]}".count("\n")
    stride = 2 if x_columns == "Multi" else 1
    # With several columns of times, the header's cells above them are empty or left out.
    stated = next((keys[key] for key in ("Samples", "Delta_X", "Y_Unit_Label") if key in keys), [])
    cells = [i for i, cell in enumerate(stated) if cell]
    channels = {
        1 + stride * number: {key: values[i] for key, values in keys.items() if i < len(values)}
        for number, i in enumerate(cells)
    }
    for number, segment in enumerate(parts[1:]):
        rows = segment.partition("\nChannels")[0].split("\n")[1:]
        names, *samples = [row for row in rows if row.strip(f" {separator}")]
        if number == 0:
            units = {i: channel.get("Y_Unit_Label") for i, channel in channels.items()}
            if channels.get(1, {}).get("X_Dimension", "Time") == "Time":
                units[0] = "s"
            columns = names.split(separator)
            named = [f"{n} [{units[i]}]" if units.get(i) else n for i, n in enumerate(columns)]
            # The first of several columns of times counts; the others get another name.
            for i in range(2, len(named) - 1, 2) if x_columns == "Multi" else ():
                named[i] += f" {i + 1}"
            lines += ["", separator.join(named)]
        lines += samples
    clocks = {i: clock for i, channel in channels.items() if (clock := _clock(channel, time_pref))}
    if x_columns == "No":  # the file has an empty column of times
        lines = [line.partition(separator)[2] for line in lines]
        clocks = {i - 1: clock for i, clock in clocks.items()}
    return "\n".join(lines) + "\n" * text.endswith("\n"), clocks


def _clock(channel: Mapping[str, str], time_pref: str) -> Clock | None:
    """Return the clock that a segment's header states for a channel, if it does."""
    try:
        interval, start = (float(channel[key].replace(",", ".")) for key in ("Delta_X", "X0"))
    except (KeyError, ValueError):
        return None
    if not 0 < interval < math.inf or channel.get("X_Dimension", "Time") != "Time":
        return None
    if time_pref == "Absolute":  # X0 is then a time of day or date
        return Clock(interval, start)
    zero = None
    with suppress(KeyError, ValueError):
        date, time = channel["Date"].replace("/", "-"), channel["Time"].replace(",", ".")
        zero = np.datetime64(f"{date}T{time[:18]}", "ns")  # to the nanosecond
    return Clock(interval, start, zero)


def _keys(header: str, separator: str) -> dict[str, list[str]]:
    """Return the cells of a header's rows behind their keys."""
    rows = [line.split(separator) for line in header.split("\n")]
    return {row[0].strip(): [cell.strip() for cell in row[1:]] for row in rows}


def read_tdms(path: Path) -> Source:
    """Return the channels of a TDMS file; npTDMS may raise any exception for a damaged one.

    Raises InputError: npTDMS is not installed.
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
    series = [
        Series(
            *(f"{channel.group_name}/{channel.name}", len(channel), partial(load, channel)),
            unit=str(channel.properties.get("unit_string", "")),
            group=f"{channel.group_name}/",
            clock=_wave_clock(channel.properties),
        )
        for channel in channels
    ]
    return Source(path, tuple(series))


def _wave_clock(wave: Mapping[str, Any]) -> Clock | None:
    """Return the clock of a waveform by its properties, if the channel is one."""
    if not wave.get("wf_increment"):
        return None
    start = float(wave.get("wf_start_offset", 0.0))
    return Clock(float(wave["wf_increment"]), start, wave.get("wf_start_time"))
