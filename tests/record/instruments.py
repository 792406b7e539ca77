"""Files as programs and instruments write them: one record, in every form that a bench has.

:data:`INSTRUMENTS` writes the same record in each of them; beside the file stands what a user has
to say of its columns, where they can mean several things. Nothing here uses bwbayes to write.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import h5py
import numpy as np
import pandas as pd
import scipy.io

SAMPLES, INTERVAL = 600, 0.005

Array = Any


class Written(NamedTuple):
    """A file, and what a user says of its columns."""

    path: Path
    columns: Mapping[str, str] = {}
    units: Mapping[str, str] = {}
    fs: float | None = None


def signals() -> tuple[Array, Array, Array]:
    """Return time, s, a decaying sine, V, and the displacement of a play with a gain, um."""
    time = INTERVAL * np.arange(SAMPLES)
    voltage = np.round(60 * np.exp(-0.5 * time) * np.sin(2 * np.pi * time / 0.5), 4)
    state, states = 0.0, []
    for value in voltage:
        state = min(max(state, value - 6), value + 6)
        states.append(state)
    noise = np.random.default_rng(1).normal(scale=0.02, size=SAMPLES)
    return time, voltage, np.round(0.3 * voltage + 0.2 * np.array(states) + noise, 5)


def _rows(columns: list[Array], separator: str, decimal: str = ".", end: str = "") -> list[str]:
    return [
        separator.join(f"{value:.6f}".replace(".", decimal) for value in row) + end
        for row in zip(*columns, strict=True)
    ]


def _text(path: Path, lines: list[str], encoding: str = "utf-8", newline: str = "\r\n") -> Written:
    path.write_bytes((newline.join(lines) + newline).encode(encoding))
    return Written(path)


def _excel(folder: Path, time: Array, voltage: Array, displacement: Array) -> Written:
    rows = _rows([time, voltage, displacement], ";", ",", ";in Ordnung")
    head = ["Prüfstand 3", "Bediener;Müller", "Datum;3. März 2026", ""]
    return _text(
        folder / "messung.csv",
        [*head, "Zeit [s];Spannung [V];Weg [µm];Bemerkung", *rows],
        "cp1252",
    )


def _unicode_text(folder: Path, time: Array, voltage: Array, displacement: Array) -> Written:
    rows = _rows([time, voltage, displacement], "\t", ",")
    return _text(folder / "a.txt", ["Time (s)\tDrive (V)\tStroke (µm)", *rows], "utf-16")


def _lvm_head(separator: str = "Tab", columns: str = "One") -> list[str]:
    mark = {"Tab": "\t", "Comma": ","}[separator]
    pairs = {
        "Writer_Version": "2",
        "Reader_Version": "2",
        "Separator": separator,
        "Decimal_Separator": ".",
        "Multi_Headings": "Yes",
        "X_Columns": columns,
        "Time_Pref": "Relative",
        "Operator": "bench",
        "Date": "2026/03/03",
        "Time": "16:00:05.123",
    }
    lines = [f"{key}{mark}{value}" for key, value in pairs.items()]
    return [f"LabVIEW Measurement{mark}", *lines, f"***End_of_Header***{mark}", mark]


def _lvm_segment(names: str, samples: int, delta: float = INTERVAL) -> list[str]:
    return [
        "Channels\t2\t\t",
        f"Samples\t{samples}\t{samples}\t",
        "Date\t2026/03/03\t2026/03/03\t",
        "Time\t16:00:05.1\t16:00:05.1\t",
        "Y_Unit_Label\tV\tum\t",
        "X_Dimension\tTime\tTime\t",
        "X0\t0.0000000000000000E+0\t0.0000000000000000E+0\t",
        f"Delta_X\t{delta:.6f}\t{delta:.6f}\t",
        "***End_of_Header***\t\t\t",
        names,
    ]


def _lvm(folder: Path, time: Array, voltage: Array, displacement: Array) -> Written:
    rows = _rows([time, voltage, displacement], "\t")
    segment = _lvm_segment("X_Value\tVoltage\tPosition\tComment", SAMPLES)
    return _text(folder / "a.lvm", [*_lvm_head(), *segment, f"{rows[0]}\t", *rows[1:]])


def _lvm_segments(folder: Path, time: Array, voltage: Array, displacement: Array) -> Written:
    rows = _rows([time, voltage, displacement], "\t")
    segment = _lvm_segment("X_Value\tVoltage\tPosition\tComment", SAMPLES // 3)
    third = SAMPLES // 3
    lines = _lvm_head()
    for first in (0, third, 2 * third):
        lines += [*segment, *rows[first : first + third], ""]
    return _text(folder / "a.lvm", lines)


def _lvm_without_times(folder: Path, _: Array, voltage: Array, displacement: Array) -> Written:
    rows = [f"\t{row}" for row in _rows([voltage, displacement], "\t")]
    segment = _lvm_segment("X_Value\tVoltage\tPosition\tComment", SAMPLES)
    return _text(folder / "a.lvm", [*_lvm_head(columns="No"), *segment, *rows])


def _lvm_many_times(folder: Path, time: Array, voltage: Array, displacement: Array) -> Written:
    rows = _rows([time, voltage, time, displacement], "\t")
    segment = _lvm_segment("X_Value\tVoltage\tX_Value\tPosition\tComment", SAMPLES)
    return _text(folder / "a.lvm", [*_lvm_head(columns="Multi"), *segment, *rows])


def _tdms(folder: Path, channels: Mapping[str, tuple[Array, Mapping[str, Any]]]) -> Written:
    from nptdms import ChannelObject, TdmsWriter  # noqa: PLC0415  # an extra

    with TdmsWriter(folder / "a.tdms") as writer:
        writer.write_segment(
            [ChannelObject("Log", name, data, known) for name, (data, known) in channels.items()]
        )
    return Written(folder / "a.tdms")


def _tdms_waveform(folder: Path, _: Array, voltage: Array, displacement: Array) -> Written:
    wave = {"wf_increment": INTERVAL, "wf_start_offset": 0.0, "wf_samples": SAMPLES}
    return _tdms(
        folder,
        {
            "Voltage": (voltage, wave | {"unit_string": "V"}),
            "Position": (displacement, wave | {"unit_string": "um"}),
        },
    )


def _tdms_times(folder: Path, time: Array, voltage: Array, displacement: Array) -> Written:
    channels = {"Time (s)": time, "U_V": voltage, "laser": displacement}
    written = _tdms(folder, {name: (values, {}) for name, values in channels.items()})
    return written._replace(columns={"displacement": "laser"}, units={"displacement": "um"})


def _struct(folder: Path, time: Array, voltage: Array, displacement: Array) -> Written:
    log = {"time": time, "Ux": voltage, "Uy": 0 * voltage, "x": displacement, "y": 0.1 * voltage}
    scipy.io.savemat(folder / "a.mat", {"log": log, "operator": "bench"})
    columns = {"voltage": "log.Ux", "displacement": "log.x"}
    return Written(folder / "a.mat", columns, {"time": "s", "voltage": "V", "displacement": "um"})


def _struct_array(folder: Path, time: Array, voltage: Array, displacement: Array) -> Written:
    channels = np.zeros(2, dtype=[("Name", object), ("Data", object)])
    channels["Name"] = ["Model Root/u", "Model Root/y"]
    channels["Data"] = [voltage, displacement]
    scipy.io.savemat(folder / "a.mat", {"rec": {"X": {"Data": time}, "Y": channels}})
    columns = {"time": "rec.X.Data", "voltage": "rec.Y(1).Data", "displacement": "rec.Y(2).Data"}
    return Written(folder / "a.mat", columns, {"time": "s", "voltage": "V", "displacement": "um"})


def _struct_7_3(folder: Path, time: Array, voltage: Array, displacement: Array) -> Written:
    with h5py.File(folder / "a.mat", "w", userblock_size=512) as file:
        for name, values in (("t", time), ("U_V", voltage), ("pos_um", displacement)):
            file[f"log/{name}"] = values[np.newaxis, :]
            file[f"log/{name}"].attrs["MATLAB_class"] = np.bytes_("double")
        file["log/operator"] = np.frombuffer("bench".encode("utf-16-le"), "<u2")[:, np.newaxis]
        file["log/operator"].attrs["MATLAB_class"] = np.bytes_("char")
        file["#refs#/a"] = np.arange(9.0)
    with (folder / "a.mat").open("r+b") as stream:
        stream.write(b"MATLAB 7.3 MAT-file, Platform: GLNXA64".ljust(116) + bytes(8) + b"\0\2IM")
    return Written(folder / "a.mat", {}, {"time": "s"})


def _matrix(folder: Path, time: Array, voltage: Array, displacement: Array) -> Written:
    data = np.stack([time, voltage, displacement], axis=1)
    scipy.io.savemat(folder / "a.mat", {"data": data, "fs": 200.0})
    columns = {"time": "data[1]", "voltage": "data[2]", "displacement": "data[3]"}
    return Written(folder / "a.mat", columns, {"time": "s", "voltage": "V", "displacement": "um"})


def _groups(folder: Path, time: Array, voltage: Array, displacement: Array) -> Written:
    with h5py.File(folder / "a.h5", "w") as file:
        for run in ("run_001", "run_003"):
            group = file.create_group(f"measurement/{run}")
            group["t"], group["hv_out"] = 1e3 * time, voltage
            group["axis_x"], group["axis_y"] = 1e3 * displacement, 0 * displacement
            for name, unit in (("t", "ms"), ("hv_out", "V"), ("axis_x", "nm"), ("axis_y", "nm")):
                group[name].attrs["unit"] = unit
    columns = {
        "voltage": "measurement/run_003/hv_out",
        "displacement": "measurement/run_003/axis_x",
    }
    return Written(folder / "a.h5", columns)


def _table(folder: Path, time: Array, voltage: Array, displacement: Array) -> Written:
    rows = np.zeros(SAMPLES, dtype=[("t_s", "f8"), ("u_V", "f4"), ("pos_um", "f8")])
    rows["t_s"], rows["u_V"], rows["pos_um"] = time, voltage, displacement
    with h5py.File(folder / "a.hdf5", "w") as file:
        file["log"] = rows
    return Written(folder / "a.hdf5")


def _savetxt(folder: Path, time: Array, voltage: Array, displacement: Array) -> Written:
    data = np.stack([time, voltage, displacement], axis=1)
    np.savetxt(folder / "a.dat", data, header="t_s u_V x_um")
    return Written(folder / "a.dat")


def _bare(folder: Path, time: Array, voltage: Array, displacement: Array) -> Written:
    written = _text(folder / "a.asc", _rows([time, displacement, voltage], "  "), newline="\n")
    columns = {"time": "1", "voltage": "3", "displacement": "2"}
    return written._replace(
        columns=columns, units={"time": "s", "voltage": "V", "displacement": "um"}
    )


def _scope(folder: Path, time: Array, voltage: Array, displacement: Array) -> Written:
    """Of an oscilloscope: names, units in brackets, an empty line; the sensor's is a voltage."""
    rows = _rows([1e3 * time, voltage, 1e3 * displacement], ",")
    written = _text(folder / "a.csv", ["Time,Channel A,Channel B", "(ms),(V),(mV)", "", *rows])
    columns = {"voltage": "Channel A", "displacement": "Channel B"}
    return written._replace(columns=columns, units={"displacement": "nm"})


