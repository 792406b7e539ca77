"""Loop and time series to zoom and hover in the report, drawn by Bokeh in the reader's browser.

:func:`draw` returns each plot as the JSON that goes into the page; :func:`scripts` what draws it
there, Bokeh's own script and a few lines that hand it the plots. Long series are thinned to what a
screen can show: each stretch keeps its least and its largest value.
"""

from __future__ import annotations

import itertools
import json
import re
from importlib.resources import files
from typing import Any

import numpy as np
from bokeh.embed import json_item
from bokeh.layouts import gridplot, row
from bokeh.models import (
    BasicTicker,
    ColumnDataSource,
    DataRange1d,
    HoverTool,
    Model,
)
from bokeh.models.annotations import BoxAnnotation
from bokeh.models.renderers import DataRenderer
from bokeh.plotting import figure
from bokeh.resources import INLINE
from markupsafe import Markup

from bwbayes.arrays import FloatArray, IntArray
from bwbayes.prediction.bands import Bands, Kind
from bwbayes.report.figures.loop import paths, polygons
from bwbayes.report.figures.style import (
    BAND_COLORS,
    BAND_NAMES,
    EDGE_COLOR,
    LEAD_IN_COLOR,
    MEAN_COLOR,
    MEASURED_COLOR,
    starts,
    time_label,
    title,
)
from bwbayes.report.page import PagePlots, Script
from bwbayes.report.result import Result

__all__ = ["draw", "made", "scripts"]


# A loop shows one reading in each cell of a grid of so many by so many.
CELLS = 200

LEVEL = 95  # %
OF_LOOPS: tuple[Kind, ...] = ("sensor", "parameter")
HEIGHTS = {"voltage": 130, "displacement": 330, "residual": 230}  # CSS pixels
LOOP_HEIGHT, LOOP_WIDTH = 430, 240  # CSS pixels; the least width
FONT_SIZE = "13px"


def made(result: Result) -> PagePlots:
    """Return a run's plots and, if there are any, the scripts that draw them."""
    plots = draw(result) if result.outcome.converged else {}
    return PagePlots(plots, scripts() if plots else [])


def scripts() -> list[Script]:
    """Return what draws the plots: Bokeh, and the lines that hand it what is in the page."""
    script = files("bwbayes.report").joinpath("templates/plots.js").read_text(encoding="utf-8")
    core = INLINE.js_raw[0]  # without widgets, tables and mathematics
    return [Script(Markup(text)) for text in (core, script)]


def draw(result: Result) -> dict[str, Markup]:
    """Return a run's plots by the name of the figure that shows the same: JSON for the page.

    ``loop`` and ``bands_NAME`` for each of the result's bands; nothing without convergence.
    """
    plots: dict[str, Model] = {f"bands_{bands.name}": _series(bands) for bands in result.bands}
    # A step has no loop; held-out records come first.
    looped = [bands for bands in result.bands if bands.name not in result.steps]
    looped.sort(key=lambda bands: bands.training)
    if looped:
        plots["loop"] = _side_by_side([_loop(bands) for bands in looped])
    return {name: _page_json(plot, i) for i, (name, plot) in enumerate(plots.items())}


def _side_by_side(plots: list[figure]) -> Model:
    """Put plots into a row, which goes on below where it is too narrow."""
    for plot in plots:
        plot.styles = {"flex": f"1 1 {LOOP_WIDTH}px"}
    columns: Model = row(*plots, sizing_mode="stretch_width", styles={"flex-wrap": "wrap"})
    return columns


def _page_json(plot: Model, number: int) -> Markup:
    """Return a plot as JSON that may stand in HTML, and is the same whenever it is drawn.

    Bokeh numbers its models on through a process; here they are numbered through the plot.
    """
    text = json.dumps(json_item(plot))
    names: dict[str, str] = {}
    text = re.sub(
        r'"(p\d+)"', lambda old: f'"{names.setdefault(old[1], f"p{number}-{len(names)}")}"', text
    )
    for character in "<>&":
        text = text.replace(character, f"\\u{ord(character):04x}")
    return Markup(text)  # nothing in it can end the element


