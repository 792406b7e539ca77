"""Innovations of the fitted readings: whether they are white, normal, and even along the drive."""

from __future__ import annotations

import numpy as np
import scipy
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from bwbayes.diagnosis.innovations import Innovations
from bwbayes.report.figures.style import COLORS, MEAN_COLOR, MEASURED_COLOR

__all__ = ["draw_innovations"]

# Dots of the quantiles: the extremes all, the others thinned.
DOTS = 600
EXTREMES = 100


def draw_innovations(innovations: Innovations) -> Figure:
    """Draw autocorrelation, quantiles, size along time, and size along the drive."""
    figure = Figure(figsize=(11, 6.6), layout="constrained")
    axes = figure.subplots(2, 2)
    _draw_correlation(axes[0, 0], innovations)
    _draw_quantiles(axes[0, 1], innovations)
    _draw_time(axes[1, 0], innovations)
    _draw_drive(axes[1, 1], innovations)
    return figure


def _draw_correlation(panel: Axes, innovations: Innovations) -> None:
    correlation = innovations.correlation
    bound = scipy.stats.norm.isf(0.025) / np.sqrt(innovations.white.size)
    lags = np.arange(1, correlation.size + 1)
    panel.axhspan(-bound, bound, color="#dddddd", lw=0, label="95 % of independent ones")
    panel.vlines(lags, 0, correlation, color=COLORS[0], lw=2)
    panel.axhline(0, color=MEASURED_COLOR, lw=0.8)
    reach = max(float(np.max(np.abs(correlation))), 2 * float(bound), 0.1) * 1.15
    panel.set(ylim=(-reach, reach), xlim=(0, lags[-1] + 1))
    panel.set(title="Are they white?", xlabel="lag (readings)", ylabel="autocorrelation")
    panel.legend(loc="lower right")


def _draw_quantiles(panel: Axes, innovations: Innovations) -> None:
    ordered = np.sort(innovations.white)
    size = ordered.size
    expected = scipy.stats.norm.ppf((np.arange(size) + 0.5) / size)
    inner = np.arange(EXTREMES, size - EXTREMES, max(1, size // DOTS))
    ends = np.r_[: min(EXTREMES, size), max(size - EXTREMES, 0) : size]
    at = np.unique(np.concatenate([ends, inner])).astype(np.int64)
    # Where each of so many independent ones lies, pointwise, from the beta distribution.
    low, high = (
        scipy.stats.norm.ppf(scipy.stats.beta.ppf(level, at + 1, size - at))
        for level in (0.025, 0.975)
    )
    panel.fill_between(expected[at], low, high, color="#dddddd", lw=0, label="95 % of normal ones")
    panel.plot(expected[at], expected[at], color=MEAN_COLOR, lw=1)
    panel.plot(expected[at], ordered[at], ".", color=COLORS[0], ms=3, mew=0)
    panel.set(title="Are they normal?", xlabel="normal quantile", ylabel="innovation (sds)")
    panel.legend(loc="upper left")


def _draw_time(panel: Axes, innovations: Innovations) -> None:
    """Draw all innovations, and the root mean square of stretches: 1 if the size is right."""
    time, white = innovations.time, innovations.white
    dim = min(0.7, 8000 / white.size)
    reach = max(4.5, 1.1 * float(np.quantile(np.abs(white), 0.9995)))
    shown = np.clip(white, -reach, reach)
    panel.plot(time, shown, ".", color=MEASURED_COLOR, ms=2, mew=0, alpha=dim)
    # The size is shown of 40 stretches of time, or fewer that have enough readings.
    stretches = min(40, max(white.size // 20, 1))
    # A gap of this part of the time ends the line.
    gaps = np.flatnonzero(np.diff(time) > 0.02 * np.ptp(time)) + 1
    label = "root mean square: 1 is right"
    for window in np.split(np.arange(white.size), gaps):
        pieces = np.array_split(window, max(round(stretches * window.size / white.size), 1))
        centers = [float(np.mean(time[segment])) for segment in pieces]
        size = [float(np.sqrt(np.mean(white[segment] ** 2))) for segment in pieces]
        panel.plot(centers, size, color=MEAN_COLOR, lw=1.5, label=label)
        label = "_nolegend_"
    panel.axhline(1, color=MEAN_COLOR, lw=0.8, ls=":")
    panel.set(ylim=(-reach, reach), title="Does the record go on as it starts?")
    panel.set(xlabel="time (s)", ylabel="innovation (sds)")
    panel.legend(loc="upper right")


def _draw_drive(panel: Axes, innovations: Innovations) -> None:
    """Draw mean and sd in parts of the drive, with the errors that chance gives them."""
    x = 0.0
    names: list[tuple[float, str]] = []
    edges: list[tuple[float, str]] = []
    for quantity in ("rate", "voltage", "direction"):
        for name, values in innovations.by(quantity):
            if values.size < 2:
                continue
            sd, mean, many = float(np.std(values)), float(np.mean(values)), values.size
            first = not names
            panel.errorbar(
                x, sd, yerr=1.96 * sd / np.sqrt(2 * many), fmt="o", color=COLORS[0], ms=5,
                label="sd: 1 is right" if first else None,
            )  # fmt: skip
            panel.errorbar(
                x, mean, yerr=1.96 * sd / np.sqrt(many), fmt="s", color=COLORS[1], ms=4,
                label="mean: 0 is right" if first else None,
            )  # fmt: skip
            names.append((x, name))
            x += 1
        edges.append((x - 0.5, quantity))
        x += 0.5
    for level, color in ((1, COLORS[0]), (0, COLORS[1])):
        panel.axhline(level, color=color, lw=0.8, ls=":")
    panel.set_xticks([at for at, _ in names], [name for _, name in names])
    start = -0.5
    for edge, quantity in edges:
        panel.text((start + edge) / 2, 1.0, f"by {quantity}", transform=panel.get_xaxis_transform(),
                   ha="center", va="top", color="#555555")  # fmt: skip
        if edge != edges[-1][0]:
            panel.axvline(edge + 0.25, color="#cccccc", lw=0.8)
        start = edge + 0.5
    low, high = panel.get_ylim()
    panel.set_ylim(min(low, -0.3), max(high, 1.3) + 0.15 * (high - low))
    panel.set(title="Are they the same along the drive?", ylabel="innovation (sds)")
    panel.legend(loc="center right")
