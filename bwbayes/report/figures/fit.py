"""Figures of a fit besides its series: draws, coverage, residuals, measured loops and steps."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterable, Mapping, Sequence
from importlib.util import find_spec, module_from_spec, spec_from_file_location
from pathlib import Path
from typing import Any

import numpy as np
import scipy
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from bwbayes.arrays import FloatArray
from bwbayes.diagnosis.consistency import Consistency
from bwbayes.diagnosis.innovations import Innovations
from bwbayes.prediction.bands import LEVELS, Bands
from bwbayes.prediction.loops import CREEP_FROM, Loops, StepResponse
from bwbayes.report.figures import style
from bwbayes.report.result import Result

BAND = "95% parameters"


def draw_coverage(scored: Sequence[Bands]) -> Figure:
    """Draw the coverage of the 50, 90 and 95% bands that have scores, and the histogram of the PIT.

    Whiskers are one block-bootstrap standard error either way. If the sensor's distribution is
    right the PIT, its probability below each reading, is uniform: a hump means bands that are too
    wide, a bowl bands that are too narrow, a slope a bias.
    """
    figure, ((nominal, pit),) = style.new_figure(11, 4.2, 1, 2)
    x = np.arange(len(LEVELS))
    expected: style.Look = {"color": style.Color.EXPECTED, "lw": 1}
    nominal.hlines(LEVELS, x - 0.4, x + 0.4, ls="--", label="nominal", **expected)
    for i, bands in enumerate(scored):
        color, name = style.COLORS[i % len(style.COLORS)], style.plain(bands.title)
        assert bands.scores is not None
        score, center = bands.scores, x + 0.14 * (i - (len(scored) - 1) / 2)
        # Filled markers show bands that a measurement can check, open ones need a simulation.
        for kind, shift, marker, fill in (
            ("sensor", -0.03, "o", "full"),
            ("displacement", 0.03, "s", "none"),
        ):
            covered, error = score.coverage[kind], score.coverage_error[kind]
            if covered is not None:
                nominal.errorbar(
                    center + shift,
                    [100 * covered[level] for level in LEVELS],
                    [100 * error[level] if error else 0.0 for level in LEVELS],
                    fmt=marker,
                    fillstyle=fill,
                    ms=5,
                    capsize=3,
                    color=color,
                    label=f"{name}: {kind} band",
                )
        if bands.pit is not None:
            judged = bands.pit[bands.scored_from :]
            heights, edges = np.histogram(judged, 20, range=(0, 1), density=True)
            pit.stairs(heights, edges, baseline=None, color=color, lw=1.4, label=name)
    nominal.set_xticks(x, [f"{level}%" for level in LEVELS])
    nominal.set(xlabel="nominal coverage (%)", ylabel="measured coverage (%)")
    nominal.legend(loc="lower right")
    pit.axhline(1.0, **expected)
    pit.set(xlim=(0, 1), xlabel="PIT: predicted probability below the reading (-)")
    pit.set(ylim=(0, None), ylabel="density (expected: 1)")
    return figure


def draw_innovations(innovations: Innovations) -> Figure:
    """Draw autocorrelation, quantiles, size along time, and size along the drive."""
    figure, ((correlation, quantiles), (time, drive)) = style.new_figure(11, 6.6, 2, 2)
    _draw_correlation(correlation, innovations)
    _draw_quantiles(quantiles, innovations.white)
    _draw_time(time, innovations.time, innovations.white)
    _draw_drive(drive, innovations)
    for panel in (quantiles, time, drive):
        panel.set_ylabel("innovation (sds)")
    return figure


def _draw_correlation(panel: Axes, innovations: Innovations) -> None:
    correlation = innovations.correlation
    bound = 1.96 / np.sqrt(innovations.white.size)
    lags = np.arange(1, correlation.size + 1)
    label = "95% of independent ones"
    panel.axhspan(-bound, bound, color=style.Color.CHANCE, lw=0, label=label)
    panel.vlines(lags, 0, correlation, color=style.COLORS[0], lw=2)
    panel.axhline(0, color=style.Color.MEASURED, lw=0.8)
    reach = max(float(np.max(np.abs(correlation))), 2 * bound, 0.1) * 1.15
    panel.set(title="Autocorrelation", xlabel="lag (readings)", ylabel="autocorrelation")
    panel.set(ylim=(-reach, reach), xlim=(0, lags[-1] + 1))
    panel.legend(loc="lower right")


def _draw_quantiles(panel: Axes, white: FloatArray) -> None:
    """Draw the hundred extremes at either end, and some of the others."""
    size = white.size
    rows = np.arange(size)
    at = rows[(rows < 100) | (rows >= size - 100) | (rows % max(1, size // 600) == 0)]
    expected = scipy.special.ndtri((at + 0.5) / size)
    # Pointwise limits of each of so many independent innovations, from the beta distribution.
    low, high = (
        scipy.special.ndtri(scipy.special.betaincinv(at + 1, size - at, level))
        for level in (0.025, 0.975)
    )
    label = "95% of normal ones"
    panel.fill_between(expected, low, high, color=style.Color.CHANCE, lw=0, label=label)
    panel.plot(expected, expected, color=style.Color.MEAN, lw=1)
    panel.plot(expected, np.sort(white)[at], ".", color=style.COLORS[0], ms=3, mew=0)
    panel.set(title="Normal quantiles", xlabel="normal quantile")
    panel.legend(loc="upper left")


def _draw_time(panel: Axes, time: FloatArray, white: FloatArray) -> None:
    """Draw all innovations, and the root mean square of 40 segments: 1 if the size is right."""
    reach = max(4.5, 1.1 * float(np.quantile(np.abs(white), 0.9995)))
    dots: style.Look = {"ms": 2, "mew": 0, "alpha": min(0.7, 8000 / white.size)}
    panel.plot(time, np.clip(white, -reach, reach), ".", color=style.Color.MEASURED, **dots)
    # Each segment has twenty readings or more; a gap of a fiftieth of the time ends the line.
    count = min(40, max(white.size // 20, 1))
    gaps = np.flatnonzero(np.diff(time) > 0.02 * np.ptp(time)) + 1
    for rows in np.split(np.arange(white.size), gaps):
        segments = np.array_split(rows, max(round(count * rows.size / white.size), 1))
        centers = [np.mean(time[segment]) for segment in segments]
        size = [np.sqrt(np.mean(white[segment] ** 2)) for segment in segments]
        label = "_nolegend_" if rows[0] else "root mean square: 1 is right"
        panel.plot(centers, size, color=style.Color.MEAN, lw=1.5, label=label)
    panel.axhline(1, color=style.Color.MEAN, lw=0.8, ls=":")
    panel.set(ylim=(-reach, reach), title="Stationarity")
    panel.set_xlabel("time (s)")
    panel.legend(loc="upper right")


def _draw_drive(panel: Axes, innovations: Innovations) -> None:
    """Draw mean and sd in parts of the drive, with their standard errors."""
    ticks: dict[float, str] = {}
    sizes: list[tuple[float, float, int]] = []
    start = 0.0
    for quantity in ("rate", "voltage", "direction"):
        groups = [(name, x) for name, x in innovations.by(quantity) if x.size > 1]
        if ticks and groups:
            panel.axvline(start - 0.75, color="#cccccc", lw=0.8)
        ticks |= {start + i: name for i, (name, _) in enumerate(groups)}
        sizes += [(float(np.mean(x)), float(np.std(x)), x.size) for _, x in groups]
        look: style.Look = {"ha": "center", "va": "top", "color": "#555555"}
        center = start + (len(groups) - 1) / 2
        panel.text(center, 1.0, f"by {quantity}", transform=panel.get_xaxis_transform(), **look)
        start += len(groups) + 0.5
    mean, sd, size = np.array(sizes).reshape(-1, 3).T
    for values, error, right, name, marker, color in (
        (sd, sd / np.sqrt(2 * size), 1, "sd", "o", style.COLORS[0]),
        (mean, sd / np.sqrt(size), 0, "mean", "s", style.COLORS[1]),
    ):
        look = {
            "fmt": marker,
            "color": color,
            "ms": 5,
            "label": f"{name}: {right} is right",
        }
        panel.errorbar(list(ticks), values, 1.96 * error, **look)
        panel.axhline(right, color=color, lw=0.8, ls=":")
    panel.set_xticks(list(ticks), list(ticks.values()))
    panel.set_xlim(-0.7, start - 0.8)
    low, high = panel.get_ylim()
    panel.set_ylim(min(low, -0.3), max(high, 1.3) + 0.15 * (high - low))
    panel.set_title("Size by input voltage")
    panel.legend(loc="center right")


def draw_spectrum(residual: tuple[FloatArray, FloatArray], noise: FloatArray) -> Figure:
    """Draw the amplitude spectral density of the residual and of the noise model, um/√Hz.

    ``residual`` is (frequencies, Hz, density), ``noise`` is the model's density there.
    """
    frequency, density = residual
    figure, ((panel,),) = style.new_figure(11, 4.2)
    panel.loglog(frequency, density, color=style.Color.MEASURED, lw=0.9, label="residual")
    panel.loglog(frequency, noise, color=style.Color.MEAN, lw=1.5, label="noise model")
    panel.set(xlabel="frequency (Hz)", ylabel="amplitude density (µm/√Hz)")
    panel.legend(loc="upper right")
    return figure


def draw_agreement(agreements: Mapping[str, Consistency]) -> Figure:
    """Draw each record's residuals along time, in the joint fit and in its single fit."""
    count = len(agreements)
    figure, panels = style.new_figure(11, 0.9 + 1.9 * count, count, gap=0.5)
    for (panel,), (name, agreement) in zip(panels, agreements.items(), strict=True):
        for values, color, label in (
            (agreement.joint, style.COLORS[0], f"joint fit: {agreement.joint_rms_um:.3g} µm rms"),
            (agreement.own, style.COLORS[1], f"own fit: {agreement.single_rms_um:.3g} µm rms"),
        ):
            dots: style.Look = {"ms": 2, "mew": 0, "alpha": 0.7}
            panel.plot(agreement.time, values, ".", color=color, label=label, **dots)
        panel.axhline(0, color=style.Color.MEAN, lw=0.8)
        verdict = "DOES NOT AGREE" if agreement.disagrees else "agrees"
        distance = f"chi-square {agreement.distance:.3g} of {agreement.degrees:.3g}"
        chance = f"({distance}, p = {agreement.p_value:.2g})"
        panel.set(title=f"{name}: {verdict} with the others {chance}", ylabel="residual (µm)")
        panel.legend(loc="upper right", markerscale=4)
    panels[-1, 0].set_xlabel("time (s)")
    return figure


