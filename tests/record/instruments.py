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

from tests.stand import play

SAMPLES, INTERVAL = 600, 0.005

Array = Any


class Written(NamedTuple):
    """A file, and what a user says of its columns."""

    path: Path
    columns: Mapping[str, str] = {}
    units: Mapping[str, str] = {}
    fs: float | None = None


Writer = Callable[[Path], Written]
INSTRUMENTS: dict[str, Writer] = {}


def _instrument(name: str) -> Callable[[Writer], Writer]:
    def register(write: Writer) -> Writer:
        INSTRUMENTS[name] = write
        return write

    return register


TIME = INTERVAL * np.arange(SAMPLES)  # s
VOLTAGE = np.round(60 * np.exp(-0.5 * TIME) * np.sin(2 * np.pi * TIME / 0.5), 4)
_NOISE = np.random.default_rng(1).normal(scale=0.02, size=SAMPLES)
DISPLACEMENT = np.round(0.3 * VOLTAGE + 0.2 * play(VOLTAGE, 6.0) + _NOISE, 5)  # um
COLUMNS = [TIME, VOLTAGE, DISPLACEMENT]
UNITS = {"time": "s", "voltage": "V", "displacement": "um"}
_MICRONS = {"displacement": "um"}


def _named(*names: str) -> dict[str, str]:
    return dict(zip(UNITS, names, strict=True))


def _rows(columns: list[Array], separator: str, form: str = ".6f", end: str = "") -> list[str]:
    return [
        separator.join(f"{value:{form}}" for value in row) + end
        for row in zip(*columns, strict=True)
    ]


def _commas(rows: list[str]) -> list[str]:
    return [row.replace(".", ",") for row in rows]


def _text(path: Path, lines: list[str], encoding: str = "utf-8", **said: Any) -> Written:
    path.write_bytes(("\r\n".join(lines) + "\r\n").encode(encoding))
    return Written(path, **said)


@_instrument("Excel, German, cp1252, preamble")
def _(folder: Path) -> Written:
    head = ["Prüfstand 3", "Bediener;Müller", "Datum;3. März 2026", ""]
    names = "Zeit [s];Spannung [V];Weg [µm];Bemerkung"
    rows = _commas(_rows(COLUMNS, ";", end=";in Ordnung"))
    return _text(folder / "messung.csv", [*head, names, *rows], "cp1252")


@_instrument("Excel, Unicode text")
def _(folder: Path) -> Written:
    rows = _commas(_rows(COLUMNS, "\t"))
    return _text(folder / "a.txt", ["Time (s)\tDrive (V)\tStroke (µm)", *rows], "utf-16")


def _lvm(folder: Path, segments: list[list[str]], names: str, x_columns: str = "One") -> Written:
    """Write LabVIEW's text with its header, and one for each segment."""
    lines = [
        *("LabVIEW Measurement\t", "Writer_Version\t2", "Reader_Version\t2", "Separator\tTab"),
        *("Decimal_Separator\t.", "Multi_Headings\tYes", f"X_Columns\t{x_columns}"),
        *("Time_Pref\tRelative", "Operator\tbench", "Date\t2026/03/03", "Time\t16:00:05.123"),
        *("***End_of_Header***\t", "\t"),
    ]
    for rows in segments:
        lines += [
            *("Channels\t2\t\t", f"Samples\t{len(rows)}\t{len(rows)}\t"),
            *("Date\t2026/03/03\t2026/03/03\t", "Time\t16:00:05.1\t16:00:05.1\t"),
            *("Y_Unit_Label\tV\tum\t", "X_Dimension\tTime\tTime\t"),
            "X0\t0.0000000000000000E+0\t0.0000000000000000E+0\t",
            f"Delta_X\t{INTERVAL:.6f}\t{INTERVAL:.6f}\t",
            *("***End_of_Header***\t\t\t", f"{names}\tComment", *rows, ""),
        ]
    return _text(folder / "a.lvm", lines[:-1])


