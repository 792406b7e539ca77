"""Texts as programs and instruments write them: one record, in every form that a bench has.

:data:`TEXTS` writes the same record in each of them, :mod:`tests.record.makers` adds the
files that are no texts; beside a file stands what a user has to say of its columns, where they can
mean several things. Nothing here uses bwbayes to write.
"""

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd

from tests.stand import play

SAMPLES, INTERVAL = 600, 0.005


class Written(NamedTuple):
    """A file, and what a user says of its columns."""

    path: Path
    columns: Mapping[str, str] = {}
    units: Mapping[str, str] = {}
    fs: float | None = None


Writer = Callable[[Path], Written]
TEXTS: dict[str, Writer] = {}

TIME = INTERVAL * np.arange(SAMPLES)  # s
VOLTAGE = np.round(60 * np.exp(-0.5 * TIME) * np.sin(2 * np.pi * TIME / 0.5), 4)
_NOISE = np.random.default_rng(1).normal(scale=0.02, size=SAMPLES)
DISPLACEMENT = np.round(0.3 * VOLTAGE + 0.2 * play(VOLTAGE, 6.0) + _NOISE, 5)  # um
COLUMNS = [TIME, VOLTAGE, DISPLACEMENT]
UNITS = {"time": "s", "voltage": "V", "displacement": "um"}
BOTH = {"voltage": "V", "displacement": "um"}
MICRONS = {"displacement": "um"}


def named(*names: str) -> dict[str, str]:
    """Return the names of all three columns, or of voltage and displacement."""
    return dict(zip([*UNITS][-len(names) :], names, strict=True))


def _rows(columns: list[Any], separator: str, form: str = ".6f", end: str = "") -> list[str]:
    return [
        separator.join(f"{value:{form}}" for value in row) + end
        for row in zip(*columns, strict=True)
    ]


def _beside(cells: list[str], columns: Any = COLUMNS) -> list[str]:
    """Return rows behind cells of another column."""
    return [f"{cell},{row}" for cell, row in zip(cells, _rows(columns, ","), strict=True)]


def _commas(rows: list[str]) -> list[str]:
    return [row.replace(".", ",") for row in rows]


def _text(
    name: str,
    head: list[str],
    rows: list[str],
    said: tuple[Any, ...] = (),
    *,
    encoding: str = "utf-8",
    file: str = "a.csv",
) -> None:
    """Have an instrument write lines, of whose columns, units and rate a user says this."""

    def write(folder: Path) -> Written:
        (folder / file).write_bytes(("\r\n".join([*head, *rows]) + "\r\n").encode(encoding))
        return Written(folder / file, *said)

    TEXTS[name] = write


_text(
    "Excel, German, cp1252, preamble",
    [
        *("Prüfstand 3", "Bediener;Müller", "Datum;3. März 2026", ""),
        "Zeit [s];Spannung [V];Weg [µm];Bemerkung",
    ],
    _commas(_rows(COLUMNS, ";", end=";in Ordnung")),
    encoding="cp1252",
)
_text(
    "Excel, Unicode text",
    ["Time (s)\tDrive (V)\tStroke (µm)"],
    _commas(_rows(COLUMNS, "\t")),
    encoding="utf-16",
)


def _lvm(name: str, segments: list[list[str]], names: str, x_columns: str = "One") -> None:
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
    _text(name, lines[:-1], [], file="a.lvm")