def _figure(height: int, ylabel: str, **options: Any) -> figure:
    plot = figure(
        height=height,
        sizing_mode="stretch_width",
        tools="box_zoom,wheel_zoom,pan,reset",
        active_drag="box_zoom",
        y_axis_label=ylabel,
        background_fill_color="white",
        border_fill_color="white",
        **options,
    )
    plot.toolbar.logo = None
    for axis in plot.axis:
        axis.ticker = BasicTicker(desired_num_ticks=5)
        axis.update(axis_label_text_font_style="normal", axis_label_text_font_size=FONT_SIZE)
        axis.update(major_label_text_font_size=FONT_SIZE)
    return plot


def _legend(plot: figure, columns: int = 2) -> None:
    """Put the legend above the plot, where a click hides what it names."""
    legend = plot.legend[0]
    legend.update(ncols=columns, click_policy="hide", border_line_color=None, padding=0)
    legend.update(label_text_font_size=FONT_SIZE, glyph_height=14, spacing=8, margin=4)
    plot.add_layout(legend, "above")


def _series(bands: Bands) -> Model:
    """Draw voltage, displacement with its bands, and readings minus mean, over one time.

    Each window by itself: an area has no gaps.
    """
    at = kept(bands)
    sources = [
        ColumnDataSource(_columns(bands, at[(at >= window.start) & (at < window.stop)]))
        for window in bands.windows
    ]
    voltage = _figure(HEIGHTS["voltage"], "voltage (V)", x_range=DataRange1d(range_padding=0.01))
    for source in sources:
        voltage.line("time", "voltage", source=source, color=MEASURED_COLOR)
    plots = [voltage]
    residual = "band − mean (µm)" if bands.measured is None else "measured − mean (µm)"
    for about, label in (("", "displacement (µm)"), ("_residual", residual)):
        height = HEIGHTS["residual" if about else "displacement"]
        plot = _figure(height, label, x_range=voltage.x_range)
        means = [_along(plot, bands, source, about) for source in sources]
        if bands.scored_from:
            until = float(bands.time[min(bands.scored_from, bands.time.size - 1)])
            lead_in: dict[str, Any] = {"left": float(bands.time[0]), "right": until}
            plot.add_layout(BoxAnnotation(**lead_in, fill_color=LEAD_IN_COLOR, fill_alpha=0.35))
        plot.add_tools(HoverTool(renderers=means, mode="vline", tooltips=_tips(bands)))
        plots.append(plot)
    _legend(plots[1])
    plots[-1].xaxis.axis_label = time_label(bands.time_offset)
    for plot in plots[:-1]:
        plot.xaxis.major_label_text_font_size = "0px"
    grid: Model = gridplot(
        [[plot] for plot in plots], sizing_mode="stretch_width", toolbar_location="above"
    )
    return grid


def _along(plot: figure, bands: Bands, source: ColumnDataSource, about: str) -> DataRenderer:
    """Draw the bands, the mean and the readings of a window; return the mean's line."""
    _ribbons(plot, source, about)
    mean = plot.line(
        "time", f"mean{about}", source=source, color=MEAN_COLOR, **_named("mean", about)
    )
    if bands.measured is not None:
        plot.scatter(
            "time",
            f"measured{about}",
            source=source,
            size=2.5,
            color=MEASURED_COLOR,
            alpha=0.6,
            **_named("measured", about),
        )
    return mean


def _named(label: str, about: str) -> dict[str, Any]:
    """Return a legend's entry; the second panel needs none."""
    return {} if about else {"legend_label": label}


def _ribbons(plot: figure, source: ColumnDataSource, about: str) -> None:
    """Draw the bands, the widest first, the sensor's with a dashed edge."""
    for kind, color in BAND_COLORS.items():
        edges = [f"{side}_{kind}{about}" for side in ("lower", "upper")]
        named = _named(BAND_NAMES[kind], about)
        plot.varea("time", *edges, source=source, color=color, **named)
    for side in ("lower", "upper"):
        plot.line(
            "time",
            f"{side}_sensor{about}",
            source=source,
            color=EDGE_COLOR,
            line_dash="dashed",
            **_named(BAND_NAMES["sensor"], about),
        )


def _tips(bands: Bands) -> str:
    """Return what hovering shows: each number of the sample below the pointer."""
    tips = {"time": "@time{0.0000} s", "voltage": "@voltage{0.00} V"}
    if bands.measured is not None:
        tips["measured"] = "@measured{0.000} µm"
    tips["mean"] = "@mean{0.000} µm"
    for kind, name in BAND_NAMES.items():
        tips[name] = f"@lower_{kind}{{0.000}} to @upper_{kind}{{0.000}} µm"
    return "".join(f"<div>{name}: <b>{text}</b></div>" for name, text in tips.items())


