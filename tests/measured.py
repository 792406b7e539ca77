"""The figures of the slow tests and benchmarks from when they last ran in full.

They are kept in ``measured.json``, and the README's figures are compared with them, so that none is
quoted from memory.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

__all__ = ["keep", "measured"]

PATH = Path(__file__).with_suffix(".json")


def measured() -> dict[str, Any]:
    """Return all figures, by promise."""
    figures: dict[str, Any] = json.loads(PATH.read_text(encoding="utf-8"))
    return figures


def keep(promise: str, figures: Mapping[str, Any]) -> None:
    """Store the figures of a promise in place of older ones."""
    every = (measured() if PATH.is_file() else {}) | {promise: figures}
    PATH.write_text(json.dumps(every, indent=1, sort_keys=True) + "\n", encoding="utf-8")
