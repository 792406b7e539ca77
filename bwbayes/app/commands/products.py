"""The commands of a run's verbs, and ``predict``, which writes bands instead of a page."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
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
    type_of,
    working,
    worse,
)
from bwbayes.app.verbs import Verb
from bwbayes.errors import ColumnsError, InputError, path_text


def command_of(verb: Verb) -> click.Command:
    """Return the command of a verb, which saves and shows the product of the run in FOLDER."""
    words = _words(verb)
    below = verb.below or verb.name
    # A verb that reads a file takes the options on its columns.
    reads = any(name == "reading" for name, *_ in verb.options())
    files = [word for word in words if reads and word.type is FILE]

    def command(
        folder: Path, out: Path | None, overwrite: bool, quiet: bool, **options: Any
    ) -> int:
        for file in files:
            options["reading"] = reading_of(options, options[str(file.name)], file.opts[0])
        given = [options.pop(str(word.name)) for word in words]
        arguments = [value for value in given if value is not None]
        if verb.either and len(arguments) + bool(options.get(verb.instead)) != 1:
            ways = [*verb.either.values(), *[f"--{verb.instead}"] * bool(verb.instead)]
            raise InputError(f"{verb.name}: give either {' or '.join(ways)}")
        stem = "".join(Path(str(value)).stem for value in arguments)
        out = out or folder / below.replace("NAME", stem)
        with working() as watch:
            from bwbayes.app.fit.fitted import open_converged
            from bwbayes.report.outputs import refuse_existing

            # Refuse before the computation; saving refuses every single file.
            kind = verb.load(verb.product)
            refuse_existing([out / f"{kind.NAME}.json"], overwrite=overwrite)
            fit = open_converged(folder)
            try:
                with fit.quantities.spoken():
                    product = verb.load()(fit, *arguments, watch=watch, **options)
            except ColumnsError as error:
                raise error.in_command(command_as_typed()) from None
            product.said_in(fit.quantities)
            saved = product.save(out, overwrite=overwrite, watch=partial(watch, "figures"))
        return present(product, saved, fit.standing, quiet=quiet)

    where = f"Where the files go; default: FOLDER/{below}."
    out_option = click.Option(["--out"], type=FILE, help=where)
    first = [click.Argument(["folder"], type=FILE), *words, out_option]
    options = options_of(verb, "overwrite")
    about, *example = verb.help
    text = [about, "FOLDER has the run, with whose status the command ends.", *example]
    decorated = options(overwrite_option(quiet_option(command)))
    if reads:
        decorated = column_options(decorated)
    return click.command(verb.name, params=first, help="\n\n".join(text))(decorated)


def _words(verb: Verb) -> list[click.Parameter]:
    """Return the words and options that give a verb's arguments after the fit."""
    words: list[click.Parameter] = []
    for name, hint in verb.words.items():
        kind = type_of(name, hint)
        for usage, text in zip(verb.either or [name], verb.sentences(name), strict=False):
            flag, _, value = usage.partition(" ")
            if flag.startswith("--"):
                words.append(click.Option([flag], type=FILE if value else str, help=text))
            else:
                words.append(click.Argument([flag.lower()], required=not verb.either, type=kind))
    return words


@click.command()
@folder_argument
@click.option(
    "--record", "--voltage", type=FILE, help="Record to predict (measured, or voltage only)."
)
@naming_options
@options_of(
    Verb("bwbayes.app.jobs.predict:predict"),
    "name",
    "table",
    "displacement_file",
    "estimate_offset",
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

        from bwbayes.app.fit.fitted import open_converged
        from bwbayes.app.jobs.predict import predict as predict_record
        from bwbayes.app.jobs.predict import write_prediction
        from bwbayes.report.outputs import refuse_existing
        from bwbayes.report.report import remarks_banner, standing_banner

        refuse_existing(files, overwrite=overwrite)
        fit = open_converged(folder)
        try:
            options |= {"name": name, "estimate_offset": not same_offset, "watch": watch}
            keys = ("columns", "units", "fs", "covariates", "input", "output")
            reading = {key: options.pop(key) for key in keys}
            with fit.quantities.spoken():
                bands = predict_record(fit, record, reading=reading, **options)
        except ColumnsError as error:
            raise error.in_command(command_as_typed()) from None
        write_prediction(bands, files, fit.standing, partial(watch, "files"), fit.quantities)
    unmeasured, remarks = bands.measured is None, list[str]()
    if unmeasured and record is not None:
        remarks.append(
            f"{record}: has no displacement that is recognized, so the bands are not validated; if "
            "a column is one, say --column displacement=NAME"
        )
    is_known = options["from_rest"] or options["after"]
    if unmeasured and not (is_known or any("--from-rest" in remark for remark in bands.remarks)):
        width = bands.upper["sensor", 95] - bands.lower["sensor", 95]
        remarks.append(
            "the state that the actuator starts from is unknown: the 95% sensor band is "
            f"{width[0]:.3g} um wide at first, {np.median(width):.3g} um in the median; if it is "
            "demagnetized, say --from-rest"
        )
    banners = [*standing_banner(fit.standing), *remarks_banner(remarks)]
    report = bands.report()
    banners = [*banners, *report.banners]
    show_report(replace(report, banners=banners, quantities=fit.quantities))
    for path in files:
        click.echo(f"wrote {path}")
    return worse(fit.standing.exit_status, bands.standing.exit_status)