def draw_loops(loops: Loops) -> Figure:
    """Draw displacement against voltage, and on the right minus the major loop's straight line.

    On the scale of the whole loop its band is as thin as a line; without the line it can be seen.
    """
    figure, ((loop_axes, tilted),) = style.new_figure(11, 4.8, 1, 2)
    major, minor = loops.major, loops.minor
    branches = (
        ("major loop", 0, "-", major.voltage, major.rising),
        ("_nolegend_", 0, "-", major.voltage, major.falling),
        ("minor loop", 1, "-", minor.voltage, minor.rising),
        ("_nolegend_", 1, "-", minor.voltage, minor.falling),
        ("initial curve", 2, "--", loops.initial_voltage, loops.initial),
    )
    ends = major.falling.mean[0], major.rising.mean[-1]
    line = np.polyfit(major.voltage[[0, -1]], ends, 1)
    for panel, subtracted in ((loop_axes, 0 * line), (tilted, line)):
        for label, color, dashes, voltage, curve in branches:
            mean, *edges = (
                values - np.polyval(subtracted, voltage)
                for values in (curve.mean, curve.lower, curve.upper)
            )
            style.draw_band(panel, voltage, mean, edges, label, style.COLORS[color], dashes)
        panel.set_xlabel("voltage (V)")
    loop_axes.set(ylabel="displacement (µm)", title="driven slowly, without offset")
    tilted.set(ylabel="displacement − straight line (µm)")
    tilted.set(title="less the line between the major loop's turns")
    style.share_legend(figure, band=BAND)
    return figure