@_instrument("LabVIEW lvm")
def _(folder: Path) -> Written:
    first, *rows = _rows(COLUMNS, "\t")
    return _lvm(folder, [[f"{first}\t", *rows]], "X_Value\tVoltage\tPosition")


@_instrument("LabVIEW lvm, three segments")
def _(folder: Path) -> Written:
    rows = _rows(COLUMNS, "\t")
    return _lvm(folder, [rows[:200], rows[200:400], rows[400:]], "X_Value\tVoltage\tPosition")


@_instrument("LabVIEW lvm without times")
def _(folder: Path) -> Written:
    rows = [f"\t{row}" for row in _rows([VOLTAGE, DISPLACEMENT], "\t")]
    return _lvm(folder, [rows], "X_Value\tVoltage\tPosition", "No")


@_instrument("LabVIEW lvm, times of each channel")
def _(folder: Path) -> Written:
    rows = _rows([TIME, VOLTAGE, TIME, DISPLACEMENT], "\t")
    return _lvm(folder, [rows], "X_Value\tVoltage\tX_Value\tPosition", "Multi")


def _tdms(folder: Path, channels: Mapping[str, Array], **properties: dict[str, Any]) -> Path:
    from nptdms import ChannelObject, TdmsWriter  # noqa: PLC0415  # an extra

    with TdmsWriter(folder / "a.tdms") as writer:
        writer.write_segment(
            [ChannelObject("Log", n, data, properties.get(n, {})) for n, data in channels.items()]
        )
    return folder / "a.tdms"


@_instrument("TDMS waveforms")
def _(folder: Path) -> Written:
    wave = {"wf_increment": INTERVAL, "wf_start_offset": 0.0, "wf_samples": SAMPLES}
    units = {"Voltage": wave | {"unit_string": "V"}, "Position": wave | {"unit_string": "um"}}
    return Written(_tdms(folder, {"Voltage": VOLTAGE, "Position": DISPLACEMENT}, **units))


@_instrument("TDMS with times")
def _(folder: Path) -> Written:
    path = _tdms(folder, {"Time (s)": TIME, "U_V": VOLTAGE, "laser": DISPLACEMENT})
    return Written(path, {"displacement": "laser"}, {"displacement": "um"})


@_instrument("Excel workbook, units in a second row")
def _(folder: Path) -> Written:
    from openpyxl import Workbook  # noqa: PLC0415  # an extra

    book = Workbook()
    book.active.title = "Notes"
    book.active.append(["Bench 3", "piezo"])
    sheet = book.create_sheet("Run 1")
    sheet.append(["Measurement 7, loops"])
    sheet.merge_cells("A1:C1")
    sheet.append(["Time", "Voltage", "Displacement", "Remark"])
    sheet.append(["s", "V", "um"])
    for row in zip(*COLUMNS, strict=True):
        sheet.append([float(value) for value in row])
    book.save(folder / "a.xlsx")
    return Written(folder / "a.xlsx")


@_instrument("pandas to Excel, with dates")
def _(folder: Path) -> Written:
    moments = pd.Timestamp("2026-03-03T11:59:59") + pd.to_timedelta(TIME, unit="s")
    frame = pd.DataFrame({"Time": moments, "U [V]": VOLTAGE, "x [um]": DISPLACEMENT})
    frame.to_excel(folder / "a.xlsx", index=False)
    return Written(folder / "a.xlsx")


def _mat(folder: Path, variables: dict[str, Any], *names: str) -> Written:
    scipy.io.savemat(folder / "a.mat", variables)
    return Written(folder / "a.mat", _named(*names), UNITS)


@_instrument("MATLAB struct of two axes")
def _(folder: Path) -> Written:
    axes = {"Ux": VOLTAGE, "Uy": 0 * VOLTAGE, "x": DISPLACEMENT, "y": 0.1 * VOLTAGE}
    written = _mat(folder, {"log": {"time": TIME} | axes, "operator": "bench"}, *"tux")
    return written._replace(columns={"voltage": "log.Ux", "displacement": "log.x"})


