"""What all tests share: no deadline on a busy machine, and in CI the same examples each time.

Elsewhere hypothesis looks for new ones in every run, and keeps those that fail for the next.
"""

from __future__ import annotations

import os

from hypothesis import settings

from tests.programs import REQUIRED, VARIABLE

settings.register_profile("busy", deadline=None, derandomize=os.environ.get(VARIABLE) == REQUIRED)
settings.load_profile("busy")