def _scope_words(folder: Path, time: Array, voltage: Array, displacement: Array) -> Written:
    rows = _rows([time, voltage, displacement], ",")
    written = _text(folder / "a.csv", ["x-axis,1,2", "second,Volt,Volt", *rows])
    columns = {"voltage": "2", "displacement": "3"}
    return written._replace(columns=columns, units={"displacement": "um"})


def _logger(folder: Path, time: Array, voltage: Array, displacement: Array) -> Written:
    moments = pd.Timestamp("2026-03-03T11:59:59") + pd.to_timedelta(time, unit="s")
    values = zip(moments, voltage, displacement, strict=True)
    rows = [f"{t.isoformat(timespec='milliseconds')},{v},{d}" for t, v, d in values]
    return _text(folder / "a.csv", ["Timestamp,Command [V],Position [um]", *rows])


def _clock(folder: Path, time: Array, voltage: Array, displacement: Array) -> Written:
    values = zip(time, voltage, displacement, strict=True)
    rows = [f"00:00:{t:06.3f},{v},{d}" for t, v, d in values]
    return _text(folder / "a.csv", ["Time,Command [V],Position [um]", *rows])


def _thousands(folder: Path, time: Array, voltage: Array, displacement: Array) -> Written:
    marks = str.maketrans(",.", ".,")
    table = zip(1e3 * time, 1e3 * voltage, 1e3 * displacement, strict=True)
    rows = [";".join(f"{value:,.2f}".translate(marks) for value in row) for row in table]
    return _text(folder / "a.csv", ["Zeit [ms];Spannung [mV];Weg [nm]", *rows])


