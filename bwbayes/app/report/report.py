"""The report: one HTML page with a run's verdict, numbers and pictures, which needs nothing else.

:func:`render` puts a :class:`~bwbayes.results.result.Result`, its summary and its pictures into
the page's template. Without convergence the page says so first, and says nothing of parameters or
displacement.
"""

from __future__ import annotations

import math
import re
import unicodedata
from base64 import b64encode
from collections.abc import Iterator, Mapping
from typing import Any, NamedTuple

import numpy as np
from jinja2 import Environment, PackageLoader, StrictUndefined, Template

from bwbayes.app.figures.style import title, unit_text
from bwbayes.inference.conflict import effective
from bwbayes.inference.parameters import JointPrior, Parameter
from bwbayes.results.bands import LEVELS
from bwbayes.results.loops import MEASURES, Estimate
from bwbayes.results.result import Result
from bwbayes.results.scores import Scores
from bwbayes.results.steps import STEP_MEASURES
from bwbayes.results.verdict import Verdict

__all__ = ["Symbol", "digits", "picture", "render", "symbol", "template"]

UNKNOWN = "–"

# Pictures that say nothing of the posterior, and so may be seen without convergence.
OF_THE_CHAIN = ("trace", "ranks")

# Titles and captions by the first word of a figure's name.
CAPTIONS = {
    "loop": (
        "Hysteresis loop",
        "Displacement against voltage; below, the marked tip enlarged. The sensor band is where "
        "new readings lie, the parameter band where the model lies.",
    ),
    "agreement": (
        "Do the records agree?",
        "What each record's readings are off the joint fit, and off a fit of that record alone. "
        "The chi-square compares where both fits have the shared parameters with how far apart "
        "chance may put them.",
    ),
    "loops": (
        "Major loop, minor loop and initial curve",
        "The model driven slowly, without dynamics, creep and offset. Left: displacement against "
        "voltage. Right: the same less the straight line between the major loop's turns, where "
        "the 95 % bands of the parameters can be seen.",
    ),
    "steps": (
        "Step responses",
        "Displacement since a step of the voltage from zero, over the log of the time; on the "
        "right its growth from 0.1 s on. Of an ideal step, whatever the amplifier did. Bands: "
        "95 %, of the parameters.",
    ),
    "bands": (
        "Along time",
        "Voltage, displacement, and what is left of it without the mean; on the right, the stretch "
        "with the largest error enlarged. Each dot is one reading. Of all readings, 95 % should "
        "lie inside the sensor band; those of a lead-in, if any, served to find the sensor's "
        "offset and are not judged.",
    ),
    "coverage": (
        "Coverage and PIT",
        "Left: how much the bands cover, against what they promise; whiskers are one "
        "block-bootstrap standard error. It leaves out that a record has one offset, and a "
        "posterior one estimate of the discrepancy: one record may be covered more or less than "
        "many are on average, and its PIT may lean. Right: how often readings fall at each "
        "predicted probability. Level is right; a hump means bands that are too wide, a bowl too "
        "narrow, a slope a bias.",
    ),
    "innovations": (
        "Innovations",
        "What each fitted reading brings anew, over its standard deviation: its residual less what "
        "the readings before it foretell. If model and noise model are right these are independent "
        "standard normal numbers: white, on the line of the normal quantiles, of one size from the "
        "start on, and the same wherever the drive is. Whiskers are 95 % of chance.",
    ),
    "corner": (
        "Posterior",
        "Each parameter, and each pair of parameters; contours hold 50 and 90 % of the draws. "
        "Crossing lines, if any, are the true values.",
    ),
    "trace": (
        "Trace",
        "Each ensemble's mean over its walkers, step by step, and the spread of its walkers. "
        "Ensembles should lie on top of each other and not drift.",
    ),
    "ranks": (
        "Ranks",
        "How the ranks of each ensemble's draws among all draws are spread. Each line should stay "
        "near one, mostly inside the grey stripe that independent draws would fill.",
    ),
}


class Symbol(NamedTuple):
    """A symbol in plain characters: its base, and what stands below."""

    base: str
    below: str