_TIMED = _rows(COLUMNS, "\t")
_NAMES = "X_Value\tVoltage\tPosition"
_lvm("LabVIEW lvm", [[f"{_TIMED[0]}\t", *_TIMED[1:]]], _NAMES)
_lvm("LabVIEW lvm, three segments", [_TIMED[:200], _TIMED[200:400], _TIMED[400:]], _NAMES)
_UNTIMED = [f"\t{row}" for row in _rows(COLUMNS[1:], "\t")]
_lvm("LabVIEW lvm without times", [_UNTIMED], _NAMES, "No")
_EACH = _rows([TIME, VOLTAGE, TIME, DISPLACEMENT], "\t")
_lvm("LabVIEW lvm, times of each channel", [_EACH], "X_Value\tVoltage\tX_Value\tPosition", "Multi")
_text("numpy.savetxt", ["# t_s u_V x_um"], _rows(COLUMNS, " ", ".18e"), file="a.dat")
_text(
    "no header, blanks",
    [],
    _rows([TIME, DISPLACEMENT, VOLTAGE], "  "),
    (named("1", "3", "2"), UNITS),
    file="a.asc",
)
_FRAME = pd.DataFrame(dict(zip(("time_s", "voltage_V", "displacement_um"), COLUMNS, strict=True)))
_text("pandas with its index", [], _FRAME.to_csv().splitlines())
_text(
    "pandas without names",
    [],
    pd.DataFrame(np.transpose(COLUMNS)).to_csv(index=False).splitlines(),
    (named("1", "2", "3"), UNITS),
)
_text(
    "Japanese, cp932",
    ["圧電アクチュエータ", "時間(s),電圧(V),変位(um)"],
    _rows(COLUMNS, ","),
    encoding="cp932",
)
_text("no times at all", ["u_V,x_um"], _rows(COLUMNS[1:], ","), ({}, {}, 1 / INTERVAL))
_text("no names and no times", [], _rows(COLUMNS[1:], "\t"), (named("1", "2"), BOTH, 1 / INTERVAL))
_text(
    "spreadsheet, French, blanks between thousands and typeset minus signs",
    ["temps [s];tension [mV];position [nm]"],
    [
        row.translate({ord(a): b for a, b in {",": " ", ".": ",", "-": "\u2212"}.items()})
        for row in _rows([TIME, 1e3 * VOLTAGE, 1e3 * DISPLACEMENT], ";", ",.3f")
    ],
)
_text(
    "exponents of Fortran",
    ["% t/s u/V x/um"],
    [row.replace("E", "D") for row in _rows(COLUMNS, "  ", ".9E")],
    file="a.dat",
)
_text(
    "Origin, comments below the units",
    ["Time\tVoltage\tDisplacement", "s\tV\tum", "\tamplifier\tcapacitive"],
    _rows(COLUMNS, "\t"),
)
_text(
    "dSPACE, with a column of words",
    [
        *("values;;;", 'path;;"Model Root/DAC";"Model Root/ADC"', "name;time;U_cmd;pos_um"),
        "unit;s;V;um",
    ],
    [f";{row}" for row in _commas(_rows(COLUMNS, ";"))],
)
_text(
    "MATLAB timetable",
    ["Time,Voltage_V_,Position_um_"],
    [f"{t:g} sec,{v:.6f},{d:.6f}" for t, v, d in zip(*COLUMNS, strict=True)],
)
# Shortest digits, no names.
_text("writematrix of MATLAB", [], _rows(COLUMNS, ",", ".15g"), (named("1", "2", "3"), UNITS))
_text(
    "commas in quotes",
    ['"Time (s)","Voltage (V)","Displacement (um)"'],
    [f'"{row}"'.replace("|", ",") for row in _commas(_rows(COLUMNS, '"|"'))],
)
_text(
    "a table drawn with bars and dashes",
    ["| t (s) | U (V) | x (um) |", "|-------|------:|:------:|"],
    [f"| {row} |" for row in _rows(COLUMNS, " | ")],
    file="a.md",
)
_text(
    "Igor, waves as text",
    ["IGOR", "WAVES/D t_s, voltage_V, pos_nm", "BEGIN"],
    [f"\t{row}" for row in _rows([TIME, VOLTAGE, 1e3 * DISPLACEMENT], "\t")]
    + ["END", 'X SetScale/P x 0,0.005,"s", voltage_V'],
    file="a.itx",
)