def _fortran(folder: Path, time: Array, voltage: Array, displacement: Array) -> Written:
    table = zip(time, voltage, displacement, strict=True)
    rows = ["  ".join(f"{value:.9E}".replace("E", "D") for value in row) for row in table]
    return _text(folder / "a.dat", ["% t/s u/V x/um", *rows], newline="\n")


def _beside(folder: Path, time: Array, voltage: Array, displacement: Array) -> Written:
    """Of an oscilloscope: what it was set to stands beside the first numbers."""
    rows = _rows([time, voltage, displacement], ",")
    head = ['"Record Length",600', '"Source","CH1"', '"Vertical Units","V"']
    head += [","] * (len(rows) - len(head))
    written = _text(folder / "a.csv", [f"{a},{b}" for a, b in zip(head, rows, strict=True)])
    columns = {"time": "3", "voltage": "4", "displacement": "5"}
    return written._replace(
        columns=columns, units={"time": "s", "voltage": "V", "displacement": "um"}
    )


def _no_names(folder: Path, _: Array, voltage: Array, displacement: Array) -> Written:
    written = _text(folder / "a.txt", _rows([voltage, displacement], "\t"))
    return written._replace(
        columns={"voltage": "1", "displacement": "2"},
        units={"voltage": "V", "displacement": "um"},
        fs=1 / INTERVAL,
    )


