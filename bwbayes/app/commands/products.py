"""What is made of a run: ``predict``, ``compensate``, ``design``, ``export`` and ``track``."""

from __future__ import annotations

from functools import partial
from importlib import import_module
from pathlib import Path
from typing import Any

import click

from bwbayes.app.commands.shared import (
    FILE,
    column_options,
    command_as_typed,
    folder_argument,
    naming_options,
    options_of,
    overwrite_option,
    present,
    quiet_option,
    reading_of,
    show_report,
    working,
)
from bwbayes.errors import ColumnsError, ExitStatus, InputError, path_text


def _saved(
    module: str,
    name: str,
    folder: Path,
    out: Path,
    *arguments: Any,
    overwrite: bool,
    quiet: bool,
    **options: Any,
) -> int:
    """Do a job with the run in a folder, save and show its product; return the exit status."""
    with working() as watch:
        from bwbayes.app.fit.fitted import converged
        from bwbayes.report.outputs import refuse_existing

        # What takes long is refused at once, and every single file when it is saved.
        refuse_existing([out / f"{name}.json"], overwrite=overwrite)
        job = getattr(import_module(f"bwbayes.app.jobs.{module}"), name)
        try:
            product = job(converged(folder), *arguments, watch=watch, **options)
        except ColumnsError as error:
            raise error.in_command(command_as_typed()) from None
        files = product.save(out, overwrite=overwrite, watch=partial(watch, "figures"))
        report = product.report()
    status = present(report, files, product.standing, quiet=quiet)
    if quiet and product.shortfall:
        click.echo(product.shortfall, err=True)
    # The worse of the two: a failure, then what is uncertain.
    endings = (ExitStatus.VALIDATION_FAILED, ExitStatus.VALIDATION_INCONCLUSIVE)
    return next((end for end in endings if end in (status, product.exit_status)), status)


@click.command()
@folder_argument
@click.option(
    "--record", "--voltage", type=FILE, help="Record to predict (measured, or voltage only)."
)
@naming_options
@options_of(
    "bwbayes.app.jobs.predict:predict", "name", "table", "displacement_file", "own_offset", "watch"
)
@click.option("--same-offset", is_flag=True, help="The sensor's offset is the training record's.")
@click.option("--out", type=FILE, help="The bands' CSV; default: FOLDER/predictions/NAME.csv.")
@overwrite_option
def predict(
    folder: Path,
    record: Path | None,
    same_offset: bool,
    out: Path | None,
    overwrite: bool,
    columns: dict[str, str],
    units: dict[str, str],
    fs: float | None,
    **options: Any,
) -> int:
    """Write displacement bands for another record or voltage, from the run in FOLDER.

    A record of the same columns as the run's is read as that was. Beside the bands, their scores
    (JSON) and a figure. Exit status 3: validation failed on the record; 5: it is inconclusive.

    Example: bwbayes predict results/ring_bender --record new.csv --lead-in 2
    """
    if (record is None) == (options["signal"] is None):
        raise InputError("predict: give either a record or a signal")
    name = options["signal"] if record is None else path_text(record.stem)
    bands_file = out or folder / "predictions" / f"{name}.csv"
    files = [bands_file, bands_file.with_suffix(".json"), bands_file.with_suffix(".png")]
    if bands_file in files[1:]:
        raise InputError(f"{bands_file}: the bands are a table; give a name that ends in .csv")
    with working() as watch:
        import numpy as np

        from bwbayes.app.fit.fitted import converged
        from bwbayes.app.jobs.predict import predict as predict_record
        from bwbayes.app.jobs.predict import write_prediction
        from bwbayes.record import Record, read_record
        from bwbayes.report.outputs import refuse_existing
        from bwbayes.report.report import Report, remarks_banner, standing_banner

        refuse_existing(files, overwrite=overwrite)
        fit = converged(folder)
        other: Record | Path | None = record
        try:
            if record and (columns or units or fs is not None):
                naming: dict[str, Any] = {"columns": columns, "units": units, "fs": fs}
                naming |= {key: options[key] for key in ("table", "displacement_file")}
                other = read_record(record, need_displacement=False, **naming)
            options |= {"name": name, "own_offset": not same_offset, "watch": watch}
            bands = predict_record(fit, other, **options)
        except ColumnsError as error:
            raise error.in_command(command_as_typed()) from None
        write_prediction(bands, files, fit.standing, partial(watch, "files"))
    unmeasured, remarks = bands.measured is None, list[str]()
    if unmeasured and record is not None:
        remarks.append(
            f"{record}: has no displacement that is recognized, so the bands are not validated; if "
            "a column is one, say --column displacement=NAME"
        )
    known = options["from_rest"] or options["after"]
    if unmeasured and not (known or any("--from-rest" in remark for remark in bands.remarks)):
        width = bands.upper["sensor", 95] - bands.lower["sensor", 95]
        remarks.append(
            "the state that the actuator starts from is unknown: the 95% sensor band is "
            f"{width[0]:.3g} um wide at first, {np.median(width):.3g} um in the median; if it is "
            "demagnetized, say --from-rest"
        )
    banners = [*standing_banner(fit.standing), *remarks_banner(remarks)]
    show_report(Report(title=name, banners=banners))
    # The worse of the two.
    own = bands.standing.holds is False or fit.standing.holds
    worse = bands.standing if own else fit.standing
    return present(bands.report(), files, worse)


