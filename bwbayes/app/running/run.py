"""A run, from a config or from where it was interrupted, to its last file.

:func:`start` makes the run's folder; :func:`resume` does whatever is left to do in one: point
fit, sampling, prediction, files. Each stage draws from a random stream of its own and stores what
the next one needs, so it does not matter in how many pieces a run is done.
"""

from __future__ import annotations

import json
import platform
import shutil
import time
from collections.abc import Callable, Mapping
from concurrent.futures import Executor
from functools import partial
from pathlib import Path

import numpy as np
from rich.console import Console

from bwbayes.app.config.config import Config, dump, load, parse
from bwbayes.app.fit.fitted import Fit
from bwbayes.app.fit.opening import finished
from bwbayes.app.problem.problem import Problem, generator, resolve
from bwbayes.app.running.assembling import assemble, save_result
from bwbayes.app.running.choosing import chosen_noise
from bwbayes.app.running.figure_worker import Beside, beside
from bwbayes.app.running.fingerprint import fingerprint, require_its_own, versions
from bwbayes.app.running.folder import RunFolder
from bwbayes.app.running.progress import Progress, StepProgress
from bwbayes.app.running.workers import executor, one_thread
from bwbayes.errors import InputError
from bwbayes.inference import map_estimate as pointfit
from bwbayes.inference.engine import Engine
from bwbayes.inference.map_estimate import PointFit
from bwbayes.report.figures import save_pictures
from bwbayes.report.outputs import write_bands, write_posterior, write_summary
from bwbayes.report.page import render
from bwbayes.report.saving import draw_pictures
from bwbayes.sampling.chain import PHASES
from bwbayes.sampling.diagnostics import Outcome
from bwbayes.sampling.sampler import first_chain, sample
from bwbayes.sampling.storage import ChainFile

__all__ = ["begin", "draw", "redraw", "resume", "start", "write_files"]


def start(config: Config, where: Path, out: Path, *, overwrite: bool = False) -> RunFolder:
    """Make the folder of a new run; the config's files are relative to the folder ``where``.

    Raises
    ------
    InputError
        The config, its records or the folder cannot be used.
    """
    return RunFolder.create(out, resolve(config, where), overwrite)


def begin(folder: RunFolder) -> tuple[Problem, PointFit]:
    """Return a run's problem and its MAP estimate, which is worked out if it is not there yet.

    Raises
    ------
    InputError
        The folder's files do not fit together, or another process is writing them.
    """
    with folder.locked(), one_thread():
        problem, chain = _chain(folder, Console(quiet=True))
        return problem, chain.point


def draw(folder: RunFolder) -> Fit:
    """Sample a run to its end, from wherever it stands, and work nothing out of it yet.

    Raises
    ------
    InputError
        The folder's files do not fit together, or another process is writing them.
    """
    with folder.locked(), one_thread():
        problem, chain = _chain(folder, Console(quiet=True))
        with executor(1, problem.posterior.engine) as pool:
            outcome = sample(problem.posterior, problem.plan, chain, pool)
        return Fit(problem, chain, folder).knowing(outcome=outcome)


def resume(
    folder: RunFolder,
    console: Console,
    *,
    workers: int | None = None,
    ess: float | None = None,
    steps: int | None = None,
    engine: Engine | None = None,
    files: bool = True,
    backend: str | Executor | None = None,
    background: bool = False,
    show: Callable[[Problem], None] | None = None,
    answer: Callable[[Fit], None] | None = None,
) -> Fit:
    """Finish a run, from wherever it stands.

    Parameters
    ----------
    folder
        The run's folder.
    console
        Where progress goes.
    workers
        Processes for the ensembles; by default one a core. The result does not depend on it.
    ess, steps
        A new target and budget, if given.
    engine
        Resume with this engine, whatever the chain was begun with: the same posterior, but from
        here on not the same bits.
    files
        Write what a run leaves besides its config, records and chain.
    backend
        Which executor, as in :func:`~bwbayes.app.running.workers.executor`.
    background
        Draw in a process of its own, if there may be several: sooner, and the same figures.
    show
        Is called with the problem before anything is done with it.
    answer
        Is called with the fit before its files are written.

    Raises
    ------
    InputError
        The folder's files do not fit together, or another process is writing them.
    """
    start_time = time.monotonic()
    # First of all: it goes on from this process as it is now.
    with beside(workers, enabled=background and files) as artist, folder.locked(), one_thread():
        targets = {"ess": ess, "steps": steps, "engine": engine}
        _retarget(folder, {name: value for name, value in targets.items() if value is not None})
        if show is not None:
            show(folder.problem())
        problem, chain = _chain(folder, console, engine)
        with (
            executor(workers, problem.posterior.engine, backend) as pool,
            Progress(console, problem.plan) as progress,
        ):
            # It is written last, as the sign that all is done; now there is more to do.
            folder.summary.unlink(missing_ok=True)
            outcome = sample(problem.posterior, problem.plan, chain, pool, progress)
        console.print(_effort(problem, chain, outcome), highlight=False)
        console.print("computing predictions ...", highlight=False)
        with StepProgress(console) as watch:
            result = assemble(problem, chain, outcome, artist, watch)
        fit = Fit(problem, chain, folder, time.monotonic() - start_time).knowing(
            outcome=outcome, result=result, standing=result.standing
        )
        if answer is not None:
            answer(fit)
        if files:
            console.print("writing figures and files ...", highlight=False)
            write_files(fit, folder, artist)
    return fit