@_instrument("MATLAB struct array")
def _(folder: Path) -> Written:
    channels = np.zeros(2, dtype=[("Name", object), ("Data", object)])
    channels["Name"] = ["Model Root/u", "Model Root/y"]
    channels["Data"] = [VOLTAGE, DISPLACEMENT]
    variables = {"rec": {"X": {"Data": TIME}, "Y": channels}}
    return _mat(folder, variables, "rec.X.Data", "rec.Y(1).Data", "rec.Y(2).Data")


@_instrument("MATLAB matrix")
def _(folder: Path) -> Written:
    variables = {"data": np.stack(COLUMNS, axis=1), "fs": 200.0}
    return _mat(folder, variables, "data[1]", "data[2]", "data[3]")


@_instrument("MATLAB 7.3 struct")
def _(folder: Path) -> Written:
    with h5py.File(folder / "a.mat", "w", userblock_size=512) as file:
        for name, values in zip(("t", "U_V", "pos_um"), COLUMNS, strict=True):
            file[f"log/{name}"] = values[np.newaxis, :]
            file[f"log/{name}"].attrs["MATLAB_class"] = np.bytes_("double")
        file["log/operator"] = np.frombuffer("bench".encode("utf-16-le"), "<u2")[:, np.newaxis]
        file["log/operator"].attrs["MATLAB_class"] = np.bytes_("char")
        file["#refs#/a"] = np.arange(9.0)
    with (folder / "a.mat").open("r+b") as stream:
        stream.write(b"MATLAB 7.3 MAT-file, Platform: GLNXA64".ljust(116) + bytes(8) + b"\0\2IM")
    return Written(folder / "a.mat", {}, {"time": "s"})


@_instrument("HDF5 groups with units")
def _(folder: Path) -> Written:
    with h5py.File(folder / "a.h5", "w") as file:
        for run in ("run_001", "run_003"):
            group = file.create_group(f"measurement/{run}")
            group["t"], group["hv_out"] = 1e3 * TIME, VOLTAGE
            group["axis_x"], group["axis_y"] = 1e3 * DISPLACEMENT, 0 * DISPLACEMENT
            for name, unit in (("t", "ms"), ("hv_out", "V"), ("axis_x", "nm"), ("axis_y", "nm")):
                group[name].attrs["unit"] = unit
    run = "measurement/run_003"
    columns = {"voltage": f"{run}/hv_out", "displacement": f"{run}/axis_x"}
    return Written(folder / "a.h5", columns)


@_instrument("HDF5 table")
def _(folder: Path) -> Written:
    rows = np.zeros(SAMPLES, dtype=[("t_s", "f8"), ("u_V", "f4"), ("pos_um", "f8")])
    rows["t_s"], rows["u_V"], rows["pos_um"] = COLUMNS
    with h5py.File(folder / "a.hdf5", "w") as file:
        file["log"] = rows
    return Written(folder / "a.hdf5")


@_instrument("numpy.savetxt")
def _(folder: Path) -> Written:
    np.savetxt(folder / "a.dat", np.stack(COLUMNS, axis=1), header="t_s u_V x_um")
    return Written(folder / "a.dat")


@_instrument("no header, blanks")
def _(folder: Path) -> Written:
    rows = _rows([TIME, DISPLACEMENT, VOLTAGE], "  ")
    return _text(folder / "a.asc", rows, columns=_named("1", "3", "2"), units=UNITS)


@_instrument("oscilloscope, units in brackets")
def _(folder: Path) -> Written:
    """With an empty line; the sensor's is a voltage."""
    rows = _rows([1e3 * TIME, VOLTAGE, 1e3 * DISPLACEMENT], ",")
    lines = ["Time,Channel A,Channel B", "(ms),(V),(mV)", "", *rows]
    columns = {"voltage": "Channel A", "displacement": "Channel B"}
    return _text(folder / "a.csv", lines, columns=columns, units={"displacement": "nm"})


