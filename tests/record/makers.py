"""More files of other makers, as :mod:`tests.record.instruments` has them, after their formats."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any
from zipfile import ZipFile

import h5py
import numpy as np
import scipy.io

from tests.record.instruments import (
    COLUMNS,
    DISPLACEMENT,
    INTERVAL,
    SAMPLES,
    TIME,
    UNITS,
    VOLTAGE,
    Writer,
    Written,
)

MAKERS: dict[str, Writer] = {}
MICRONS = {"displacement": "1 um"}
COUNTS = np.rint(DISPLACEMENT / 1e-5).astype(np.int32)  # exact, as it has five decimals


def _maker(name: str) -> Callable[[Writer], Writer]:
    def register(write: Writer) -> Writer:
        MAKERS[name] = write
        return write

    return register


@_maker("xarray, netCDF-4")
def _(folder: Path) -> Written:
    """Packed, with a coordinate of dates and a dimension scale that is no variable."""
    with h5py.File(folder / "a.nc", "w") as file:
        time = file.create_dataset("time", data=np.rint(1e6 * TIME).astype(np.int64))
        time.attrs["units"] = "microseconds since 2026-03-03 12:00:00"
        time.make_scale("time")
        bare = file.create_dataset("bench", data=np.zeros(SAMPLES, ">f4"))
        bare.make_scale("This is a netCDF dimension but not a netCDF variable.       600")
        for name, unit, values in (("voltage", "V", VOLTAGE), ("displacement", "um", COUNTS)):
            data = file.create_dataset(name, data=values)
            data.dims[0].attach_scale(time)
            data.attrs["units"] = unit
        data.attrs["scale_factor"], data.attrs["_FillValue"] = 1e-5, np.int32(-(2**31))
    return Written(folder / "a.nc")


@_maker("netCDF-3 of SciPy, packed")
def _(folder: Path) -> Written:
    with scipy.io.netcdf_file(folder / "a.nc", "w") as file:
        file.createDimension("time", SAMPLES)
        columns = zip(UNITS.items(), (*COLUMNS[:2], COUNTS), strict=True)
        for (name, unit), values in columns:
            data = file.createVariable(name, values.dtype.newbyteorder("="), ("time",))
            data[:] = values
            data.units = unit
        data.scale_factor = np.float64(1e-5)
    return Written(folder / "a.nc")


@_maker("netCDF, channels along a dimension with names")
def _(folder: Path) -> Written:
    with scipy.io.netcdf_file(folder / "a.nc", "w", version=2) as file:
        for name, size in (("time", SAMPLES), ("channel", 2), ("letters", 16)):
            file.createDimension(name, size)
        words = np.array(["voltage_V".ljust(16), "displacement_um".ljust(16)], "S16")
        file.createVariable("channel", "c", ("channel", "letters"))[:] = words.view("S1").reshape(
            2, 16
        )
        file.createVariable("data", "f8", ("time", "channel"))[:] = np.stack(COLUMNS[1:], axis=1)
        time = file.createVariable("time", "f8", ("time",))
        time[:], time.units = TIME, "s"
    return Written(folder / "a.nc")


@_maker("vibrometer, HDF5 with channels in an attribute")
def _(folder: Path) -> Written:
    with h5py.File(folder / "a.h5", "w") as file:
        data = file.create_dataset("scan/data", data=np.stack(COLUMNS, axis=1).astype("f8"))
        data.attrs["channels"] = ["Time", "Ref1 Voltage", "Vib Displacement"]
        data.attrs["units"] = ["s", "V", "um"]
    columns = {"voltage": "Ref1 Voltage", "displacement": "Vib Displacement"}
    return Written(folder / "a.h5", columns)


@_maker("HDF5 table with an array in each row")
def _(folder: Path) -> Written:
    rows = np.zeros(SAMPLES, dtype=[("t_s", "f8"), ("adc", "f8", (2,))])
    rows["t_s"], rows["adc"] = TIME, np.stack(COLUMNS[1:], axis=1)
    with h5py.File(folder / "a.h5", "w") as file:
        file["log"] = rows
    columns = {"voltage": "log.adc[1]", "displacement": "log.adc[2]"}
    return Written(folder / "a.h5", columns, {"voltage": "V", "displacement": "um"})


def _pandas(folder: Path, kind: str) -> tuple[h5py.File, h5py.Group]:
    file = h5py.File(folder / "a.h5", "w")
    frame = file.create_group("record")
    frame.attrs["pandas_type"] = np.bytes_(kind)
    return file, frame


NAMES = ("time_s", "voltage_V", "displacement_um")


def _tektronix(folder: Path, columns: list[Any], names: str, units: str) -> Path:
    head = [
        *("Model,MSO44", "Firmware Version,1.2.3", "Horizontal Units,s", "Horizontal Scale,0.4"),
        *(f"Sample Interval,{INTERVAL}", f"Record Length,{SAMPLES}", "Gating,0.0% to 100.0%"),
        *("Probe Attenuation,10,1", f"Vertical Units,{units}", "Vertical Offset,0,0", ","),
        *("Label,Monitor,Sensor", names),
    ]
    rows = [",".join(f"{value:.6f}" for value in row) for row in zip(*columns, strict=True)]
    (folder / "a.csv").write_text("\n".join([*head, *rows, ""]))
    return folder / "a.csv"


@_maker("oscilloscope, units and rate above the header")
def _(folder: Path) -> Written:
    path = _tektronix(folder, COLUMNS, "TIME,CH1,CH2", "V,um")
    return Written(path, {"voltage": "CH1", "displacement": "CH2"})


@_maker("oscilloscope, rate above the header in place of times")
def _(folder: Path) -> Written:
    path = _tektronix(folder, COLUMNS[1:], "CH1,CH2", "V,um")
    return Written(path, {"voltage": "CH1", "displacement": "CH2"})


@_maker("pandas to HDF5, fixed")
def _(folder: Path) -> Written:
    file, frame = _pandas(folder, "frame")
    with file:
        words = np.array(NAMES, "S15")
        frame["axis0"], frame["axis1"], frame["block0_items"] = words, np.arange(SAMPLES), words
        frame["block0_values"] = np.stack(COLUMNS, axis=1)
    return Written(folder / "a.h5")


@_maker("pandas to HDF5, table")
def _(folder: Path) -> Written:
    file, frame = _pandas(folder, "frame_table")
    rows = np.zeros(SAMPLES, dtype=[("index", "i8"), ("values_block_0", "f8", (3,))])
    rows["index"], rows["values_block_0"] = np.arange(SAMPLES), np.stack(COLUMNS, axis=1)
    with file:
        frame["table"] = rows
        listed = "(lp0\n" + "".join(f"{'a' * (i > 0)}V{n}\np{i + 1}\n" for i, n in enumerate(NAMES))
        frame["table"].attrs["values_block_0_kind"] = np.bytes_(f"{listed}a.")
    return Written(folder / "a.h5")


@_maker("MATLAB, structs of time series")
def _(folder: Path) -> Written:
    """As ``struct(ts)`` saves them, each with the same times."""
    variables: dict[str, Any] = {
        name: {
            **{"Name": name, "Time": TIME[:, None], "Data": values[:, None]},
            "DataInfo": {"Units": unit},
            "TimeInfo": {"Units": "seconds"},
        }
        for name, unit, values in (("drive", "V", VOLTAGE), ("stage", "um", DISPLACEMENT))
    }
    scipy.io.savemat(folder / "a.mat", variables)
    columns = {"voltage": "drive.Data", "displacement": "stage.Data"}
    return Written(folder / "a.mat", columns)


@_maker("Simulink, structure with time")
def _(folder: Path) -> Written:
    signals = {"values": np.stack(COLUMNS[1:], axis=1), "dimensions": 2.0, "label": "u, y"}
    variables: dict[str, Any] = {"out": {"time": TIME[:, None], "signals": signals}}
    scipy.io.savemat(folder / "a.mat", variables)
    columns = {"voltage": "out.signals.values[1]", "displacement": "out.signals.values[2]"}
    return Written(folder / "a.mat", columns, UNITS)


@_maker("FlexLogger, TDMS groups")
def _(folder: Path) -> Written:
    from nptdms import ChannelObject, GroupObject, RootObject, TdmsWriter  # noqa: PLC0415

    start = np.datetime64("2026-03-03T12:00:00.123456", "us")
    wave = {"wf_increment": INTERVAL, "wf_start_offset": 0.0, "wf_start_time": start}
    group = "cDAQ1Mod1"
    with TdmsWriter(folder / "a.tdms") as writer:
        for rows in (slice(0, 400), slice(400, SAMPLES)):
            channels = [
                ChannelObject(group, name, values[rows], wave | {"unit_string": unit})
                for name, unit, values in (
                    ("Amplifier Monitor", "V", VOLTAGE),
                    ("Stage Position", "um", DISPLACEMENT),
                )
            ]
            root = RootObject({"Name": "Test 12", "Operator": "bench"})
            writer.write_segment([root, GroupObject(group, {"Rate": 200.0}), *channels])
    columns = {"voltage": "Amplifier Monitor", "displacement": "Stage Position"}
    return Written(folder / "a.tdms", columns)


@_maker("npz with a table")
def _(folder: Path) -> Written:
    rows = np.zeros(SAMPLES, dtype=[("t_ms", "f8"), ("u_V", "f8"), ("x_nm", "f8")])
    rows["t_ms"], rows["u_V"], rows["x_nm"] = 1e3 * TIME, VOLTAGE, 1e3 * DISPLACEMENT
    np.savez_compressed(folder / "a.npz", log=rows, gains=np.eye(3), note=np.array("bench"))
    return Written(folder / "a.npz")


@_maker("LibreOffice workbook")
def _(folder: Path) -> Written:
    """With shared words, durations by their style, formulas' values, and styled empty rows."""
    words = ["Time", "Voltage [V]", "Position [um]"]
    strings = "".join(f'<si><t xml:space="preserve">{word}</t></si>' for word in words)
    rows = [
        '<row r="1">'
        + "".join(f'<c r="{c}1" s="0" t="s"><v>{i}</v></c>' for i, c in enumerate("ABC"))
        + "</row>"
    ]
    for i, (t, v, d) in enumerate(zip(*COLUMNS, strict=True), start=2):
        formula = f'<f aca="false">B{i}*1</f>' if i % 2 else ""
        rows.append(
            f'<row r="{i}"><c r="A{i}" s="1"><v>{t / 86400:.15g}</v></c>'
            f'<c r="B{i}" s="0" t="n">{formula}<v>{v}</v></c><c r="C{i}" s="0"><v>{d}</v></c>'
            "</row>"
        )
    rows += [f'<row r="{i}"><c r="A{i}" s="1"/></row>' for i in range(SAMPLES + 2, SAMPLES + 40)]
    main = 'xmlns="http://schemas.openxmlformats.org/spreadsheetml/2006/main"'
    office = "http://schemas.openxmlformats.org/officeDocument/2006/relationships"
    package = "http://schemas.openxmlformats.org/package/2006"
    kind = "application/vnd.openxmlformats-officedocument.spreadsheetml"
    parts = {
        "[Content_Types].xml": f'<Types xmlns="{package}/content-types">'
        '<Default Extension="rels" ContentType="application/vnd.openxmlformats-package.'
        'relationships+xml"/><Default Extension="xml" ContentType="application/xml"/>'
        f'<Override PartName="/xl/workbook.xml" ContentType="{kind}.sheet.main+xml"/>'
        f'<Override PartName="/xl/worksheets/sheet1.xml" ContentType="{kind}.worksheet+xml"/>'
        f'<Override PartName="/xl/sharedStrings.xml" ContentType="{kind}.sharedStrings+xml"/>'
        f'<Override PartName="/xl/styles.xml" ContentType="{kind}.styles+xml"/></Types>',
        "_rels/.rels": f'<Relationships xmlns="{package}/relationships"><Relationship Id="rId1" '
        f'Type="{office}/officeDocument" Target="xl/workbook.xml"/></Relationships>',
        "xl/_rels/workbook.xml.rels": f'<Relationships xmlns="{package}/relationships">'
        f'<Relationship Id="rId1" Type="{office}/styles" Target="styles.xml"/>'
        f'<Relationship Id="rId2" Type="{office}/worksheet" Target="worksheets/sheet1.xml"/>'
        f'<Relationship Id="rId3" Type="{office}/sharedStrings" Target="sharedStrings.xml"/>'
        "</Relationships>",
        "xl/workbook.xml": f'<workbook {main} xmlns:r="{office}"><sheets>'
        '<sheet name="Messung" sheetId="1" state="visible" r:id="rId2"/></sheets></workbook>',
        "xl/sharedStrings.xml": f"<sst {main}>{strings}</sst>",
        "xl/styles.xml": f'<styleSheet {main}><numFmts count="1"><numFmt numFmtId="165" '
        'formatCode="[HH]:MM:SS.00"/></numFmts><cellXfs count="2"><xf numFmtId="0"/>'
        '<xf numFmtId="165"/></cellXfs></styleSheet>',
        "xl/worksheets/sheet1.xml": f"<worksheet {main}><sheetData>{''.join(rows)}</sheetData>"
        "</worksheet>",
    }
    with ZipFile(folder / "a.xlsx", "w") as archive:
        for name, text in parts.items():
            archive.writestr(name, f'<?xml version="1.0" encoding="UTF-8"?>\n{text}')
    return Written(folder / "a.xlsx")


