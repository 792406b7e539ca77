"""Read and write records: text of any kind, HDF5, netCDF, MATLAB, NumPy and LabVIEW files.

The content of a file tells its format, not its suffix. Records are written by the suffix: ``.csv``,
``.txt``, ``.h5``, ``.hdf5``, ``.mat``. The noise-free displacement of a simulated record travels
with it: in a second text file ``NAME.truth.csv`` beside ``NAME.csv``, or as ``truth_um`` inside the
binary formats.
"""

from __future__ import annotations

import gzip
import os
import re
from codecs import BOM_UTF8
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from pathlib import Path
from pkgutil import resolve_name
from typing import NamedTuple
from zipfile import BadZipFile, ZipFile

import h5py
import numpy as np

from bwbayes.arrays import FloatArray
from bwbayes.errors import InputError, refuse_unwritable
from bwbayes.model.inputs import VoltageIs, require_voltage_is
from bwbayes.record.io.binary import (
    MatVersion,
    read_hdf5,
    read_mat,
    write_hdf5,
    write_mat,
)
from bwbayes.record.io.columns import ColumnTable, Naming, select
from bwbayes.record.io.fields import record_fields, reference_fields, select_pair
from bwbayes.record.io.recognition import QUANTITIES
from bwbayes.record.io.series import Source, damaged, read_numpy
from bwbayes.record.record import Record

_TEXT = (".csv", ".txt")
_BINARY = (".h5", ".hdf5", ".mat")


class Format(NamedTuple):
    """A file format: the first bytes of its content, the suffix of its names, and its reader.

    A byte order mark of UTF-8 before them does not count. The reader goes by its import path,
    ``module:function``, and is loaded when it is needed.
    """

    mark: bytes
    suffix: str
    reader: str


# One line for each format. `_reader` recognizes HDF5, archives and text, which have no fixed start.
FORMATS = (
    Format(b"\x93NUMPY", ".npy", "bwbayes.record.io.series:read_numpy"),
    Format(b"MATLAB", ".mat", "bwbayes.record.io.binary:read_mat"),
    Format(b"TDSm", ".tdms", "bwbayes.record.io.binary:read_tdms"),
    Format(b"CDF", ".nc", "bwbayes.record.io.binary:read_netcdf"),
)
# Suffixes of the files that are taken as records in a folder.
SUFFIXES = (
    *(*_TEXT, ".h5", ".hdf5", ".npz", ".lvm", ".xlsx", ".gz"),
    *(each.suffix for each in FORMATS),
)


def read_record(
    path: str | Path,
    *,
    voltage_is: VoltageIs | None = None,
    need_displacement: bool = True,
    columns: Mapping[str, str | int] | None = None,
    units: Mapping[str, str] | None = None,
    fs: float | None = None,
    table: int | str | None = None,
    displacement_file: str | Path | None = None,
    covariates: Mapping[str, str] | Sequence[str] | None = None,
    input: str | None = None,
    output: str | None = None,
    linearity: str | None = None,
) -> Record:
    """Read and check a record.

    Parameters
    ----------
    path : path
        Text of any layout, packed by gzip or not, HDF5, MATLAB, NumPy's arrays, LabVIEW's LVM or
        TDMS; the content says which. Columns may carry their units in their names, `time_s`,
        `voltage_V`, `displacement_um` or with other SI prefixes. Other names are recognized where
        they can mean nothing else: ``t [ms]``, ``U_mV``, ``pos (nm)``. Times that are not uniform
        are moved to the nearest uniform ones.
    voltage_is : "command", "output" or None
        Overrides what the file says about its voltage; a file that says nothing means "output".
    need_displacement : bool
        False also accepts a planned voltage without a displacement.
    columns : dict
        The column of time, voltage or displacement: a name, or a number from 1 on. A name may be
        the end of a path in the file: ``{"time": "t [ms]", "voltage": "U_mV", "displacement": 3}``.
    units : dict
        A column's unit, if the file does not state it: nm; -nm turns the sign; '0.35 um' is a
        sensor's sensitivity, '0.35 +- 0.004 um' or '0.35 um +- 1.2 %' one with its standard
        uncertainty. Units are given by quantity, ``{"displacement": "nm"}``; a sensitivity is the
        displacement for 1 in the column.
    fs : float
        Sampling rate, Hz, in place of a time column.
    table : int or str
        One of several tables: number or sheet. Numbers count from 1.
    displacement_file : path
        The file with the displacement, if the record's has the voltage alone.
    covariates : dict or list
        Further columns that a model may use, by name: temperature_degC. A list holds the names of
        columns in the file.
    input : str
        Input quantity, if it is not a voltage: 'H (A/m)'. Its column is converted to that unit;
        columns and units may be given for "input" and "output", or by the quantities' own names.
    output : str
        Output quantity, if it is not a displacement: 'B (T)'.
    linearity : str
        The sensor's largest departure from a straight line, as a part of the range: '0.1 %'.

    Raises
    ------
    InputError
        For every problem, in one line: ``file:line: column: problem; what to do``, with
        ``sample N`` (counted from 0) for the line in formats that have none.

    Warns
    -----
    InputWarning
        If columns are ignored, a column is recognized by nothing but its unit, samples are missing,
        or times are not uniform.
    """
    naming = Naming.stated(
        columns=columns,
        units=units,
        fs=fs,
        table=table,
        displacement_file=displacement_file,
        covariates=covariates,
        input=input,
        output=output,
        linearity=linearity,
    )
    with naming.quantities.spoken():
        return read_named(Path(path), naming, voltage_is, need_displacement)


