"""A defect found in a record, a fit or its bands: its kind, place, evidence and fix."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from bwbayes.shown import brief


@dataclass(frozen=True)
class Finding:
    """A defect of a record, a fit or its bands.

    Parameters
    ----------
    kind : str
        Kind of the issue, in a word or two: "clipping", for instance.
    text : str
        Observation, in one line.
    fix : str
        Fix: a line of config, or a change of the file or the measurement.
    start, stop : float, s
        Its place in the record: start <= time < stop; by default everywhere.
    nats : float
        Evidence: the log of its odds against no defect; nan if it is obvious.
    removes : bool
        The fix leaves readings out.
    """

    __repr__ = brief

    kind: str
    text: str
    fix: str
    start: float = -np.inf
    stop: float = np.inf
    nats: float = np.nan
    removes: bool = False

    def __str__(self) -> str:
        return f"{self.kind}: {self.note}"

    @property
    def note(self) -> str:
        """Observation and fix."""
        return f"{self.text}. Fix: {self.fix}."

    @property
    def error(self) -> str:
        """Kind, observation and fix, as a part of an error's line."""
        return f"{self.kind}: {self.text}; {self.fix}"

    @property
    def line(self) -> str:
        """Cause and fix, as a part of a line."""
        return f"Likely cause: {self.note}"


# Fix for a model that may be wrong: a drive that would show it.
TELLING_DRIVE = (
    "train on a record with reversals at all voltages, such as a multisine; `bwbayes design FOLDER "
    "--validate` finds one"
)


def join_findings(findings: Sequence[Finding]) -> Finding | None:
    """Join findings that are tied into one; return None without any."""
    if not findings:
        return None
    return Finding(
        " or ".join(finding.kind for finding in findings),
        ", or ".join(finding.text for finding in findings),
        "; or ".join(finding.fix for finding in findings),
        min(finding.start for finding in findings),
        max(finding.stop for finding in findings),
        max(finding.nats for finding in findings),
    )
