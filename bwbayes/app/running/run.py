"""A run, from a config or from where it was interrupted, to its last file.

:meth:`RunFolder.create` makes the run's folder; :func:`resume` does whatever is left to do in one:
MAP estimate, sampling, prediction, files. Each stage draws from a random stream of its own and
stores what the next one needs, so it does not matter in how many pieces a run is done.
"""

from __future__ import annotations

import json
import platform
import shutil
import time
from collections.abc import Callable
from concurrent.futures import Executor
from functools import partial
from pathlib import Path

from rich.console import Console

from bwbayes.app.config.config import Config, dump, load, parse
from bwbayes.app.fit.fitted import VOLTAGE_NOISE, Run, open_finished
from bwbayes.app.running.explaining import choose_model
from bwbayes.app.running.fingerprint import fingerprint, require_own, save, versions
from bwbayes.app.running.folder import RunFolder
from bwbayes.app.running.progress import Progress, ProgressLine, StepProgress
from bwbayes.app.running.workers import FigureWorker, one_thread, open_executor
from bwbayes.diagnosis import averaging
from bwbayes.errors import InputError
from bwbayes.inference import Engine, resolve_engine
from bwbayes.inference.map_estimate import path_covariance
from bwbayes.record.io.formats import draft_of
from bwbayes.report.result import render, write_bands, write_summary
from bwbayes.sampling.chain import PHASES, ChainFile
from bwbayes.sampling.sampler import init_chain, sample
from bwbayes.watching import WatchSteps, part, unwatched


def begin(folder: RunFolder) -> Run:
    """Return a run with its MAP estimate, which is worked out if it is not there yet.

    Raises InputError: the folder's files do not fit together, or another process is writing them.
    """
    with folder.locked(), one_thread():
        return _open_chain(Run(folder), Console(quiet=True))


def resume(
    folder: RunFolder,
    console: Console,
    *,
    workers: int | None = None,
    ess: float | None = None,
    steps: int | None = None,
    engine: Engine | None = None,
    predict: bool = True,
    files: bool = True,
    executor: str | Executor | None = None,
    figure_worker: FigureWorker | None = None,
    run: Run | None = None,
    answer: Callable[[Run], None] | None = None,
) -> Run:
    """Finish a run, from wherever it stands; progress goes to the console.

    ``workers`` and ``executor`` are as of :func:`~bwbayes.app.running.workers.open_executor`; the
    result does not depend on them. ``ess``, ``steps`` and ``engine`` are a new target, budget or
    engine; another engine has the same posterior, but from here on not the same bits. Unless it is
    to ``predict``, it ends with the sampling. ``files`` are what a run leaves besides its config,
    records and chain; the ``figure_worker``, if any, draws them. The ``run`` is the folder's, if it
    is known already. ``answer`` is called with the fit before its files are written.

    Raises InputError: the folder's files do not fit together, or another process is writing them.
    """
    start_time = time.monotonic()
    figure_worker = figure_worker or FigureWorker()
    with folder.locked(), one_thread():
        config = run.config if run else load(folder.config)
        targets = {"ess": ess, "steps": steps, "engine": engine}
        targets = {name: value for name, value in targets.items() if value is not None}
        sampling = config.sampling.model_copy(update=targets)
        # An executor that cannot be used is refused before anything is computed for it.
        with open_executor(workers, resolve_engine(sampling.engine), executor) as pool:
            if targets:
                _rewrite(folder, config.model_copy(update={"sampling": sampling}))
            with ProgressLine(console, "reading the run ...", announced=False):
                fit = run or Run(folder)
                posterior = fit.study.posterior
            figure_worker.warm_up(posterior)
            fit = _open_chain(fit, console, engine)
            plan, chain = fit.plan, fit.chain
            with Progress(console, plan) as progress:
                if not fit.kept:
                    # It is written last, as the sign that all is done; now there is more to do.
                    folder.summary.unlink(missing_ok=True)
                outcome = sample(fit.study.posterior, plan, chain, pool, progress)
        models = sum(chain.steps(phase) for phase in PHASES) * plan.ensembles * plan.walkers
        ess = outcome.check.lowest_ess
        console.print(
            f"sampled {models} models, {models / ess:.1f} for each of {ess:.0f} effective draws",
            highlight=False,
        )
        fit = fit.with_cache(outcome=outcome)
        if not predict:
            return fit
        if not fit.kept:
            with StepProgress(console, "computing predictions ...") as watch:
                fit.compute(watch, figure_worker)
        fit.seconds = time.monotonic() - start_time
        if answer is not None:
            answer(fit)
        if files and not folder.numbers():
            with StepProgress(console, "writing figures and files ...") as watch:
                write_files(fit, folder, figure_worker, watch)
    return fit


