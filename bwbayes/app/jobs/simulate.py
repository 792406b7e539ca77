"""``bwbayes simulate``: a record of the virtual test stand, with its truth beside it."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Literal, cast

from bwbayes.app.problem.problem import generator
from bwbayes.data import write_record
from bwbayes.data.teststand import VirtualTestStand
from bwbayes.data.waveforms import Sine, Waveform
from bwbayes.data.waveforms import signal as named
from bwbayes.errors import InputError

__all__ = ["simulate"]


def simulate(
    out: Path,
    signal: str,
    sine: tuple[float, float, float],
    discrepancy: str,
    seed: int,
    rate: float,
    *,
    overwrite: bool = False,
) -> list[Path]:
    """Write a record, and beside it its true parameters; return what was written.

    Parameters
    ----------
    out
        The record's file. The noise-free displacement goes into ``NAME.truth.csv`` for a CSV and
        into the file itself for HDF5 and MATLAB; the true parameters into ``NAME.truth.json``.
    signal
        A signal's name, or ``"sine"``: constant amplitude (V), frequency (Hz), duration (s).
    discrepancy, seed, rate
        Of the stand; the rate in samples a second.

    Raises
    ------
    InputError
        An unknown signal, impossible values, or a file that exists already or cannot be written.
    """
    parameters = out.with_name(f"{out.stem}.truth.json")
    truth_file = out.with_name(f"{out.stem}.truth{out.suffix}")
    for path in (out, truth_file, parameters):
        if path.exists() and not overwrite:
            raise InputError(f"{path}: exists; choose another name, or give `overwrite=True`")
    amplitude, frequency, duration = sine
    waveform = Waveform(Sine(amplitude, frequency), duration) if signal == "sine" else named(signal)
    kind = cast("Literal['none', 'process', 'structural']", discrepancy)
    stand = VirtualTestStand(kind, rate)
    record = stand.run(waveform, generator(seed, "record"))
    record = replace(record, origin=f"{record.origin}, {signal} signal, seed {seed}")
    write_record(record, out)
    try:
        parameters.write_text(json.dumps(stand.parameters(), indent=2) + "\n", encoding="utf-8")
    except OSError as error:
        raise InputError(f"{parameters}: {error.strerror}; choose another place") from None
    return [out, *([truth_file] if truth_file.exists() else []), parameters]
