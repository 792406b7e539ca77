"""Files of other formats than text, as :mod:`tests.record.instruments` has these, added to them."""

import re
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any
from zipfile import ZipFile

import h5py
import numpy as np
import pandas as pd
import scipy.io
from nptdms import ChannelObject, GroupObject, RootObject, TdmsWriter
from openpyxl import Workbook

from tests.record.instruments import (
    BOTH,
    COLUMNS,
    DISPLACEMENT,
    INTERVAL,
    MICRONS,
    SAMPLES,
    TEXTS,
    TIME,
    UNITS,
    VOLTAGE,
    Writer,
    Written,
    named,
)

COUNTS = np.rint(DISPLACEMENT / 1e-5).astype(np.int32)  # exact, as it has five decimals
NAMES = ("time_s", "voltage_V", "displacement_um")
INSTRUMENTS: dict[str, Writer] = dict(TEXTS)
PAIR = np.stack(COLUMNS[1:], axis=1)


def _maker(name: str) -> Callable[[Writer], Writer]:
    def register(write: Writer) -> Writer:
        INSTRUMENTS[name] = write
        return write

    return register


def _table(*fields: tuple[Any, ...]) -> Any:
    rows = np.zeros(SAMPLES, dtype=[(name, kind, *shape) for name, kind, _, *shape in fields])
    for name, _, values, *_ in fields:
        rows[name] = values
    return rows


def _tdms(folder: Path, channels: Mapping[str, Any], **properties: dict[str, Any]) -> Path:
    with TdmsWriter(folder / "a.tdms") as writer:
        writer.write_segment(
            [ChannelObject("Log", n, data, properties.get(n, {})) for n, data in channels.items()]
        )
    return folder / "a.tdms"


@_maker("TDMS waveforms")
def _(folder: Path) -> Written:
    wave = {"wf_increment": INTERVAL, "wf_start_offset": 0.0, "wf_samples": SAMPLES}
    units = {"Voltage": wave | {"unit_string": "V"}, "Position": wave | {"unit_string": "um"}}
    return Written(_tdms(folder, {"Voltage": VOLTAGE, "Position": DISPLACEMENT}, **units))


@_maker("TDMS with times")
def _(folder: Path) -> Written:
    path = _tdms(folder, {"Time (s)": TIME, "U_V": VOLTAGE, "laser": DISPLACEMENT})
    return Written(path, {"displacement": "laser"}, MICRONS)


@_maker("FlexLogger, TDMS groups")
def _(folder: Path) -> Written:
    start = np.datetime64("2026-03-03T12:00:00.123456", "us")
    wave = {"wf_increment": INTERVAL, "wf_start_offset": 0.0, "wf_start_time": start}
    group = "cDAQ1Mod1"
    monitor, position = wave | {"unit_string": "V"}, wave | {"unit_string": "um"}
    with TdmsWriter(folder / "a.tdms") as writer:
        for rows in (slice(0, 400), slice(400, SAMPLES)):
            writer.write_segment(
                [
                    RootObject({"Name": "Test 12", "Operator": "bench"}),
                    GroupObject(group, {"Rate": 200.0}),
                    ChannelObject(group, "Amplifier Monitor", VOLTAGE[rows], monitor),
                    ChannelObject(group, "Stage Position", DISPLACEMENT[rows], position),
                ]
            )
    return Written(folder / "a.tdms", named("Amplifier Monitor", "Stage Position"))


@_maker("Excel workbook, units in a second row")
def _(folder: Path) -> Written:
    book = Workbook()
    book.active.title = "Notes"
    book.active.append(["Bench 3", "piezo"])
    sheet = book.create_sheet("Run 1")
    sheet.append(["Measurement 7, loops"])
    sheet.merge_cells("A1:C1")
    sheet.append(["Time", "Voltage", "Displacement", "Remark"])
    for row in (["s", "V", "um"], *np.stack(COLUMNS, axis=1).tolist()):
        sheet.append(row)
    book.save(folder / "a.xlsx")
    return Written(folder / "a.xlsx")


@_maker("pandas to Excel, with dates")
def _(folder: Path) -> Written:
    moments = pd.Timestamp("2026-03-03T11:59:59") + pd.to_timedelta(TIME, unit="s")
    frame = pd.DataFrame({"Time": moments, "U [V]": VOLTAGE, "x [um]": DISPLACEMENT})
    frame.to_excel(folder / "a.xlsx", index=False)
    return Written(folder / "a.xlsx")