def _unix(folder: Path, time: Array, voltage: Array, displacement: Array) -> Written:
    stamps = np.rint(1_772_539_199_000 + 1e3 * time).astype(np.int64)
    values = zip(stamps, voltage, displacement, strict=True)
    return _text(folder / "a.csv", ["t_ms,u_V,x_um", *(f"{t},{v},{d}" for t, v, d in values)])


def _frame(folder: Path, time: Array, voltage: Array, displacement: Array) -> Written:
    columns = {"time_s": time, "voltage_V": voltage, "displacement_um": displacement}
    pd.DataFrame(columns).to_csv(folder / "a.csv")
    return Written(folder / "a.csv")


def _japanese(folder: Path, time: Array, voltage: Array, displacement: Array) -> Written:
    rows = _rows([time, voltage, displacement], ",")
    return _text(
        folder / "a.csv", ["圧電アクチュエータ", "時間(s),電圧(V),変位(um)", *rows], "cp932"
    )


def _trailing(folder: Path, time: Array, voltage: Array, displacement: Array) -> Written:
    rows = _rows([time, voltage, displacement], "\t", end="\t")
    return _text(folder / "a.txt", ['"t_s"\t"u_V"\t"x_um"\t', *rows])


def _no_times(folder: Path, _: Array, voltage: Array, displacement: Array) -> Written:
    rows = _rows([voltage, displacement], ",")
    return _text(folder / "a.csv", ["u_V,x_um", *rows])._replace(fs=1 / INTERVAL)


INSTRUMENTS: Mapping[str, Callable[[Path, Array, Array, Array], Written]] = {
    "Excel, German, cp1252, preamble": _excel,
    "Excel, Unicode text": _unicode_text,
    "LabVIEW lvm": _lvm,
    "LabVIEW lvm, three segments": _lvm_segments,
    "LabVIEW lvm without times": _lvm_without_times,
    "LabVIEW lvm, times of each channel": _lvm_many_times,
    "TDMS waveforms": _tdms_waveform,
    "TDMS with times": _tdms_times,
    "MATLAB struct of two axes": _struct,
    "MATLAB struct array": _struct_array,
    "MATLAB 7.3 struct": _struct_7_3,
    "MATLAB matrix": _matrix,
    "HDF5 groups with units": _groups,
    "HDF5 table": _table,
    "numpy.savetxt": _savetxt,
    "no header, blanks": _bare,
    "oscilloscope, units in brackets": _scope,
    "oscilloscope, units in words": _scope_words,
    "logger with dates": _logger,
    "Unix time in ms": _unix,
    "pandas with its index": _frame,
    "Japanese, cp932": _japanese,
    "separators at the ends": _trailing,
    "no times at all": _no_times,
    "no names and no times": _no_names,
    "times of day": _clock,
    "marks between thousands": _thousands,
    "exponents of Fortran": _fortran,
    "settings beside the numbers": _beside,
}
