"""A run, from a config or from where it was interrupted, to its last file.

:func:`start` makes the run's folder; :func:`carry_on` does whatever is left to do in one: point
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
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import NamedTuple

from rich.console import Console

from bwbayes.app.config.config import Config, dump, load, parse
from bwbayes.app.figures import draw_all, save
from bwbayes.app.problem.problem import Problem, generator, resolve
from bwbayes.app.report.report import render
from bwbayes.app.running.assembling import assemble
from bwbayes.app.running.drawing import Beside, beside
from bwbayes.app.running.fingerprint import fingerprint, require_same, versions
from bwbayes.app.running.folder import RunFolder
from bwbayes.app.running.predictions import judged, predictions
from bwbayes.app.running.progress import Progress
from bwbayes.app.running.workers import executor, one_thread
from bwbayes.arrays import FloatArray
from bwbayes.errors import InputError
from bwbayes.inference import pointfit
from bwbayes.inference.engine import Engine
from bwbayes.inference.posterior import Posterior
from bwbayes.results.outputs import write_bands, write_posterior, write_summary
from bwbayes.results.result import Result, summary
from bwbayes.sampling.sampler import Outcome, first_chain, sample
from bwbayes.sampling.storage import ChainFile

__all__ = [
    "Run",
    "assemble",
    "carry_on",
    "finished",
    "go_on",
    "judged",
    "load_run",
    "numbers_of",
    "predictions",
    "redraw",
    "start",
    "versions",
    "write_files",
]


class Run(NamedTuple):
    """A run whose sampling has come to an end: its problem, chain and outcome.

    ``seconds`` is the wall time that it took, and ``result`` what came of it.
    """

    problem: Problem
    chain: ChainFile
    outcome: Outcome
    result: Result
    seconds: float


def start(config: Config, where: Path, out: Path, *, overwrite: bool = False) -> RunFolder:
    """Make the folder of a new run; the config's files are relative to the folder ``where``.

    Raises
    ------
    InputError
        The config, its records or the folder cannot be used.
    """
    return RunFolder.create(out, resolve(config, where), overwrite)


def load_run(folder: RunFolder) -> Problem:
    """Return the problem of a run's folder."""
    return resolve(load(folder.config), folder.path)


def carry_on(
    folder: RunFolder,
    console: Console,
    *,
    workers: int | None = None,
    ess: float | None = None,
    steps: int | None = None,
    engine: Engine | None = None,
    how: str | Executor | None = None,
    apart: bool = False,
    show: Callable[[Problem], None] | None = None,
) -> Result:
    """Finish a run and write its files, as :func:`go_on` does; return the result."""
    to = partial(go_on, ess=ess, steps=steps, engine=engine)
    return to(folder, console, workers=workers, how=how, apart=apart, show=show).result


def go_on(
    folder: RunFolder,
    console: Console,
    *,
    workers: int | None = None,
    ess: float | None = None,
    steps: int | None = None,
    engine: Engine | None = None,
    files: bool = True,
    how: str | Executor | None = None,
    apart: bool = False,
    show: Callable[[Problem], None] | None = None,
) -> Run:
    """Finish a run.

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
        Go on with this engine, whatever the chain was begun with: the same posterior, but from
        here on not the same bits.
    files
        Write what a run leaves besides its config, records and chain.
    how
        Which executor, as in :func:`~bwbayes.app.running.workers.executor`.
    apart
        Draw in a process of its own, if there may be several: sooner, and the same pictures.
    show
        Is called with the problem before anything is done with it.

    Raises
    ------
    InputError
        The folder's files do not fit together, or another process is writing them.
    """
    begun = time.monotonic()
    # First of all: it goes on from this process as it is now.
    with beside(workers, asked=apart and files) as artist, folder.locked(), one_thread():
        if any(one is not None for one in (ess, steps, engine)):
            _retarget(folder, ess, steps, engine)
        problem = load_run(folder)
        if show is not None:
            show(problem)
        with (
            _chain(folder, problem, console, engine) as chain,
            executor(workers, problem.posterior.engine, how) as pool,
            Progress(console, problem.plan) as progress,
        ):
            # It is written last, as the sign that all is done; now there is more to do.
            folder.summary.unlink(missing_ok=True)
            outcome = sample(problem.posterior, problem.plan, chain, pool, progress)
        console.print("predicting and drawing ..." if files else "predicting ...", highlight=False)
        result = assemble(problem, chain, outcome, artist)
        seconds = time.monotonic() - begun
        if files:
            write_files(folder, problem, result, seconds, artist)
    return Run(problem, chain, outcome, result, seconds)


def redraw(folder: RunFolder) -> Result:
    """Write the files of a finished run again, from its chain.

    Raises
    ------
    InputError
        The run has no draws yet, or another process is writing it.
    """
    with folder.locked(), one_thread():
        if not folder.summary.is_file():
            raise InputError(
                f"{folder.path}: the run is not finished; go on with {folder.resuming}"
            )
        seconds = json.loads(folder.summary.read_text(encoding="utf-8"))["wall_s"]
        problem, chain, outcome = finished(folder)
        result = assemble(problem, chain, outcome)
        write_files(folder, problem, result, seconds)
    return result


