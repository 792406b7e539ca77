"""The commands that are no products of a run: from a record to a run, and studies of many fits.

From a record to a run: ``bwbayes init``, ``check``, ``run``, ``resume`` and ``report``; or without
one: ``bwbayes simulate``.

Studies of many fits: ``bwbayes compare``, ``campaign`` and ``calibrate``.
"""

from __future__ import annotations

import shlex
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import click
from rich.console import Console

from bwbayes.app.commands.cli import (
    command_as_typed,
    finish,
    present,
    refuse_beside_config,
    resumable,
    show_paths,
    show_report,
    working,
)
from bwbayes.app.running.workers import open_figure_worker
from bwbayes.errors import (
    ColumnsError,
    ExitStatus,
    InputError,
    NoNumbersError,
    path_text,
    refuse_unwritable,
    with_naming,
)

if TYPE_CHECKING:
    from bwbayes.app.config.config import Config
    from bwbayes.app.config.proposal import ConfigProposal
    from bwbayes.record import Record

type Reading = dict[str, Any]
"""How a record's file is read, as keyword arguments of ``read_record``."""


def init(record: Path, *, reading: Reading, out: Path | None) -> int:
    """Write a commented config for RECORD.

    Parameters
    ----------
    record
        A record's file. A record's file with the voltage, if --displacement has the rest.
    out
        The config; default: NAME-OF-RECORD.toml.

    Examples
    --------
    bwbayes init my_record.csv --unit displacement=nm
    """
    out = out or record.with_suffix(".toml")
    if out.exists():
        raise InputError(f"{out}: exists; edit it, or choose another name with --out")
    proposal = _propose_config(record, out.parent, reading)
    with refuse_unwritable(out, "choose another place with --out"):
        out.write_text(proposal.text, encoding="utf-8")
    _show(proposal, f"wrote {out}; next: `bwbayes check {out}`, then `bwbayes run {out}`")
    return 0


def check(
    config: Path,
    *,
    record: Path | None,
    reading: Reading,
    out: Path | None,
    search: str | None,
) -> int:
    """Check a CONFIG or record for issues and compute a MAP estimate; no sampling.

    Parameters
    ----------
    config
        A config, or a record. A record's file with the voltage, if --displacement has the rest.
    record
        Check this record instead of the config's.
    out
        Folder of the page; default: results/NAME-check.

    Examples
    --------
    bwbayes check runs/measured_stack.toml --record my_record.csv
    """
    chosen, in_memory = _config_or_proposal(config, record, reading, "check", quiet=True)
    chosen = chosen.with_search(search)
    out = out or Path("results") / f"{config.stem}-check"
    with working() as watch:
        from bwbayes.app.jobs.check import check as check_config

        checked = check_config(chosen, config.parent, out, watch, in_memory)
    show_report(checked)
    click.echo(f"report: {out / 'check.html'}")
    return 0


def run(
    config: Path,
    *,
    record: Path | None,
    reading: Reading,
    out: Path | None,
    seed: int | None,
    search: str | None,
    overwrite: bool,
    workers: int | None,
    quiet: bool,
    **options: Any,
) -> int:
    """Fit a model to a record: sample the posterior, predict, write the report.

    CONFIG is a config in TOML, or a record without one.

    Parameters
    ----------
    config
        A config, or a record. A record's file with the voltage, if --displacement has the rest.
    record
        Fit this record instead of the config's.
    out
        The run's folder; default: results/NAME-OF-CONFIG.

    Examples
    --------
    bwbayes run runs/ring_bender.toml --out results/ring_bender
    """
    # First of all: it loads what draws while this process loads what samples.
    with open_figure_worker(workers) as figure_worker:
        with working():
            from bwbayes.app.running.folder import RunFolder
            from bwbayes.app.study.resolve import resolve_config
            from bwbayes.report.report import Report, remarks_banner
            from bwbayes.report.run import priors_table

        chosen, in_memory = _config_or_proposal(config, record, reading, "run", quiet=quiet)
        chosen = chosen.with_name(path_text(config.stem), seed)
        path = out or Path("results") / config.stem
        chosen = chosen.with_search(search)
        with working():
            resolved = resolve_config(chosen, config.parent, in_memory)
            folder = RunFolder.create(path, resolved, overwrite)
        with resumable(f"`bwbayes resume {path}`"):
            with working():
                remarks = resolved.record_remarks
            if not quiet:
                # A proposed config has shown its remarks already.
                banners = [] if in_memory else remarks_banner(remarks)
                report_fields: Any = {"banners": banners, "quantities": resolved.quantities}
                priors = priors_table(resolved.study.posterior.prior)
                show_report(Report(title="priors", blocks=[priors], **report_fields))
            options |= {"workers": workers, "figure_worker": figure_worker}
            return finish(
                folder.path, quiet=quiet, run=resolved.with_cache(folder=folder), **options
            )


