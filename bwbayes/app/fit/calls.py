"""From a record to a fit in Python: ``fit = bwbayes.fit(record, dynamics="lag", train=(0, 12))``.

What :func:`fit` makes, ``bwbayes run`` makes too, by the same functions; :func:`open_run` reads
what either has written, and :func:`resume_run` goes on with it. :func:`compare` tells which of
several models to take.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from bwbayes.app.config.keywords import config_of
from bwbayes.app.config.limits import USUAL_MODELS
from bwbayes.app.config.models import models_of
from bwbayes.app.fit.compared import Compared, compared, named
from bwbayes.app.fit.fitted import Fit, carried_on, to_know
from bwbayes.app.fit.surroundings import Scratch, console_of, warn
from bwbayes.app.jobs.compare import Fitted, require_free, run_models
from bwbayes.app.problem.problem import resolve
from bwbayes.app.running.folder import RunFolder
from bwbayes.app.running.run import finished
from bwbayes.data import Record
from bwbayes.errors import InputError
from bwbayes.inference.engine import Engine

__all__ = ["compare", "fit", "open_run", "resume_run"]


def fit(
    record: Record | str | Path | Sequence[Any] | Mapping[str, Any],
    *,
    folder: str | Path | None = None,
    overwrite: bool = False,
    workers: int | None = None,
    executor: Any = None,
    progress: bool = True,
    **keys: Any,
) -> Fit:
    """Fit a record: sample the posterior until it has converged, predict and judge.

    Parameters
    ----------
    record
        The training record, or its file, whose columns are recognised unless ``columns`` says them.
        Several records of one actuator are fitted jointly: a list of them, or a dict by name, in
        which a record may be a dict of the keys of [record.NAME], with ``record`` the record
        itself: ``{"loops": loops, "step": {"record": step, "train": (0, 3)}}``.
    folder
        Where the run is kept, as ``bwbayes run`` keeps it; what was computed is kept after
        Ctrl-C too, for :func:`resume_run`. By default nothing is left but the fit.
    overwrite
        Replace a run that is in the folder already.
    workers
        Ensembles side by side; by default one a core. The draws do not depend on it.
    executor
        Where they run: "local", "threads", "processes", "dask" or "dask://HOST:PORT", a
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
        A misspelt key, a record that cannot be used, a folder that exists.

    Warns
    -----
    InputWarning
        What is wrong with the record or its priors, bands that do not hold, and a sampling that
        has not converged.
    """
    config, records = config_of(record, keys)
    problem = resolve(config, Path(), records)
    warn(problem.remarks, 3)
    scratch = Scratch() if folder is None else None
    path = scratch.path / "run" if scratch is not None else Path(str(folder))
    made = carried_on(
        RunFolder.create(path, problem, overwrite), scratch, progress, workers, how=executor
    )
    warn([one for one in to_know(made) if one not in problem.remarks], 3)
    return made


def compare(
    *runs: Any,
    models: str | Sequence[str] | None = None,
    folder: str | Path | None = None,
    overwrite: bool = False,
    future: bool = True,
    workers: int | None = None,
    executor: Any = None,
    progress: bool = True,
    **keys: Any,
) -> Compared:
    """Compare models of the same readings, to tell which one to take.

    To a record each model is fitted first; fits and runs that exist are compared as they are.

    Parameters
    ----------
    runs
        What :func:`fit` takes: a record, its file, or a list or dict of several records; or two or
        more fits and folders of runs.
    models
        Models to fit to a record, as on the command line: an operator, then gain, creep, dynamics
        and noise after plus signs; in one text with semicolons between them, or in a list. By
        default seven usual ones.
    folder
        Where page, table and numbers go, and the runs of the models: after an interruption those
        that are there go on. By default nothing is left but the comparison.
    overwrite
        Replace what is in the folder already.
    future
        Whether to predict the later half of the training readings from the earlier ones too, which
        takes short fits.
    workers, executor, progress
        As in :func:`fit`.
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
        comparison.recommended, comparison.against
        comparison = bwbayes.compare(fit, other_fit, "results/bender")
    """
    scratch = Scratch() if folder is None else None
    path = scratch.path / "comparison" if scratch is not None else Path(str(folder))
    require_free(path, overwrite)
    given = runs[0] if len(runs) == 1 else list(runs)
    listed = given if isinstance(given, list | tuple) else [given]
    if any(isinstance(one, Fit) or _is_folder(one) for one in listed):
        for name in [*keys] if models is None else ["models"]:
            raise InputError(f"compare: {name}: fits are compared as they are; leave it out")
        if len(listed) < 2:
            raise InputError("compare: one fit alone; give two or more, or a record")
        fits = [_finished(one) for one in listed]
    else:
        config, records = config_of(given, keys, "compare")
        named_models = USUAL_MODELS if models is None else models
        text = named_models if isinstance(named_models, str) else "; ".join(named_models)
        fits = run_models(
            config,
            Path(),
            models_of(text, config.model),
            path,
            console_of(progress),
            workers,
            executor,
            given=records,
            overwrite=overwrite,
        )
    made = compared(fits, future=future, workers=workers, executor=executor)
    if scratch is None:
        made.save(path)
    return replace(made, _scratch=scratch)


def _is_folder(given: Any) -> bool:
    return isinstance(given, str | Path) and Path(given).is_dir()


def _finished(given: Any) -> Fitted:
    """Return a fit, or the run in a folder under the folder's name."""
    if isinstance(given, Fit):
        return named(given)
    if not _is_folder(given):
        raise InputError(
            f"compare: {given if isinstance(given, str | Path) else type(given).__name__}: is "
            "neither a fit nor the folder of a run; give a list of those alone, or records alone"
        )
    return replace(named(open_run(given)), name=Path(given).name)


def open_run(folder: str | Path) -> Fit:
    """Open a run's folder, written by :func:`fit`, :meth:`Fit.save` or ``bwbayes run``.

    Raises
    ------
    InputError
        No such run, or it has no draws yet.
    """
    where = RunFolder.open(Path(folder))
    problem, chain, outcome = finished(where)
    seconds = 0.0
    if where.summary.is_file():
        seconds = json.loads(where.summary.read_text(encoding="utf-8"))["wall_s"]
    return Fit(problem, chain, outcome, where, seconds)


def resume_run(
    folder: str | Path,
    *,
    ess: float | None = None,
    steps: int | None = None,
    engine: Engine | None = None,
    workers: int | None = None,
    executor: Any = None,
    progress: bool = True,
) -> Fit:
    """Go on with a run in a folder that was interrupted or is short of its target.

    Parameters
    ----------
    folder
        The run's folder.
    ess, steps
        A new target of effective draws, a new budget of steps; by default as before.
    engine
        Go on with this engine, whatever the chain was begun with.
    workers, executor, progress
        As in :func:`fit`.

    Raises
    ------
    InputError
        No such run, or its files do not belong together.

    Warns
    -----
    InputWarning
        As :func:`fit` does.
    """
    where = RunFolder.open(Path(folder))
    made = carried_on(where, None, progress, workers, ess, steps, engine, executor)
    warn(to_know(made), 3)
    return made
