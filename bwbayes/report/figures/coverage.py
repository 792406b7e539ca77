"""Do the bands keep their promise? Measured against nominal coverage, and the PIT."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from bwbayes.prediction.bands import LEVELS, Bands
from bwbayes.prediction.scores import Scores
from bwbayes.report.figures.style import COLORS, plain, title

__all__ = ["draw_coverage"]


# Filled markers for what a measurement can check, open ones for what only a simulation can.
FILLS = {"sensor": "full", "displacement": "none"}
MARKERS = {"sensor": "o", "displacement": "s"}


def draw_coverage(predictions: Sequence[Bands], scores: Mapping[str, Scores]) -> Figure:
    """Draw the coverage of the 50, 90 and 95 % bands, and the histogram of the PIT.

    Whiskers are one block-bootstrap standard error either way. Where the sensor's distribution is
    right the PIT, its probability below each reading, is spread evenly: a hump tells of bands that
    are too wide, a bowl of bands that are too narrow, a slope of a bias.
    """
    judged = [bands for bands in predictions if bands.name in scores]
    figure = Figure(figsize=(11, 4.2), layout="constrained")
    nominal, pit = figure.subplots(1, 2)
    _draw_nominal(nominal)
    for i, bands in enumerate(judged):
        color = COLORS[i % len(COLORS)]
        _draw_measured(
            nominal, scores[bands.name], plain(title(bands)), color, i - (len(judged) - 1) / 2
        )
        if bands.pit is not None:
            _draw_pit(pit, bands, color)
    nominal.set_xticks(range(len(LEVELS)), [f"{level} %" for level in LEVELS])
    nominal.set_xlabel("nominal coverage (%)")
    nominal.set_ylabel("measured coverage (%)")
    nominal.legend(loc="lower right")
    pit.axhline(1.0, color="#777777", lw=1)
    pit.set_xlim(0, 1)
    pit.set_ylim(bottom=0)
    pit.set_xlabel("PIT: predicted probability below the reading (-)")
    pit.set_ylabel("density (expected: 1)")
    return figure


def _draw_nominal(panel: Axes) -> None:
    for x, level in enumerate(LEVELS):
        panel.hlines(
            level,
            x - 0.4,
            x + 0.4,
            color="#777777",
            ls="--",
            lw=1,
            label="" if x else "nominal",
        )


def _draw_measured(panel: Axes, scores: Scores, name: str, color: str, position: float) -> None:
    """Draw one validation, beside the others."""
    for shift, (kind, marker) in zip((-0.03, 0.03), MARKERS.items(), strict=True):
        covered, error = scores.coverage[kind], scores.coverage_error[kind]
        if covered is None:
            continue
        panel.errorbar(
            np.arange(len(LEVELS)) + 0.14 * position + shift,
            [100 * covered[level] for level in LEVELS],
            [100 * error[level] if error else 0.0 for level in LEVELS],
            fmt=marker,
            fillstyle=FILLS[kind],
            ms=5,
            capsize=3,
            color=color,
            label=f"{name}: {kind} band",
        )


def _draw_pit(panel: Axes, bands: Bands, color: str) -> None:
    assert bands.pit is not None
    heights, edges = np.histogram(bands.pit[bands.scored_from :], 20, range=(0, 1), density=True)
    panel.stairs(heights, edges, baseline=None, color=color, lw=1.4, label=plain(title(bands)))
