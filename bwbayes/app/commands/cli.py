"""The command line: a thin layer over the package.

Exit status 0: done, and converged. 2: input that cannot be used, said in one line. 3: converged,
but bands do not hold on a record that was measured, fitted or not. 4: finished without converging,
or a calibration not passed. 130: interrupted; what was computed is kept.
"""

from __future__ import annotations

import math
import signal
import sys
import warnings
from concurrent.futures import BrokenExecutor
from pathlib import Path
from typing import TYPE_CHECKING, get_args

import click
from rich.console import Console

from bwbayes.app.commands import beginning, lookup
from bwbayes.app.config.config import LARGEST_SEED, load
from bwbayes.errors import InputError
from bwbayes.inference.engine import Engine

if TYPE_CHECKING:
    from bwbayes.app.running.folder import CalibrationFolder

__all__ = ["main"]

DOES_NOT_HOLD = 3
NOT_CONVERGED = 4

# Replicates of a calibration, unless told otherwise.
REPLICATES = 500
BAD_INPUT = 2
INTERRUPTED = 130

# Options that several commands share.
FILE = click.Path(path_type=Path)
workers_option = click.option(
    "--workers", type=click.IntRange(1), help="Ensembles side by side; default: all cores."
)
overwrite_option = click.option(
    "--overwrite", is_flag=True, help="Replace files that are there already."
)
quiet_option = click.option("--quiet", is_flag=True, help="Print nothing but errors.")


@click.group(context_settings={"help_option_names": ["-h", "--help"]})
@click.version_option(package_name="bwbayes", prog_name="bwbayes")
def cli() -> None:
    """Bayesian uncertainty of piezoelectric actuators with the Bouc-Wen hysteresis model.

    Exit status: 0 done; 2 input that cannot be used; 3 converged, but the bands do not hold on a
    record that was measured; 4 not converged, or a calibration not passed; 130 interrupted.
    """


@cli.command()
@click.argument("config", type=FILE)
@click.option("--record", type=FILE, help="Fit this record instead of the config's.")
@click.option("--out", type=FILE, help="The run's folder; default: results/NAME-OF-CONFIG.")
@click.option("--seed", type=click.IntRange(0, LARGEST_SEED), help="Seed, instead of the config's.")
@click.option("--overwrite", is_flag=True, help="Replace a run that is there already.")
@workers_option
@quiet_option
def run(
    config: Path,
    record: Path | None,
    out: Path | None,
    seed: int | None,
    overwrite: bool,
    workers: int | None,
    quiet: bool,
) -> int:
    """Sample a posterior and predict, from a CONFIG in TOML, or from a record without one.

    Example: bwbayes run runs/ring_bender.toml --out results/ring_bender
    """
    from bwbayes.app.running.run import load_run, start  # noqa: PLC0415  # --help need not wait for scipy
    from bwbayes.app.screen import show_priors  # noqa: PLC0415

    wanted = beginning.config_or_proposal(config, Console(quiet=quiet))
    if record is not None:
        source = wanted.record.model_copy(update={"file": str(record.resolve()), "signal": None})
        wanted = wanted.model_copy(update={"record": source})
    if seed is not None:
        wanted = wanted.model_copy(update={"seed": seed})
    if wanted.name is None:
        wanted = wanted.model_copy(update={"name": config.stem})
    folder = start(wanted, config.parent, out or Path("results") / config.stem, overwrite=overwrite)
    if not quiet:
        show_priors(load_run(folder).posterior.prior, Console())
    return _finish(folder.path, workers, quiet)


@cli.command()
@click.argument("folder", type=FILE)
@click.option("--ess", type=click.FloatRange(1), help="A new target of effective draws.")
@click.option("--steps", type=click.IntRange(1), help="A new budget of steps.")
@click.option("--engine", type=click.Choice(get_args(Engine)), help="Go on with this engine.")
@workers_option
@quiet_option
def resume(
    folder: Path,
    ess: float | None,
    steps: int | None,
    engine: Engine | None,
    workers: int | None,
    quiet: bool,
) -> int:
    """Go on with the run in FOLDER, interrupted or short of its target.

    Example: bwbayes resume results/ring_bender --steps 40000
    """
    return _finish(folder, workers, quiet, ess=ess, steps=steps, engine=engine)


