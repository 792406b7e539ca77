"""The report: one HTML page with a run's answer, why one may believe it, and all the rest.

:func:`render` puts a :class:`~bwbayes.results.result.Result`, its summary and its pictures into
the page's template. What does not hold is said first. Without convergence the page says so, and
says nothing of parameters or displacement.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

from bwbayes.app.figures.style import title
from bwbayes.app.report import tables
from bwbayes.app.report.captions import OF_THE_CHAIN, caption
from bwbayes.app.report.page import PagePlots, Picture, picture, template
from bwbayes.app.report.words import covered, error_text, mark
from bwbayes.results.bands import Bands
from bwbayes.results.result import Result

__all__ = ["render"]

# Figures by where they stand; those of bands come with the evidence, held-out ones first.
ANSWER = ("loop",)
EVIDENCE = ("agreement", "coverage", "innovations", "spectrum")

LEVEL = 95  # %, of the bands that the answer speaks of


def render(
    result: Result,
    summary: Mapping[str, Any],
    pictures: Mapping[str, bytes],
    plots: PagePlots | None = None,
) -> str:
    """Return the report's page.

    Parameters
    ----------
    result
        The run.
    summary
        Its numbers, as :func:`bwbayes.results.result.summary` returns them; ``seed``, ``wall_s``,
        ``versions`` and ``data_sha256`` are shown too if they are there, and without convergence
        ``go_on``, the command that goes on.
    pictures
        PNG files by the name of their figure, in their order.
    plots
        What :func:`bwbayes.app.figures.interactive.made` returns of the run, if that was called.
    """
    if plots is None:
        from bwbayes.app.figures import interactive  # noqa: PLC0415  # bokeh is slow to load

        plots = interactive.made(result)
    converged = result.outcome.converged
    check = result.outcome.check
    shown = {
        name: picture(png, name, *caption(name), plots.drawn.get(name, ""))
        for name, png in pictures.items()
        if converged or name in OF_THE_CHAIN
    }
    held_out_first = sorted(result.bands, key=lambda bands: bands.training)
    return template("report.html.j2").render(
        name=result.name,
        about=_about(result),
        converged=converged,
        standing=result.standing,
        open=[v for v in result.verdicts.values() if v.holds is result.standing.holds],
        headline=_headline(result),
        answers=list(_answers(result, held_out_first)),
        stop_reason=result.outcome.stop_reason,
        sampled=f"{check.steps} steps, {100 * check.acceptance:.0f} % of the moves accepted.",
        go_on=summary.get("go_on") or "bwbayes resume FOLDER --steps N",
        remarks=result.remarks,
        parameters=tables.parameters(result, summary) if converged else None,
        validation=tables.validation(result, summary) if converged and result.scores else None,
        scores=tables.scores(result, summary) if converged and result.scores else None,
        loops=tables.loops(result, summary),
        loops_closed=result.loops is None
        or all(one.closed for one in (result.loops.major, result.loops.minor)),
        steps=tables.steps(result, summary),
        sampling=tables.sampling(result, summary),
        moves=tables.moves(result),
        pareto_k=None if check.pareto_k is None else f"{check.pareto_k:.2f}",
        priors=tables.priors(result),
        taught=tables.taught(result),
        learned=result.learned.remarks if result.learned is not None else (),
        replicated=tables.replicated(result),
        constraints=[
            parameter.declared.stated_bounds
            for parameter in result.parameters
            if parameter.declared is not None and parameter.declared.stated_bounds
        ],
        pictures=shown,
        scripts=plots.scripts if any(one.plot for one in shown.values()) else [],
        evidence=_in_order(shown, [f"bands_{one.name}" for one in held_out_first]),
        facts=[*result.facts.items(), *_circumstances(summary)],
    )


def _in_order(shown: Mapping[str, Picture], of_bands: list[str]) -> list[Picture]:
    """Return the pictures of the evidence: bands, then what is not in a place of its own."""
    # Of several records "innovations_NAME" is one of the innovations.
    of_records = [name for kind in EVIDENCE for name in shown if name.partition("_")[0] == kind]
    return [shown[name] for name in (*of_bands, *of_records) if name in shown]


def _about(result: Result) -> str:
    """Return what was fitted to what, in a line."""
    known = result.facts
    parts = [
        f"{subject.capitalize()}: {fact}"
        for subject, fact in known.items()
        if subject.partition(" ")[0] == "record"
    ]
    parts += [f"fitted {known['fitted']}"] if "fitted" in known else []
    held_out = [f"{one.name} ({_span(one)})" for one in result.bands if not one.training]
    parts += [f"predicted {', '.join(held_out)}"] if held_out else []
    parts += [f"model {known['model']}"] if "model" in known else []
    parts += [f"noise {known['noise']}"] if "noise" in known else []
    return "; ".join(parts)


def _span(bands: Bands) -> str:
    windows = [bands.time[window] for window in bands.windows]
    return ", ".join(f"{time[0]:g} to {time[-1]:g}" for time in windows) + " s"


def _headline(result: Result) -> str:
    """Return what may be said of a converged run none of whose bands fail."""
    if any(not verdict.training for verdict in result.verdicts.values()):
        return "Converged; validation passed on held-out data"
    return "Converged; validation passed on the training data" if result.verdicts else "Converged"


def _answers(result: Result, every: list[Bands]) -> Iterator[dict[str, str]]:
    """Yield what the bands did on readings that were not fitted, or else on those that were."""
    judged = [bands for bands in every if bands.name in result.scores]
    for bands in [one for one in judged if not one.training] or judged:
        scores = result.scores[bands.name]
        verdict = result.verdicts.get(bands.name)
        yield {
            "where": f"{title(bands)}, {_span(bands)}",
            "status": mark(verdict.status) if verdict else "",
            "coverage": covered(scores, "sensor", LEVEL),
            "width": f"{scores.width_um[LEVEL]:.2f} µm",
            "error": error_text(scores),
            "most": f"{scores.max_error_um:.2f} µm",
        }


def _circumstances(summary: Mapping[str, Any]) -> Iterator[tuple[str, str]]:
    """Yield what the summary knows of the run besides its results."""
    if "seed" in summary:
        yield "seed", str(summary["seed"])
    if isinstance(wall := summary.get("wall_s"), int | float):
        yield "wall time", f"{wall:.0f} s"
    if "data_sha256" in summary:
        yield "data, SHA-256", str(summary["data_sha256"])
    if isinstance(versions := summary.get("versions"), Mapping):
        yield "versions", ", ".join(f"{name} {version}" for name, version in versions.items())