def resume(folder: Path, *, workers: int | None, quiet: bool, **options: Any) -> int:
    """Resume the run in FOLDER, interrupted or short of its target.

    Examples
    --------
    bwbayes resume results/ring_bender --steps 40000
    """
    with open_figure_worker(workers) as figure_worker:
        with working():
            import bwbayes.app.running.run  # noqa: F401  # what takes long to load

        options |= {"workers": workers, "figure_worker": figure_worker}
        return finish(folder, quiet=quiet, **options)


def report(folder: Path) -> int:
    """Draw the pictures and the page of the run in FOLDER again.

    Examples
    --------
    bwbayes report results/ring_bender
    """
    with working() as watch:
        from bwbayes.app.running.folder import RunFolder
        from bwbayes.app.running.run import redraw

        redraw(RunFolder.open(folder), watch)
    show_paths([folder / "report.html"])
    return 0


def _config_or_proposal(
    path: Path, record: Path | None, reading: Reading, command: str, *, quiet: bool
) -> tuple[Config, dict[str, Record]]:
    """Read a config; or propose one where the file is a record, and show what is wrong with it.

    Return the config, of another record if there is one, and what was read for a proposal. Records
    that only ``check`` can use are refused.
    """
    from bwbayes.app.config.config import ALONE, is_config, load

    if is_config(path):
        config = load(path)
        refuse_beside_config(path, reading)
        return config if record is None else config.with_record(record), {}
    try:
        proposal = _propose_config(path, path.parent, reading)
    except NoNumbersError:
        raise InputError(
            f"{path}: is no config, and no record; a config has a table [record], a record columns "
            "of numbers"
        ) from None
    config = proposal.config
    tables = {key: reading[key] for key in ("columns", "units", "covariates")}
    init = f"bwbayes init {shlex.quote(str(path))}"
    options = ("table", "displacement_file", "input", "output", "linearity")
    for key in options:
        option = key.removesuffix("_file")
        init += "" if reading[key] is None else f" --{option} {shlex.quote(str(reading[key]))}"
    init = with_naming(init, tables, reading["fs"])
    if command != "check" and proposal.blocking_issue is not None:
        raise InputError(
            f"{path}: {proposal.blocking_issue.error}; if the record is right as it is, "
            f"write a config with `{init}` and run that"
        )
    if not quiet:
        train = ", ".join(f"{a:g} to {b:g}" for a, b in config.records["record"].train or ())
        held_out = "the rest" if "held_out" in config.validation else "nothing"
        _show(
            proposal,
            f"training on {train} s, holding out {held_out}; save this config with `{init}`",
        )
    if record is not None:
        return config.with_record(record), {}
    return config, {ALONE: proposal.record}


def _propose_config(path: Path, where: Path, reading: Reading) -> ConfigProposal:
    """Propose a config; of unknown columns say the command that settles them."""
    try:
        with working():
            from bwbayes.app.config.proposal import draft_config
            from bwbayes.record.io.columns import Naming

            stated = Naming.stated(**reading)
            with stated.quantities.spoken():
                return draft_config(path, where, stated)
    except ColumnsError as error:
        raise error.in_command(command_as_typed()) from None


def _show(proposal: ConfigProposal, conclusion: str) -> None:
    """Show what was said of the record, with what to do."""
    from bwbayes.report.report import Banner, Report, Text, remarks_banner

    findings = [
        Banner("note", finding.kind, [finding.text, f"    fix: {finding.fix}"])
        for finding in proposal.findings
    ]
    if proposal.record.starts_at_zero:
        conclusion += (
            f"\nthe record {proposal.record.beginning}: its initial state is estimated; if it was "
            "demagnetized and nothing moved, from_rest = true under [record] makes it known"
        )
    banners = [*remarks_banner(proposal.remarks), *findings]
    blocks, quantities = [Text(conclusion, on="screen")], proposal.record.quantities
    show_report(Report(title="", banners=banners, blocks=blocks, quantities=quantities))


