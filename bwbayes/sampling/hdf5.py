"""What HDF5 leaves to those who use it: damaged files, and disks that are full.

HDF5 refuses a file whose end is missing, and waits without end for the writer of one that was
killed, if it is damaged too. :class:`Image` lets it read what is there. And it does not survive a
write that fails; :func:`reserve` asks for the room before.
"""

from __future__ import annotations

import errno
import os
from io import SEEK_END, SEEK_SET, FileIO
from pathlib import Path
from typing import Any

from numpy.typing import NDArray

__all__ = ["DAMAGE", "FULL", "Image", "either", "name_finished", "put", "reserve"]

# What reading a damaged file raises.
DAMAGE = (OSError, LookupError, ValueError, RuntimeError)

# Where a file says of which version it is, and in the newer ones how long.
VERSION, STORED_END = slice(8, 9), slice(28, 36)
NEW = (b"\2", b"\3")
LARGEST = 2**62

# What HDF5 adds to the numbers that are written, at most; in bytes.
OVERHEAD = 2**16

# No room left: on the disk, in the user's share of it, in what one file may have.
FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)


class Image(FileIO):
    """A file to be read by HDF5 even if its end was cut off."""

    def __init__(self, path: Path) -> None:
        super().__init__(path)
        head = self.read(STORED_END.stop)
        self._end = super().seek(0, SEEK_END)
        if head[VERSION] in NEW:
            self._end = max(self._end, min(int.from_bytes(head[STORED_END], "little"), LARGEST))

    def seek(self, offset: int, whence: int = SEEK_SET) -> int:
        """Move to a place; the end is where the file says that it should be."""
        return super().seek(self._end if whence == SEEK_END else offset)

    def readinto(self, buffer: Any) -> int:
        """Fill a buffer, or say that what should be there is missing."""
        view, done = memoryview(buffer), 0
        while done < len(view) and (more := super().readinto(view[done:])):
            done += more
        if done < len(view):
            raise OSError("its end is missing")
        return done


def either(dataset: Any) -> Any:
    """Read what is written twice: the first copy that is whole."""
    try:
        return dataset[0]
    except DAMAGE:
        return dataset[1]


def put(dataset: Any, first: int, values: NDArray[Any]) -> None:
    """Write values (rows, ...) to the end of a dataset, from row ``first`` on."""
    dataset.resize(first + len(values), axis=0)
    dataset[first:] = values


def reserve(file: Any, size: int) -> None:
    """Take up room on the disk for ``size`` bytes more in an open file, if the system can.

    Raises
    ------
    OSError
        There is none, see ``FULL``; nothing was written.
    """
    if not hasattr(os, "posix_fallocate"):
        return
    end = file.id.get_filesize() + size + OVERHEAD
    try:
        os.posix_fallocate(file.id.get_vfd_handle(), 0, end)
    except OSError as error:
        # Anything else is a system or a disk that cannot reserve.
        if error.errno in FULL:
            raise


def name_finished(temporary: Path, path: Path) -> None:
    """Give a finished file its name, in one step, after it has reached the disk."""
    with temporary.open("rb") as file:
        os.fsync(file.fileno())
    temporary.replace(path)