def draw_steps(responses: Mapping[str, StepResponse]) -> Figure:
    """Draw the displacement since each step, and beside it the creep, if there is any."""
    creeps = any(response.crept is not None for response in responses.values())
    figure, (panels,) = style.new_figure(11 if creeps else 6.4, 4.8, 1, 1 + creeps)
    first = np.inf
    for number, (name, response) in enumerate(responses.items()):
        color = style.COLORS[number % len(style.COLORS)]
        label = style.plain(f"{name}, {response.height:g} V")
        # The rise is drawn from this part of its final value on.
        started = np.abs(response.response.mean) > 1e-3 * abs(float(response.response.mean[-1]))
        # Without dynamics there is no rise to be seen.
        start = CREEP_FROM / 10 if started[0] else float(response.time[int(np.argmax(started))])
        first = min(first, start)
        for panel, curve in zip(panels, (response.response, response.crept), strict=False):
            if curve is not None:
                edges = curve.lower, curve.upper
                style.draw_band(panel, response.time, curve.mean, edges, label, color)
    last = max(response.held for response in responses.values())
    for panel in panels:
        panel.set(xscale="log", xlabel="time since the step (s)", xlim=(CREEP_FROM, last))
    panels[0].set(xlim=(first, last), ylabel="displacement (µm)", title="rise")
    if creeps:
        panels[1].set(ylabel="growth since 0.1 s (µm)", title="creep")
    style.share_legend(figure, band=BAND)
    return figure