def simulate(
    out: Path,
    *,
    signal: str = "identification",
    amplitude: float | None = None,
    frequency: float | None = None,
    duration: float | None = None,
    discrepancy: Literal["none", "process", "structural"] = "process",
    seed: int = 1,
    rate: float = 1000.0,
    overwrite: bool = False,
) -> list[Path]:
    """Write a record of the virtual test stand to OUT (.csv, .h5, .mat), its truth beside it.

    Parameters
    ----------
    out
        The record's file. The noise-free displacement goes into ``NAME.truth.csv`` for a CSV and
        into the file itself for HDF5 and MATLAB; the true parameters into ``NAME.truth.json``.
    signal
        identification, verification, step10, step50, step100, or sine (see the next options).
    amplitude
        Amplitude of the sine, V; default: 100.
    frequency
        Frequency of the sine, Hz; default: 1.
    duration
        Duration of the sine, s; default: 16.
    discrepancy
        How the stand's actuator departs from the model.
    seed
        Seed of the noise.
    rate
        Samples a second.
    overwrite
        Replace existing files.

    Raises
    ------
    InputError
        An unknown signal, impossible values, or a file that exists already or cannot be written.

    Examples
    --------
    bwbayes simulate ring.csv --signal verification --seed 7
    """
    from bwbayes.inference.study import generator
    from bwbayes.record import write_record
    from bwbayes.record.teststand import VirtualTestStand
    from bwbayes.record.waveforms import Waveform, signal as named, sine
    from bwbayes.report.result import refuse_existing, write_summary

    parameters = out.with_name(f"{out.stem}.truth.json")
    truth_file = out.with_name(f"{out.stem}.truth{out.suffix}")
    refuse_existing([out, truth_file, parameters], overwrite=overwrite)
    stated = {"amplitude": amplitude, "frequency": frequency, "duration": duration}
    arguments = {name: value for name, value in stated.items() if value is not None}
    if signal == "sine":
        options = {"amplitude": 100.0, "frequency": 1.0, "duration": 16.0} | arguments
        waveform = Waveform(sine(options["amplitude"], options["frequency"]), options["duration"])
    elif arguments:
        raise InputError(f"simulate: {', '.join(arguments)} need --signal sine")
    else:
        waveform = named(signal)
    stand = VirtualTestStand(discrepancy, rate)
    record = stand.run(waveform, generator(seed, "record"))
    record = replace(record, origin=f"{record.origin}, {signal} signal, seed {seed}")
    write_record(record, out)
    with refuse_unwritable(parameters):
        write_summary(parameters, stand.parameters())
    return [out, *([truth_file] if truth_file.exists() else []), parameters]


def calibrate(
    config: Path | None = None,
    *,
    resumed: Path | None,
    out: Path | None,
    seed: int | None,
    overwrite: bool,
    quiet: bool,
    replicates: int | None,
    **options: Any,
) -> int:
    """Simulation-based calibration of CONFIG, or of the run whose folder CONFIG is.

    Each replicate draws parameters from the config's prior, simulates its record and fits it
    as a run does. Those of a run are drawn from its posterior, and each record is fitted together
    with the run's: are these intervals right for this record? It is kept in the run's folder, 200
    replicates by default, and shown in its report. Exit status 4: the posteriors are not what they
    say, or more than 1% of the replicates did not converge.

    Parameters
    ----------
    resumed
        Resume the calibration in this folder.
    out
        Its folder; default: results/NAME-OF-CONFIG-calibration.
    overwrite
        Replace an existing calibration.

    Examples
    --------
    bwbayes calibrate runs/calibration.toml --replicates 500
    """
    with working():
        from bwbayes.app.config.config import load
        from bwbayes.app.fit.calls import open_converged
        from bwbayes.app.jobs.calibrate import calibrate as calibrate_run, resume, start
        from bwbayes.app.running.folder import CalibrationFolder
        from bwbayes.report.calibration import calibration_report

    new = {"out": out, "seed": seed, "overwrite": overwrite}
    _refuse_beside_resume("calibrate", resumed, new)
    console, standing = Console(stderr=True, quiet=quiet), ExitStatus.SUCCESS
    options["replicates"] = replicates
    if config is not None and config.is_dir():
        if out is not None or seed is not None:
            raise InputError(f"{config}: is a run, with its seed and folder; remove --seed, --out")
        with working():
            fit = open_converged(config)
        folder, standing = fit.folder.calibration, fit.standing.exit_status
        for line in fit.standing.messages:
            click.echo(line, err=True)
        with resumable(f"`bwbayes calibrate {config}`"):
            calibration = calibrate_run(fit, overwrite=overwrite, progress=not quiet, **options)
    else:
        if config is None:
            folder = CalibrationFolder.open(Path(str(resumed)))
        else:
            chosen = load(config).with_name(config.stem, seed)
            path = out or Path("results") / f"{config.stem}-calibration"
            with working():
                folder = start(chosen, config.parent, path, replicates, overwrite=overwrite)
        with resumable(folder.resuming):
            calibration = resume(folder, console, **options)
    page = folder.path / "calibration.html"
    if not quiet:
        show_report(calibration_report(calibration))
        click.echo(f"report: {page}")
    if calibration.passed:
        return standing
    first, *others = calibration.failures
    more = f", and {len(others)} more" if others else ""
    click.echo(f"CALIBRATION FAILED: {first}{more}; see {page}", err=True)
    return ExitStatus.NOT_CONVERGED


