"""Whole files for mutations to begin with: good ones in every format, and ones of odd arrays."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from io import BytesIO
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import h5py
import numpy as np
import scipy.io

from bwbayes.record import read_record, write_record
from tests.app.oddities import GOOD, ROWS

__all__ = ["chosen", "few", "good_arrays", "made", "odd_arrays"]

Generator = np.random.Generator


def chosen(generator: Generator, among: Any) -> Any:
    """Choose one of a sequence."""
    return among[int(generator.integers(len(among)))]


def few(generator: Generator) -> int:
    """Return how often to spoil one thing: once, mostly."""
    return int(generator.choice([1, 1, 1, 2, 4]))


@cache
def made() -> dict[str, bytes]:
    """Return a good record in every format, as this package and as others write it."""
    files = {"csv": "\n".join([*GOOD, ""]).encode()}
    with TemporaryDirectory() as folder:
        path = Path(folder) / "record.csv"
        path.write_bytes(files["csv"])
        record = read_record(path)
        for suffix in ("h5", "mat"):
            write_record(record, path.with_suffix(f".{suffix}"))
            files[suffix] = path.with_suffix(f".{suffix}").read_bytes()
        write_record(record, path.with_suffix(".mat"), mat_version="7.3")
        files["mat-7.3"] = path.with_suffix(".mat").read_bytes()
    arrays = good_arrays()
    files["h5-other"] = stored(arrays | {"@origin": "a bench"}, "h5", None)
    files["mat-other"] = stored(arrays, "mat", None)
    return files


def good_arrays() -> dict[str, Any]:
    values = np.array([[float(cell) for cell in row.split(",")] for row in ROWS])
    return dict(zip(("time_s", "voltage_V", "displacement_um"), values.T, strict=True))


def stored(arrays: dict[str, Any], suffix: str, generator: Generator | None) -> bytes:
    """Return the bytes of a file of arrays, made by h5py or SciPy alone."""
    buffer = BytesIO()
    if suffix == "mat":
        scipy.io.savemat(buffer, arrays, do_compression=generator is not None)
        return buffer.getvalue()
    with h5py.File(buffer, "w", userblock_size=512 if suffix == "mat-7.3" else 0) as file:
        for name, values in arrays.items():
            if name.startswith("@"):
                file.attrs[name[1:]] = values
            elif callable(values):
                values(file, name)
            else:
                file[name] = values
    return buffer.getvalue()


def odd_arrays(suffix: str) -> Callable[[bytes, Generator], bytes]:
    """Return a maker of files in which an array or a note, or some, belong in no record."""

    def make(good: bytes, generator: Generator) -> bytes:
        del good
        arrays = good_arrays()
        for _ in range(few(generator)):
            name, values = chosen(generator, [*arrays.items()])
            if suffix != "mat" and generator.random() < 0.3:
                arrays[name] = chosen(generator, ODD_OBJECTS)
            elif isinstance(values, np.ndarray) and values.dtype.kind in "iuf":
                with np.errstate(all="ignore"):
                    arrays[name] = chosen(generator, ODD_ARRAYS)(values, generator)
        if generator.random() < 0.3:
            prefix = "@" if suffix == "h5" else ""
            note = chosen(generator, ("voltage_is", "origin", "interval_s"))
            arrays[prefix + note] = chosen(generator, ODD_ARRAY_NOTES)
        return stored(arrays, suffix, generator)

    return make


def _odd_value(values: Any, generator: Generator) -> Any:
    changed = np.array(values, dtype=np.float64)
    odd = (np.nan, np.inf, -np.inf, 1e300, -0.0, 5e-324, 1e10, 0.0)
    changed.flat[int(generator.integers(max(changed.size, 1))) if changed.size else ...] = chosen(
        generator, odd
    )
    return changed


ODD_ARRAYS: tuple[Callable[[Any, Generator], Any], ...] = (
    _odd_value,
    lambda values, _: values[:, np.newaxis] if values.ndim == 1 else values,
    lambda values, _: values[::-1],
    lambda values, _: values[:0],
    lambda values, _: values[:7],
    lambda values, _: np.resize(values, (4, 10)),
    lambda values, _: np.resize(values, (2, 2, 10)),
    lambda values, _: np.float64(values.flat[0] if values.size else 0),
    lambda values, _: values.astype(np.float32),
    lambda values, _: values.astype(np.int8),
    lambda values, _: values.astype(np.uint64),
    lambda values, _: values.astype(">f8"),
    lambda values, _: values + 1j,
    lambda values, _: values > 0,
    lambda values, _: values * 1e-300,
    lambda values, _: values * 1e300,
    lambda values, _: np.full(values.shape, 3.0),
    lambda *_: "text instead",
)


ODD_ARRAY_NOTES = ("output", "x" * 999, "<b>[/red]\x1b", 1.0, np.nan, np.zeros(0), [[1, 2]])

# What HDF5 can have in a dataset's place.
ODD_OBJECTS: tuple[Callable[[Any, str], Any], ...] = (
    lambda file, name: file.create_group(name),
    lambda file, name: file.__setitem__(name, h5py.SoftLink(f"/{name}")),
    lambda file, name: file.__setitem__(name, h5py.SoftLink("/nowhere")),
    lambda file, name: file.__setitem__(name, h5py.ExternalLink("/dev/zero", "/x")),
    lambda file, name: file.create_dataset(name, data=["a", "b"], dtype=h5py.string_dtype()),
    lambda file, name: file.create_dataset(name, data=np.zeros(40, [("a", "f8"), ("b", "i4")])),
    lambda file, name: file.create_dataset(name, data=h5py.Empty("f8")),
    lambda file, name: file.create_dataset(name, (40,), "f8", external=[("/dev/zero", 0, 320)]),
    lambda file, name: file.create_dataset(name, data=[file.ref] * 40, dtype=h5py.ref_dtype),
    lambda file, name: file.create_dataset(name, (10**13,), chunks=(1000,), dtype="f8"),
)
