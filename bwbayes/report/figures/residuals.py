"""Residuals: whether innovations are pure chance, their spectrum, and those of several records."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import scipy
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from bwbayes.arrays import FloatArray
from bwbayes.diagnosis.consistency import Agreement
from bwbayes.diagnosis.innovations import Innovations
from bwbayes.report.figures import style


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
    label = "95 % of independent ones"
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
    expected = scipy.stats.norm.ppf((at + 0.5) / size)
    # Where each of so many independent ones lies, pointwise, from the beta distribution.
    low, high = (
        scipy.stats.norm.ppf(scipy.stats.beta.ppf(level, at + 1, size - at))
        for level in (0.025, 0.975)
    )
    label = "95 % of normal ones"
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
        parts = np.array_split(rows, max(round(count * rows.size / white.size), 1))
        centers = [np.mean(time[part]) for part in parts]
        size = [np.sqrt(np.mean(white[part] ** 2)) for part in parts]
        label = "_nolegend_" if rows[0] else "root mean square: 1 is right"
        panel.plot(centers, size, color=style.Color.MEAN, lw=1.5, label=label)
    panel.axhline(1, color=style.Color.MEAN, lw=0.8, ls=":")
    panel.set(ylim=(-reach, reach), title="Stationarity")
    panel.set_xlabel("time (s)")
    panel.legend(loc="upper right")


def _draw_drive(panel: Axes, innovations: Innovations) -> None:
    """Draw mean and sd in parts of the drive, with the errors that chance gives them."""
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
    low, high = panel.get_ylim()
    panel.set_ylim(min(low, -0.3), max(high, 1.3) + 0.15 * (high - low))
    panel.set_title("Size by input voltage")
    panel.legend(loc="center right")


def draw_spectrum(innovations: Innovations) -> Figure:
    """Draw the amplitude spectral density of the residual and of the noise model."""
    frequency, density = innovations.residual_density()
    figure, ((panel,),) = style.new_figure(11, 4.2)
    panel.loglog(frequency, density, color=style.Color.MEASURED, lw=0.9, label="residual")
    model = innovations.noise_density(frequency)
    if model is not None:
        panel.loglog(frequency, model, color=style.Color.MEAN, lw=1.5, label="noise model")
    panel.set(xlabel="frequency (Hz)", ylabel="amplitude density (µm/√Hz)")
    figure.legend(loc="outside right upper")
    return figure


def draw_agreement(agreements: Mapping[str, Agreement]) -> Figure:
    """Draw each record's residuals, along time, in the joint fit and in a fit of its own."""
    figure, panels = style.new_figure(11, 0.9 + 1.9 * len(agreements), len(agreements))
    for (panel,), (name, agreement) in zip(panels, agreements.items(), strict=True):
        for values, color, label in (
            (agreement.joint, style.COLORS[0], f"joint fit: {agreement.joint_um:.3g} µm rms"),
            (agreement.own, style.COLORS[1], f"own fit: {agreement.own_um:.3g} µm rms"),
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
