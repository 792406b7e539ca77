"""What all tests share: no deadline on a busy machine, and in CI the same examples each time.

Elsewhere hypothesis looks for new ones in every run, and keeps those that fail for the next.
The tests of the whole come first: they take longest, and no worker shall end with one alone. Before
them come the tools, which need nothing compiled: while one worker checks types, another compiles.
Rooms whose files take a second or two come last, so that all workers end at about the same time.
Commands of other processes take this checkout too, and what is compiled of it, not an installation.
"""

import gc
import os
from pathlib import Path

import pytest
from hypothesis import settings

from tests.programs import REQUIRED, VARIABLE

# As the command line does: what is compiled here makes as many objects that stay.
gc.set_threshold(50_000)

os.environ["PYTHONPATH"] = str(Path(__file__).resolve().parents[1])

settings.register_profile("busy", deadline=None, derandomize=os.environ.get(VARIABLE) == REQUIRED)
settings.load_profile("busy")


QUICK_ROOMS = ("population", "record", "report")


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Put those at the top of ``tests/`` before those of the rooms, and quick rooms last."""

    def place(item: pytest.Item) -> tuple[bool, int, bool]:
        room = item.path.parent.name
        return room in QUICK_ROOMS, len(item.path.parts), item.path.stem != "test_style"

    items.sort(key=place)
