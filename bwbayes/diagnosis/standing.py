"""Whether the bands of a whole run hold: what everything that builds on the run carries along.

A :class:`Standing` goes first on every page, into every file of numbers, and decides the exit
status of every command.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any, Self

from bwbayes.diagnosis.validation import STATUSES, Verdict
from bwbayes.errors import ExitStatus


@dataclass(frozen=True)
class Standing:
    """Whether the bands of a run hold on all that they were validated on.

    Attributes
    ----------
    holds
        False if they fail anywhere; else None if validation is inconclusive anywhere.
    lines
        What is off, a line for each record or window that fails, or that is inconclusive.
    """

    holds: bool | None = True
    lines: tuple[str, ...] = ()

    @classmethod
    def of(cls, verdicts: Iterable[Verdict]) -> Self:
        """Return what the verdicts of a run come to."""
        return cls._of((verdict.holds, verdict.line) for verdict in verdicts)

    @classmethod
    def read(cls, summary: Mapping[str, Any]) -> Self:
        """Return what a converged run's ``summary.json`` says."""
        every = (summary.get("validation") or {}).items()
        return cls._of((entry["holds"], entry.get("verdict", name)) for name, entry in every)

    @classmethod
    def _of(cls, answers: Iterable[tuple[bool | None, str]]) -> Self:
        every = list(answers)
        for holds in (False, None):
            lines = tuple(line for answer, line in every if answer is holds)
            if lines:
                return cls(holds, lines)
        return cls()

    @property
    def status(self) -> str:
        """The outcome in a word."""
        return STATUSES[self.holds]

    @property
    def exit_status(self) -> ExitStatus:
        """What a command ends with that builds on it."""
        statuses = {False: ExitStatus.VALIDATION_FAILED, None: ExitStatus.VALIDATION_INCONCLUSIVE}
        return statuses.get(self.holds, ExitStatus.SUCCESS)

    @property
    def headline(self) -> str:
        """What stands above the lines; nothing if validation passed."""
        titles = {True: "", False: "VALIDATION FAILED", None: "Validation inconclusive"}
        return titles[self.holds]

    @property
    def said(self) -> tuple[str, ...]:
        """What to say of it, a line each; nothing if validation passed."""
        return tuple(f"{self.headline}: {line}" for line in self.lines)

    @property
    def numbers(self) -> dict[str, object]:
        """What files of numbers have of it."""
        return {"status": self.status, "verdicts": list(self.lines)}
