"""Pictures of the draws: corner, traces and ranks."""

from __future__ import annotations

import itertools

import numpy as np
import scipy
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FixedLocator, MaxNLocator, NullLocator

from bwbayes.arrays import FloatArray, IntArray
from bwbayes.report.figures.style import (
    COLORS,
    TRUTH_COLOR,
    axis_label,
    hide_unused,
    share_legend,
    starts,
)
from bwbayes.report.result import Result

__all__ = ["draw_corner", "draw_ranks", "draw_trace"]

RANK_BINS = 20

# Inches of one panel of the corner picture and of its margin for labels, and the size of its text,
# which the page shows smaller the more panels there are.
CORNER_PANEL = 1.25
CORNER_MARGIN = 1.3
CORNER_FONT = 11
CORNER_BINS = 20

# How far its labels are off its panels, in units of a panel.
CORNER_LABEL = 0.75


def draw_corner(result: Result) -> Figure:
    """Draw every pair of free parameters, with contours that hold 50 and 90 % of the draws.

    The true values, where they are known, are lines.
    """
    import corner  # noqa: PLC0415  # it loads all of arviz, which nobody else here needs

    flat = result.flat_draws
    flat = flat[starts(flat.shape[0], 5_000)]
    free = len(result.free)
    truths = [result.truth.get(p.name) for p in result.free]
    ranges = [_range(x, truth) for x, truth in zip(flat.T, truths, strict=True)]
    ticks = [_inner_ticks(*limits) for limits in ranges]
    side = CORNER_PANEL * free + CORNER_MARGIN + 0.2
    figure = Figure(figsize=(side, side))
    margin, edge = CORNER_MARGIN / side, 1 - 0.2 / side
    edges = {"left": margin, "bottom": margin, "right": edge, "top": edge}
    grid = figure.add_gridspec(free, free, **edges, wspace=0.05, hspace=0.05)
    for row, column in zip(*(axis.tolist() for axis in np.tril_indices(free)), strict=True):
        panel = figure.add_subplot(grid[row, column])
        panel.tick_params(labelsize=CORNER_FONT, labelbottom=False, labelleft=False)
        if row == column:
            low, high = ranges[row]
            bins = np.linspace(low, high, CORNER_BINS + 1).tolist()
            heights = panel.hist(flat[:, row], bins, histtype="step", color=COLORS[0])[0]
            panel.set(xlim=ranges[row], ylim=(0, 1.1 * np.max(heights)))
        else:
            corner.hist2d(
                *flat[:, [column, row]].T,
                ax=panel,
                bins=CORNER_BINS,
                range=[ranges[column], ranges[row]],
                levels=(0.5, 0.9),
                color=COLORS[0],
                smooth=0.8,
                plot_density=False,
                fill_contours=True,
                data_kwargs={"alpha": 0.3, "ms": 1.2},
                quiet=True,
            )
        panel.xaxis.set_major_locator(FixedLocator(ticks[column]))
        panel.yaxis.set_major_locator(FixedLocator(ticks[row]) if row > column else NullLocator())
        _mark_truth(panel, truths[column], truths[row] if row > column else None)
        if row == free - 1:
            panel.tick_params("x", labelbottom=True, labelrotation=90)
            panel.set_xlabel(axis_label(result.free[column]), fontsize=CORNER_FONT + 2)
            panel.xaxis.set_label_coords(0.5, -CORNER_LABEL)
        if column == 0 and row > 0:
            panel.tick_params("y", labelleft=True)
            panel.set_ylabel(axis_label(result.free[row]), fontsize=CORNER_FONT + 2)
            panel.yaxis.set_label_coords(-CORNER_LABEL, 0.5)
    return figure


def _inner_ticks(low: float, high: float) -> list[float]:
    """Return ticks that keep away from the ends, where they would meet the next panel's."""
    ticks = np.asarray(MaxNLocator(4).tick_values(low, high), dtype=np.float64)
    return [float(x) for x in ticks if abs(x - (low + high) / 2) < 0.4 * (high - low)]


def _range(draws: FloatArray, truth: float | None) -> tuple[float, float]:
    """Return the range of a parameter's axis: nearly all draws, and the truth."""
    low, high = np.quantile(draws, [0.001, 0.999])
    if truth is not None:
        low, high = min(low, truth), max(high, truth)
    margin = 0.05 * (high - low)
    return float(low - margin), float(high + margin)


def _mark_truth(panel: Axes, across: float | None, upright: float | None) -> None:
    """Draw the true values that are known."""
    if across is not None:
        panel.axvline(across, color=TRUTH_COLOR)
    if upright is not None:
        panel.axhline(upright, color=TRUTH_COLOR)