RANK_BINS = 20


def pair_contours() -> Callable[..., None]:
    """Load corner's ``hist2d`` alone: the package loads all of arviz, which no picture needs."""
    package = find_spec("corner")
    assert package is not None
    assert package.origin is not None
    core = spec_from_file_location("corner.core", Path(package.origin).with_name("core.py"))
    assert core is not None
    assert core.loader is not None
    module = module_from_spec(core)
    core.loader.exec_module(module)
    hist2d: Callable[..., None] = module.hist2d
    return hist2d


def draw_corner(result: Result) -> Figure:
    """Draw every pair of free parameters, with contours that hold 50 and 90% of the draws.

    Lines mark the true values, if they are known. One panel holds all, and each parameter has a
    cell of side one in each direction: separate panels would take many times as long.
    """
    # Options of corner for a pair: the contours are filled and opaque, and so hide the draws below.
    contours: style.Look = {
        "levels": (0.5, 0.9),
        "color": style.COLORS[0],
        "contourf_kwargs": {"colors": ["none", "#AAD0E5", style.COLORS[0]]},
        "smooth": 0.8,
        "plot_density": False,
        "plot_datapoints": False,
        "fill_contours": True,
        "no_fill_contours": True,
        "quiet": True,
    }
    flat = result.flat_draws
    flat = flat[style.starts(flat.shape[0], 5_000)]
    free = len(result.free)
    truths = [result.truth.get(parameter.name) for parameter in result.free]
    ranges = [_range(x, truth) for x, truth in zip(flat.T, truths, strict=True)]
    labels = [style.axis_label(parameter) for parameter in result.free]
    # Inches: a cell has 1.25, the margin for the labels 1.3.
    side = 1.25 * free + 1.5
    figure, hist2d = Figure(figsize=(side, side)), pair_contours()
    panel = figure.subplots()
    figure.subplots_adjust(1.3 / side, 1.3 / side, 1 - 0.2 / side, 1 - 0.2 / side)
    columns, rows = np.arange(free), np.arange(free)[::-1]
    scaled = np.stack([_scale(x, r) for x, r in zip(flat.T, ranges, strict=True)])
    scaled[(scaled < 0) | (scaled > 1)] = np.nan
    for i in range(free):
        counts, edges = np.histogram(scaled[i], 20, range=(0, 1))
        heights = rows[i] + 0.95 * counts / max(counts.max(), 1)
        panel.stairs(heights, columns[i] + edges, baseline=rows[i], color=style.COLORS[0])
        for j in range(i):
            x, y = columns[j] + scaled[j], rows[i] + scaled[i]
            panel.plot(x, y, ",", color=style.COLORS[0], zorder=0.5)
            cell = [(columns[j], columns[j] + 1), (rows[i], rows[i] + 1)]
            hist2d(x, y, ax=panel, range=cell, **contours)
        if (truth := truths[i]) is not None:
            at = _scale(truth, ranges[i])
            panel.vlines(columns[i] + at, 0, rows[i] + 1, color=style.Color.TRUTH)
            panel.hlines(rows[i] + at, 0, columns[i], color=style.Color.TRUTH)
    frame: style.Look = {"color": "black", "lw": 0.8, "clip_on": False}
    panel.hlines(rows, 0, columns + 1, **frame)
    panel.vlines(columns, 0, rows + 1, **frame)
    _label(panel.xaxis, columns, ranges)
    _label(panel.yaxis, rows[1:], ranges[1:])
    panel.tick_params(labelsize=11)
    panel.tick_params("x", labelrotation=90)
    panel.set(xlim=(0, free), ylim=(0, free))
    panel.grid(visible=False)
    panel.spines[:].set_visible(False)
    center: style.Look = {"ha": "center", "va": "center", "fontsize": 13}
    for column, row, label in zip(columns, rows, labels, strict=True):
        panel.text(column + 0.5, -0.75, label, **center)
        if column:
            panel.text(-0.75, row + 0.5, label, rotation=90, **center)
    return figure