def redraw(folder: RunFolder) -> Fit:
    """Write the files of a finished run again, from its chain.

    Raises
    ------
    InputError
        The run has no draws yet, or another process is writing it.
    """
    with folder.locked(), one_thread():
        if not folder.summary.is_file():
            raise InputError(f"{folder.path}: is not finished; resume with {folder.resuming}")
        fit = finished(folder)
        write_files(fit, folder)
    return fit


def _chain(
    folder: RunFolder, console: Console, requested: Engine | None = None
) -> tuple[Problem, ChainFile]:
    """Open the run's chain where it stands, or start it with a point fit; its problem first."""
    problem = folder.problem()
    if not folder.chain.exists() and not folder.chain.with_suffix(".h5").exists():
        return _begun(folder, problem, console)
    chain = ChainFile.resume(folder.chain, partial(require_its_own, folder.chain, problem))
    first_engine, now = chain.attributes()["engine"], problem.posterior.engine
    if first_engine != now:
        if requested is None:
            raise InputError(
                f"{folder.chain}: was sampled with the {first_engine} engine, not {now}; set "
                f'engine = "{first_engine}" in {folder.config}, or resume with `engine="{now}"`'
            )
        console.print(f"resuming with the {now} engine a chain begun with {first_engine}")
    return problem, chain


def _begun(folder: RunFolder, problem: Problem, console: Console) -> tuple[Problem, ChainFile]:
    """Start a chain with a point fit, and with the noise that it shows."""
    console.print("computing the MAP estimate ...", highlight=False)
    point = pointfit.fit(problem.posterior, generator(problem.config.seed, "point fit"))
    if problem.config.model.noise == "auto":
        noise, why = chosen_noise(problem, point)
        console.print(why, highlight=False, soft_wrap=True)
        if noise != problem.config.model.noise_until_chosen:
            _rewrite(folder, problem.changed(problem.config, {"noise": noise}, {}))
            problem = folder.problem()
            point = pointfit.fit(problem.posterior, generator(problem.config.seed, "point fit"))
        else:
            model = problem.config.model.model_copy(update={"noise": noise})
            _rewrite(folder, problem.config.model_copy(update={"model": model}))
            problem = folder.problem()
    posterior, config = problem.posterior, problem.config
    attributes: dict[str, str | int] = {
        "config": dump(config),
        "data_sha256": problem.sha256,
        "posterior": fingerprint(config),
        "versions": json.dumps(versions(posterior.engine)),
        "engine": posterior.engine,
        "platform": platform.platform(),
        "seed": config.seed,
        "parameters": json.dumps(posterior.names),
    }
    first = first_chain(posterior, point, problem.plan, generator(config.seed, "sampling"))
    chain = ChainFile.create(folder.chain, first, point, problem.plan.block, attributes)
    return problem, chain


def _effort(problem: Problem, chain: ChainFile, outcome: Outcome) -> str:
    """Say how many models all effective draws took, those of the phases before them included."""
    steps = sum(chain.steps(phase) for phase in PHASES)
    models = steps * problem.plan.ensembles * problem.plan.walkers
    fewest = float(np.min([outcome.check.ess_bulk, outcome.check.ess_tail]))
    return (
        f"sampled {models} models, {models / fewest:.1f} for each of {fewest:.0f} effective draws"
    )


def _retarget(folder: RunFolder, targets: Mapping[str, object]) -> None:
    """Write new targets of the sampling, if there are any, into the folder's config."""
    if not targets:
        return
    config = load(folder.config)
    sampling = config.sampling.model_copy(update=targets)
    _rewrite(folder, config.model_copy(update={"sampling": sampling}))


def _rewrite(folder: RunFolder, config: Config) -> None:
    """Write another config into a run's folder."""
    text = dump(config)
    parse(text, "resume")  # refuses what a config cannot say
    draft = folder.config.with_suffix(".partial")
    draft.write_text(text, encoding="utf-8")
    draft.replace(folder.config)


def write_files(fit: Fit, folder: RunFolder, artist: Beside | None = None) -> None:
    """Write all files of a run into a folder; the summary last, as the sign that all is done."""
    fit = fit.knowing(folder=folder)
    result, numbers = fit.result, fit.numbers
    figures = folder.path / "figures"
    shutil.rmtree(figures, ignore_errors=True)  # none of an earlier end, as of bands
    if artist is not None:
        artist.draw(result)
    records = fit.problem.records
    write_posterior(folder.path / "posterior.nc", result, fit.log_likelihood, records)
    (folder.path / "bands.csv").unlink(missing_ok=True)
    if result.bands:
        write_bands(folder.path / "bands.csv", result.bands)
    if artist is None:
        from bwbayes.report.figures import interactive  # noqa: PLC0415  # bokeh is slow to load

        pictures, plots = draw_pictures(fit.report()), interactive.made(result)
        save_pictures(pictures, figures)
    else:
        pictures, plots = artist.pictures(result, figures), artist.plots(result)
    save_result(folder.result, fit.problem, fit.chain, result)
    page = render(fit.report(), pictures, plots)
    (folder.path / "report.html").write_text(page, encoding="utf-8")
    write_summary(folder.summary, numbers)
