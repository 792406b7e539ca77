"""Read and write records by the file's suffix: ``.csv``, ``.txt``, ``.h5``, ``.hdf5``, ``.mat``.

The noise-free displacement of a simulated record travels with it: in a second text file
``NAME.truth.csv`` beside ``NAME.csv``, or as ``truth_um`` inside the binary formats.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np

from bwbayes.arrays import FloatArray
from bwbayes.data.io.checks import (
    Table,
    VoltageIs,
    checked,
    checked_reference,
    require_voltage_is,
)
from bwbayes.data.io.columns import Naming, say_guesses
from bwbayes.data.io.hdf5 import read_hdf5, write_hdf5
from bwbayes.data.io.matlab import MatVersion, read_mat, write_mat
from bwbayes.data.io.text import read_csv, write_csv
from bwbayes.data.record import Record
from bwbayes.errors import InputError

__all__ = ["SUFFIXES", "read_record", "read_reference", "read_table", "write_record"]

_TEXT = (".csv", ".txt")
_READERS: dict[str, Callable[[Path, Naming], Table]] = {
    ".csv": read_csv,
    ".txt": read_csv,
    ".h5": read_hdf5,
    ".hdf5": read_hdf5,
    ".mat": read_mat,
}
SUFFIXES = tuple(_READERS)


def read_record(
    path: str | Path,
    *,
    voltage_is: VoltageIs | None = None,
    need_displacement: bool = True,
    columns: Mapping[str, str] | None = None,
    units: Mapping[str, str] | None = None,
) -> Record:
    """Read and check a record.

    Parameters
    ----------
    path : path
        The suffix says the format. Columns carry their units in their names: `time_s`,
        `voltage_V`, `displacement_um`, or with other SI prefixes; time must be uniform. Other names
        are recognised where they can mean nothing else: ``t [ms]``, ``U_mV``, ``pos (nm)``.
    voltage_is : "command", "output" or None
        Overrides what the file says about its voltage; a file that says nothing means "output".
    need_displacement : bool
        False also accepts a planned voltage without a displacement.
    columns : dict
        Names of the columns in the file by quantity, where they are not to be recognised:
        ``{"time": "t [ms]", "voltage": "U_mV", "displacement": "pos"}``.
    units : dict
        Units by quantity, ``{"displacement": "nm"}``, where the names do not say them; ``"-nm"``
        turns the sign.

    Raises
    ------
    InputError
        For every problem, in one line: ``file:line: column: problem; what to do``, with
        ``sample N`` (counted from 0) for the line in formats that have none.

    Warns
    -----
    InputWarning
        If columns are ignored, a column is recognised by nothing but its unit, or a commanded
        voltage is held where samples are missing.
    """
    path = Path(path)
    if voltage_is is not None:
        require_voltage_is(voltage_is)
    naming = Naming(columns or {}, units or {})
    table = read_table(path, naming)
    say_guesses(str(path), naming, table.naming)
    record = Record(**checked(table, voltage_is=voltage_is, need_displacement=need_displacement))
    truth_path = _truth_path(path)
    if path.suffix.lower() in _TEXT and truth_path.exists():
        return _with_truth(record, truth_path)
    return record


def read_reference(path: str | Path) -> tuple[FloatArray, float]:
    """Read what a displacement is to be: its samples, um, and their interval, s.

    The file has the columns of a record, `time_s` and `displacement_um` or with other SI prefixes;
    a voltage in it does not count.

    Raises
    ------
    InputError
        For every problem, in one line, as of :func:`read_record`.
    """
    return checked_reference(read_table(Path(path), Naming()))


def read_table(path: str | Path, naming: Naming) -> Table:
    """Read a file's columns as they stand in it, with the naming that they were recognised by.

    Raises
    ------
    InputError
        The file cannot be read, or a column cannot be told.
    """
    path = Path(path)
    return _opened(path, lambda: _READERS[path.suffix.lower()](path, naming))


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
    suffix = _known_suffix(path)
    if suffix == ".mat":
        _write_whole(path, lambda part: write_mat(record, part, mat_version))
    elif suffix not in _TEXT:
        _write_whole(path, lambda part: write_hdf5(record, part))
    else:
        truth_path = _truth_path(path)
        truth_path.unlink(missing_ok=True)  # first, so that it never stands beside another record
        _write_whole(path, lambda part: write_csv(record, part))
        if record.truth is not None:
            truth = replace(record, displacement=record.truth)
            _write_whole(truth_path, lambda part: write_csv(truth, part))


def _known_suffix(path: Path) -> str:
    suffix = path.suffix.lower()
    if suffix not in _READERS:
        raise InputError(f"{path}: unknown suffix {suffix!r}; use one of {', '.join(_READERS)}")
    return suffix


def _opened[T](path: Path, read: Callable[[], T]) -> T:
    """Return what is read from a file, and say what keeps it from being opened."""
    try:
        if path.is_dir():
            raise InputError(f"{path}: is a directory; give the file in it")
        _known_suffix(path)
        if not path.exists():
            raise InputError(f"{path}: does not exist; check the path")
        if not path.is_file():
            raise InputError(f"{path}: is not a regular file; give one")
        with path.open("rb"):  # so that a file without permission says so in every format
            pass
        return read()
    except (OSError, ValueError) as error:
        if isinstance(error, InputError):
            raise
        raise InputError(f"{path}: cannot be read ({error}); check the file") from error


def _truth_path(path: Path) -> Path:
    return path.with_suffix(f".truth{path.suffix}")


def _with_truth(record: Record, path: Path) -> Record:
    truth = Record(**checked(read_table(path, Naming())))
    same = truth.samples == record.samples and np.allclose(
        truth.time, record.time, rtol=0.0, atol=0.01 * record.interval
    )
    if not same:
        raise InputError(f"{path}: time_s: not the times of the record; remove or replace the file")
    return replace(record, truth=truth.displacement)


def _write_whole(path: Path, write: Callable[[Path], None]) -> None:
    """Let `write` fill a temporary file beside `path`, then put it in place in one step."""
    part = path.with_name(f".{path.name}.{os.getpid()}.part")
    try:
        write(part)
        with part.open("rb") as file:
            os.fsync(file.fileno())
        part.replace(path)
    except OSError as error:
        raise InputError(f"{path}: cannot be written ({error}); choose another place") from error
    finally:
        part.unlink(missing_ok=True)