def _scale(values: Any, limits: tuple[float, float]) -> Any:
    """Return the positions of values in their cell: 0 at its lower limit, 1 at its upper."""
    low, high = limits
    return (values - low) / (high - low)


def _label(axis: Axis, starts: Iterable[int], ranges: Sequence[tuple[float, float]]) -> None:
    """Label the cells along an axis with their values, away from the cells' corners."""
    ticks, texts = [], []
    for start, (low, high) in zip(starts, ranges, strict=True):
        for value in MaxNLocator(6, steps=[1, 2, 5, 10]).tick_values(low, high):
            at = _scale(value, (low, high))
            if abs(at - 0.5) < 0.4:
                ticks.append(start + at)
                texts.append(f"{value:.10g}".replace("-", "\N{MINUS SIGN}"))
    axis.set_ticks(ticks, texts)


def _range(draws: FloatArray, truth: float | None) -> tuple[float, float]:
    """Return the limits of a parameter's cell: nearly all draws, and the truth."""
    low, high = np.quantile(draws, [0.001, 0.999])
    if truth is not None:
        low, high = min(low, truth), max(high, truth)
    # Contours, which end half a bin beyond the last draw, stay within the cell.
    margin = 0.1 * (high - low)
    return float(low - margin), float(high + margin)


def draw_trace(result: Result) -> Figure:
    """Draw each ensemble's mean over its walkers, and the range of 90% of them, by steps.

    The figure shows all parameters, and the log density. Ensembles that stay apart or drift have
    not converged.
    """
    names = [*map(style.axis_label, result.free), "log density (nats)"]
    steps = style.starts(result.draws.shape[0], 400)
    series = np.concatenate([result.draws[steps], result.log_density[steps][..., None]], axis=-1)
    series = np.where(np.isfinite(series), series, np.nan)
    mean = np.mean(series, axis=2)
    # The quantiles are those of fifty segments of steps; the last ones also stand at its end.
    cuts = np.append(style.starts(steps.size, 50), steps.size)
    spread = [
        np.quantile(series[a:b], [0.05, 0.95], axis=(0, 2)) for a, b in itertools.pairwise(cuts)
    ]
    low, high = np.stack([*spread, spread[-1]], axis=1)
    ends = np.append(steps, result.draws.shape[0])[cuts]
    limits = [_limits(low[..., i], high[..., i], mean[..., i]) for i in range(len(names))]
    figure, cells = _columns_of_cells(names, limits, "step")
    for i, (panel, bottom) in enumerate(cells):
        lower, upper, center = (bottom + _scale(x[..., i], limits[i]) for x in (low, high, mean))
        for ensemble in range(series.shape[1]):
            edges, look = (lower[:, ensemble], upper[:, ensemble]), _look(ensemble)
            panel.fill_between(ends + 1, *edges, color=look["color"], alpha=0.15, lw=0, step="post")
            panel.plot(steps + 1, center[:, ensemble], **look)
    figure.axes[0].set_ylabel("mean of the walkers, and 90% of them")
    style.share_legend(figure)
    return figure


def _look(ensemble: int) -> style.Look:
    color = style.COLORS[ensemble % len(style.COLORS)]
    return {"color": color, "label": f"ensemble {ensemble + 1}"}