@_instrument("oscilloscope, units in words")
def _(folder: Path) -> Written:
    lines = ["x-axis,1,2", "second,Volt,Volt", *_rows(COLUMNS, ",")]
    columns = {"voltage": "2", "displacement": "3"}
    return _text(folder / "a.csv", lines, columns=columns, units={"displacement": "um"})


def _stamped(folder: Path, names: str, stamps: Any) -> Written:
    rows = [f"{t},{v},{d}" for t, v, d in zip(stamps, VOLTAGE, DISPLACEMENT, strict=True)]
    return _text(folder / "a.csv", [names, *rows])


@_instrument("logger with dates")
def _(folder: Path) -> Written:
    moments = pd.Timestamp("2026-03-03T11:59:59") + pd.to_timedelta(TIME, unit="s")
    stamps = [t.isoformat(timespec="milliseconds") for t in moments]
    return _stamped(folder, "Timestamp,Command [V],Position [um]", stamps)


@_instrument("Unix time in ms")
def _(folder: Path) -> Written:
    stamps = np.rint(1_772_539_199_000 + 1e3 * TIME).astype(np.int64)
    return _stamped(folder, "t_ms,u_V,x_um", stamps)


@_instrument("times of day")
def _(folder: Path) -> Written:
    return _stamped(folder, "Time,Command [V],Position [um]", [f"00:00:{t:06.3f}" for t in TIME])


@_instrument("pandas with its index")
def _(folder: Path) -> Written:
    columns = dict(zip(("time_s", "voltage_V", "displacement_um"), COLUMNS, strict=True))
    pd.DataFrame(columns).to_csv(folder / "a.csv")
    return Written(folder / "a.csv")


@_instrument("Japanese, cp932")
def _(folder: Path) -> Written:
    lines = ["圧電アクチュエータ", "時間(s),電圧(V),変位(um)", *_rows(COLUMNS, ",")]
    return _text(folder / "a.csv", lines, "cp932")


@_instrument("separators at the ends")
def _(folder: Path) -> Written:
    return _text(folder / "a.txt", ['"t_s"\t"u_V"\t"x_um"\t', *_rows(COLUMNS, "\t", end="\t")])


@_instrument("no times at all")
def _(folder: Path) -> Written:
    rows = _rows([VOLTAGE, DISPLACEMENT], ",")
    return _text(folder / "a.csv", ["u_V,x_um", *rows], fs=1 / INTERVAL)


@_instrument("no names and no times")
def _(folder: Path) -> Written:
    columns = {"voltage": "1", "displacement": "2"}
    units = {"voltage": "V", "displacement": "um"}
    rows = _rows([VOLTAGE, DISPLACEMENT], "\t")
    return _text(folder / "a.txt", rows, columns=columns, units=units, fs=1 / INTERVAL)


@_instrument("marks between thousands")
def _(folder: Path) -> Written:
    rows = _rows([1e3 * column for column in COLUMNS], ";", ",.2f")
    rows = [row.translate(str.maketrans(",.", ".,")) for row in rows]
    return _text(folder / "a.csv", ["Zeit [ms];Spannung [mV];Weg [nm]", *rows])


@_instrument("exponents of Fortran")
def _(folder: Path) -> Written:
    rows = [row.replace("E", "D") for row in _rows(COLUMNS, "  ", ".9E")]
    return _text(folder / "a.dat", ["% t/s u/V x/um", *rows])


@_instrument("settings beside the numbers")
def _(folder: Path) -> Written:
    """Of an oscilloscope."""
    rows = _rows(COLUMNS, ",")
    head = ['"Record Length",600', '"Source","CH1"', '"Vertical Units","V"']
    head += [","] * (len(rows) - len(head))
    lines = [f"{a},{b}" for a, b in zip(head, rows, strict=True)]
    return _text(folder / "a.csv", lines, columns=_named("3", "4", "5"), units=UNITS)