def render(result: Result, summary: Mapping[str, object], pictures: Mapping[str, bytes]) -> str:
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
    """
    check = result.outcome.check
    return template("report.html.j2").render(
        name=result.name,
        failed=[_verdict(verdict) for verdict in result.failed],
        converged=result.outcome.converged,
        stop_reason=result.outcome.stop_reason,
        sampling=f"{check.steps} steps, {100 * check.acceptance:.0f} % of the moves accepted.",
        moves=[
            {"name": name, "proposed": str(proposed), "accepted": f"{100 * kept / proposed:.1f} %"}
            for name, (proposed, kept) in result.moves.items()
        ],
        pareto_k=None if check.pareto_k is None else f"{check.pareto_k:.2f}",
        go_on=summary.get("go_on") or "bwbayes resume FOLDER --steps N",
        remarks=result.remarks,
        free=list(_free(result, summary)),
        truth_known=any(p.name in result.truth for p in result.free),
        assumed=list(_assumed(result.parameters)),
        validation=_validation(result) if result.outcome.converged and result.scores else None,
        loops=_loops(result),
        steps=_steps(result),
        pictures=[
            picture(png, name, *_caption(name))
            for name, png in pictures.items()
            if result.outcome.converged or name in OF_THE_CHAIN
        ],
        facts=[*result.facts.items(), *_circumstances(summary)],
    )


def template(name: str) -> Template:
    """Return a template of the package; what it is filled with comes out escaped."""
    environment = Environment(
        loader=PackageLoader("bwbayes.app.report"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    return environment.get_template(name)


def symbol(parameter: Parameter) -> Symbol:
    r"""Return a parameter's LaTeX label in plain characters, or its name if that cannot be done.

    Greek letters, one subscript and ``\mathrm`` are understood.
    """
    text = re.sub(r"\\mathrm\{(\w*)\}", r"\1", parameter.label)
    text = re.sub(r"\\([A-Za-z]+)", _greek, text)
    found = re.fullmatch(r"([^\\{}_^$]+)(?:_(?:\{([^\\{}_^$]+)\}|(\w+)))?", text)
    if found is None:
        return Symbol(parameter.name, "")
    return Symbol(found[1], found[2] or found[3] or "")


def _greek(found: re.Match[str]) -> str:
    """Return the Greek letter that a LaTeX command stands for, or the command."""
    size = "CAPITAL" if found[1][0].isupper() else "SMALL"
    try:
        return unicodedata.lookup(f"GREEK {size} LETTER {found[1].upper()}")
    except KeyError:
        return found[0]


def digits(value: float, sd: float) -> str:
    """Write a value as exactly as its standard deviation with two digits is written.

    ``digits(0.69712, 0.0061234)`` is ``0.6971``. Far from one, with a power of ten.
    """
    if not (math.isfinite(value) and math.isfinite(sd) and sd > 0):
        return f"{value:.6g}"
    place = int(f"{sd:.1e}".partition("e")[2]) - 1
    if place < -7 or place > 3:
        leading = int(f"{value:e}".partition("e")[2]) if value else place
        return f"{value:.{max(leading - place, 0)}e}"
    # Adding zero takes the sign from a negative zero.
    return f"{round(value, -place) + 0.0:.{max(-place, 0)}f}"


def _free(result: Result, summary: Mapping[str, object]) -> Iterator[dict[str, Any]]:
    """Yield the free parameters' rows; estimates come from the summary, if it has any."""
    check = result.outcome.check
    estimates: Any = summary["parameters"] if result.outcome.converged else None
    for i, parameter in enumerate(result.free):
        row = _words(parameter) | {
            "ess_bulk": f"{check.ess_bulk[i]:.0f}",
            "ess_tail": f"{check.ess_tail[i]:.0f}",
            "rhat": f"{check.rhat[i]:.4f}",
        }
        if estimates is not None:
            row |= _estimate(estimates[parameter.name])
        yield row


def _estimate(numbers: Mapping[str, Any]) -> dict[str, str]:
    sd = numbers["sd"]
    return {
        "mean": digits(numbers["mean"], sd),
        "sd": digits(sd, sd),
        "median": digits(numbers["median"], sd),
        "lower": digits(numbers["lower_95"], sd),
        "upper": digits(numbers["upper_95"], sd),
        "mcse": f"{numbers['mcse_mean']:.2g}",
        "truth": f"{numbers['truth']:.6g}" if "truth" in numbers else UNKNOWN,
    }


def _words(parameter: Parameter) -> dict[str, Any]:
    return {
        "name": parameter.name,
        "description": parameter.description,
        "symbol": symbol(parameter),
        "unit": unit_text(parameter.unit),
    }


def _assumed(parameters: tuple[Parameter, ...]) -> Iterator[dict[str, Any]]:
    """Yield each parameter's prior in words, stated and in effect, or its fixed value."""
    prior = JointPrior(parameters)
    quantiles = effective(prior, np.random.default_rng(0))
    left = dict(zip(prior.free_names, quantiles.T, strict=True))
    for parameter in parameters:
        row = _words(parameter) | {"prior": _stated(parameter), "effect": ""}
        if parameter.name in left:
            low, middle, high = left[parameter.name]
            row["effect"] = f"{middle:.3g} ({low:.2g} to {high:.2g})"
        yield row


def _stated(parameter: Parameter) -> str:
    """Return a prior in words, with the bounds that cut it, or a fixed value."""
    if parameter.fixed is not None:
        return f"fixed at {parameter.fixed:.6g}"
    text = str(parameter.prior)
    if math.isfinite(parameter.lower):
        text += f", at least {parameter.lower:.6g}"
    if math.isfinite(parameter.upper):
        text += f", at most {parameter.upper:.6g}"
    return text


