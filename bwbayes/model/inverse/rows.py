"""One model of a batch: what is remembered of it, cut out of what is remembered of all."""

from __future__ import annotations

from typing import Any

import numpy as np

__all__ = ["of_row"]


def of_row(memory: Any, row: int) -> Any:
    """Return a memory with its arrays (models,) cut to one model, whatever it is made of."""
    if isinstance(memory, np.ndarray):
        return memory[row : row + 1]
    if isinstance(memory, tuple):
        parts = [of_row(one, row) for one in memory]
        return type(memory)(*parts) if hasattr(memory, "_fields") else tuple(parts)
    if hasattr(memory, "__dataclass_fields__"):
        return type(memory)(
            **{name: of_row(getattr(memory, name), row) for name in memory.__dataclass_fields__}
        )
    return memory
