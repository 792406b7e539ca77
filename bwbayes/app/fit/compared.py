"""Fits compared, as Python users have it: what ``bwbayes.compare`` and ``fit.compare`` return.

It shows itself as ``bwbayes compare`` does on screen: what is recommended, what speaks against it,
the numbers of the models and their differences.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from html import escape
from io import StringIO
from pathlib import Path
from typing import Any, Protocol

from rich.console import Console

from bwbayes.app.fit.surroundings import Scratch
from bwbayes.app.jobs.compare import Fitted, compare, require_same, write
from bwbayes.app.problem.problem import Problem
from bwbayes.app.screen import show_comparison
from bwbayes.comparison.choice import Comparison
from bwbayes.comparison.table import table
from bwbayes.results.result import Result
from bwbayes.sampling.sampler import Outcome
from bwbayes.sampling.storage import ChainFile
from bwbayes.shown import head

__all__ = ["Compared", "FinishedFit", "compared", "named"]


class FinishedFit(Protocol):
    """What a comparison needs of a fit."""

    @property
    def problem(self) -> Problem:
        """What was fitted."""

    @property
    def chain(self) -> ChainFile:
        """The draws."""

    @property
    def outcome(self) -> Outcome:
        """How the sampling ended."""

    @property
    def result(self) -> Result:
        """What came of it."""


@dataclass(frozen=True, eq=False, repr=False)
class Compared:
    """Fits compared on the same readings.

    ``comparison`` has the models with all that is known of each.
    """

    comparison: Comparison
    _runs: tuple[Fitted, ...]
    _scratch: Scratch | None = None

    @property
    def recommended(self) -> str | None:
        """The name of the model recommended; None if nothing has converged."""
        return self.comparison.recommended

    @property
    def alike(self) -> tuple[str, ...]:
        """The models that cannot be told apart from it."""
        return self.comparison.alike

    @property
    def lines(self) -> tuple[str, ...]:
        """The recommendation in words, a line each."""
        return self.comparison.lines

    @property
    def against(self) -> tuple[str, ...]:
        """What speaks against it, a line each."""
        return self.comparison.against

    def to_pandas(self) -> Any:
        """Return a pandas.DataFrame with a row for each model, as ``comparison.csv`` has them."""
        import pandas as pd  # noqa: PLC0415  # slow to load, and only needed here

        return pd.DataFrame(table(self.comparison)).set_index("name")

    def save(self, folder: str | Path) -> Path:
        """Write page, table and numbers to a folder, as ``bwbayes compare`` does; return it."""
        write(self.comparison, self._runs, Path(folder))
        return Path(folder)

    def __repr__(self) -> str:
        return head(str(self))

    def __str__(self) -> str:
        said = StringIO()
        console = Console(file=said, width=110, force_jupyter=False, color_system=None)
        show_comparison(self.comparison, None, console)
        return said.getvalue().rstrip()

    def _repr_html_(self) -> str:
        return f"<pre>{escape(str(self))}</pre>"


def named(fit: FinishedFit) -> Fitted:
    """Return a fit under the name of its config, or of its operator."""
    config = fit.problem.config
    name = config.name or config.model.hysteresis
    return Fitted(name, fit.problem, fit.chain, fit.outcome, fit.result.standing)


def compared(
    runs: Sequence[Fitted],
    *,
    future: bool = True,
    workers: int | None = None,
    executor: Any = None,
) -> Compared:
    """Compare fits; those of one name by number.

    Parameters
    ----------
    runs
        Fits of the same readings, of different models.
    future
        Whether to predict the later half of the training readings from the earlier ones too, which
        takes short fits.
    workers
        Ensembles of those side by side; by default one a core.
    executor
        Where they run, as in :func:`bwbayes.fit`.

    Raises
    ------
    InputError
        Fits of different readings.
    """
    if len({run.name for run in runs}) < len(runs):
        runs = [replace(run, name=f"{run.name} {n}") for n, run in enumerate(runs, start=1)]
    for one in runs[1:]:
        require_same(runs[0], one)
    quiet = Console(quiet=True)
    made = compare(runs, quiet, workers=workers, how=executor, with_future=future)
    return Compared(made, tuple(runs))