def redraw(folder: RunFolder, watch: WatchSteps = unwatched) -> Run:
    """Write the files of a finished run again, from its chain.

    ``watch`` is called with the name of a step and the share of it that is done.

    Raises InputError: the run has no draws yet, or another process is writing it.
    """
    with folder.locked(), one_thread():
        folder.require_finished()
        fit = open_finished(folder)
        write_files(fit, folder, FigureWorker(), watch)
    return fit


def _open_chain(run: Run, console: Console, requested: Engine | None = None) -> Run:
    """Return a run with its chain open where it stands, or started with a point fit."""
    folder = run.folder
    if not folder.chain.exists():
        config_before = run.config
        with StepProgress(console, "choosing the model ...") as watch:
            run, point, steps, explanations, others = choose_model(run, watch)
            study, posterior = run.study, run.study.posterior
            paths = {name: record.path for name, record in study.records.items()}
            unsure: dict[str, str] = {}
            if any(path.noise_sd for path in paths.values()):
                source = study.generator("voltage noise")
                watch_noise = partial(watch, "noise on the voltage")
                covariance = path_covariance(posterior, paths, point, source, watch_noise)
                unsure[VOLTAGE_NOISE] = json.dumps(covariance.tolist())
            if others:
                unsure["alternatives"] = averaging.to_text(others)
        for step in map(study.quantities.say, steps):
            console.print(step, highlight=False, soft_wrap=True)
        if run.config != config_before:
            _rewrite(folder, run.config)
        if explanations is not None:
            save(folder.search, fingerprint(run), explanations)
        attributes: dict[str, str | int] = {
            "config": dump(run.config),
            "data_sha256": study.sha256,
            "posterior": fingerprint(run),
            "versions": json.dumps(versions(posterior.engine)),
            "engine": posterior.engine,
            "platform": platform.platform(),
            "seed": study.seed,
            "parameters": json.dumps(posterior.names),
            **unsure,
        }
        first = init_chain(posterior, point, run.plan, study.generator("sampling"))
        chain = ChainFile.create(folder.chain, first, point, run.plan.block, attributes)
        return run.with_cache(folder=folder, chain=chain)
    chain = ChainFile.resume(folder.chain, lambda noted: require_own(run, folder.chain, noted))
    first_engine, now = chain.attributes()["engine"], run.study.engine
    if first_engine != now:
        if requested is None:
            raise InputError(
                f"{folder.chain}: was sampled with the {first_engine} engine, not {now}; set "
                f'engine = "{first_engine}" in {folder.config}, or resume with `engine="{now}"`'
            )
        console.print(f"resuming with the {now} engine a chain begun with {first_engine}")
    return run.with_cache(chain=chain)


def _rewrite(folder: RunFolder, config: Config) -> None:
    text = dump(config)
    parse(text, "resume")  # refuses what a config cannot say
    with draft_of(folder.config) as draft:
        draft.write_text(text, encoding="utf-8")


def copy_run(fit: Run, path: Path, overwrite: bool) -> RunFolder:
    """Write all of a run into a new folder.

    Raises InputError: the folder exists and ``overwrite`` is not given, or it cannot be written.
    """
    folder = RunFolder.create(path, fit, overwrite)
    with folder.locked():
        shutil.copytree(fit.folder.chain, folder.chain)
        shutil.copyfile(fit.folder.backend, folder.backend)
        if fit.folder.calibration.path.exists():
            shutil.copytree(fit.folder.calibration.path, folder.calibration.path)
        write_files(fit, folder, FigureWorker())
        # Predictions that were asked for now may have needed them.
        for original, copy in (
            (fit.folder.search, folder.search),
            (fit.folder.rivals, folder.rivals),
        ):
            if original.exists():
                shutil.copyfile(original, copy)
    return folder


def write_files(
    fit: Run, folder: RunFolder, figure_worker: FigureWorker, watch: WatchSteps = unwatched
) -> None:
    """Write all files of a run into a folder; the summary last, as the sign that all is done.

    ``watch`` is called with the name of a step and the share of it that is done.
    """
    result, bands = fit.result, folder.path / "bands.csv"
    numbers = fit.with_cache(folder=folder).numbers
    figures = folder.path / "figures"
    shutil.rmtree(figures, ignore_errors=True)  # none of an earlier end, as of bands
    figure_worker.draw(result)
    files = partial(watch, "files")
    files(0.0)
    with draft_of(folder.path / "posterior.nc") as draft:
        # From memory: HDF5 does not survive a disk that is full.
        draft.write_bytes(bytes(fit.posterior.to_netcdf(engine="h5netcdf")))
    files(0.3)
    bands.unlink(missing_ok=True)
    if result.predictions:
        written = result.predictions, part(files, 0.3, 0.9), fit.quantities
        write_bands(bands, *written)
    fit.keep(folder)
    files(1.0)
    pictures, plots = figure_worker.collect(result, figures, partial(watch, "figures"))
    page = render(fit.full_report(), pictures, plots)
    (folder.path / "report.html").write_text(page, encoding="utf-8")
    write_summary(folder.summary, numbers)