def kept(bands: Bands) -> IntArray:
    """Return the samples to draw of bands along time: the extremes of each stretch.

    Those of the mean, and those of the readings minus mean: no excursion is lost, and what hovering
    shows are samples as they are.
    """
    series = [bands.mean, bands.voltage]
    if bands.measured is not None:
        series.append(np.nan_to_num(bands.measured - bands.mean))
    # Each stretch has up to six samples: more in all than a screen has pixels.
    first = starts(bands.time.size, 500)
    chosen = [np.array([[window.start, window.stop - 1] for window in bands.windows]).ravel()]
    for values, order in itertools.product(series, (1, -1)):
        # Sorted by stretch and value, each stretch begins with its least.
        stretch = np.searchsorted(first, np.arange(values.size), side="right")
        chosen.append(np.lexsort((order * values, stretch))[first])
    return np.unique(np.concatenate(chosen))


def _columns(bands: Bands, at: IntArray) -> dict[str, FloatArray]:
    """Return all that is drawn along time at these samples, by name, in single precision."""
    columns = {"time": bands.time, "voltage": bands.voltage, "mean": bands.mean}
    columns["mean_residual"] = np.zeros_like(bands.mean)
    if bands.measured is not None:
        columns |= {"measured": bands.measured, "measured_residual": bands.measured - bands.mean}
    for kind in BAND_COLORS:
        for side, edge in (("lower", bands.lower), ("upper", bands.upper)):
            values = edge[kind, LEVEL]
            columns[f"{side}_{kind}"] = values
            columns[f"{side}_{kind}_residual"] = values - bands.mean
    return {name: values[at].astype(np.float32) for name, values in columns.items()}


def _loop(bands: Bands) -> figure:
    """Draw displacement against voltage, with sensor and parameter band."""
    # One in four of the points that the picture has.
    thinned = [np.union1d(path[::4], path[-1:]) for path in paths(bands)]
    plot = _figure(
        LOOP_HEIGHT,
        "displacement (µm)",
        x_axis_label="voltage (V)",
        title=title(bands).replace(" (", "\n("),  # a narrow plot cuts off what does not fit
        toolbar_location="above",
    )
    for kind in OF_LOOPS:
        corners = [polygon.astype(np.float32) for polygon in polygons(bands, thinned, kind)]
        ribbon = ColumnDataSource(
            {
                "x": [polygon[:, 0] for polygon in corners],
                "y": [polygon[:, 1] for polygon in corners],
            }
        )
        plot.patches(
            "x", "y", source=ribbon, color=BAND_COLORS[kind], legend_label=BAND_NAMES[kind]
        )
    if bands.measured is not None:
        read = _one_in_each_cell(bands.voltage, bands.measured)
        plot.scatter(
            bands.voltage[read].astype(np.float32),
            bands.measured[read].astype(np.float32),
            size=2,
            color=MEASURED_COLOR,
            alpha=0.4,
            legend_label="measured",
        )
    columns = _columns(bands, np.concatenate(thinned))
    ends = np.cumsum([path.size for path in thinned])[:-1]  # of windows, where the line ends
    source = ColumnDataSource(
        {n: np.insert(x, ends, np.nan) for n, x in columns.items() if not n.endswith("_residual")}
    )
    mean = plot.line(
        "voltage", "mean", source=source, color=MEAN_COLOR, line_width=1.5, legend_label="mean"
    )
    plot.add_tools(HoverTool(renderers=[mean], line_policy="nearest", tooltips=_tips(bands)))
    _legend(plot, 1)
    return plot


def _one_in_each_cell(x: FloatArray, y: FloatArray) -> IntArray:
    """Return one point of each cell of a grid over all points, so that what is seen stays."""
    finite = np.flatnonzero(np.isfinite(y))
    cells = [
        np.floor(CELLS * (v - v.min()) / max(float(np.ptp(v)), 1e-300)).astype(np.int64)
        for v in (x[finite], y[finite])
    ]
    return finite[np.unique(cells[0] * (CELLS + 1) + cells[1], return_index=True)[1]]