@cli.command()
@click.argument("config", type=FILE)
@click.option("--record", type=FILE, help="Check this record instead of the config's.")
@click.option("--out", type=FILE, help="Folder of the page; default: results/NAME-check.")
def check(config: Path, record: Path | None, out: Path | None) -> int:
    """Check a CONFIG or a record, draw the record, and fit a point, without sampling.

    Example: bwbayes check runs/measured_stack.toml --record my_record.csv
    """
    from bwbayes.app.commands.check import check as look  # noqa: PLC0415

    wanted = beginning.config_or_proposal(config, Console(quiet=True), refuse=False)
    if record is not None:
        source = wanted.record.model_copy(update={"file": str(record.resolve()), "signal": None})
        wanted = wanted.model_copy(update={"record": source})
    look(wanted, config.parent, out or Path("results") / f"{config.stem}-check", Console())
    return 0


@cli.command()
@click.argument("out", type=FILE)
@click.option(
    "--signal",
    "wanted",
    default="identification",
    show_default=True,
    help="identification, verification, step10, step50, step100, or sine (see the next options).",
)
@click.option("--amplitude", type=float, help="Of the sine, V; default: 100.")
@click.option("--frequency", type=float, help="Of the sine, Hz; default: 1.")
@click.option("--duration", type=float, help="Of the sine, s; default: 16.")
@click.option(
    "--discrepancy",
    type=click.Choice(["none", "process", "structural"]),
    default="process",
    show_default=True,
    help="How the stand's actuator departs from the model.",
)
@click.option("--seed", type=click.IntRange(0, LARGEST_SEED), default=1, show_default=True)
@click.option("--rate", type=float, default=1000.0, show_default=True, help="Samples a second.")
@overwrite_option
def simulate(
    out: Path,
    wanted: str,
    amplitude: float | None,
    frequency: float | None,
    duration: float | None,
    discrepancy: str,
    seed: int,
    rate: float,
    overwrite: bool,
) -> int:
    """Write a record of the virtual test stand to OUT (.csv, .h5, .mat), its truth beside it.

    Example: bwbayes simulate ring.csv --signal verification --seed 7
    """
    from bwbayes.app.commands.simulate import simulate as write  # noqa: PLC0415

    given = (amplitude, frequency, duration)
    if wanted != "sine" and any(value is not None for value in given):
        raise InputError("simulate: amplitude, frequency and duration need --signal sine")
    first, second, third = (
        default if value is None else value
        for value, default in zip(given, (100.0, 1.0, 16.0), strict=True)
    )
    sine = (first, second, third)
    for path in write(out, wanted, sine, discrepancy, seed, rate, overwrite=overwrite):
        click.echo(f"wrote {path}")
    return 0


