"""The spectrum of the residual: its lines, and beside it what the noise model takes it for."""

from __future__ import annotations

import numpy as np
from matplotlib.figure import Figure

from bwbayes.report.figures.style import COLORS, MEAN_COLOR, MEASURED_COLOR
from bwbayes.report.words import unit_text
from bwbayes.results.innovations import Innovations

__all__ = ["draw_spectrum"]

# Colors of lines: not that of the noise model.
LINE_COLORS = tuple(color for color in COLORS if color != MEAN_COLOR)


def draw_spectrum(innovations: Innovations) -> Figure:
    """Draw the residual's amplitude spectral density with its lines, the strongest named first."""
    spectrum = innovations.spectrum()
    figure = Figure(figsize=(11, 4.2), layout="constrained")
    panel = figure.subplots()
    panel.loglog(
        spectrum.frequency, spectrum.density, color=MEASURED_COLOR, lw=0.9, label="residual"
    )
    model = innovations.noise_density(spectrum.frequency)
    if model is not None:
        panel.loglog(spectrum.frequency, model, color=MEAN_COLOR, lw=1.5, label="noise model")
    for number, line in enumerate(spectrum.lines):
        panel.axvline(
            line.frequency,
            color=LINE_COLORS[number % len(LINE_COLORS)],
            ls="--" if number < len(LINE_COLORS) else ":",
            lw=1.2,
            zorder=1.5,
            label=unit_text(line.description),
        )
    if not spectrum.lines:
        panel.plot(np.nan, np.nan, " ", label="no lines")
    panel.set_xlabel("frequency (Hz)")
    panel.set_ylabel("amplitude density (µm/√Hz)")
    figure.legend(loc="outside right upper")
    return figure
