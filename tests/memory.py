"""The largest memory of a process of its own."""

import subprocess
import sys

import pytest

on_linux = pytest.mark.skipif(sys.platform != "linux", reason="reads Linux's /proc")

# Not ru_maxrss, which a process takes over from the one that starts it.
LARGEST = """
from pathlib import Path
status = dict(line.split(":", 1) for line in Path("/proc/self/status").read_text().splitlines())
print(status["VmHWM"].split()[0])
"""


def peak(script: str, *arguments: object) -> int:
    done = subprocess.run(
        [sys.executable, "-c", script + LARGEST, *map(str, arguments)],
        stdout=subprocess.PIPE,
        text=True,
        check=True,
    )
    return 1024 * int(done.stdout.split()[-1])