def _limits(*drawn: FloatArray) -> tuple[float, float]:
    """Return the limits of a cell with room for all lines, below its name."""
    values = np.concatenate([x[np.isfinite(x)] for x in drawn])
    low, high = (values.min(), values.max()) if values.size else (0.0, 0.0)
    size = float(high - low) or abs(low) or 1.0
    return float(low - 0.06 * size), float(high + 0.25 * size)


def _columns_of_cells(
    names: Sequence[str], limits: Sequence[tuple[float, float]], xlabel: str
) -> tuple[Figure, list[tuple[Axes, int]]]:
    """Return a figure with named cells in two columns, and each cell's panel and bottom.

    A column is one panel, in which the cells, each of height one, have separate values.
    """
    rows = -(-len(names) // 2)
    figure, (panels,) = style.new_figure(11, 1.4 * rows + 0.9, 1, 2)
    for side, panel in enumerate(panels):
        column = slice(side, None, 2)
        bottoms = range(rows - 1, -1, -1)[: len(names[column])]
        _label(panel.yaxis, bottoms, limits[column])
        across = panel.get_yaxis_transform()
        panel.hlines(bottoms, 0, 1, color="black", lw=0.8, transform=across)
        for bottom, name in zip(bottoms, names[column], strict=True):
            panel.text(0.01, bottom + 0.96, name, va="top", transform=across)
        panel.set(xlabel=xlabel, ylim=(0, rows))
    return figure, [(panels[i % 2], rows - 1 - i // 2) for i in range(len(names))]


def draw_ranks(result: Result) -> Figure:
    """Draw the distribution of the ranks of each ensemble's draws among all, by parameter.

    Ensembles that draw from the same distribution have uniform ranks: each line stays near one, 19
    times out of 20 inside the gray band. The band is that of independent draws, one for each
    autocorrelation time τ of each walker: with n draws of E ensembles in B bins its half width is
    1.96 √((B − 1)(E − 1) τ/n).
    """
    steps, ensembles, walkers, free = result.draws.shape
    # About 100,000 draws are ranked.
    thinned = result.draws[style.starts(steps, max(100_000 // (ensembles * walkers), 1))]
    heights = [_rank_heights(thinned[..., i]) for i in range(free)]
    time = np.maximum(result.outcome.check.autocorrelation[:free], 1.0)
    reach = 1.96 * np.sqrt((RANK_BINS - 1) * (ensembles - 1) * time / (steps * ensembles * walkers))
    bands = np.stack([np.maximum(1 - reach, 0), 1 + reach], axis=1)
    limits = [_limits(band, x) for band, x in zip(bands, heights, strict=True)]
    names = [*map(style.axis_label, result.free)]
    figure, cells = _columns_of_cells(names, limits, "rank among all draws (%)")
    edges = np.linspace(0, 100, RANK_BINS + 1)
    for (panel, bottom), lines, band, limit in zip(cells, heights, bands, limits, strict=True):
        panel.axhline(bottom + _scale(1.0, limit), color=style.Color.EXPECTED, lw=0.8)
        label = "what independent draws show"
        panel.axhspan(*(bottom + _scale(band, limit)), color=style.Color.CHANCE, lw=0, label=label)
        for ensemble, line in enumerate(lines):
            drawn = bottom + _scale(line, limit)
            panel.stairs(drawn, edges, baseline=None, lw=1.2, **_look(ensemble))
    figure.axes[0].set_ylabel("draws per bin (expected: 1)")
    style.share_legend(figure)
    return figure


def _rank_heights(draws: FloatArray) -> FloatArray:
    """Return counts of ranks (ensembles, bins), relative to the expected counts.

    ``draws`` is (steps, ensembles, walkers); nan has no rank.
    """
    _, order, equal = np.unique(draws, return_inverse=True, return_counts=True)
    ranks = (np.cumsum(equal) - equal / 2)[order] / draws.size
    edges = np.linspace(0, 1, RANK_BINS + 1)
    counts = [np.histogram(ranks[:, e], edges)[0] for e in range(draws.shape[1])]
    heights: FloatArray = np.asarray(counts) * (RANK_BINS * draws.shape[1] / draws.size)
    return heights