@cli.command()
@click.argument("folder", type=FILE)
@click.option("--record", type=FILE, help="A record to predict; measured or a voltage alone.")
@click.option("--signal", "wanted", help="A signal to predict instead, by its name.")
@click.option("--from-rest", is_flag=True, help="The record starts from a demagnetised actuator.")
@click.option(
    "--lead-in", type=float, default=1.0, show_default=True, help="Estimates the offset, s."
)
@click.option(
    "--lead-in-from", type=float, help="Where the lead-in begins, s; default: the record's start."
)
@click.option(
    "--window", type=(float, float), help="Judge and write this part alone: start and stop, s."
)
@click.option("--same-offset", is_flag=True, help="The sensor's offset is the training record's.")
@click.option("--out", type=FILE, help="The bands' CSV; default: FOLDER/predictions/NAME.csv.")
@overwrite_option
def predict(
    folder: Path,
    record: Path | None,
    wanted: str | None,
    from_rest: bool,
    lead_in: float,
    lead_in_from: float | None,
    window: tuple[float, float] | None,
    same_offset: bool,
    out: Path | None,
    overwrite: bool,
) -> int:
    """Write displacement bands for another record or voltage, from the run in FOLDER.

    Beside the bands, their scores (JSON) and a picture. Exit status 3: the bands do not hold on
    the record.

    Example: bwbayes predict results/ring_bender --record new.csv --lead-in 2
    """
    from bwbayes.app.commands.predict import predict as write  # noqa: PLC0415
    from bwbayes.results.prediction import Start  # noqa: PLC0415

    if (record is None) == (wanted is None):
        raise InputError("predict: give either --record or --signal")
    if not 0 < lead_in < math.inf:
        raise InputError(f"predict: a lead-in of {lead_in:g} s is no length of time; give another")
    begin = Start(from_rest, not same_offset, lead_in, lead_in_from)
    return write(folder, record, wanted, begin, out, Console(), window=window, overwrite=overwrite)


@cli.command()
@click.argument("folder", type=FILE)
def report(folder: Path) -> int:
    """Draw the pictures and the page of the run in FOLDER again.

    Example: bwbayes report results/ring_bender
    """
    from bwbayes.app.running.folder import RunFolder  # noqa: PLC0415
    from bwbayes.app.running.run import redraw  # noqa: PLC0415

    run_folder = RunFolder.open(folder)
    redraw(run_folder)
    click.echo(f"wrote {run_folder.path / 'report.html'}")
    return 0


@cli.command()
@click.argument("config", type=FILE, required=False)
@click.option("--resume", "begun", type=FILE, help="Go on with the calibration in this folder.")
@click.option(
    "--replicates", type=click.IntRange(1), help=f"How many; default: {REPLICATES}, or as begun."
)
@click.option("--out", type=FILE, help="Its folder; default: results/NAME-OF-CONFIG-calibration.")
@click.option("--seed", type=click.IntRange(0, LARGEST_SEED), help="Seed, instead of the config's.")
@click.option("--overwrite", is_flag=True, help="Replace a calibration that is there already.")
@click.option("--workers", type=click.IntRange(1), help="Replicates side by side; default: cores.")
@quiet_option
def calibrate(
    config: Path | None,
    begun: Path | None,
    replicates: int | None,
    out: Path | None,
    seed: int | None,
    overwrite: bool,
    workers: int | None,
    quiet: bool,
) -> int:
    """Simulation-based calibration of a CONFIG: fit simulated records whose truth is known.

    Each replicate draws parameters from the config's prior, simulates its record anew and fits it
    as a run does. Exit status 4: the posteriors are not what they say, or more than 1 % of the
    replicates did not converge.

    Example: bwbayes calibrate runs/calibration.toml --replicates 500
    """
    from bwbayes.app.commands.calibrate import start  # noqa: PLC0415
    from bwbayes.app.running.folder import CalibrationFolder  # noqa: PLC0415

    if (config is None) == (begun is None):
        raise InputError("calibrate: give either a CONFIG or --resume FOLDER")
    if begun is not None:
        if out is not None or seed is not None or overwrite:
            raise InputError("calibrate: --resume goes on as begun; leave the other options out")
        return _calibrate(CalibrationFolder.open(begun), replicates, workers, quiet)
    assert config is not None
    changes = {"name": config.stem} | ({} if seed is None else {"seed": seed})
    wanted = load(config)
    wanted = wanted.model_copy(update=changes | ({"name": wanted.name} if wanted.name else {}))
    where = out or Path("results") / f"{config.stem}-calibration"
    folder = start(wanted, config.parent, where, replicates or REPLICATES, overwrite=overwrite)
    return _calibrate(folder, None, workers, quiet)


cli.add_command(beginning.init)
cli.add_command(lookup.config)
cli.add_command(lookup.models)