def _lines(path: Path, head: list[str], rows: Any) -> Path:
    path.write_text("\n".join([*head, *rows, ""]), encoding="utf-8")
    return path


@_maker("Keysight BenchLink, milliseconds behind a colon")
def _(folder: Path) -> Written:
    stamps = np.datetime64("2026-12-03T14:05:58", "us") + np.rint(1e6 * TIME).astype("m8[us]")
    texts = [f"{t:%m/%d/%Y %H:%M:%S}:{t.microsecond // 1000:03d}" for t in stamps.tolist()]
    rows = enumerate(zip(texts, VOLTAGE, DISPLACEMENT, strict=True), start=1)
    cells = [f"{i},{t},{v:+.8E},0,{d:+.8E},0" for i, (t, v, d) in rows]
    head = ["Scan,Time,101 <HV> (VDC),Alarm 101,102 <Gauge> (VDC),Alarm 102"]
    columns = {"voltage": "101 <HV> (VDC)", "displacement": "102 <Gauge> (VDC)"}
    return Written(_lines(folder / "a.csv", head, cells), columns, {"voltage": "V"} | MICRONS)


@_maker("a table drawn with bars and dashes")
def _(folder: Path) -> Written:
    rows = [f"| {t:.3f} | {v:.4f} | {d:.5f} |" for t, v, d in zip(*COLUMNS, strict=True)]
    head = ["| t (s) | U (V) | x (um) |", "|-------|------:|:------:|"]
    return Written(_lines(folder / "a.md", head, rows))


