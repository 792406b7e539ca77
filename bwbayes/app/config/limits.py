"""Limits that configs and the command line share, without waiting for what checks configs."""

from __future__ import annotations

__all__ = ["LARGEST_SEED"]

# What files hold as a whole number.
LARGEST_SEED = 2**63 - 1
