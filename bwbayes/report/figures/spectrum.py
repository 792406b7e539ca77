"""The spectrum of the residual, and beside it what the noise model takes it for."""

from __future__ import annotations

from matplotlib.figure import Figure

from bwbayes.diagnosis.innovations import Innovations
from bwbayes.report.figures.style import MEAN_COLOR, MEASURED_COLOR

__all__ = ["draw_spectrum"]


def draw_spectrum(innovations: Innovations) -> Figure:
    """Draw the amplitude spectral density of the residual and of the noise model."""
    frequency, density = innovations.residual_density()
    figure = Figure(figsize=(11, 4.2), layout="constrained")
    panel = figure.subplots()
    panel.loglog(frequency, density, color=MEASURED_COLOR, lw=0.9, label="residual")
    model = innovations.noise_density(frequency)
    if model is not None:
        panel.loglog(frequency, model, color=MEAN_COLOR, lw=1.5, label="noise model")
    panel.set_xlabel("frequency (Hz)")
    panel.set_ylabel("amplitude density (µm/√Hz)")
    figure.legend(loc="outside right upper")
    return figure
