"""Do the bands keep their promise? Measured against nominal coverage, and the PIT."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.figure import Figure

from bwbayes.prediction.bands import LEVELS, Bands
from bwbayes.prediction.scores import Scores
from bwbayes.report.figures import style


def draw_coverage(predictions: Sequence[Bands], scores: Mapping[str, Scores]) -> Figure:
    """Draw the coverage of the 50, 90 and 95 % bands, and the histogram of the PIT.

    Whiskers are one block-bootstrap standard error either way. Where the sensor's distribution is
    right the PIT, its probability below each reading, is spread evenly: a hump tells of bands that
    are too wide, a bowl of bands that are too narrow, a slope of a bias.
    """
    scored = [bands for bands in predictions if bands.name in scores]
    figure, ((nominal, pit),) = style.new_figure(11, 4.2, 1, 2)
    x = np.arange(len(LEVELS))
    expected: style.Look = {"color": style.Color.EXPECTED, "lw": 1}
    nominal.hlines(LEVELS, x - 0.4, x + 0.4, ls="--", label="nominal", **expected)
    for i, bands in enumerate(scored):
        color, name = style.COLORS[i % len(style.COLORS)], style.plain(style.title(bands))
        score, center = scores[bands.name], x + 0.14 * (i - (len(scored) - 1) / 2)
        # Filled is what a measurement can check, open what only a simulation can.
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
    nominal.set_xticks(x, [f"{level} %" for level in LEVELS])
    nominal.set(xlabel="nominal coverage (%)", ylabel="measured coverage (%)")
    nominal.legend(loc="lower right")
    pit.axhline(1.0, **expected)
    pit.set(xlim=(0, 1), xlabel="PIT: predicted probability below the reading (-)")
    pit.set(ylim=(0, None), ylabel="density (expected: 1)")
    return figure