@click.command()
@folder_argument
@click.argument(
    "shape", required=False, type=click.Choice(["sine", "triangle", "staircase", "raster"])
)
@click.option(
    "--reference", type=FILE, help="A file with time and displacement, in place of SHAPE."
)
@column_options
@options_of("bwbayes.app.jobs.control:compensate", "reading", "watch", smoothed="smooth")
@click.option("--out", type=FILE, help="Where the files go; default: FOLDER/compensation/NAME.")
@overwrite_option
@quiet_option
def compensate(
    folder: Path, shape: str | None, reference: Path | None, out: Path | None, **options: Any
) -> int:
    """Compute the voltage command for a reference displacement, with the run in FOLDER.

    The displacement is in a file, or one of the usual shapes. 0 um is where the actuator stands at
    zero volts as the command begins, so the default voltages are those fitted and 0 V. What the
    voltage will do is predicted with its error; beside it stands what a linear command would do.
    Exit status 3: a --limit is exceeded more probably than not; 5: it is kept at less than 95%.

    Example: bwbayes compensate results/ring_bender sine --amplitude 40 --frequency 1 --from-rest
    """
    requested = shape or reference
    if requested is None or (shape and reference):
        raise InputError("compensate: give either a shape or --reference")
    options["reading"] = reading_of(options, reference, "--reference")
    out = out or folder / "compensation" / Path(requested).stem
    return _saved("control", "compensate", folder, out, requested, **options)


@click.command()
@folder_argument
@click.option("--parameter", help="The parameter to know better.")
@click.option(
    "--drive", type=FILE, help="Or the drive whose band is to be narrow: a record or a signal."
)
@column_options
@options_of("bwbayes.app.jobs.design:design", "reading", "watch")
@click.option("--out", type=FILE, help="Where the best goes; default: FOLDER/design.")
@overwrite_option
@quiet_option
def design(
    folder: Path, parameter: str | None, drive: Path | None, out: Path | None, **options: Any
) -> int:
    """Rank input signals by the expected reduction in posterior SD, from the run in FOLDER.

    What would be left of a parameter's standard deviation, or of a band's width along a drive,
    after one more record; the best signal within the amplifier's limits goes into best.csv.

    Example: bwbayes design results/ring_bender --parameter beta --slew 2000
    """
    target = parameter or drive
    if target is None or (parameter and drive):
        raise InputError("design: give either a parameter or a drive")
    options["reading"] = reading_of(options, drive, "--drive")
    return _saved("design", "design", folder, out or folder / "design", target, **options)


@click.command()
@folder_argument
@click.option("--out", type=FILE, help="Where the files go; default: FOLDER/export.")
@options_of("bwbayes.app.jobs.control:export")
def export(folder: Path, out: Path | None, **options: Any) -> int:
    """Write the model of the run in FOLDER for a controller: JSON, and C with its inverse.

    It is the posterior's mean. The C file needs math.h alone and does a sample a call; its head
    says which sample, and what a value does that is not a number. 0 um is where the demagnetized
    actuator stands at zero volts.

    Example: bwbayes export results/ring_bender --rate 1000
    """
    out = out or folder / "export"
    with working():
        from bwbayes.app.fit.fitted import converged
        from bwbayes.app.jobs.control import FILES
        from bwbayes.app.jobs.control import export as write

        model = write(converged(folder), out, **options)
    for line in model.standing.said:
        click.echo(line, err=True)
    if model.without_inverse is not None:
        click.echo(f"bwbayes: no inverse in it: {model.without_inverse}", err=True)
    for name in FILES:
        click.echo(f"wrote {out / name}")
    return model.standing.exit_status


@click.command()
@folder_argument
@click.option("--out", type=FILE, help="Where the files go; default: FOLDER/track.")
@options_of("bwbayes.app.jobs.control:track", "watch", frequencies="frequency")
@overwrite_option
@quiet_option
def track(folder: Path, out: Path | None, **options: Any) -> int:
    """Simulate closed-loop tracking with the run in FOLDER: open loop, feedforward, PID, and both.

    On the virtual test stand, with every draw of the posterior for actuator, and the paper's
    signals: a linear command, the mean model's inverse (feedforward), a PID controller, and both
    together. 0 um is where the demagnetized actuator stands at zero volts; the default voltages
    are those fitted and 0 V.

    Example: bwbayes track results/ring_bender --frequency 1 --frequency 10
    """
    return _saved("control", "track", folder, out or folder / "track", **options)
