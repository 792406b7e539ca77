"""The figures of the slow tests and benchmarks from when they last ran in full.

They are kept in ``measured.json``, and the figures of ``README.md`` beside it are compared with
them, so that none is quoted from memory.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from tempfile import gettempdir
from typing import Any

from filelock import FileLock

PATH = Path(__file__).with_suffix(".json")


def measured() -> dict[str, Any]:
    """Return all figures, by promise."""
    figures: dict[str, Any] = json.loads(PATH.read_text(encoding="utf-8"))
    return figures


def keep(promise: str, figures: Mapping[str, Any]) -> None:
    """Store the figures of a promise in place of older ones; a line for each promise."""
    # Studies may run side by side.
    with FileLock(Path(gettempdir()) / "bwbayes-measured.lock"):
        every = sorted((measured() | {promise: figures}).items())
        lines = (f"{json.dumps(name)}: {json.dumps(one, sort_keys=True)}" for name, one in every)
        PATH.write_text("{\n" + ",\n".join(lines) + "\n}\n", encoding="utf-8")
