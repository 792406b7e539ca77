"""One thing that is wrong: what it is, where, how sure that is, and what to do about it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from bwbayes.shown import brief


@dataclass(frozen=True)
class Finding:
    """One thing that is wrong with a record, a fit or its bands.

    Parameters
    ----------
    kind : str
        Kind of the issue, in a word or two: "clipping", for instance.
    text : str
        Observation, in one line.
    fix : str
        Remedy: a line of config, or a change of the file or the measurement.
    start, stop : float, s
        Where it is: start <= time < stop; by default everywhere.
    nats : float
        How sure it is: the log of its odds against nothing being wrong; nan where that is plain.
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
        """What was seen, and what to do."""
        return f"{self.text}. Fix: {self.fix}."

    @property
    def error(self) -> str:
        """The same as a part of an error's line."""
        return f"{self.kind}: {self.text}; {self.fix}"

    @property
    def line(self) -> str:
        """Cause and fix, as a part of a line."""
        return f"Likely cause: {self.note}"


# What shows a wrong model, and which drive that would be.
TELLING_DRIVE = (
    "train on a record with reversals at all voltages, such as a multisine; `bwbayes design FOLDER "
    "--validate` finds one"
)


def join_findings(findings: Sequence[Finding]) -> Finding | None:
    """Return findings that cannot be told apart as one; None if there is none."""
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
