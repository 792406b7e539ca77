"""Pictures of the draws: corner, traces and ranks."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterable, Sequence
from importlib.util import find_spec, module_from_spec, spec_from_file_location
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from bwbayes.arrays import FloatArray
from bwbayes.report.figures import style
from bwbayes.report.result import Result

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
