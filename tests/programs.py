"""Programs that some tests need and pip does not install: a browser, a C compiler.

``needs("chromium")`` returns the program's path, or skips the test with a reason. Where the
variable ``BWBAYES_PROGRAMS`` is ``required``, as in ``.ci/run``, the test fails instead, so that
none is left out unnoticed.

``python3 tests/programs.py`` prints the Debian packages of those that are missing here.
"""

import os
import shutil
from dataclasses import dataclass

VARIABLE = "BWBAYES_PROGRAMS"
REQUIRED = "required"


@dataclass(frozen=True)
class Program:
    """Names that the program may have, and the Debian packages with it."""

    names: tuple[str, ...]
    packages: tuple[str, ...]


PROGRAMS = {
    "chromium": Program(
        ("chromium", "chromium-browser", "google-chrome"), ("chromium", "fonts-dejavu-core")
    ),
    "cc": Program(("cc", "gcc"), ("gcc", "libc6-dev")),
}


def path(program: str) -> str | None:
    """Return the program's path, or None where it is missing."""
    return next(filter(None, map(shutil.which, PROGRAMS[program].names)), None)


def needs(program: str) -> str:
    """Return the program's path; without it, skip the test, or fail it where it is required."""
    import pytest  # noqa: PLC0415  # printing the packages does without

    here = path(program)
    if here is None:
        packages = " ".join(PROGRAMS[program].packages)
        reason = f"{program} is not installed; on Debian: apt-get install {packages}"
        if os.environ.get(VARIABLE) == REQUIRED:
            pytest.fail(f"{reason} ({VARIABLE}={REQUIRED})")
        pytest.skip(reason)
    return here


def missing() -> list[str]:
    """Return the Debian packages of all programs that are missing."""
    return [
        package
        for name, program in PROGRAMS.items()
        if path(name) is None
        for package in program.packages
    ]


if __name__ == "__main__":
    print(*missing())
