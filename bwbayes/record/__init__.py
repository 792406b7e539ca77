"""Voltage and displacement records: their class, and functions to read, check and write them."""

from __future__ import annotations

from bwbayes.record.io.formats import read_record, write_record
from bwbayes.record.record import Record

__all__ = ["Record", "read_record", "write_record"]
