"""The progress of a job as it is shown: names of its steps, and what share of each is done."""

import pytest

from bwbayes.app.running.progress import StepProgress


class Steps:
    """Takes note of the shares of each step, in turn."""

    def __init__(self) -> None:
        self.shares: dict[str, list[float]] = {}

    @classmethod
    def of_commands(cls, monkeypatch: pytest.MonkeyPatch) -> "Steps":
        """Return what takes note of all that the lines of commands show from now on."""
        steps = cls()
        monkeypatch.setattr(StepProgress, "__call__", lambda _, *told: steps(*told))
        return steps

    def __call__(self, step: str, share: float) -> None:
        """Take note of a share."""
        self.shares.setdefault(step, []).append(share)

    def require(self, *names: str) -> None:
        """Require steps of these names alone, whose shares rise to one."""
        assert names == tuple(self.shares), self.shares.keys()
        for shares in self.shares.values():
            assert shares == sorted(shares)
            assert shares[-1] == pytest.approx(1.0, abs=1e-12)
