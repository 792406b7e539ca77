"""Many records in Python: ``batch = bwbayes.campaign("records/", config="my.toml")``.

What :func:`campaign` makes ``bwbayes campaign`` makes too, by the same functions.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

from bwbayes.app.config.config import dump
from bwbayes.app.config.keywords import config_of
from bwbayes.app.fit.calls import open_run
from bwbayes.app.fit.fitted import Fit
from bwbayes.app.fit.surroundings import Scratch, console_of, warn
from bwbayes.app.jobs.campaign import config_text, resume, start
from bwbayes.app.problem.problem import generator
from bwbayes.app.running.campaign_folder import CampaignFolder
from bwbayes.app.running.campaign_result import CampaignResult
from bwbayes.app.running.predictions import Prediction, predict_another
from bwbayes.errors import InputError
from bwbayes.population.population import Population, next_specimen
from bwbayes.prediction.initial_state import Start
from bwbayes.record import Record, read_record, write_record
from bwbayes.report.figures import drawn
from bwbayes.shown import head

__all__ = ["Campaign", "campaign"]


@dataclass(frozen=True, eq=False, repr=False)
class Campaign:
    """Records that were fitted one by one, and what they say together.

    Parameters
    ----------
    result
        A row for each record, and the population.
    folder
        The campaign's folder.
    """

    result: CampaignResult
    folder: CampaignFolder
    _scratch: Scratch | None = field(default=None, repr=False)

    @cached_property
    def table(self) -> Any:
        """A pandas.DataFrame with a row for each record: status, reason, means, intervals."""
        import pandas as pd  # noqa: PLC0415  # slow to load, and only needed here

        words = ("record", "file", "status", "reason", "outlier_in")
        table = pd.read_csv(self.folder.table, index_col="record", dtype=dict.fromkeys(words, str))
        return table.fillna(dict.fromkeys(words[1:], ""))

    @property
    def population(self) -> Population:
        """Population mean and spread of each parameter, and every specimen among the others.

        Raises
        ------
        InputError
            There is none, and why.
        """
        if self.result.population is None:
            raise InputError(f"campaign: no population: {self.result.untold}")
        return self.result.population

    @property
    def outliers(self) -> dict[str, list[str]]:
        """The parameters in which a record lies off the population, by record."""
        return self.result.outliers

    @property
    def short(self) -> dict[str, str]:
        """Why records were refused, did not converge, or have bands that do not hold, by record."""
        return {row.name: f"{row.status}: {row.reason}" for row in self.result.rows if row.reason}

    def fit(self, name: str) -> Fit:
        """Return the fit of one record.

        Raises
        ------
        InputError
            It has none.
        """
        return open_run(self.folder.run(name))

    def predict(
        self, record: Record | str | Path, *, from_rest: bool = False, lead_in: float | None = None
    ) -> Prediction:
        """Predict a specimen that was not measured, along a record or a planned voltage.

        Its parameters are drawn from the population; noise and offset are those of the campaign's
        first record that has converged. `from_rest` and `lead_in` are as in :meth:`Fit.predict`.

        Raises
        ------
        InputError
            There is no population, or the record cannot be used.
        """
        first = self.fit(self.population.names[0])
        other = (
            record if isinstance(record, Record) else read_record(record, need_displacement=False)
        )
        source = generator(first.problem.config.seed, "next specimen")
        posterior = first.problem.posterior
        draws = next_specimen(self.population, posterior, first.flat_draws, source)
        begin = Start(from_rest, True, lead_in)
        return predict_another(first.problem, draws, other, begin, "next specimen", None)

    def plot(self) -> Any:
        """Draw each parameter's intervals side by side, with the population, as a Figure.

        Raises
        ------
        InputError
            No record has converged.
        """
        if not self.result.units:
            raise InputError("campaign: no record has converged, so there is nothing to draw")
        return drawn(self.result.draw)

    def __repr__(self) -> str:
        return head(str(self))

    def __str__(self) -> str:
        counts = ", ".join(f"{n} {status}" for status, n in self.result.counts.items() if n)
        lines = [f"{len(self.result.rows)} records: {counts}"]
        lines += [f"{name}: {why}" for name, why in self.short.items()]
        lines += [
            f"{name}: off the population in {', '.join(o)}" for name, o in self.outliers.items()
        ]
        return "\n".join(lines)


def campaign(
    records: str | Path | Mapping[str, Record],
    *,
    config: str | Path | None = None,
    folder: str | Path | None = None,
    overwrite: bool = False,
    workers: int | None = None,
    executor: Any = None,
    pictures: bool = False,
    progress: bool = True,
    **keys: Any,
) -> Campaign:
    """Fit many records, each by itself, and say what they show together.

    Parameters
    ----------
    records
        The folder of their files, or records by name.
    config
        The config of all; or give its keys, as to :func:`bwbayes.fit`. Without either each record
        proposes its own.
    folder
        Where the campaign is kept; called again with the same folder it goes on, and fits what is
        new. By default nothing is left but the campaign.
    overwrite
        Replace a campaign that is in the folder already.
    workers
        Records side by side; by default as many as cores. The result does not depend on it.
    executor
        Where they are fitted, as in :func:`bwbayes.fit`.
    pictures
        Draw each run's figures and report too.
    progress
        Show how far it is.
    keys
        The keys of a config, as in :func:`bwbayes.fit`.

    Raises
    ------
    InputError
        A config that cannot be used, or a folder of something else. A record that cannot be used is
        a row of the table.

    Warns
    -----
    InputWarning
        Each record that was refused, has not converged, or lies off the population.
    """
    if config is not None and keys:
        raise InputError(f"campaign: give either config or keys ({', '.join(keys)}), not both")
    text, where = "", Path()
    if config is not None:
        text, where = config_text(Path(config)), Path(config).parent
    elif keys:
        common, in_memory = config_of("each", keys, "campaign")
        if in_memory:
            raise InputError("campaign: validation: give files, which each record's run can read")
        text = dump(common)
    scratch = Scratch() if folder is None else None
    path = scratch.path / "campaign" if scratch is not None else Path(str(folder))
    source = path.with_name(f"{path.name}-records") if isinstance(records, Mapping) else records
    if isinstance(records, Mapping):
        _write(records, Path(source))
    begun_folder = start(Path(source), text, where, path, pictures=pictures, overwrite=overwrite)
    finished = Campaign(
        resume(begun_folder, console_of(progress), workers=workers, executor=executor),
        begun_folder,
        scratch,
    )
    off = [f"{name}: off the population in {', '.join(o)}" for name, o in finished.outliers.items()]
    warn([*(f"{name}: {why}" for name, why in finished.short.items()), *off], 3)
    return finished


def _write(records: Mapping[str, Record], folder: Path) -> None:
    """Write the records that are in memory, except those that are written already."""
    folder.mkdir(parents=True, exist_ok=True)
    for name, record in records.items():
        if not re.fullmatch(r"[\w][\w .+-]*", name):
            raise InputError(f"campaign: {name!r} is not a valid file name; choose another")
        path = folder / f"{name}.h5"
        if not path.exists() or read_record(path).sha256 != record.sha256:
            write_record(record, path)
