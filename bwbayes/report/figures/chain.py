"""Pictures of the draws: corner, traces and ranks."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from importlib.util import find_spec, module_from_spec, spec_from_file_location
from pathlib import Path

import matplotlib as mpl
import numpy as np
import scipy
from matplotlib.figure import Figure
from matplotlib.ticker import FixedLocator, MaxNLocator

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
    """Draw every pair of free parameters, with contours that hold 50 and 90 % of the draws.

    The true values, where they are known, are lines.
    """
    flat = result.flat_draws
    flat = flat[style.starts(flat.shape[0], 5_000)]
    free = len(result.free)
    truths = [result.truth.get(parameter.name) for parameter in result.free]
    ranges = [_range(x, truth) for x, truth in zip(flat.T, truths, strict=True)]
    ticks = [FixedLocator(_inner_ticks(*limits)) for limits in ranges]
    labels = [style.axis_label(parameter) for parameter in result.free]
    # Inches: a panel has 1.25, the margin for the labels 1.3.
    side = 1.25 * free + 1.5
    figure, hist2d = Figure(figsize=(side, side)), pair_contours()
    low, high = 1.3 / side, 1 - 0.2 / side
    grid = figure.add_gridspec(
        free, free, left=low, bottom=low, right=high, top=high, wspace=0.05, hspace=0.05
    )
    for row, column in ((i, j) for i in range(free) for j in range(i + 1)):
        # Set before there are any ticks: to change those of so many panels takes longer.
        with mpl.rc_context({"axes.grid": False, "xtick.labelsize": 11, "ytick.labelsize": 11}):
            panel = figure.add_subplot(grid[row, column])
        is_lowest, is_first = row == free - 1, column == 0 < row
        panel.tick_params(labelbottom=is_lowest, labelleft=is_first)
        if is_lowest:
            panel.tick_params("x", labelrotation=90)
            panel.set_xlabel(labels[column], fontsize=13)
            panel.xaxis.set_label_coords(0.5, -0.75)
        if is_first:
            panel.set_ylabel(labels[row], fontsize=13)
            panel.yaxis.set_label_coords(-0.75, 0.5)
        if (truth := truths[column]) is not None:
            panel.axvline(truth, color=style.Color.TRUTH)
        if row == column:
            panel.hist(flat[:, row], 20, range=ranges[row], histtype="step", color=style.COLORS[0])
            panel.set(xlim=ranges[row], yticks=[])
            panel.xaxis.set_major_locator(ticks[row])
            continue
        hist2d(
            flat[:, column],
            flat[:, row],
            ax=panel,
            range=[ranges[column], ranges[row]],
            levels=(0.5, 0.9),
            color=style.COLORS[0],
            smooth=0.8,
            plot_density=False,
            fill_contours=True,
            data_kwargs={"alpha": 0.3, "ms": 1.2},
            quiet=True,
        )
        panel.xaxis.set_major_locator(ticks[column])
        panel.yaxis.set_major_locator(ticks[row])
        if (truth := truths[row]) is not None:
            panel.axhline(truth, color=style.Color.TRUTH)
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


def draw_trace(result: Result) -> Figure:
    """Draw, step by step, each ensemble's mean over its walkers and where 90 % of them are.

    All parameters, and the log density. Ensembles that stay apart or drift have not converged.
    """
    names = [*map(style.axis_label, result.free), "log density (nats)"]
    figure, panels = style.panel_grid(len(names), 2, 1.5, "step", sharex=True)
    steps = style.starts(result.draws.shape[0], 400)
    series = np.concatenate([result.draws[steps], result.log_density[steps][..., None]], axis=-1)
    series = np.where(np.isfinite(series), series, np.nan)
    mean = np.mean(series, axis=2)
    # The quantiles are those of fifty stretches of steps; the last one's stand at its end, too.
    cuts = np.append(style.starts(steps.size, 50), steps.size)
    spread = [
        np.quantile(series[a:b], [0.05, 0.95], axis=(0, 2)) for a, b in itertools.pairwise(cuts)
    ]
    low, high = np.stack([*spread, spread[-1]], axis=1)
    ends = np.append(steps, result.draws.shape[0])[cuts]
    for i, (panel, name) in enumerate(zip(panels, names, strict=True)):
        panel.set_ylabel(name)
        for ensemble in range(series.shape[1]):
            edges = low[:, ensemble, i], high[:, ensemble, i]
            look = _look(ensemble)
            panel.fill_between(ends + 1, *edges, color=look["color"], alpha=0.15, lw=0, step="post")
            panel.plot(steps + 1, mean[:, ensemble, i], **look)
    style.share_legend(figure)
    return figure


def _look(ensemble: int) -> style.Look:
    color = style.COLORS[ensemble % len(style.COLORS)]
    return {"color": color, "label": f"ensemble {ensemble + 1}"}


def draw_ranks(result: Result) -> Figure:
    """Draw, for each parameter, how the ranks of each ensemble's draws among all are spread.

    Ensembles that draw from the same distribution have ranks that are spread evenly: each line
    stays near one, 19 times out of 20 inside the gray band. The band is what independent draws
    show, one for each autocorrelation time τ of each walker: with n draws of E ensembles in B bins
    its half width is 1.96 √((B − 1)(E − 1) τ/n).
    """
    steps, ensembles, walkers, free = result.draws.shape
    labels = "rank among all draws (%)", "draws per bin\n(expected: 1)"
    figure, panels = style.panel_grid(free, min(3, free), 1.8, *labels, sharex=True)
    # About 100,000 draws are ranked.
    thinned = result.draws[style.starts(steps, max(100_000 // (ensembles * walkers), 1))]
    for i, panel in enumerate(panels):
        panel.set_title(style.axis_label(result.free[i]))
        panel.margins(y=0.12)
        panel.axhline(1.0, color=style.Color.EXPECTED, lw=0.8)
        time = float(np.maximum(result.outcome.check.autocorrelation[i], 1.0))
        if np.isfinite(time):
            independent = steps * ensembles * walkers / time
            reach = 1.96 * np.sqrt((RANK_BINS - 1) * (ensembles - 1) / independent)
            label = "what independent draws show"
            band = max(1 - reach, 0.0), 1 + reach
            panel.axhspan(*band, color=style.Color.CHANCE, lw=0, label=label)
        edges = np.linspace(0, 100, RANK_BINS + 1)
        for ensemble, heights in enumerate(_rank_heights(thinned[..., i])):
            panel.stairs(heights, edges, baseline=None, lw=1.2, **_look(ensemble))
    style.share_legend(figure)
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
