"""Figures of products: designs, commands, closed loops, calibrations, and populations."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np
import scipy
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import (
    FuncFormatter,
    LogLocator,
    MaxNLocator,
    NullFormatter,
    ScalarFormatter,
)

from bwbayes.arrays import FloatArray
from bwbayes.calibration.calibration import LIMIT, Calibration
from bwbayes.prediction.bands import KINDS, LEVELS
from bwbayes.report.calibration import EXTRA_WORDS
from bwbayes.report.figures import style
from bwbayes.report.report import label_with_unit

COLOR_OF = {"uncompensated": style.COLORS[3], "compensated": style.Color.MEAN}


# Commands by name, "uncompensated" and "compensated": objects with ``voltage`` (samples,), V,
# ``bands`` of the displacement, and ``rms`` errors (draws,), um.
type Commands = Mapping[str, Any]


def draw_command(
    name: str, reference: FloatArray, commands: Commands, limit: float | None
) -> Figure:
    """Draw voltage, displacement and error along time, beside those without compensation.

    ``reference`` (samples,), um, is the desired displacement; ``limit``, um, that of the error.
    """
    figure, panels = style.new_figure(10, 6.5, 3, gap=0.15, sharex=True, height_ratios=(1, 2, 2))
    top, center, below = panels[:, 0]
    time = commands["compensated"].bands.time
    style.draw_ribbons(center, commands["compensated"].bands, kinds=("displacement", "parameter"))
    for label, command in commands.items():
        color = COLOR_OF[label]
        top.plot(*style.zigzag(time, command.voltage), color=color, label=label)
        center.plot(*style.zigzag(time, command.bands.mean), color=color, label=label)
    top.set(ylabel="voltage (V)", title=style.plain(f"command for {name}"))
    line = style.zigzag(time, reference)
    center.plot(*line, "--", color=style.Color.MEASURED, label="reference")
    center.set_ylabel("displacement (µm)")
    _draw_errors(below, reference, commands, limit)
    style.share_legend(figure, ncols=5)
    return figure


def draw_error(reference: FloatArray, commands: Commands, limit: float | None) -> Figure:
    """Draw the error along time with its bands, and the distribution of its rms over the draws."""
    figure, ((along, spread),) = style.new_figure(10, 3.6, 1, 2, width_ratios=(2, 1))
    _draw_errors(along, reference, {"compensated": commands["compensated"]}, limit)
    rms = np.concatenate([command.rms for command in commands.values()])
    # Errors are mostly far from zero; if they are not, all of them may be zero, or equal.
    low = max(float(rms.min()), 1e-9)
    bins = np.geomspace(low, max(float(rms.max()), 1.1 * low), 61)
    for label, command in commands.items():
        spread.hist(command.rms, bins=bins, color=COLOR_OF[label], alpha=0.6, label=label)
    spread.set(xlabel="rms of the error (µm)", ylabel="draws", xscale="log")
    # Two to five ticks; one decade may hold no power of ten.
    decades = float(np.log10(bins[-1] / bins[0]))
    powers = LogLocator(numticks=5) if decades > 2 else LogLocator(subs=(1, 3))
    spread.xaxis.set_major_locator(MaxNLocator(3) if decades < 1 else powers)
    spread.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    spread.xaxis.set_minor_formatter(NullFormatter())
    style.share_legend(figure)
    return figure


def draw_loops(reference: FloatArray, commands: Commands) -> Figure:
    """Draw the displacement against the reference, without and with compensation."""
    figure, (panels,) = style.new_figure(10, 4.6, 1, 2, sharex=True, sharey=True)
    ends = [float(reference.min()), float(reference.max())]
    for panel, (label, command) in zip(panels, commands.items(), strict=True):
        panel.plot(ends, ends, "--", color=style.Color.MEASURED, label="reference")
        panel.plot(reference, command.bands.mean, color=style.Color.MEAN, label="predicted")
        panel.set(title=label, xlabel="reference (µm)")
        panel.legend(fontsize=8)
    panels[0].set_ylabel("displacement (µm)")
    return figure


def _draw_errors(
    panel: Axes, reference: FloatArray, commands: Commands, limit: float | None
) -> None:
    bands = commands["compensated"].bands
    style.draw_ribbons(panel, bands, reference, ("displacement", "parameter"))
    for label, command in commands.items():
        error = style.zigzag(bands.time, command.bands.mean - reference)
        panel.plot(*error, color=COLOR_OF[label], label=label)
    for side in () if limit is None else (-limit, limit):
        panel.axhline(side, color=style.Color.MEASURED, lw=0.8, ls=":")
    panel.set(xlabel="time (s)", ylabel="error (µm)")


def draw_tracking(table: Any, controllers: Iterable[str]) -> Figure:
    """Draw the rms errors of the controllers: mean over the draws, and the range of 95% of them.

    The table is a pandas.DataFrame with a row for each signal, frequency and controller.
    """
    signals = list(dict.fromkeys(table["signal"]))
    labels = "frequency (Hz)", "rms error (µm)"
    share: style.Look = {"sharex": True, "sharey": True}
    figure, panels = style.panel_grid(len(signals), 2, 3.4, *labels, **share)
    curves = table.groupby(["signal", "controller"])
    for panel, signal in zip(panels, signals, strict=True):
        for controller, color in zip(controllers, style.COLORS, strict=False):
            curve = curves.get_group((signal, controller))
            edges = curve["rms_um_low"], curve["rms_um_high"]
            means = curve["frequency_Hz"], curve["rms_um"]
            style.draw_band(panel, *means, edges, controller, color, "o-")
        panel.set(title=signal, xscale="log", yscale="log")
        panel.xaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
        panel.xaxis.set_major_formatter(ScalarFormatter())
        panel.xaxis.set_minor_formatter(NullFormatter())
    style.share_legend(figure)
    return figure


def draw_promises(
    names: Sequence[str], remaining: FloatArray, error: FloatArray, label: str
) -> Figure:
    """Draw a dot with two standard errors for each candidate; one at 100% adds no information.

    ``remaining`` and ``error`` (candidates,) are parts, the best first.
    """
    figure, ((panel,),) = style.new_figure(7, 1.2 + 0.32 * len(names))
    rows, percent = np.arange(len(names)), 100 * remaining
    colors = [style.Color.MEAN, *[style.COLORS[0]] * (len(names) - 1)]
    panel.hlines(rows, percent, 100, color="#bbbbbb", lw=1)
    panel.errorbar(percent, rows, xerr=200 * error, fmt="none", ecolor="#222222", capsize=5)
    panel.scatter(percent, rows, color=colors, s=28, zorder=3)
    panel.axvline(100, color="#222222", lw=1, ls=":")
    panel.set_yticks(rows, [style.plain(name) for name in names])
    figure.set_layout_engine("constrained")
    panel.invert_yaxis()
    panel.set(xlim=(0, 104), xlabel=style.plain(f"{label} (%)"))
    return figure


def draw_histograms(calibration: Calibration, bins: int = 20) -> Figure:
    """Draw the rank histogram of each statistic, relative to the expected counts.

    The gray band holds each bar of a uniform statistic with a probability of 99%.
    """
    count = calibration.positions.shape[0]
    low, high = (x * bins / count for x in scipy.stats.binom.interval(0.99, count, 1 / bins))
    figure, panels = _rank_panels(calibration, "replicates\n(expected: 1)")
    for panel, column in zip(panels, calibration.positions.T, strict=True):
        heights, edges = np.histogram(column, bins, range=(0, 1))
        panel.axhspan(low, high, color=style.Color.CHANCE, lw=0, label="99% of even bars")
        panel.axhline(1.0, color=style.Color.EXPECTED, lw=0.8)
        look: style.Look = {"color": style.COLORS[0], "lw": 1.2, "label": "replicates"}
        panel.stairs(heights * bins / count, 100 * edges, **look)
    panels[0].set_ylim(bottom=0)
    style.share_legend(figure)
    return figure


def draw_ecdf(calibration: Calibration) -> Figure:
    """Draw each distribution function of ranks minus the uniform one, and its band."""
    count, limit = calibration.positions.shape[0], 100 * calibration.ecdf_limit
    figure, panels = _rank_panels(calibration, "ECDF less\neven ECDF (%)")
    steps = np.repeat(np.arange(count + 1) / count, 2)
    columns = np.sort(calibration.positions, axis=0).T
    for panel, ranks, column in zip(panels, calibration.statistics.values(), columns, strict=True):
        panel.axhspan(-limit, limit, color=style.Color.CHANCE, lw=0, label="simultaneous band")
        panel.axhline(0.0, color=style.Color.EXPECTED, lw=0.8)
        # The distribution function before and after each rank.
        at = np.concatenate([[0.0], np.repeat(column, 2), [1.0]])
        label = "leaves the band" if ranks.outside else "replicates"
        color = style.COLORS[1] if ranks.outside else style.COLORS[0]
        panel.plot(100 * at, 100 * (steps - at), color=color, label=label)
        corner: style.Look = {"transform": panel.transAxes, "ha": "right", "va": "top"}
        panel.text(0.97, 0.95, f"p = {ranks.p:.2g}", **corner)
        panel.margins(y=0.2)
    style.share_legend(figure)
    return figure


def draw_coverage(calibration: Calibration) -> Figure:
    """Draw the coverage of the posteriors' intervals, and of the bands on held-out samples.

    Each statistic's intervals are a row, with binomial limits around each level. For each kind of
    band, the deviation of its mean coverage stands with three standard errors.
    """
    others, labels = calibration.predicted, _labels(calibration)
    size = 7.5 + 3.5 * len(others), 0.28 * len(labels) + 1.8
    figure, ((intervals, *panels),) = style.new_figure(*size, 1, 1 + len(others))
    for level, color in zip(LEVELS, style.COLORS, strict=False):
        low, high = calibration.limits[level]
        intervals.axvspan(100 * low, 100 * high, color=color, alpha=0.13, lw=0)
        intervals.axvline(level, color=color, lw=0.8, ls="--")
        covered = [100 * ranks.covered[level] for ranks in calibration.statistics.values()]
        intervals.plot(covered, range(len(labels)), "o", color=color, ms=4.5, label=f"{level}%")
    intervals.set_yticks(range(len(labels)), labels)
    figure.set_layout_engine("constrained")
    intervals.invert_yaxis()
    intervals.set_xlabel("truths inside the interval (%)")
    intervals.set_title("posterior intervals (shaded: 99% binomial limits)")
    intervals.legend(loc="upper center", bbox_to_anchor=(0.5, -0.11), ncols=len(LEVELS))
    x = np.arange(len(LEVELS))
    for panel, other in zip(panels, others, strict=True):
        for i, kind in enumerate(KINDS):
            coverages = [calibration.bands[f"{other} {kind} {level}".strip()] for level in LEVELS]
            off = [100 * cover.mean - level for cover, level in zip(coverages, LEVELS, strict=True)]
            error = [100 * LIMIT * coverage.error for coverage in coverages]
            look: style.Look = {"fmt": "os^"[i], "ms": 5, "capsize": 3, "color": style.COLORS[i]}
            panel.errorbar(x + 0.15 * (i - 1), off, error, label=f"{kind} band", **look)
        panel.axhline(0.0, color=style.Color.EXPECTED, lw=0.8, ls="--")
        panel.set_xticks(x, [f"{level}%" for level in LEVELS])
        panel.set(xlabel="nominal coverage (%)", ylabel="measured less nominal coverage (%)")
        panel.set_title(f"bands on {other or 'held-out samples'} (whiskers: 3 standard errors)")
        panel.legend(loc="best")
    return figure


def _labels(calibration: Calibration) -> list[str]:
    """Return the label of each statistic."""
    labels = {name: label_with_unit(*words) for name, words in EXTRA_WORDS.items()}
    labels |= {parameter.name: style.axis_label(parameter) for parameter in calibration.parameters}
    return [labels[name] for name in calibration.statistics]


def _rank_panels(calibration: Calibration, ylabel: str) -> tuple[Figure, list[Axes]]:
    """Return a figure with a titled panel for each statistic."""
    labels = _labels(calibration)
    xlabel = "rank among the draws (%)"
    share: style.Look = {"sharex": True, "sharey": True}
    figure, panels = style.panel_grid(len(labels), 4, 1.7, xlabel, ylabel, **share)
    for panel, label in zip(panels, labels, strict=True):
        panel.set(title=label, xlim=(0, 100))
    return figure, panels


def draw_parameters(
    records: Mapping[str, Mapping[str, Mapping[str, Any]]], new: Mapping[str, FloatArray]
) -> Figure:
    """Draw a panel for each parameter: the records' 95% intervals in the order of their names.

    ``records`` are the records' estimates by parameter, as in ``campaign.json``, ``new`` the draws
    of a new specimen. Intervals of a single fit are gray, those with the population as the prior
    blue; the panel also shows the population's median and the range of 95% of new specimens.
    Outliers are red.
    """
    units = {
        name: estimate["unit"]
        for estimates in records.values()
        for name, estimate in estimates.items()
    }
    figure, panels = style.panel_grid(len(units), 3, 2.6, "record")
    figure.set_layout_engine("constrained")
    for panel, (name, unit) in zip(panels, units.items(), strict=True):
        if name in new:
            low, median, high = np.quantile(new[name], [0.025, 0.5, 0.975])
            panel.axhspan(low, high, color=style.BAND_COLORS["sensor"], zorder=0)
            panel.axhline(median, color=style.COLORS[0], lw=0.8, zorder=1)
        for x, estimates in enumerate(records.values(), start=1):
            estimate = estimates.get(name)
            if estimate is None:
                continue
            edges = estimate["lower_95"], estimate["upper_95"]
            panel.vlines(x, *edges, color=style.Color.LEAD_IN, lw=0.8)
            if "shrunk_median" in estimate:
                color = style.COLORS[1] if estimate["outlier"] else style.COLORS[0]
                edges = estimate["shrunk_lower_95"], estimate["shrunk_upper_95"]
                panel.vlines(x + 0.25, *edges, color=color, lw=1.4)
                panel.plot(x + 0.25, estimate["shrunk_median"], "o", color=color, ms=2.5)
            else:
                panel.plot(x, estimate["median"], ".", color=style.Color.LEAD_IN, ms=3)
        label = style.plain(label_with_unit(name, unit))
        panel.set(ylabel=label, xlim=(0, len(records) + 1))
        # The names of more records would overlap.
        if len(records) <= 24:
            names = [style.plain(record) for record in records]
            panel.set_xticks(range(1, len(records) + 1), names, rotation=90, fontsize=7)
    return figure