def read_named(
    file: Path | Source,
    naming: Naming,
    voltage_is: VoltageIs | None = None,
    need_displacement: bool = True,
) -> Record:
    """Read and check a record by a naming, as :func:`read_record`, with errors of any quantities.

    The ``file`` is a path, or the content of one.

    Raises InputError: for every problem, in one line.
    """
    if voltage_is is not None:
        require_voltage_is(voltage_is)
    needed = QUANTITIES if need_displacement else ("time", "voltage")
    table = read_table(file, naming, needed)
    record = Record(**record_fields(table, voltage_is, need_displacement))
    path = file.path if isinstance(file, Source) else file
    truth_path = _truth_path(path)
    if path.suffix.lower() not in _TEXT or not truth_path.exists():
        return record
    same = Naming(input=naming.input, output=naming.output)
    truth = Record(**record_fields(read_table(truth_path, same)))
    is_same = truth.samples == record.samples and np.allclose(
        truth.time, record.time, rtol=0.0, atol=0.01 * record.interval
    )
    if not is_same:
        problem = "time_s: not the times of the record; remove or replace the file"
        raise InputError(f"{truth_path}: {problem}")
    return replace(record, truth=truth.displacement)


def read_reference(file: Path | Source, naming: Naming) -> tuple[FloatArray, float]:
    """Read a reference displacement: its samples, um, and their interval, s.

    The file has the columns of a record, `time_s` and `displacement_um` or with other SI prefixes,
    or those of the ``naming``; a voltage in it does not count.

    Raises InputError: for every problem, in one line, as of :func:`read_record`.
    """
    return reference_fields(read_table(file, naming, ("time", "displacement")))


def read_table(
    file: Path | Source, naming: Naming, needed: Collection[str] = QUANTITIES
) -> ColumnTable:
    """Read the columns of a file that a record needs, with the naming that recognized them.

    Raises InputError: the file cannot be read, or a column that is needed is not known.
    """
    source = file if isinstance(file, Source) else read_source(file, naming.table)
    if naming.displacement_file is None:
        return select(source, naming, needed)
    displacement = read_source(naming.displacement_file, naming.table)
    return select_pair({"voltage": source, "displacement": displacement}, naming)


def read_source(path: Path, table: int | str | None = None) -> Source:
    """Return the series of a file of any format, or those of one ``table`` in it.

    Raises InputError: the file cannot be read.
    """
    if not path.exists():  # undo the escapes of `path_text` for bytes not UTF-8
        code = rb"\\x([0-9a-f]{2})"
        name = re.sub(code, lambda found: bytes.fromhex(found[1].decode()), os.fsencode(path))
        path = Path(os.fsdecode(name))
    if path.is_dir():
        raise InputError(f"{path}: is a directory; give the file in it")
    if not path.exists():
        raise InputError(f"{path}: does not exist; check the path")
    if not path.is_file():
        raise InputError(f"{path}: is not a regular file; give one")
    try:
        with path.open("rb") as file:
            begin = file.read(64)
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error}); check the file") from error
    try:
        if begin.startswith(b"\x1f\x8b"):
            _refuse_packed(path)
        return _reader(path, begin.removeprefix(BOM_UTF8), table)(path)
    except (InputError, Warning):
        raise
    except Exception as error:  # whatever a library raises of a damaged file
        raise damaged(path, error) from error


