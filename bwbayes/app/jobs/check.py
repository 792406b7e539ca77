"""What to know of a record and a config before a run: on the screen, and as a page with pictures.

:func:`check` resolves the config, looks at the record, fits a point, and says what the record
shows to be wrong with it, each with the line of config that deals with it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

from rich.console import Console
from rich.markup import escape

from bwbayes.app.config.config import Config
from bwbayes.app.figures import save
from bwbayes.app.figures.record import draw_record
from bwbayes.app.figures.style import unit_text
from bwbayes.app.problem.problem import Problem, generator, resolve
from bwbayes.app.report.page import Table, picture, template
from bwbayes.app.report.words import symbol
from bwbayes.app.screen import show_priors
from bwbayes.data import Record
from bwbayes.inference import conflict, pointfit
from bwbayes.results import identifiability

__all__ = ["check", "write_page"]

CAPTIONS = {
    "time": (
        "Along time",
        "Voltage and displacement. Grey: readings that are not fitted; coloured: the parts of the "
        "record with which something is wrong.",
    ),
    "loop": ("Hysteresis loop", "Displacement against voltage, coloured by time."),
    "drive": ("Spectrum of the drive", "Amplitude of the voltage at each frequency."),
}


def check(config: Config, folder: Path, out: Path, console: Console) -> Problem:
    """Check a config and its record, fit a point, and write ``out/check.html``.

    Parameters
    ----------
    config
        The config; its files are relative to `folder`.
    out
        The page's folder, made if need be; an existing page is replaced.
    console
        Shows the record, what is wrong with it, priors and point fit.

    Raises
    ------
    InputError
        The config or its record cannot be used.
    """
    problem = resolve(config, folder)
    posterior = problem.posterior
    findings = problem.findings
    point = pointfit.fit(posterior, generator(problem.config.seed, "point fit"))
    free, _ = posterior.prior.constrain(point.mode[None])
    fitted = dict(zip(posterior.names, free[0], strict=True))
    likely = conflict.around(posterior.prior, point, generator(problem.config.seed, "around"))
    # The findings are remarks too, but here they come with what to do.
    shown = {f"{name}: {one}" for name, every in findings.items() for one in every}
    remarks = [remark for remark in problem.remarks if remark not in shown]
    remarks += conflict.conflicts(posterior.prior, likely, problem.defaults)
    untold = identifiability.remarks(posterior, point, likely)
    page = write_page(out, problem, [*remarks, *untold], fitted)

    def say(text: str) -> None:
        console.print(text, highlight=False, soft_wrap=True)

    for name, record in problem.records.items():
        say(f"{name}: " + escape("; ".join(fact for _, fact in _facts(record))))
        for one in findings[name]:
            say(f"{escape(one.kind)}: {escape(one.text)}\n    what to do: {escape(one.remedy)}")
        if not findings[name]:
            say("nothing wrong shows in the record")
    show_priors(posterior.prior, console, fitted)
    for remark in remarks:
        say(f"note: {escape(remark)}")
    for text in untold:
        say(f"warning: {escape(text)}")
    say(f"pictures: {escape(str(page))}")
    return problem


def write_page(
    out: Path,
    problem: Problem,
    remarks: Sequence[str],
    fitted: Mapping[str, float],
) -> Path:
    """Write the page and its pictures to a folder, and return the page's path."""
    figures, facts, several = {}, [], len(problem.records) > 1
    for name, record in problem.records.items():
        training = problem.posterior.alone(name).only.training
        for kind, figure in draw_record(record, training, problem.findings[name]).items():
            figures[f"{kind}_{name}" if several else kind] = figure
        for subject, fact in _facts(record):
            facts.append((f"{subject}, {name}" if several else subject, fact))
    pictures = save(figures, out / "figures")
    page = template("check.html.j2").render(
        name=problem.config.name or problem.record.origin,
        findings=[one for every in problem.findings.values() for one in every],
        remarks=remarks,
        about="; ".join(f"{subject} {fact}" if several else fact for subject, fact in facts),
        known=facts,
        pictures=[picture(png, name, *_caption(name)) for name, png in pictures.items()],
        parameters=_table(problem, fitted),
    )
    path = out / "check.html"
    path.write_text(page, encoding="utf-8")
    return path


def _caption(name: str) -> tuple[str, str]:
    """Return title and text of a figure; of several records its name is that of its record too."""
    kind, _, record = name.partition("_")
    title, text = CAPTIONS[kind]
    return (f"{title}: {record}" if record else title), text


def _facts(record: Record) -> list[tuple[str, str]]:
    low, high = record.range_voltage
    missing = record.samples - record.readings
    return [
        ("origin", record.origin),
        ("samples", f"{record.samples} samples every {record.interval:g} s"),
        ("voltage", f"{low:.4g} to {high:.4g} V ({record.voltage_is})"),
        ("readings", f"{record.readings} readings" + (f", {missing} missing" if missing else "")),
    ]


def _table(problem: Problem, fitted: Mapping[str, float]) -> Table:
    rows = [
        (
            parameter.description,
            symbol(parameter).html,
            str(parameter.prior) if parameter.prior else f"fixed at {parameter.fixed:g}",
            f"{fitted[parameter.name]:.5g}" if parameter.name in fitted else "",
            unit_text(parameter.unit),
        )
        for parameter in problem.parameters
    ]
    titles = ("Parameter", "Symbol", "Prior or value", "Point fit", "Unit")
    return Table("priors", "Parameters", titles, rows)
