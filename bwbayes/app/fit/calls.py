"""From a record to a fit in Python: ``fit = bwbayes.fit(record, dynamics="lag", train=(0, 12))``.

:func:`fit` and ``bwbayes run`` make the same run, by the same functions; :func:`open_run` reads it,
and :func:`resume` continues it. :func:`compare` tells which of several models to take, and
:func:`campaign` fits many records. Each loads its libraries when it is called.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from bwbayes.app.config import USUAL_MODELS
from bwbayes.errors import InputError

if TYPE_CHECKING:
    from bwbayes.app.config.config import Config
    from bwbayes.app.fit.fitted import Run
    from bwbayes.app.jobs.campaign import Campaign
    from bwbayes.comparison.comparison import Comparison
    from bwbayes.record import Record


def fit(
    record: Record | str | Path | Sequence[Any] | Mapping[str, Any],
    *,
    folder: str | Path | None = None,
    overwrite: bool = False,
    workers: int | None = None,
    executor: Any = None,
    progress: bool = True,
    **keys: Any,
) -> Run:
    """Fit a record: sample the posterior until it has converged, predict and judge.

    Parameters
    ----------
    record
        The training record, or its file, whose columns are recognized unless ``columns`` says them.
        Several records of one actuator are fitted jointly: a list of them, or a dict by name, in
        which a record may be a dict of the keys of [record.NAME], with ``record`` the record
        itself: ``{"loops": loops, "step": {"record": step, "train": (0, 3)}}``. Or a config's file.
    folder
        Where the run is kept, as ``bwbayes run`` keeps it; what was computed is kept after
        Ctrl-C too, for :func:`resume`. By default nothing is left but the fit.
    overwrite
        Replace an existing run.
    workers
        Ensembles side by side; default: all cores. The draws do not depend on it.
    executor
        local (default), threads, processes, dask, or dask://HOST:PORT. In Python also a
        ``distributed.Client``, or any executor with the methods of ``concurrent.futures``.
    progress
        Show how far it is.
    keys
        The keys of a config: those of [model], [record] and [sampling], side by side
        (``dynamics="lag"``, ``train=(0, 12)``, ``ess=4000``), ``seed``, ``name``, ``parameters``
        and ``validation``. The last is a dict of names and what is held out: a window
        (start, stop) of this record, another record, or a dict of the keys of [validation.NAME]
        with ``record`` among them.

    Raises
    ------
    InputError
        A misspelled key, a record that cannot be used, a folder that exists.

    Warns
    -----
    InputWarning
        Defects of the record or its priors, bands that do not hold, and a sampling that
        has not converged.
    """
    from bwbayes.app.jobs.fit_methods import console_of, folder_or_scratch, warn
    from bwbayes.app.running import run
    from bwbayes.app.running.folder import RunFolder
    from bwbayes.app.study.resolve import resolve_config

    config, where, records = _parse_subject(record, keys, "fit")
    path, scratch = folder_or_scratch(folder, "run")
    console = console_of(progress)
    resolved = resolve_config(config, where, records)
    say = resolved.quantities.say
    warn(map(say, resolved.record_remarks), 3)
    begun = RunFolder.create(path, resolved, overwrite)
    result = run.resume(
        begun,
        console,
        workers=workers,
        files=scratch is None,
        executor=executor,
        run=resolved.with_cache(folder=begun),
    )
    warn([say(note) for note in result.notes if note not in resolved.record_remarks], 3)
    return result.with_cache(_scratch=scratch)


def compare(
    *runs: Any,
    models: str | Sequence[str] | None = None,
    folder: str | Path | None = None,
    overwrite: bool = False,
    screen: bool = True,
    future: bool = True,
    workers: int | None = None,
    executor: Any = None,
    progress: bool = True,
    **keys: Any,
) -> Comparison:
    """Compare models of the same readings, to tell which one to take.

    Each model is fitted to a record first, side by side; existing fits and runs are compared as
    they are.

    Parameters
    ----------
    runs
        As :func:`fit` takes it: a record, its file, or a list or dict of several records; the file
        of a config; or two or more fits and folders of runs.
    models
        Models to fit to a record, as on the command line: an operator, then nonlinearity, creep,
        dynamics and noise after plus signs; in one text with semicolons between them, or in a list.
        By default seven usual ones.
    folder
        Where page, table and numbers go, and the runs of the models: after an interruption those
        that are there go on. By default nothing is left but the comparison.
    overwrite
        Replace existing files.
    screen
        Whether to leave out the sampling of models that are out of reach at their MAP estimates.
    future
        Whether to score the later half of the training readings too, given the earlier half, which
        takes a short fit.
    workers
        Models or ensembles side by side; default: all cores.
    executor
        local (default), threads, processes, dask, or dask://HOST:PORT. In Python as in :func:`fit`.
    progress
        Show how far it is.
    keys
        The keys of a config, as in :func:`fit`; the same for all models.

    Raises
    ------
    InputError
        A model that does not exist, fits of different readings, or what no fit can use.

    Examples
    --------
    Two models of a record, and fits that exist::

        comparison = bwbayes.compare(record, models="bouc-wen; maxwell-slip + quadratic")
        comparison.recommended, comparison.caveats
        comparison = bwbayes.compare(fit, other_fit, "results/bender")
    """
    from bwbayes.app.config.keywords import models_of
    from bwbayes.app.fit.fitted import Run
    from bwbayes.app.jobs import compare as job
    from bwbayes.app.jobs.fit_methods import console_of, folder_or_scratch
    from bwbayes.app.running.progress import ProgressLine, StepProgress
    from bwbayes.report.result import refuse_existing

    path, scratch = folder_or_scratch(folder, "comparison")
    console = console_of(progress)
    refuse_existing([path / "comparison.json"], overwrite=overwrite)
    compared_runs = runs[0] if len(runs) == 1 else list(runs)
    listed = compared_runs if isinstance(compared_runs, list | tuple) else [compared_runs]
    if any(
        isinstance(run, Run) or (isinstance(run, str | Path) and Path(run).is_dir())
        for run in listed
    ):
        for name in [*keys] if models is None else ["models"]:
            raise InputError(f"compare: {name}: fits are compared as they are; leave it out")
        if len(listed) < 2:
            raise InputError("compare: one fit alone; give two or more, or a record")
        with ProgressLine(console, "reading the runs ...", announced=False):
            fits = job.fits_of(listed)
        comparison = job.compare(fits, console, future=future, workers=workers, executor=executor)
    else:
        config, where, records = _parse_subject(compared_runs, keys, "compare")
        named_models = USUAL_MODELS if models is None else models
        text = named_models if isinstance(named_models, str) else "; ".join(named_models)
        comparison = job.compare_models(
            config,
            where,
            models_of(text, config.model),
            path,
            console,
            in_memory=records,
            overwrite=overwrite,
            screen=screen,
            future=future,
            files=scratch is None,
            workers=workers,
            executor=executor,
        )
    if scratch is None:
        with StepProgress(console, "writing the comparison ...") as watch:
            comparison.save(path, overwrite=True, watch=partial(watch, "figures"))
    return comparison


def _parse_subject(
    subject: Any, keys: Mapping[str, Any], call: str
) -> tuple[Config, Path, dict[str, Record]]:
    """Return what is to be fitted, where its files are, and the records in memory by name."""
    from bwbayes.app.config.config import is_config, load
    from bwbayes.app.config.keywords import config_of

    if not isinstance(subject, str | Path) or not is_config(Path(subject)):
        config, records = config_of(subject, keys, call)
        return config, Path(), records
    for name in keys:
        raise InputError(f"{call}: {name}: say it in the config, or give a record")
    path = Path(subject)
    return load(path).with_name(path.stem, None), path.parent, {}


def open_run(folder: str | Path) -> Run:
    """Open a run's folder, written by :func:`fit`, :meth:`bwbayes.Run.save` or ``bwbayes run``.

    Raises
    ------
    InputError
        No such run, or it has no draws yet.
    """
    from bwbayes.app.fit.fitted import open_finished
    from bwbayes.app.running.folder import RunFolder

    return open_finished(RunFolder.open(Path(folder)))


def open_converged(folder: Path) -> Run:
    """Return the run in a folder, if it is finished and has converged.

    Raises NotConvergedError if it has not, and InputError: no such run, or it is not finished.
    """
    fit = open_run(folder)
    fit.folder.require_finished()
    fit.require_converged()
    return fit


def resume(
    folder: str | Path,
    *,
    ess: float | None = None,
    steps: int | None = None,
    engine: Literal["numpy", "numba"] | None = None,
    workers: int | None = None,
    executor: Any = None,
    progress: bool = True,
) -> Run:
    """Continue a run in a folder that was interrupted or is short of its target.

    Parameters
    ----------
    folder
        The run's folder.
    ess
        New target of effective draws; default: as before.
    steps
        New maximum number of steps; default: as before.
    engine
        Continue with this engine, whatever the chain was begun with.
    workers
        Ensembles side by side; default: all cores.
    executor
        local (default), threads, processes, dask, or dask://HOST:PORT. In Python as in :func:`fit`.
    progress
        Show how far it is.

    Raises
    ------
    InputError
        No such run, or its files do not belong together.

    Warns
    -----
    InputWarning
        As :func:`fit` does.
    """
    from bwbayes.app.jobs.fit_methods import console_of, warn
    from bwbayes.app.running import run
    from bwbayes.app.running.folder import RunFolder

    result = run.resume(
        RunFolder.open(Path(folder)),
        console_of(progress),
        workers=workers,
        ess=ess,
        steps=steps,
        engine=engine,
        executor=executor,
    )
    warn(result.notes, 3)
    return result


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
        Records side by side; default: all cores. The result does not depend on it.
    executor
        local (default), threads, processes, dask, or dask://HOST:PORT. In Python as in :func:`fit`.
        The machines of a cluster must all see the folders by the same path.
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
    from dataclasses import replace

    from bwbayes.app.config.config import dump
    from bwbayes.app.config.keywords import config_of
    from bwbayes.app.jobs.campaign import config_text, resume, start
    from bwbayes.app.jobs.fit_methods import console_of, folder_or_scratch, warn
    from bwbayes.record import read_record, write_record

    text, where = "", Path()
    if config is not None:
        if keys:
            raise InputError(f"campaign: give either config or keys ({', '.join(keys)}), not both")
        text, where = config_text(Path(config)), Path(config).parent
    elif keys:
        common, in_memory = config_of("each", keys, "campaign")
        if in_memory:
            raise InputError("campaign: validation: give files, which each record's run can read")
        text = dump(common)
    path, scratch = folder_or_scratch(folder, "campaign")
    if isinstance(records, Mapping):
        source = path.with_name(f"{path.name}-records")
        source.mkdir(parents=True, exist_ok=True)
        for name, record in records.items():
            if not re.fullmatch(r"[\w][\w .+-]*", name):
                raise InputError(f"campaign: {name!r} is not a valid file name; choose another")
            file = source / f"{name}.h5"
            # Files that an earlier call has written are not written again.
            if not file.exists() or read_record(file).sha256 != record.sha256:
                write_record(record, file)
    else:
        source = Path(records)
    batch = start(source, text, where, path, pictures=pictures, overwrite=overwrite)
    result = resume(batch, console_of(progress), workers=workers, executor=executor)
    warn(result.notes, 3)
    return replace(result, _scratch=scratch)
