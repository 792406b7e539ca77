"""Some models of a batch: what is remembered of them, cut out of what is remembered of all."""

from __future__ import annotations

from typing import Any

import numpy as np

__all__ = ["of_rows"]


def of_rows(memory: Any, rows: slice) -> Any:
    """Return a memory with its arrays (models, ...) cut to some models, whatever it is made of."""
    if isinstance(memory, np.ndarray):
        return memory[rows]
    if isinstance(memory, tuple):
        parts = [of_rows(member, rows) for member in memory]
        return type(memory)(*parts) if hasattr(memory, "_fields") else tuple(parts)
    if hasattr(memory, "__dataclass_fields__"):
        return type(memory)(
            **{name: of_rows(getattr(memory, name), rows) for name in memory.__dataclass_fields__}
        )
    return memory
