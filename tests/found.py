"""What was found when what takes long was last run in full, as the README quotes it.

The slow tests and the benchmarks write their figures to ``found.json``; the README's are held
against it, so that none is quoted from memory.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

__all__ = ["found", "keep"]

PATH = Path(__file__).with_suffix(".json")


def found() -> dict[str, Any]:
    """Return all figures, by promise."""
    figures: dict[str, Any] = json.loads(PATH.read_text(encoding="utf-8"))
    return figures


def keep(promise: str, figures: Mapping[str, Any]) -> None:
    """Store the figures of a promise in place of older ones."""
    every = (found() if PATH.is_file() else {}) | {promise: figures}
    PATH.write_text(json.dumps(every, indent=1, sort_keys=True) + "\n", encoding="utf-8")
