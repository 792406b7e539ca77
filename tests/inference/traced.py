"""Stops a process before every single write that it asks the system for, and looks.

A file is seen as it would stay if the process were killed there. The process is traced as a
debugger does it, so no library it uses can write unseen.
"""

from __future__ import annotations

import ctypes
import os
import platform
import signal
from collections.abc import Callable

__all__ = ["WRITES", "stopped_before_every_write"]

# Numbers of the system calls that change files.
WRITES = {
    "x86_64": {
        1: "write",
        18: "pwrite64",
        77: "ftruncate",
        82: "rename",
        87: "unlink",
        264: "renameat",
        285: "fallocate",
        316: "renameat2",
    },
    "aarch64": {
        35: "unlinkat",
        38: "renameat",
        46: "ftruncate",
        47: "fallocate",
        64: "write",
        68: "pwrite64",
        276: "renameat2",
    },
}

TRACE_ME, CONTINUE_TO_CALL, SET_OPTIONS, GET_CALL = 0, 24, 0x4200, 0x420E
MARK_CALLS, KILL_WITH_TRACER = 0x01, 0x100000
ENTRY = 1
STOPPED_AT_CALL = signal.SIGTRAP | 0x80


class _Call(ctypes.Structure):
    """What the kernel tells of a system call that a process stopped at."""

    _fields_ = (
        ("op", ctypes.c_uint8),
        ("pad", ctypes.c_uint8 * 3),
        ("arch", ctypes.c_uint32),
        ("instruction", ctypes.c_uint64),
        ("stack", ctypes.c_uint64),
        ("number", ctypes.c_uint64),
        ("arguments", ctypes.c_uint64 * 6),
    )


def stopped_before_every_write(work: Callable[[], None], look: Callable[[str], None]) -> int:
    """Do the work in a process of its own, and look before each of its writes.

    Returns the exit status of the work; -1 where no process may be traced.
    """
    process = os.fork()
    if process == 0:
        if _trace(TRACE_ME, 0, 0, 0) != 0:
            os._exit(255)
        os.kill(os.getpid(), signal.SIGSTOP)
        work()
        os._exit(0)
    _, status = os.waitpid(process, 0)
    if os.WIFEXITED(status):
        return -1
    _trace(SET_OPTIONS, process, 0, MARK_CALLS | KILL_WITH_TRACER)
    names, delivered = WRITES[platform.machine()], 0
    while True:
        _trace(CONTINUE_TO_CALL, process, 0, delivered)
        _, status = os.waitpid(process, 0)
        if not os.WIFSTOPPED(status):
            return os.waitstatus_to_exitcode(status)
        delivered = 0
        if os.WSTOPSIG(status) != STOPPED_AT_CALL:
            delivered = os.WSTOPSIG(status)
            continue
        call = _Call()
        _trace(GET_CALL, process, ctypes.sizeof(call), ctypes.addressof(call))
        if call.op == ENTRY and call.number in names:
            look(names[call.number])


def _trace(request: int, process: int, address: int, data: int) -> int:
    library = ctypes.CDLL(None, use_errno=True)
    library.ptrace.restype = ctypes.c_long
    words = (ctypes.c_long(request), ctypes.c_long(process))
    result: int = library.ptrace(*words, ctypes.c_void_p(address), ctypes.c_void_p(data))
    return result