@_maker("LibreOffice workbook")
def _(folder: Path) -> Written:
    """With shared words, durations by their style, formulas' values, and styled empty rows."""
    book = Workbook()
    book.active.append(["Time", "Voltage [V]", "Position [um]"])
    for row in np.stack([TIME / 86400, *COLUMNS[1:]], axis=1).tolist():
        book.active.append(row)
    for number in range(2, SAMPLES + 40):
        book.active.cell(number, 1).number_format = "[HH]:MM:SS.00"
    book.save(folder / "written.xlsx")
    formula = rb'<c r="B\1"\2><f aca="false">B\1*1</f><v>'
    with ZipFile(folder / "written.xlsx") as plain, ZipFile(folder / "a.xlsx", "w") as archive:
        for name in plain.namelist():
            content = plain.read(name)
            if name == "xl/worksheets/sheet1.xml":
                content = re.sub(rb'<c r="B(\d*[13579])"([^>]*)><v>', formula, content)
                assert content.count(b"<f ") == SAMPLES // 2
            archive.writestr(name, content)
    return Written(folder / "a.xlsx")


def _mat(folder: Path, variables: dict[str, Any], *names: str, **units: str) -> Written:
    scipy.io.savemat(folder / "a.mat", variables)
    return Written(folder / "a.mat", named(*names), units)


@_maker("MATLAB struct of two axes")
def _(folder: Path) -> Written:
    axes = {"Ux": VOLTAGE, "Uy": 0 * VOLTAGE, "x": DISPLACEMENT, "y": 0.1 * VOLTAGE}
    variables = {"log": {"time": TIME} | axes, "operator": "bench"}
    return _mat(folder, variables, "log.Ux", "log.x", **UNITS)


@_maker("MATLAB struct array")
def _(folder: Path) -> Written:
    channels = np.zeros(2, dtype=[("Name", object), ("Data", object)])
    channels["Name"] = ["Model Root/u", "Model Root/y"]
    channels["Data"] = [VOLTAGE, DISPLACEMENT]
    variables = {"rec": {"X": {"Data": TIME}, "Y": channels}}
    return _mat(folder, variables, "rec.X.Data", "rec.Y(1).Data", "rec.Y(2).Data", **UNITS)


@_maker("MATLAB matrix")
def _(folder: Path) -> Written:
    variables = {"data": np.stack(COLUMNS, axis=1), "fs": 200.0}
    return _mat(folder, variables, "data[1]", "data[2]", "data[3]", **UNITS)


@_maker("MATLAB, structs of time series")
def _(folder: Path) -> Written:
    """As ``struct(ts)`` saves them, each with the same times."""
    variables: dict[str, Any] = {
        name: {
            **{"Name": name, "Time": TIME[:, None], "Data": values[:, None]},
            **{"DataInfo": {"Units": unit}, "TimeInfo": {"Units": "seconds"}},
        }
        for name, unit, values in (("drive", "V", VOLTAGE), ("stage", "um", DISPLACEMENT))
    }
    return _mat(folder, variables, "drive.Data", "stage.Data")


@_maker("Simulink, structure with time")
def _(folder: Path) -> Written:
    signals = {"values": PAIR, "dimensions": 2.0, "label": "u, y"}
    variables: dict[str, Any] = {"out": {"time": TIME[:, None], "signals": signals}}
    return _mat(folder, variables, "out.signals.values[1]", "out.signals.values[2]", **UNITS)


@_maker("MATLAB 7.3 struct")
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


def _hdf5(path: Path, content: Mapping[str, Any], **attributes: Mapping[str, Any]) -> Path:
    """Write datasets, and the attributes of all that have the same last name."""
    with h5py.File(path, "w") as file:
        file.update(content)
        for name in content:
            file[name].attrs.update(attributes.get(name.rpartition("/")[2], {}))
    return path


@_maker("HDF5 groups with units")
def _(folder: Path) -> Written:
    axes = {"hv_out": (VOLTAGE, "V"), "axis_x": (1e3 * DISPLACEMENT, "nm")}
    axes |= {"t": (1e3 * TIME, "ms"), "axis_y": (0 * DISPLACEMENT, "nm")}
    content = {
        f"measurement/run_00{i}/{n}": values for i in (1, 3) for n, (values, _) in axes.items()
    }
    path = _hdf5(folder / "a.h5", content, **{n: {"unit": unit} for n, (_, unit) in axes.items()})
    return Written(path, named("measurement/run_003/hv_out", "measurement/run_003/axis_x"))


