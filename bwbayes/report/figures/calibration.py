"""Pictures of a calibration: whether ranks are even, and what intervals and bands cover."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import scipy
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from bwbayes.calibration.evaluation import LIMIT, Calibration
from bwbayes.calibration.replicates import EXTRA
from bwbayes.prediction.bands import KINDS, LEVELS
from bwbayes.report.figures.style import COLORS, axis_label, hide_unused, share_legend

__all__ = ["draw_coverage", "draw_ecdf", "draw_histograms"]

RANK_BINS = 20
COLUMNS = 4

EVEN_COLOR = "#dddddd"
NOMINAL_COLOR = "#777777"

# What is ranked besides parameters.
EXTRA_LABELS = dict(
    zip(EXTRA, ("log likelihood", "loop opening (µm)", "displacement range (µm)"), strict=True)
)


def draw_histograms(calibration: Calibration) -> Figure:
    """Draw how the ranks of each statistic are spread, over what is expected.

    The gray band holds each bar of an even statistic with a probability of 99 %.
    """
    labels = _labels(calibration)
    count = calibration.positions.shape[0]
    low, high = scipy.stats.binom.interval(0.99, count, 1 / RANK_BINS)
    figure, panels = _grid(labels, "rank among the draws (%)", "replicates\n(expected: 1)")
    for panel, column in zip(panels, calibration.positions.T, strict=True):
        heights, edges = np.histogram(column, RANK_BINS, range=(0, 1))
        scale = RANK_BINS / count
        panel.axhspan(low * scale, high * scale, color=EVEN_COLOR, lw=0, label="99 % of even bars")
        panel.axhline(1.0, color=NOMINAL_COLOR, lw=0.8)
        panel.stairs(heights * scale, 100 * edges, color=COLORS[0], lw=1.2, label="replicates")
    panels[0].set_ylim(bottom=0)
    share_legend(figure)
    return figure


def draw_ecdf(calibration: Calibration) -> Figure:
    """Draw each distribution function of ranks less that of even ones, and its band."""
    labels = _labels(calibration)
    count, limit = calibration.positions.shape[0], 100 * calibration.ecdf_limit
    figure, panels = _grid(labels, "rank among the draws (%)", "ECDF less\neven ECDF (%)")
    steps = np.arange(count + 1) / count
    columns = np.sort(calibration.positions, axis=0).T
    for panel, ranks, column in zip(panels, calibration.statistics.values(), columns, strict=True):
        panel.axhspan(-limit, limit, color=EVEN_COLOR, lw=0, label="simultaneous band")
        panel.axhline(0.0, color=NOMINAL_COLOR, lw=0.8)
        # The distribution function before and after each rank.
        at = np.concatenate([[0.0], np.repeat(column, 2), [1.0]])
        panel.plot(
            100 * at,
            100 * (np.repeat(steps, 2) - at),
            color=COLORS[1] if ranks.outside else COLORS[0],
            label="leaves the band" if ranks.outside else "replicates",
        )
        panel.text(
            0.97, 0.95, f"p = {ranks.p:.2g}", transform=panel.transAxes, ha="right", va="top"
        )
        panel.margins(y=0.2)
    share_legend(figure)
    return figure


def draw_coverage(calibration: Calibration) -> Figure:
    """Draw the coverage of the posteriors' intervals, and of the bands on held-out samples."""
    labels = _labels(calibration)
    others = calibration.predicted
    width = 7.5 + 3.5 * len(others)
    figure = Figure(figsize=(width, 0.28 * len(labels) + 1.8), layout="constrained")
    first, *panels = figure.subplots(1, 1 + len(others), squeeze=False)[0]
    _draw_intervals(first, calibration, labels)
    for panel, other in zip(panels, others, strict=True):
        _draw_bands(panel, calibration, other)
    return figure


def _draw_intervals(panel: Axes, calibration: Calibration, labels: Sequence[str]) -> None:
    """Draw a row for each statistic, and binomial limits around each level."""
    rows = np.arange(len(labels))
    for i, level in enumerate(LEVELS):
        low, high = calibration.limits[level]
        panel.axvspan(100 * low, 100 * high, color=COLORS[i], alpha=0.13, lw=0)
        panel.axvline(level, color=COLORS[i], lw=0.8, ls="--")
        covered = [100 * ranks.covered[level] for ranks in calibration.statistics.values()]
        panel.plot(covered, rows, "o", color=COLORS[i], ms=4.5, label=f"{level} %")
    panel.set_yticks(rows, labels)
    panel.invert_yaxis()
    panel.set_xlabel("truths inside the interval (%)")
    panel.set_title("posterior intervals (shaded: 99 % binomial limits)")
    panel.legend(loc="upper center", bbox_to_anchor=(0.5, -0.11), ncols=len(LEVELS))


def _draw_bands(panel: Axes, calibration: Calibration, other: str) -> None:
    """Draw how far each band's mean coverage is off, with three standard errors."""
    for i, kind in enumerate(KINDS):
        off, error = zip(
            *(
                (100 * coverage.mean - level, 100 * LIMIT * coverage.error)
                for level, coverage in (
                    (level, calibration.bands[f"{other} {kind} {level}".strip()])
                    for level in LEVELS
                )
            ),
            strict=True,
        )
        x = np.arange(len(LEVELS)) + 0.15 * (i - 1)
        panel.errorbar(
            x, off, error, fmt="os^"[i], ms=5, capsize=3, color=COLORS[i], label=f"{kind} band"
        )
    panel.axhline(0.0, color=NOMINAL_COLOR, lw=0.8, ls="--")
    panel.set_xticks(range(len(LEVELS)), [f"{level} %" for level in LEVELS])
    panel.set_xlabel("nominal coverage (%)")
    panel.set_ylabel("measured less nominal coverage (%)")
    panel.set_title(f"bands on {other or 'held-out samples'} (whiskers: 3 standard errors)")
    panel.legend(loc="best")


def _labels(calibration: Calibration) -> list[str]:
    """Return the label of each statistic."""
    labels = {
        parameter.name: axis_label(parameter) for parameter in calibration.parameters
    } | EXTRA_LABELS
    return [labels[name] for name in calibration.statistics]


def _grid(labels: Sequence[str], xlabel: str, ylabel: str) -> tuple[Figure, list[Axes]]:
    """Return a figure with a titled panel for each label."""
    rows = -(-len(labels) // COLUMNS)
    figure = Figure(figsize=(11, 1.7 * rows + 0.7), layout="constrained")
    grid = figure.subplots(rows, COLUMNS, sharex=True, sharey=True, squeeze=False)
    panels = hide_unused(grid, len(labels), xlabel)
    for i, (panel, label) in enumerate(zip(panels, labels, strict=True)):
        panel.tick_params(labelbottom=bool(panel.get_xlabel()))
        panel.set_title(label)
        panel.set_xlim(0, 100)
        if i % COLUMNS == 0:
            panel.set_ylabel(ylabel)
    return figure, panels
