"""Programs that some tests need beside Python: a test is skipped where one is missing.

With ``BWBAYES_NEEDS_PROGRAMS`` in the environment a missing program is a failure instead, so that a
machine that should have them all cannot lose a test without a word.
"""

from __future__ import annotations

import os
import shutil

import pytest

__all__ = ["needs"]


def needs(program: str) -> str:
    """Return the path of a program, or skip the test that needs it."""
    path = shutil.which(program)
    if path is None:
        missing = f"{program} is not installed"
        if os.environ.get("BWBAYES_NEEDS_PROGRAMS"):
            pytest.fail(missing)
        pytest.skip(missing)
    return path
