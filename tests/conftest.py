"""Settings of all tests: twenty examples, no deadline, and in CI the same examples each time.

Elsewhere hypothesis looks for new ones in every run, and keeps those that fail for the next.
The tests of the whole come first: they take longest, and no worker shall end with one alone. Before
them come the tools, which need nothing compiled: while one worker checks types, another compiles.
Rooms whose files take a second or two come last, so that all workers end at about the same time.
"""

import gc
import os
import sys
from collections.abc import Iterator
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import pytest
from filelock import FileLock
from hypothesis import settings

from tests.programs import REQUIRED, VARIABLE

# As the command line does: what is compiled here makes as many objects that stay.
gc.set_threshold(50_000)

# Commands of other processes find the checkout, and its bytecode, which is a third of their start.
os.environ["PYTHONPATH"] = str(Path(__file__).resolve().parents[1])
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
sys.dont_write_bytecode = False

settings.register_profile(
    "busy", deadline=None, max_examples=20, derandomize=os.environ.get(VARIABLE) == REQUIRED
)
settings.load_profile("busy")


@pytest.fixture(scope="session", autouse=True)
def _compiled_once(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """Let one worker at a time compile; the others find in the cache what it has compiled."""
    if "PYTEST_XDIST_WORKER" not in os.environ or find_spec("numba") is None:
        yield
        return
    lock = FileLock(tmp_path_factory.getbasetemp().parent / "compile.lock")
    dispatcher = import_module("numba.core.dispatcher").Dispatcher
    compile_alone = dispatcher.compile

    def compile_in_turn(function: Any, signature: Any) -> Any:
        with lock:
            return compile_alone(function, signature)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(dispatcher, "compile", compile_in_turn)
        yield


QUICK_ROOMS = ("population", "record", "report")


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Put those at the top of ``tests/`` before those of the rooms, and quick rooms last."""

    def place(item: pytest.Item) -> tuple[bool, int, bool]:
        room = item.path.parent.name
        return room in QUICK_ROOMS, len(item.path.parts), item.path.stem != "test_style"

    items.sort(key=place)
