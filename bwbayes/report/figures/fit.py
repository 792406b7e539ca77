"""Figures of a fit, besides series and draws: coverage, residuals, measured loops and steps."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import scipy
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from bwbayes.arrays import FloatArray
from bwbayes.diagnosis.consistency import Consistency
from bwbayes.diagnosis.innovations import Innovations
from bwbayes.prediction.bands import LEVELS, Bands
from bwbayes.prediction.loops import Loops
from bwbayes.prediction.scores import Scores
from bwbayes.prediction.steps import CREEP_FROM, StepResponse
from bwbayes.report.figures import style

BAND = "95% parameters"


def draw_coverage(predictions: Sequence[Bands], scores: Mapping[str, Scores]) -> Figure:
    """Draw the coverage of the 50, 90 and 95% bands, and the histogram of the PIT.

    Whiskers are one block-bootstrap standard error either way. If the sensor's distribution is
    right the PIT, its probability below each reading, is uniform: a hump means bands that are too
    wide, a bowl bands that are too narrow, a slope a bias.
    """
    scored = [bands for bands in predictions if bands.name in scores]
    figure, ((nominal, pit),) = style.new_figure(11, 4.2, 1, 2)
    x = np.arange(len(LEVELS))
    expected: style.Look = {"color": style.Color.EXPECTED, "lw": 1}
    nominal.hlines(LEVELS, x - 0.4, x + 0.4, ls="--", label="nominal", **expected)
    for i, bands in enumerate(scored):
        color, name = style.COLORS[i % len(style.COLORS)], style.plain(style.title(bands))
        score, center = scores[bands.name], x + 0.14 * (i - (len(scored) - 1) / 2)
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
        label = style.plain(f"{name}, {response.step.height:g} V")
        # The rise is drawn from this part of its final value on.
        started = np.abs(response.response.mean) > 1e-3 * abs(float(response.response.mean[-1]))
        # Without dynamics there is no rise to be seen.
        start = CREEP_FROM / 10 if started[0] else float(response.time[int(np.argmax(started))])
        first = min(first, start)
        for panel, curve in zip(panels, (response.response, response.crept), strict=False):
            if curve is not None:
                edges = curve.lower, curve.upper
                style.draw_band(panel, response.time, curve.mean, edges, label, color)
    last = max(response.step.held for response in responses.values())
    for panel in panels:
        panel.set(xscale="log", xlabel="time since the step (s)", xlim=(CREEP_FROM, last))
    panels[0].set(xlim=(first, last), ylabel="displacement (µm)", title="rise")
    if creeps:
        panels[1].set(ylabel="growth since 0.1 s (µm)", title="creep")
    style.share_legend(figure, band=BAND)
    return figure
