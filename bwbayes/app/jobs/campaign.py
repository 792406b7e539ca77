"""A campaign: one posterior for each record of a folder, and what they say together.

:func:`start` makes the folder; :func:`resume` fits the records whose runs have not ended, side by
side, and writes table and page over all of them. A record's run depends on the config, the seed and
the record alone, and the tables on the runs alone, so it does not matter in how many pieces or with
how many workers a campaign is done, and records that come later are fitted by themselves.
"""

from __future__ import annotations

import json
import tomllib
from collections import Counter
from collections.abc import Sequence
from concurrent.futures import Executor
from pathlib import Path

from rich.console import Console

from bwbayes.app.config.config import checked, dump, load
from bwbayes.app.jobs.batch import batch
from bwbayes.app.problem.problem import generator
from bwbayes.app.running.campaign import Campaign, Row
from bwbayes.app.running.campaign_folder import CampaignFolder, Origin, records_in
from bwbayes.app.running.record_task import SPECIMEN, Ended, fit_record
from bwbayes.app.running.workers import one_thread
from bwbayes.diagnosis.standing import Standing
from bwbayes.errors import InputError
from bwbayes.population.population import FEWEST, Population, population
from bwbayes.population.specimen import Specimen
from bwbayes.report.saving import save

__all__ = ["config_text", "resume", "start"]


def config_text(path: Path) -> str:
    """Return the config of all records as TOML, every default explicit; it need name no record."""
    try:
        table = tomllib.loads(path.read_text(encoding="utf-8-sig"))
        record = table.setdefault("record", {})
        bare = isinstance(record, dict) and not {"file", "signal"} & set(record)
    except (OSError, ValueError, RecursionError):
        bare = False
    if bare:
        record["file"] = "each"
        return dump(checked(table, str(path)))
    return dump(load(path))


def start(
    records: Path,
    config: str,
    where: Path,
    out: Path,
    *,
    pictures: bool = True,
    overwrite: bool = False,
) -> CampaignFolder:
    """Make the folder ``out`` of a campaign, or open the same one that was begun.

    ``config`` is that of all ``records``, as TOML, its files relative to the folder ``where``;
    empty lets each record propose its own. With ``pictures`` every run has figures and report.

    Raises
    ------
    InputError
        No records, or a folder of something else.
    """
    records_in(records)
    origin = Origin(records=str(records.absolute()), where=str(where.absolute()), pictures=pictures)
    return CampaignFolder.create(out, config, origin, overwrite=overwrite)


def resume(
    folder: CampaignFolder,
    console: Console,
    *,
    workers: int | None = None,
    executor: str | Executor | None = None,
) -> Campaign:
    """Fit the records that are missing, and write table and page over all.

    Parameters
    ----------
    folder, console
        The campaign's folder, and where progress goes.
    workers
        Records side by side; default: all cores. The result does not depend on it.
    executor
        local (default), threads, processes, dask, or dask://HOST:PORT. In Python any executor, as
        in :func:`~bwbayes.app.running.workers.executor`. The machines of a cluster must all see the
        campaign's folder and that of the records by the same path.

    Raises
    ------
    InputError
        The folder's files do not fit together, or another process is writing them.
    """
    with folder.locked(), one_thread():
        origin, config = folder.origin(), folder.config.read_text(encoding="utf-8")
        files = records_in(Path(origin.records))
        stems = Counter(file.stem.lower() for file in files)
        refused = {
            file.name: f"{file}: shares its name with another record; rename one of them"
            for file in files
            if stems[file.stem.lower()] > 1
        }
        fitted = [file for file in files if file.name not in refused]
        tasks = [
            (file, config, Path(origin.where), folder.run(file.stem).absolute(), origin.pictures)
            for file in fitted
            if not folder.is_done(file)
        ]
        folder.summary.unlink(missing_ok=True)
        ended: Ended
        for ended in batch(
            fit_record,
            tasks,
            lambda ended: "refused" if ended.refused else ended.short,
            console=console,
            kind="record",
            done=len(fitted) - len(tasks),
            short={"not converged": 0, "refused": 0},
            workers=workers,
            backend=executor,
        ):
            if ended.refused:
                refused[ended.file.name] = ended.short
        console.print("combining the records ...", highlight=False)
        rows = tuple(_row(folder, file, refused.get(file.name, "")) for file in files)
        campaign = Campaign(folder, rows, _population(folder, rows))
        # Nothing in its files depends on when or how it was computed.
        save(campaign.report(), folder.path, "campaign", pictures="figures")
    return campaign


def _population(folder: CampaignFolder, rows: Sequence[Row]) -> Population | str:
    """Return the population of the records that have converged, or why there is none."""
    specimens = [
        Specimen.load(row.name, folder.run(row.name) / SPECIMEN) for row in rows if row.parameters
    ]
    if len(specimens) < FEWEST:
        return f"a population needs {FEWEST} records or more"
    try:
        return population(specimens, generator(1, "population"))
    except InputError as error:
        return str(error)


def _row(folder: CampaignFolder, file: Path, refusal: str) -> Row:
    """Return the row of a record."""
    if refusal:
        return Row(file.stem, file.name, "refused", refusal, {})
    path = folder.run(file.stem)
    numbers = json.loads((path / "summary.json").read_text(encoding="utf-8"))
    if not numbers["converged"]:
        reason = f"{numbers['stop_reason']}; resume with `{numbers['go_on']}`"
        return Row(file.stem, file.name, "not converged", reason, numbers)
    standing = Standing.read(numbers)
    status = standing.status if standing.holds else f"validation {standing.status}"
    return Row(file.stem, file.name, status, "; ".join(standing.lines), numbers)