@_maker("spreadsheet, French, blanks between thousands and typeset minus signs")
def _(folder: Path) -> Written:
    def number(value: float) -> str:
        return f"{value:,.2f}".replace(",", " ").replace(".", ",").replace("-", "\u2212")

    rows = [
        f"{t:.3f};{number(1e3 * v)};{number(1e3 * d)}".replace(".", ",")
        for t, v, d in zip(*COLUMNS, strict=True)
    ]
    return Written(_lines(folder / "a.csv", ["temps [s];tension [mV];position [nm]"], rows))


@_maker("NumPy, dates")
def _(folder: Path) -> Written:
    stamps = np.datetime64("2026-03-03", "us") + np.rint(1e6 * TIME).astype("m8[us]")
    np.savez(folder / "a.npz", time=stamps, voltage_V=VOLTAGE, displacement_um=DISPLACEMENT)
    return Written(folder / "a.npz")


def _table(path: Path, head: str, *columns: Any, separator: str = "\t", end: str = "") -> Path:
    rows = (separator.join(f"{value:.6f}" for value in row) for row in zip(*columns, strict=True))
    path.write_text("\n".join([head, *rows, end]), encoding="utf-8")
    return path


@_maker("ferroelectric tester, electrodes of either polarity")
def _(folder: Path) -> Written:
    head = (
        "Result\nHysteresis Amplitude [V]: 60\nTable 1\nTime [s]\tV+ [V]\tV- [V]\tI1 [A]\tD1 [nm]"
    )
    columns = TIME, VOLTAGE, -VOLTAGE, np.cos(TIME), 1e3 * DISPLACEMENT
    return Written(_table(folder / "a.dat", head, *columns), {"voltage": "V+ [V]"})


