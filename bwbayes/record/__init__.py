"""Voltage and displacement records: what they are, how they are read, checked and written."""

from __future__ import annotations

from bwbayes.record.io.formats import read_record, write_record
from bwbayes.record.record import Record

__all__ = ["Record", "read_record", "write_record"]