# With an empty line; the sensor's is a voltage.
_text(
    "oscilloscope, units in brackets",
    ["Time,Channel A,Channel B", "(ms),(V),(mV)", ""],
    _rows([1e3 * TIME, VOLTAGE, 1e3 * DISPLACEMENT], ","),
    (named("Channel A", "Channel B"), {"displacement": "nm"}),
)
_text(
    "oscilloscope, units in words",
    ["x-axis,1,2", "second,Volt,Volt"],
    _rows(COLUMNS, ","),
    (named("2", "3"), MICRONS),
)
_text(
    "oscilloscope, units behind a preposition",
    ['"in s","CH1 in V","CH2 in V"'],
    _rows(COLUMNS, ","),
    (named("CH1 in V", "CH2 in V"), {"displacement": "1 um"}),
)
_text(
    "oscilloscope, settings beside the numbers",
    [],
    _beside(['"Record Length",600', '"Source","CH1"', '"Vertical Units","V"', *[","] * 597]),
    (named("3", "4", "5"), UNITS),
)
_text(
    "oscilloscope, settings in columns of their own",
    [],
    _beside(
        ["Record Length,600,", "Sample Interval,0.005,", "Trigger Point,1,", "Source,CH1,"]
        + [",,"] * 596
    ),
    (named("4", "5", "6"), UNITS),
)
_text(
    "oscilloscope, settings in as many fields",
    [
        *("Model,MSO44", "", "Sample Interval,0.005", "Vertical Units,V,V", "Vertical Offset,0,0"),
        *("Vertical Scale,2,1", "Position,0,0", ",", "Label,Monitor,Sensor", "TIME,CH1,CH2"),
    ],
    _rows([TIME, VOLTAGE / 20, DISPLACEMENT / 0.35], ",", ".9f"),
    (named("TIME", "CH1", "CH2"), {"time": "s", "voltage": "20 V", "displacement": "0.35 um"}),
)
_TEKTRONIX = [
    *("Model,MSO44", "Firmware Version,1.2.3", "Horizontal Units,s", "Horizontal Scale,0.4"),
    *(f"Sample Interval,{INTERVAL}", f"Record Length,{SAMPLES}", "Gating,0.0% to 100.0%"),
    *("Probe Attenuation,10,1", "Vertical Units,V,um", "Vertical Offset,0,0", ","),
    "Label,Monitor,Sensor",
]
_text(
    "oscilloscope, units and rate above the header",
    [*_TEKTRONIX, "TIME,CH1,CH2"],
    _rows(COLUMNS, ","),
    (named("CH1", "CH2"),),
)
_text(
    "oscilloscope, rate above the header in place of times",
    [*_TEKTRONIX, "CH1,CH2"],
    _rows(COLUMNS[1:], ","),
    (named("CH1", "CH2"),),
)
# Count samples; start and increment stand above empty columns.
_text(
    "Rigol, settings in the header",
    ["X,CH1,CH2,Start,Increment", f"Sequence,Volt,Volt,0.000000e+00,{INTERVAL:e}"],
    [f"{i},{row}" for i, row in enumerate(_rows(COLUMNS[1:], ",", end=",,"))],
    (named("CH1", "CH2"), MICRONS),
)
_text(
    "Rigol, settings in the header of lines that end with a separator",
    ["X,CH1,CH2,Start,Increment,", f"Sequence,Volt,Volt,0.000000e+00,{INTERVAL:e}"],
    [f"{i},{row}" for i, row in enumerate(_rows(COLUMNS[1:], ",", end=","))],
    (named("CH1", "CH2"), MICRONS),
)
_text(
    "Rigol, increment behind the names",
    [f"CH1(V),CH2(V),t0 = 0.000000e+00s, tInc = {INTERVAL:e}s,"],
    _rows(COLUMNS[1:], ",", end=",,"),
    (named("CH1(V)", "CH2(V)"), MICRONS),
)
_text(
    "Siglent",
    [
        *("Record Length,Analog:600", f"Sample Interval,Analog:{INTERVAL:.9f}"),
        *("Vertical Units,CH1:V,CH2:V", "Vertical Scale,CH1:20.00,CH2:5.00", "Horizontal Units,s"),
        *("Source,CH1,CH2", "Second,Volt,Volt"),
    ],
    _rows(COLUMNS, ",", ".7E"),
    (named("CH1", "CH2"), BOTH),
)
_text(
    "recorder, settings above fields that begin with a separator",
    [
        *('"Model","DL850"', '"TraceName","CH1","CH2"', '"BlockSize",600,600'),
        *('"SampleRate",200,200', '"HResolution",5.0e-03,5.0e-03', '"HOffset",0.0,0.0', ""),
    ],
    [f",{row}," for row in _rows(COLUMNS[1:], ",")],
    (named("2", "3"), BOTH, 200.0),
)
_text(
    "recorder, settings above fields that begin with a separator, with dates and units",
    [
        *('"Header Size",  16,', '"TraceName","CH1","CH2",', '"BlockSize",600,600,'),
        *('"VUnit","V","V",', '"SampleRate",200,200,', '"HResolution",5.0e-03,5.0e-03,'),
        *('"HOffset",-3.0,-3.0,', '"HUnit","s","s",', '"DisplayBlockSize",600,600,'),
        *('"DisplayPointNo.",1,1,', '"PhaseShift",0,0,', '"Date","2026/03/03","2026/03/03",'),
        *('"Time","11:59:59.00","11:59:59.00",', ""),
    ],
    [f",{row}," for row in _rows(COLUMNS[1:], ",")],
    (named("2", "3"), BOTH, 200.0),
)
_text(
    "Fortran, a header in capitals behind an exclamation mark",
    [" !   TIME(S)       VOLT(V)      DISP(UM)"],
    [
        "".join(f"{value:16.8E}".replace("E", "D") for value in row)
        for row in zip(*COLUMNS, strict=True)
    ],
    file="a.out",
)