def campaign(
    folder: Path | None = None,
    *,
    config: Path | None,
    out: Path | None,
    resumed: Path | None,
    overwrite: bool,
    pictures: bool = True,
    reading: dict[str, Any],
    quiet: bool,
    **options: Any,
) -> int:
    """Fit every record in FOLDER and compare the actuators.

    The same command goes on after an interruption, and fits records that were added or changed.
    Exit status: 2 if records were refused, else 4 if some did not converge, else 3 if validation
    failed for some, else 5 if it is inconclusive; every record is in the table in any case.

    Parameters
    ----------
    config
        Config of all records; default: each proposes its own.
    out
        The campaign's folder; default: results/NAME-OF-FOLDER.
    resumed
        Resume the campaign in this folder.
    overwrite
        Replace an existing campaign.
    pictures
        Draw each run's own figures and report.

    Examples
    --------
    bwbayes campaign records/ --config my.toml --out results/batch
    """
    with working():
        from bwbayes.app.jobs.campaign import config_text, resume, start
        from bwbayes.app.running.folder import CampaignFolder

    new = {"out": out, "config": config, "overwrite": overwrite, "pictures": not pictures}
    _refuse_beside_resume("campaign", resumed, new)
    if folder is None:
        batch = CampaignFolder.open(Path(str(resumed)))
    else:
        text, where = "", folder
        if config is not None:
            refuse_beside_config(config, reading)
            text, where = config_text(config), config.parent
        out = out or Path("results") / folder.absolute().name
        kept = {"pictures": pictures, "overwrite": overwrite}
        batch = start(folder, text, where, out, **kept, reading=reading)
    with resumable(batch.resuming):
        result = resume(batch, Console(stderr=True, quiet=quiet), **options)
    if not quiet:
        show_report(result.full_report())
        click.echo(f"report: {batch.page}")
    for row in result.rows:
        if row.reason:
            click.echo(f"{row.status.upper()}: {row.name}: {row.reason}", err=True)
    return result.exit_status


def _refuse_beside_resume(command: str, resumed: object, new: Mapping[str, object]) -> None:
    """Refuse options of a new study to resume one."""
    if resumed is not None and any(value not in (None, False) for value in new.values()):
        raise InputError(f"{command}: --resume takes no other options; remove them")


def compare(*paths: Path, models: str | None, out: Path | None, quiet: bool, **options: Any) -> int:
    """Compare the runs in folders PATHS, or models that one config is run with.

    Reports joint log scores of later readings given earlier ones, with errors; log evidence; a
    recommendation and its caveats. In --models the first word is an operator; nonlinearity, creep,
    dynamics and noise follow after plus signs. Models out of reach at their MAP estimates are only
    screened.

    Parameters
    ----------
    models
        Models to fit to a CONFIG's record; default: seven usual ones, see below.
    out
        Its folder; default: results/comparison, or by the config.

    Examples
    --------
    bwbayes compare results/bender results/bender_plays
    """
    with working():
        import bwbayes.app.jobs.compare  # noqa: F401  # what takes long to load
        from bwbayes.app.fit.calls import compare as compare_runs

    alone = len(paths) == 1 and not paths[0].is_dir()
    out = out or Path("results") / (f"{paths[0].stem}-comparison" if alone else "comparison")
    comparison = compare_runs(*paths, models=models, folder=out, progress=not quiet, **options)
    return present(comparison, [out / "comparison.html"], comparison.standing, quiet=quiet)