@_instrument("oscilloscope, settings in as many fields")
def _(folder: Path) -> Written:
    head = ["Model,MSO44", "", "Sample Interval,0.005", "Vertical Units,V,V", "Vertical Offset,0,0"]
    head += ["Vertical Scale,2,1", "Position,0,0", ",", "Label,Monitor,Sensor", "TIME,CH1,CH2"]
    rows = _rows([TIME, VOLTAGE / 20, DISPLACEMENT / 0.35], ",", ".9f")
    columns = _named("TIME", "CH1", "CH2")
    units = {"time": "s", "voltage": "20 V", "displacement": "0.35 um"}
    return _text(folder / "a.csv", [*head, *rows], columns=columns, units=units)


@_instrument("Origin, comments below the units")
def _(folder: Path) -> Written:
    head = ["Time\tVoltage\tDisplacement", "s\tV\tum", "\tamplifier\tcapacitive"]
    return _text(folder / "a.txt", [*head, *_rows(COLUMNS, "\t")])


@_instrument("dSPACE, with a column of words")
def _(folder: Path) -> Written:
    head = ["values;;;", 'path;;"Model Root/DAC";"Model Root/ADC"', "name;time;U_cmd;pos_um"]
    rows = _commas([f";{row}" for row in _rows(COLUMNS, ";")])
    return _text(folder / "a.csv", [*head, "unit;s;V;um", *rows])


@_instrument("MATLAB timetable")
def _(folder: Path) -> Written:
    rows = [f"{t:g} sec,{v:.6f},{d:.6f}" for t, v, d in zip(*COLUMNS, strict=True)]
    return _text(folder / "a.csv", ["Time,Voltage_V_,Position_um_", *rows])


@_instrument("data recorder of PI")
def _(folder: Path) -> Written:
    head = ["REM E-709", "", "VERSION = 1", "SEPARATOR = 32", "DIM = 2", "SAMPLE_TIME = 0.005000"]
    head += ["NDATA = 600", "", "NAME0 = Actual Position of axis 1"]
    head += ["NAME1 = Control Voltage of output chan 1", "", "END_HEADER"]
    rows = _rows([DISPLACEMENT, VOLTAGE], " ")
    columns = {"voltage": "Control Voltage of output chan 1", "displacement": "1"}
    units = {"voltage": "V", "displacement": "um"}
    return _text(
        folder / "a.dat",
        [*(f"# {line}" for line in head), *rows],
        columns=columns,
        units=units,
        fs=200,
    )


@_instrument("commas in quotes")
def _(folder: Path) -> Written:
    rows = [f'"{row}"' for row in _commas(_rows(COLUMNS, '"|"'))]
    rows = [row.replace("|", ",") for row in rows]
    return _text(folder / "a.csv", ['"Time (s)","Voltage (V)","Displacement (um)"', *rows])


@_instrument("numbered samples")
def _(folder: Path) -> Written:
    head = ["Interferometer", "Sample Rate (Hz): 200", "", "Sample;Voltage(V);Position(nm)"]
    rows = _rows([np.arange(SAMPLES), VOLTAGE, 1e3 * DISPLACEMENT], ";")
    return _text(folder / "a.txt", [*head, *rows], fs=200)


@_instrument("Rigol, settings in the header")
def _(folder: Path) -> Written:
    """Count samples; start and increment stand above empty columns."""
    rows = _rows([VOLTAGE, DISPLACEMENT], ",", end=",,")
    lines = ["X,CH1,CH2,Start,Increment", f"Sequence,Volt,Volt,0.000000e+00,{INTERVAL:e}"]
    lines += [f"{i},{row}" for i, row in enumerate(rows)]
    return _text(
        folder / "a.csv", lines, columns={"voltage": "CH1", "displacement": "CH2"}, units=_MICRONS
    )


@_instrument("Rigol, increment behind the names")
def _(folder: Path) -> Written:
    rows = _rows([VOLTAGE, DISPLACEMENT], ",", end=",,")
    header = f"CH1(V),CH2(V),t0 = 0.000000e+00s, tInc = {INTERVAL:e}s,"
    columns = {"voltage": "CH1(V)", "displacement": "CH2(V)"}
    return _text(folder / "a.csv", [header, *rows], columns=columns, units=_MICRONS)