@_maker("catman, channels and devices below the names")
def _(folder: Path) -> Written:
    head = (
        "HBM_CATMAN_DATAFILE\nVersion:\t5.2\n\n"
        '"Zeit 1 [s]"\t"U_Piezo [V]"\t"Weg 1 [µm]"\n"CH=1"\t"CH=2"\t"CH=3"\n"Auto"\t"MX"\t"MX"'
    )
    return Written(_table(folder / "a.txt", head, *COLUMNS))


@_maker("Igor, waves as text")
def _(folder: Path) -> Written:
    head = "IGOR\nWAVES/D t_s, voltage_V, pos_nm\nBEGIN"
    columns = np.full(SAMPLES, ""), TIME, VOLTAGE, 1e3 * DISPLACEMENT
    rows = ("\t".join(map(str, row)) for row in zip(*columns, strict=True))
    end = 'END\nX SetScale/P x 0,0.005,"s", voltage_V\n'
    (folder / "a.itx").write_text("\n".join([head, *rows, end]))
    return Written(folder / "a.itx")


@_maker("potentiostat, voltages against a reference")
def _(folder: Path) -> Written:
    head = "EXPLAIN\nCURVE\tTABLE\t600\nPt\tT\tVf\tIm\tPos\n#\ts\tV vs. Ref.\tA\tum"
    path = _table(folder / "a.dta", head, np.arange(SAMPLES), *COLUMNS[:2], TIME**2, DISPLACEMENT)
    return Written(path, {"voltage": "Vf"})


