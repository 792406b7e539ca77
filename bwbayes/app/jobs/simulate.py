"""``bwbayes simulate``: a record of the virtual test stand, with its truth beside it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Literal

from bwbayes.errors import InputError, refuse_unwritable
from bwbayes.inference.study import generator
from bwbayes.record import write_record
from bwbayes.record.teststand import VirtualTestStand
from bwbayes.record.waveforms import Sine, Waveform, signal as named
from bwbayes.report.result import refuse_existing, write_summary


def simulate(
    out: Path,
    *,
    signal: str = "identification",
    amplitude: float | None = None,
    frequency: float | None = None,
    duration: float | None = None,
    discrepancy: Literal["none", "process", "structural"] = "process",
    seed: int = 1,
    rate: float = 1000.0,
    overwrite: bool = False,
) -> list[Path]:
    """Write a record of the virtual test stand to OUT (.csv, .h5, .mat), its truth beside it.

    Parameters
    ----------
    out
        The record's file. The noise-free displacement goes into ``NAME.truth.csv`` for a CSV and
        into the file itself for HDF5 and MATLAB; the true parameters into ``NAME.truth.json``.
    signal
        identification, verification, step10, step50, step100, or sine (see the next options).
    amplitude
        Amplitude of the sine, V; default: 100.
    frequency
        Frequency of the sine, Hz; default: 1.
    duration
        Duration of the sine, s; default: 16.
    discrepancy
        How the stand's actuator departs from the model.
    seed
        Seed of the noise.
    rate
        Samples a second.
    overwrite
        Replace existing files.

    Raises
    ------
    InputError
        An unknown signal, impossible values, or a file that exists already or cannot be written.

    Examples
    --------
    bwbayes simulate ring.csv --signal verification --seed 7
    """
    parameters = out.with_name(f"{out.stem}.truth.json")
    truth_file = out.with_name(f"{out.stem}.truth{out.suffix}")
    refuse_existing([out, truth_file, parameters], overwrite=overwrite)
    sine = {"amplitude": amplitude, "frequency": frequency, "duration": duration}
    arguments = {name: value for name, value in sine.items() if value is not None}
    if signal == "sine":
        options = {"amplitude": 100.0, "frequency": 1.0, "duration": 16.0} | arguments
        waveform = Waveform(Sine(options["amplitude"], options["frequency"]), options["duration"])
    elif arguments:
        raise InputError(f"simulate: {', '.join(arguments)} need --signal sine")
    else:
        waveform = named(signal)
    stand = VirtualTestStand(discrepancy, rate)
    record = stand.run(waveform, generator(seed, "record"))
    record = replace(record, origin=f"{record.origin}, {signal} signal, seed {seed}")
    write_record(record, out)
    with refuse_unwritable(parameters):
        write_summary(parameters, stand.parameters())
    return [out, *([truth_file] if truth_file.exists() else []), parameters]