_MOMENTS = pd.Timestamp("2026-03-03T11:59:59") + pd.to_timedelta(np.rint(1e3 * TIME), unit="ms")
_text(
    "logger with dates",
    ["Timestamp,Command [V],Position [um]"],
    _beside([t.isoformat(timespec="milliseconds") for t in _MOMENTS], COLUMNS[1:]),
)
_text(
    "Unix time in ms",
    ["t_ms,u_V,x_um"],
    _beside([f"{1_772_539_199_000 + 1e3 * t:.0f}" for t in TIME], COLUMNS[1:]),
)
_text(
    "Keysight BenchLink, milliseconds behind a colon",
    ["Scan,Time,101 <HV> (VDC),Alarm 101,102 <Gauge> (VDC),Alarm 102"],
    [
        f"{i},{t:%m/%d/%Y %H:%M:%S}:{t.microsecond // 1000:03d},{v:+.8E},0,{d:+.8E},0"
        for i, (t, v, d) in enumerate(zip(_MOMENTS, VOLTAGE, DISPLACEMENT, strict=True), start=1)
    ],
    (named("101 <HV> (VDC)", "102 <Gauge> (VDC)"), {"voltage": "V", "displacement": "1 um"}),
)
_text(
    "thermologger, minutes and a temperature",
    ["No.,Time,U,Pos,Temp", "-,min,V,um,°C"],
    _rows([np.arange(1, 601), TIME / 60, *COLUMNS[1:], 21.5 + 0 * TIME], ",", ".9g", end=",,")
    + 2 * [",,,,,,"],
)
_text(
    "catman, channels and devices below the names",
    [
        *("HBM_CATMAN_DATAFILE", "Version:\t5.2", "", '"Zeit 1 [s]"\t"U_Piezo [V]"\t"Weg 1 [µm]"'),
        *('"CH=1"\t"CH=2"\t"CH=3"', '"Auto"\t"MX"\t"MX"'),
    ],
    _rows(COLUMNS, "\t"),
)

_text(
    "data recorder of PI",
    [
        *("# REM E-709", "# ", "# VERSION = 1", "# SEPARATOR = 32", "# DIM = 2"),
        *("# SAMPLE_TIME = 0.005000", "# NDATA = 600", "# ", "# NAME0 = Actual Position of axis 1"),
        *("# NAME1 = Control Voltage of output chan 1", "# ", "# END_HEADER"),
    ],
    _rows([DISPLACEMENT, VOLTAGE], " "),
    (named("Control Voltage of output chan 1", "1"), BOTH, 200),
    file="a.dat",
)
_text(
    "wave table of PI, target and actual",
    ["Time [s];Target Position [µm];Actual Position [µm];Control Voltage [V]"],
    _commas(_rows([TIME, np.round(DISPLACEMENT), DISPLACEMENT, VOLTAGE], ";")),
    ({"displacement": "Actual Position [µm]"},),
    encoding="cp1252",
)
_text(
    "controller's scope, a clock beside each channel and settings above",
    ["Name\tU\tName\tPos", "SampleTime[ms]\t5\tSampleTime[ms]\t5", "Unit\tV\tUnit\tum", ""],
    _rows([1e3 * TIME, VOLTAGE, 1e3 * TIME, DISPLACEMENT], "\t"),
    (named("1", "2", "4"), {"time": "ms", "voltage": "V", "displacement": "um"}),
)
_text(
    "numbered samples",
    ["Interferometer", "Sample Rate (Hz): 200", "", "Sample;Voltage(V);Position(nm)"],
    _rows([np.arange(SAMPLES), VOLTAGE, 1e3 * DISPLACEMENT], ";"),
    ({}, {}, 200),
)
_text(
    "Polytec",
    [
        *("Source File Name:\tbench.pvd", "Signal:\tTime Vib Displacement", "Frame Data", ""),
        *("Time\tVib Displacement\tRef1 Voltage", "[ s ]\t[ m ]\t[ V ]"),
    ],
    _rows([TIME, 1e-6 * DISPLACEMENT, VOLTAGE], "\t", ".14e"),
)
_text(
    "Keyence, quoted thousands",
    ['"Time [s]","Monitor [mV]","OUT1 displacement [nm]"'],
    [f'"{row}"' for row in _rows([TIME, 1e3 * VOLTAGE, 1e3 * DISPLACEMENT], '","', ",.3f")],
)
_text(
    "Attocube, picometers counted",
    ["# time (ms) drive voltage (V) displacement axis (pm)"],
    _rows([1e3 * TIME, VOLTAGE, 1e6 * DISPLACEMENT], " "),
    file="a.dat",
)
_text(
    "ferroelectric tester, electrodes of either polarity",
    [
        *("Result", "Hysteresis Amplitude [V]: 60", "Table 1"),
        "Time [s]\tV+ [V]\tV- [V]\tI1 [A]\tD1 [nm]",
    ],
    _rows([TIME, VOLTAGE, -VOLTAGE, np.cos(TIME), 1e3 * DISPLACEMENT], "\t"),
    ({"voltage": "V+ [V]"},),
    file="a.dat",
)
_text(
    "potentiostat, voltages against a reference",
    ["EXPLAIN", "CURVE\tTABLE\t600", "Pt\tT\tVf\tIm\tPos", "#\ts\tV vs. Ref.\tA\tum"],
    _rows([np.arange(SAMPLES), *COLUMNS[:2], TIME**2, DISPLACEMENT], "\t"),
    ({"voltage": "Vf"},),
    file="a.dta",
)