def _refuse_packed(path: Path) -> None:
    """Refuse a file packed by gzip with a format's mark inside: a format's reader unpacks none.

    Raises InputError: it has one.
    """
    with gzip.open(path) as file:
        begin = file.read(64).removeprefix(BOM_UTF8)
    for mark in (b"\x89HDF", b"PK\x03\x04", *(file_format.mark for file_format in FORMATS)):
        if begin.startswith(mark):
            raise InputError(f"{path}: packed by gzip, which only plain text may be; unpack it")


def _reader(path: Path, begin: bytes, table: int | str | None) -> Callable[[Path], Source]:
    """Return the reader of a file with this beginning.

    Raises InputError if the format is unknown.
    """
    if h5py.is_hdf5(path):  # MATLAB's of version 7.3 too
        return read_hdf5
    if begin.startswith(b"PK") and _is_npz(path):
        return read_numpy
    suffix = path.suffix.lower()
    if begin.startswith(b"PK") and suffix in (".xlsx", ".xlsm"):
        from bwbayes.record.io.text import read_workbook  # noqa: PLC0415  # pandas is slow to load

        return partial(read_workbook, table=table)
    if begin.startswith((b"PK", b"\xd0\xcf\x11\xe0")):
        raise InputError(f"{path}: a workbook or an archive; export it as CSV or .xlsx")
    for file_format in FORMATS:
        if begin.startswith(file_format.mark):
            read: Callable[[Path], Source] = resolve_name(file_format.reader)
            return read
    if suffix == ".mat":
        return read_mat
    if suffix in _BINARY:
        raise InputError(f"{path}: not an HDF5 file, or its beginning is lost; write it again")
    from bwbayes.record.io.text import read_text  # noqa: PLC0415  # pandas is slow to load

    return partial(read_text, table=table)


def _is_npz(path: Path) -> bool:
    """Tell whether a file is an archive of arrays alone."""
    try:
        with ZipFile(path) as archive:
            return all(name.endswith(".npy") for name in archive.namelist())
    except (BadZipFile, OSError, ValueError):
        return False


def write_record(record: Record, path: str | Path, *, mat_version: MatVersion = "5") -> None:
    """Write a record so that reading it gives the same numbers.

    An existing file is replaced at once or not at all. The truth goes beside a text file, and
    that of an earlier record is removed.

    Raises
    ------
    InputError
        If the suffix is unknown or the place cannot be written to.
    """
    path = Path(path)
    suffix = path.suffix.lower()
    if suffix not in (*_TEXT, *_BINARY):
        suffixes = ", ".join((*_TEXT, *_BINARY))
        raise InputError(f"{path}: unknown suffix {suffix!r}; use one of {suffixes}")
    files: dict[Path, Record] = {path: record}
    write: Callable[[Record, Path], None] = write_hdf5
    if suffix == ".mat":
        write = partial(write_mat, version=mat_version)
    elif suffix in _TEXT:
        from bwbayes.record.io.text import write_text  # noqa: PLC0415  # pandas is slow to load

        write = write_text
        truth_path = _truth_path(path)
        truth_path.unlink(missing_ok=True)  # first, so that it never stands beside another record
        if record.truth is not None:
            files[truth_path] = replace(record, displacement=record.truth)
    for file, content in files.items():
        with refuse_unwritable(file), draft_of(file) as draft:
            write(content, draft)


def _truth_path(path: Path) -> Path:
    return path.with_suffix(f".truth{path.suffix}")


@contextmanager
def draft_of(path: Path) -> Iterator[Path]:
    """Give a draft file to write, which replaces the file in one step once it is whole."""
    draft = path.with_name(f".{path.name}.{os.getpid()}.part")
    try:
        yield draft
        with draft.open("rb") as file:
            os.fsync(file.fileno())
        draft.replace(path)
    finally:
        draft.unlink(missing_ok=True)