def draw_trace(result: Result) -> Figure:
    """Draw, step by step, each ensemble's mean over its walkers and where 90 % of them are.

    All parameters, and the log density. Ensembles that stay apart or drift have not converged.
    """
    names = [*(axis_label(p) for p in result.free), "log density (nats)"]
    rows = -(-len(names) // 2)
    figure = Figure(figsize=(11, 1.5 * rows + 0.6), layout="constrained")
    grid = figure.subplots(rows, 2, sharex=True, squeeze=False)
    steps = starts(result.draws.shape[0], 400)
    series = np.concatenate([result.draws[steps], result.log_density[steps][..., None]], axis=-1)
    series = np.where(np.isfinite(series), series, np.nan)
    mean = np.mean(series, axis=2)
    cuts, low, high = _spread(series)
    ends = np.append(steps, result.draws.shape[0])[cuts]
    for i, panel in enumerate(hide_unused(grid, len(names), "step")):
        panel.tick_params(labelbottom=bool(panel.get_xlabel()))
        panel.set_ylabel(names[i])
        for ensemble in range(series.shape[1]):
            color = COLORS[ensemble % len(COLORS)]
            edges = (low[:, ensemble, i], high[:, ensemble, i])
            panel.fill_between(ends + 1, *edges, color=color, alpha=0.15, lw=0, step="post")
            panel.plot(
                steps + 1, mean[:, ensemble, i], color=color, label=f"ensemble {ensemble + 1}"
            )
    share_legend(figure)
    return figure


def _spread(series: FloatArray) -> tuple[IntArray, FloatArray, FloatArray]:
    """Return where 90 % of the walkers are in each of some stretches of steps.

    ``series`` is (steps, ensembles, walkers, any). Returns where the stretches begin and the last
    one ends, (stretches + 1,), and from there on the 5 % and 95 % quantiles, (stretches + 1,
    ensembles, any), the last stretch's twice.
    """
    cuts = np.append(starts(series.shape[0], 50), series.shape[0])
    edges = [
        np.quantile(series[a:b], [0.05, 0.95], axis=(0, 2)) for a, b in itertools.pairwise(cuts)
    ]
    low, high = np.stack([*edges, edges[-1]], axis=1)
    return cuts, low, high


def draw_ranks(result: Result) -> Figure:
    """Draw, for each parameter, how the ranks of each ensemble's draws among all are spread.

    Ensembles that draw from the same distribution have ranks that are spread evenly: each line
    stays near one, 19 times out of 20 inside the gray band. The band is what independent draws
    show, one for each autocorrelation time τ of each walker: with n draws of E ensembles in B bins
    its half width is 1.96 √((B − 1)(E − 1) τ/n).
    """
    steps, ensembles, walkers, free = result.draws.shape
    columns = min(3, free)
    rows = -(-free // columns)
    figure = Figure(figsize=(11, 1.8 * rows + 0.6), layout="constrained")
    grid = figure.subplots(rows, columns, sharex=True, squeeze=False)
    # About 100,000 draws are ranked.
    thinned = result.draws[starts(steps, max(100_000 // (ensembles * walkers), 1))]
    for i, panel in enumerate(hide_unused(grid, free, "rank among all draws (%)")):
        panel.tick_params(labelbottom=bool(panel.get_xlabel()))
        panel.set_title(axis_label(result.free[i]))
        panel.margins(y=0.12)
        if i % columns == 0:
            panel.set_ylabel("draws per bin\n(expected: 1)")
        time = float(np.maximum(result.outcome.check.autocorrelation[i], 1.0))
        _draw_even(panel, steps * ensembles * walkers / time, ensembles)
        for ensemble, heights in enumerate(_rank_heights(thinned[..., i])):
            panel.stairs(
                heights,
                np.linspace(0, 100, RANK_BINS + 1),
                baseline=None,
                color=COLORS[ensemble % len(COLORS)],
                lw=1.2,
                label=f"ensemble {ensemble + 1}",
            )
    share_legend(figure)
    return figure


def _rank_heights(draws: FloatArray) -> FloatArray:
    """Return (ensembles, bins) counts of ranks, over what they are expected to be.

    ``draws`` is (steps, ensembles, walkers); what is not a number has no rank.
    """
    ranks = (scipy.stats.rankdata(draws) - 0.5).reshape(draws.shape) / draws.size
    edges = np.linspace(0, 1, RANK_BINS + 1)
    counts = [np.histogram(ranks[:, e], edges)[0] for e in range(draws.shape[1])]
    heights: FloatArray = np.asarray(counts) * (RANK_BINS * draws.shape[1] / draws.size)
    return heights


def _draw_even(panel: Axes, independent: float, ensembles: int) -> None:
    """Draw what evenly spread ranks look like."""
    panel.axhline(1.0, color="#777777", lw=0.8)
    if np.isfinite(independent):
        reach = 1.96 * np.sqrt((RANK_BINS - 1) * (ensembles - 1) / independent)
        band = (max(1 - reach, 0.0), 1 + reach)
        panel.axhspan(*band, color="#dddddd", lw=0, label="what independent draws show")