def finished(folder: RunFolder) -> tuple[Problem, ChainFile, Outcome]:
    """Read a run's problem and chain, and judge the chain as it stands.

    Raises
    ------
    InputError
        The chain is missing, damaged or still in its pilot.
    """
    problem = load_run(folder)
    chain = ChainFile.read(folder.chain)
    _require_its_own(folder.chain, problem, chain.attributes())
    if chain.blocks("sampling") == 0:
        raise InputError(f"{folder.path}: no draws yet; go on with {folder.resuming}")
    as_it_stands = replace(problem.plan, most_steps=chain.steps("sampling"))
    with executor(1) as pool:
        return problem, chain, sample(problem.posterior, as_it_stands, chain, pool)


def _chain(
    folder: RunFolder, problem: Problem, console: Console, requested: Engine | None
) -> ChainFile:
    """Open the run's chain where it stands, or start it with a point fit."""
    posterior, config = problem.posterior, problem.config
    if folder.chain.exists():
        chain = ChainFile.resume(folder.chain, partial(_require_its_own, folder.chain, problem))
        begun, now = chain.attributes()["engine"], posterior.engine
        if begun != now:
            if requested is None:
                chain.close()
                raise InputError(
                    f"{folder.chain}: was sampled with the {begun} engine, not {now}; set "
                    f'engine = "{begun}" in {folder.config}, or resume with `engine="{now}"`'
                )
            console.print(f"going on with the {now} engine a chain begun with {begun}")
        return chain
    console.print("point fit ...", highlight=False)
    point = pointfit.fit(posterior, generator(config.seed, "point fit"))
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
    return ChainFile.create(folder.chain, first, point, problem.plan.block, attributes)


def _require_its_own(path: Path, problem: Problem, noted: Mapping[str, str | int]) -> None:
    """Refuse a chain, of these attributes, of another posterior than the folder's config says."""
    if noted.get("data_sha256") != problem.sha256:
        raise InputError(f"{path}: belongs to another record; undo the edit or start a new run")
    require_same(noted.get("posterior"), problem.config, path)


def _retarget(
    folder: RunFolder, ess: float | None, steps: int | None, engine: Engine | None
) -> None:
    config = load(folder.config)
    changes = {"ess": ess, "steps": steps, "engine": engine}
    sampling = config.sampling.model_copy(
        update={name: value for name, value in changes.items() if value is not None}
    )
    text = dump(config.model_copy(update={"sampling": sampling}))
    parse(text, "resume")  # refuses what a config cannot say
    draft = folder.config.with_suffix(".partial")
    draft.write_text(text, encoding="utf-8")
    draft.replace(folder.config)


def log_likelihood(posterior: Posterior, result: Result) -> FloatArray:
    """Return the log likelihood of each draw, nats, shaped as ``result.log_density``."""
    prior = posterior.prior
    _, log_prior = prior.constrain(prior.unconstrain(result.flat_draws))
    return result.log_density - log_prior.reshape(result.log_density.shape)


def going_on(path: Path, problem: Problem) -> str:
    """Return the command that goes on with a run, with twice the budget that it had."""
    return f"bwbayes resume {path} --steps {2 * problem.config.sampling.steps}"


def numbers_of(
    folder: RunFolder, problem: Problem, result: Result, seconds: float
) -> dict[str, object]:
    """Return a run's numbers as its summary holds them."""
    return summary(result) | {
        "seed": problem.config.seed,
        "go_on": None if result.outcome.converged else going_on(folder.path, problem),
        "wall_s": seconds,
        "versions": versions(problem.posterior.engine),
        "data_sha256": problem.sha256,
    }


def write_files(
    folder: RunFolder,
    problem: Problem,
    result: Result,
    seconds: float,
    artist: Beside | None = None,
) -> None:
    """Write all files of a run; the summary last, as the sign that all is done."""
    figures = folder.path / "figures"
    shutil.rmtree(figures, ignore_errors=True)  # none of an earlier end, as of bands
    if artist is not None:
        artist.draw(result)
    numbers = numbers_of(folder, problem, result, seconds)
    density = log_likelihood(problem.posterior, result)
    write_posterior(folder.path / "posterior.nc", result, density, problem.records)
    (folder.path / "bands.csv").unlink(missing_ok=True)
    if result.bands:
        write_bands(folder.path / "bands.csv", result.bands)
    if artist is None:
        page = render(result, numbers, save(draw_all(result), figures))
    else:
        page = render(result, numbers, artist.pictures(result, figures), artist.plots(result))
    (folder.path / "report.html").write_text(page, encoding="utf-8")
    write_summary(folder.summary, numbers)