@_maker("HDF5 table")
def _(folder: Path) -> Written:
    rows = _table(("t_s", "f8", TIME), ("u_V", "f4", VOLTAGE), ("pos_um", "f8", DISPLACEMENT))
    return Written(_hdf5(folder / "a.hdf5", {"log": rows}))


@_maker("HDF5 table with an array in each row")
def _(folder: Path) -> Written:
    rows = _table(("t_s", "f8", TIME), ("adc", "f8", PAIR, (2,)))
    path = _hdf5(folder / "a.h5", {"log": rows})
    return Written(path, named("log.adc[1]", "log.adc[2]"), BOTH)


@_maker("vibrometer, HDF5 with channels in an attribute")
def _(folder: Path) -> Written:
    channels, units = ["Time", "Ref1 Voltage", "Vib Displacement"], ["s", "V", "um"]
    data = {"scan/data": np.stack(COLUMNS, axis=1)}
    path = _hdf5(folder / "a.h5", data, data={"channels": channels, "units": units})
    return Written(path, named("Ref1 Voltage", "Vib Displacement"))


@_maker("pandas to HDF5, fixed")
def _(folder: Path) -> Written:
    words = np.array(NAMES, "S15")
    content = {"axis0": words, "axis1": np.arange(SAMPLES), "block0_items": words}
    content["block0_values"] = np.stack(COLUMNS, axis=1)
    path = _hdf5(folder / "a.h5", {f"record/{name}": values for name, values in content.items()})
    with h5py.File(path, "r+") as file:
        file["record"].attrs["pandas_type"] = np.bytes_("frame")
    return Written(path)


@_maker("pandas to HDF5, table")
def _(folder: Path) -> Written:
    values = np.stack(COLUMNS, axis=1)
    rows = _table(("index", "i8", np.arange(SAMPLES)), ("values_block_0", "f8", values, (3,)))
    listed = "(lp0\n" + "".join(f"{'a' * (i > 0)}V{n}\np{i + 1}\n" for i, n in enumerate(NAMES))
    kind = {"values_block_0_kind": np.bytes_(f"{listed}a.")}
    path = _hdf5(folder / "a.h5", {"record/table": rows}, table=kind)
    with h5py.File(path, "r+") as file:
        file["record"].attrs["pandas_type"] = np.bytes_("frame_table")
    return Written(path)


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
        for (name, unit), values in zip(UNITS.items(), (*COLUMNS[:2], COUNTS), strict=True):
            data = file.createVariable(name, values.dtype.newbyteorder("="), ("time",))
            data[:], data.units = values, unit
        data.scale_factor = np.float64(1e-5)
    return Written(folder / "a.nc")


@_maker("netCDF, channels along a dimension with names")
def _(folder: Path) -> Written:
    words = np.array(["voltage_V".ljust(16), "displacement_um".ljust(16)], "S16").view("S1")
    with scipy.io.netcdf_file(folder / "a.nc", "w", version=2) as file:
        for name, size in (("time", SAMPLES), ("channel", 2), ("letters", 16)):
            file.createDimension(name, size)
        file.createVariable("channel", "c", ("channel", "letters"))[:] = words.reshape(2, 16)
        file.createVariable("data", "f8", ("time", "channel"))[:] = PAIR
        time = file.createVariable("time", "f8", ("time",))
        time[:], time.units = TIME, "s"
    return Written(folder / "a.nc")


@_maker("npz with a table")
def _(folder: Path) -> Written:
    rows = _table(
        ("t_ms", "f8", 1e3 * TIME), ("u_V", "f8", VOLTAGE), ("x_nm", "f8", 1e3 * COLUMNS[2])
    )
    np.savez_compressed(folder / "a.npz", log=rows, gains=np.eye(3), note=np.array("bench"))
    return Written(folder / "a.npz")


@_maker("NumPy, dates")
def _(folder: Path) -> Written:
    stamps = np.datetime64("2026-03-03", "us") + np.rint(1e6 * TIME).astype("m8[us]")
    np.savez(folder / "a.npz", time=stamps, voltage_V=VOLTAGE, displacement_um=DISPLACEMENT)
    return Written(folder / "a.npz")