def _calibrate(
    folder: CalibrationFolder, replicates: int | None, workers: int | None, quiet: bool
) -> int:
    from bwbayes.app.commands.calibrate import carry_on  # noqa: PLC0415
    from bwbayes.app.screen import show_calibration  # noqa: PLC0415

    console = Console(stderr=True, quiet=quiet)
    try:
        calibration = carry_on(folder, console, workers=workers, count=replicates)
    except KeyboardInterrupt:
        click.echo(f"interrupted; go on with `{folder.GO_ON} {folder.path}`", err=True)
        return INTERRUPTED
    if not quiet:
        show_calibration(calibration, folder, Console())
    if calibration.passed:
        return 0
    first, *others = calibration.shortcomings
    more = f", and {len(others)} more" if others else ""
    click.echo(f"NOT PASSED: {first}{more}; see {folder.path}/calibration.html", err=True)
    return NOT_CONVERGED


def _finish(
    path: Path,
    workers: int | None,
    quiet: bool,
    *,
    ess: float | None = None,
    steps: int | None = None,
    engine: Engine | None = None,
) -> int:
    from bwbayes.app.running.folder import RunFolder  # noqa: PLC0415
    from bwbayes.app.running.run import carry_on, going_on, load_run  # noqa: PLC0415
    from bwbayes.app.screen import show_result  # noqa: PLC0415

    folder = RunFolder.open(path)
    console = Console(stderr=True, quiet=quiet)
    try:
        result = carry_on(folder, console, workers=workers, ess=ess, steps=steps, engine=engine)
    except KeyboardInterrupt:
        click.echo(f"interrupted; go on with `bwbayes resume {path}`", err=True)
        return INTERRUPTED
    if not quiet:
        show_result(result, folder, Console())
    if result.failed:
        first, *others = result.failed
        more = f", and {len(others)} more" if others else ""
        # The screen begins with all of them.
        said = first.line if quiet else f"{first.name}{more}"
        click.echo(f"DOES NOT HOLD: {said}; see {path}/report.html", err=True)
        return DOES_NOT_HOLD
    if result.outcome.converged:
        return 0
    click.echo(
        f"NOT CONVERGED: {result.outcome.stop_reason}; no interval is given. Go on with "
        f"`{going_on(path, load_run(folder))}`, and look at the traces in {path}/report.html",
        err=True,
    )
    return NOT_CONVERGED


def _terminate(*_: object) -> None:
    raise KeyboardInterrupt


def _one_line(message: Warning | str, *_: object, **__: object) -> str:
    return f"bwbayes: {message}\n"


def main() -> None:
    """Run the command line; every error that a user can fix becomes one line and exit status 2."""
    # A polite request to stop ends a run as Ctrl-C does.
    signal.signal(signal.SIGTERM, _terminate)
    warnings.formatwarning = _one_line
    try:
        status = cli.main(sys.argv[1:] or ["--help"], standalone_mode=False)
    except (InputError, click.ClickException) as error:
        message = error.format_message() if isinstance(error, click.ClickException) else str(error)
        click.echo(f"bwbayes: {' '.join(message.split())}", err=True)
        status = BAD_INPUT
    except OSError as error:
        # A full disk, a folder that went away: what is on disk already stays whole.
        where = f"{error.filename}: " if error.filename else ""
        click.echo(f"bwbayes: {where}{error.strerror or error}; fix it and resume", err=True)
        status = BAD_INPUT
    except BrokenExecutor:
        click.echo("bwbayes: a worker process was ended; mind the memory, and resume", err=True)
        status = BAD_INPUT
    except MemoryError:
        click.echo("bwbayes: out of memory; take fewer samples or walkers", err=True)
        status = BAD_INPUT
    except (KeyboardInterrupt, click.Abort):
        click.echo("bwbayes: interrupted", err=True)
        status = INTERRUPTED
    sys.exit(status if isinstance(status, int) else 0)