@_maker("controller's scope, a clock beside each channel and settings above")
def _(folder: Path) -> Written:
    head = "Name\tU\tName\tPos\nSampleTime[ms]\t5\tSampleTime[ms]\t5\nUnit\tV\tUnit\tum\n"
    path = _table(folder / "a.csv", head, 1e3 * TIME, VOLTAGE, 1e3 * TIME, DISPLACEMENT)
    columns = {"time": "1", "voltage": "2", "displacement": "4"}
    return Written(path, columns, {"time": "ms", "voltage": "V", "displacement": "um"})


@_maker("oscilloscope, units behind a preposition")
def _(folder: Path) -> Written:
    path = _table(folder / "a.csv", '"in s","CH1 in V","CH2 in V"', *COLUMNS, separator=",")
    return Written(path, {"voltage": "CH1 in V", "displacement": "CH2 in V"}, MICRONS)


@_maker("oscilloscope, settings in columns of their own")
def _(folder: Path) -> Written:
    rows = [f",,,{t:.6f},{v:.6f},{x:.6f}" for t, v, x in zip(*COLUMNS, strict=True)]
    settings = {"Record Length": 600, "Sample Interval": 0.005, "Trigger Point": 1, "Source": "CH1"}
    for row, (name, value) in enumerate(settings.items()):
        rows[row] = f"{name},{value}{rows[row][1:]}"
    (folder / "a.csv").write_text("\n".join([*rows, ""]))
    return Written(folder / "a.csv", dict(zip(UNITS, "456", strict=True)), UNITS)


@_maker("recorder, settings above fields that begin with a separator")
def _(folder: Path) -> Written:
    head = '"Model","DL850"\n"TraceName","CH1","CH2"\n"BlockSize",600,600\n"SampleRate",200,200\n'
    rows = [f",{v:.5f},{x:.5f}," for v, x in zip(*COLUMNS[1:], strict=True)]
    text = "\n".join([f'{head}"HResolution",5.0e-03,5.0e-03\n"HOffset",0.0,0.0\n', *rows, ""])
    (folder / "a.csv").write_text(text)
    columns = {"voltage": "2", "displacement": "3"}
    return Written(folder / "a.csv", columns, {"voltage": "V", "displacement": "um"}, 200.0)