def _validation(result: Result) -> dict[str, Any]:
    """Return the validation table: a column for each of the bands, a row for each score."""
    judged = [bands for bands in result.bands if bands.name in result.scores]
    columns = [
        [("Holds", _held(result, bands.name)), *_scores(result.scores[bands.name])]
        for bands in judged
    ]
    rows = [
        {
            "title": row[0][0],
            "texts": [text for _, text in row],
            # Each level's rows begin with the sensor band's coverage.
            "first": row[0][0].endswith("covers readings"),
        }
        for row in zip(*columns, strict=True)
    ]
    return {"titles": [title(bands) for bands in judged], "rows": rows}


def _loops(result: Result) -> dict[str, Any] | None:
    """Return the table of loops: a row for each measure, mean, sd and interval for each loop."""
    if not result.outcome.converged or result.loops is None:
        return None
    both = result.loops.major, result.loops.minor
    rows = [
        {
            "title": title,
            "unit": unit_text(unit),
            "texts": [text for loop in both for text in _measured(loop.estimates[name])],
        }
        for name, (title, unit) in MEASURES.items()
    ]
    titles = [
        f"{name} loop, {loop.voltage[0]:.4g} to {loop.voltage[-1]:.4g} V"
        for name, loop in zip(("Major", "Minor"), both, strict=True)
    ]
    return {"titles": titles, "rows": rows, "closed": all(loop.closed for loop in both)}


def _steps(result: Result) -> dict[str, Any] | None:
    """Return the table of steps, built as that of loops."""
    if not result.outcome.converged or not result.steps:
        return None
    every = result.steps.values()
    rows = [
        {
            "title": title,
            "unit": unit_text(unit),
            "texts": [text for step in every for text in _measured(step.estimates[name])],
        }
        for name, (title, unit) in STEP_MEASURES.items()
    ]
    titles = [
        f"{name}: {one.step.height:.4g} V for {one.step.held:.4g} s"
        for name, one in result.steps.items()
    ]
    return {"titles": titles, "rows": rows}


def _measured(one: Estimate | None) -> tuple[str, str, str]:
    """Return mean, sd and 95 % interval of what was measured, in words."""
    if one is None:
        return UNKNOWN, UNKNOWN, UNKNOWN
    interval = f"{digits(one.lower, one.sd)} to {digits(one.upper, one.sd)}"
    return digits(one.mean, one.sd), digits(one.sd, one.sd), interval


def _verdict(verdict: Verdict) -> dict[str, Any]:
    """Return a verdict that says no, in words."""
    cause = verdict.cause
    return {
        "name": verdict.name,
        "what": "fitted" if verdict.training else "not fitted",
        "reasons": verdict.reasons,
        "cause": cause.text if cause else UNKNOWN,
        "remedy": cause.remedy if cause else UNKNOWN,
    }


def _held(result: Result, name: str) -> str:
    verdict = result.verdicts.get(name)
    if verdict is None:
        return UNKNOWN
    return {True: "yes", False: "NO", None: "cannot be told"}[verdict.holds]


def _scores(scores: Scores) -> Iterator[tuple[str, str]]:
    """Yield titles and texts of one column of the validation table."""
    yield "NRMSE of the mean", f"{100 * scores.nrmse:.2f} %"
    yield "Largest error of the mean", f"{scores.max_error_um:.2f} µm"
    yield "CRPS", f"{scores.crps_um:.3f} µm"
    for level in LEVELS:
        yield f"{level} % sensor band covers readings", _covered(scores, "sensor", level)
        yield (
            f"{level} % displacement band covers displacement",
            _covered(scores, "displacement", level),
        )
        yield f"{level} % sensor band: worst second", f"{100 * scores.worst_second[level]:.1f} %"
        yield f"{level} % sensor band: mean width", f"{scores.width_um[level]:.2f} µm"
        yield f"{level} % sensor band: interval score", f"{scores.interval_score_um[level]:.2f} µm"


def _covered(scores: Scores, kind: str, level: int) -> str:
    covered, error = scores.coverage[kind], scores.coverage_error[kind]
    if covered is None:
        return UNKNOWN
    text = f"{100 * covered[level]:.1f}"
    return f"{text} %" if error is None else f"{text} ± {100 * error[level]:.1f} %"


def picture(png: bytes, name: str, title: str, caption: str) -> dict[str, str]:
    """Return a picture as the templates show it, its file inside the page."""
    source = "data:image/png;base64," + b64encode(png).decode("ascii")
    return {"name": name, "title": title, "caption": caption, "source": source}


def _caption(name: str) -> tuple[str, str]:
    """Return title and caption of a run's figure."""
    kind, _, rest = name.partition("_")
    heading, text = CAPTIONS.get(kind, (kind, ""))
    return (f"{heading}: {rest}" if rest else heading), text


def _circumstances(summary: Mapping[str, object]) -> Iterator[tuple[str, str]]:
    """Yield what the summary knows of the run besides its results."""
    if "seed" in summary:
        yield "seed", str(summary["seed"])
    if isinstance(wall := summary.get("wall_s"), int | float):
        yield "wall time", f"{wall:.0f} s"
    if "data_sha256" in summary:
        yield "data, SHA-256", str(summary["data_sha256"])
    if isinstance(versions := summary.get("versions"), Mapping):
        yield "versions", ", ".join(f"{name} {version}" for name, version in versions.items())