@_instrument("Siglent")
def _(folder: Path) -> Written:
    head = ["Record Length,Analog:600", f"Sample Interval,Analog:{INTERVAL:.9f}"]
    head += ["Vertical Units,CH1:V,CH2:V", "Vertical Scale,CH1:20.00,CH2:5.00"]
    head += ["Horizontal Units,s", "Source,CH1,CH2"]
    lines = [*head, "Second,Volt,Volt", *_rows(COLUMNS, ",", ".7E")]
    columns = {"voltage": "CH1", "displacement": "CH2"}
    return _text(folder / "a.csv", lines, columns=columns, units={"voltage": "V"} | _MICRONS)


@_instrument("PicoScope, times in ms")
def _(folder: Path) -> Written:
    rows = _rows([1e3 * TIME, VOLTAGE, DISPLACEMENT], ",", ".8f")
    lines = ["Time,Channel A,Channel B", "(ms),(V),(V)", "", *rows]
    columns = {"voltage": "Channel A", "displacement": "Channel B"}
    return _text(folder / "a.csv", lines, columns=columns, units=_MICRONS)


@_instrument("Polytec")
def _(folder: Path) -> Written:
    head = ["Source File Name:\tbench.pvd", "Signal:\tTime Vib Displacement", "Frame Data"]
    lines = [*head, "", "Time\tVib Displacement\tRef1 Voltage", "[ s ]\t[ m ]\t[ V ]"]
    rows = _rows([TIME, 1e-6 * DISPLACEMENT, VOLTAGE], "\t", ".14e")
    return _text(folder / "a.txt", [*lines, *rows])


@_instrument("Keyence, quoted thousands")
def _(folder: Path) -> Written:
    rows = _rows([TIME, 1e3 * VOLTAGE, 1e3 * DISPLACEMENT], '","', ",.3f")
    lines = ['"Time [s]","Monitor [mV]","OUT1 displacement [nm]"', *(f'"{row}"' for row in rows)]
    return _text(folder / "a.csv", lines)


@_instrument("Attocube, picometers counted")
def _(folder: Path) -> Written:
    lines = ["# time (ms) drive voltage (V) displacement axis (pm)"]
    lines += _rows([1e3 * TIME, VOLTAGE, 1e6 * DISPLACEMENT], " ", ".6f")
    return _text(folder / "a.dat", lines)


@_instrument("wave table of PI, target and actual")
def _(folder: Path) -> Written:
    lines = ["Time [s];Target Position [µm];Actual Position [µm];Control Voltage [V]"]
    rows = _rows([TIME, np.round(DISPLACEMENT), DISPLACEMENT, VOLTAGE], ";")
    columns = {"displacement": "Actual Position [µm]"}
    return _text(folder / "a.csv", [*lines, *_commas(rows)], "cp1252", columns=columns)


@_instrument("pandas without names")
def _(folder: Path) -> Written:
    pd.DataFrame(np.transpose(COLUMNS)).to_csv(folder / "a.csv", index=False)
    return Written(folder / "a.csv", _named("1", "2", "3"), UNITS)


@_instrument("writematrix of MATLAB")
def _(folder: Path) -> Written:
    """Shortest digits, no names."""
    rows = [f"{t:.15g},{v:.15g},{d:.15g}" for t, v, d in zip(*COLUMNS, strict=True)]
    return _text(folder / "a.txt", rows, columns=_named("1", "2", "3"), units=UNITS)


@_instrument("thermologger, minutes and a temperature")
def _(folder: Path) -> Written:
    lines = ["No.,Time,U,Pos,Temp", "-,min,V,um,°C"]
    rows = _rows([TIME / 60, VOLTAGE, DISPLACEMENT, 21.5 + 0 * TIME], ",", ".9g", end=",,")
    lines += [f"{i},{row}" for i, row in enumerate(rows, start=1)]
    return _text(folder / "a.csv", [*lines, ",,,,,,", ",,,,,,"])
