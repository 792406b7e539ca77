"""Interactive loop and time series in the report, drawn by Bokeh in the reader's browser.

:func:`draw` returns each plot as JSON for the page; :func:`scripts` returns the scripts that draw
it there, Bokeh's own and a few lines that hand it the plots. Long series are thinned to the
resolution of a screen: each segment keeps its least and its largest value.
"""

from __future__ import annotations

import json
import re
from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping
from importlib.resources import files
from typing import Any

import numpy as np
from bokeh import __version__, models
from bokeh.document import Document
from bokeh.layouts import gridplot, row
from bokeh.models.annotations import BoxAnnotation, Legend, LegendItem
from bokeh.models.glyph import Glyph
from bokeh.models.renderers import GlyphRenderer
from bokeh.plotting import figure
from bokeh.resources import INLINE
from markupsafe import Markup

from bwbayes.arrays import FloatArray, IntArray
from bwbayes.prediction.bands import Bands
from bwbayes.report.figures import style
from bwbayes.report.figures.series import LOOP_KINDS, path, polygons
from bwbayes.report.result import Result

FONT_SIZE = "13px"


def scripts() -> list[Markup]:
    """Return the scripts for the plots: Bokeh, and the lines that hand it the page's plots."""
    script = files("bwbayes.report").joinpath("templates/plots.js").read_text(encoding="utf-8")
    core = INLINE.js_raw[0]  # without widgets, tables and mathematics
    return [Markup(text) for text in (core, script)]


def draw(result: Result) -> dict[str, Markup]:
    """Return a run's plots, JSON for the page, by the name of the figure that shows the same.

    The names are ``loop``, and ``bands_NAME`` for each of the result's bands; there are no plots
    without convergence.
    """
    plots: dict[str, models.Model] = {
        f"bands_{bands.name}": _series(bands) for bands in result.predictions
    }
    loops = [_loop(bands) for bands in sorted(result.looped, key=lambda b: b.training)]
    if loops:
        # A row that is too narrow wraps.
        plots["loop"] = row(*loops, sizing_mode="stretch_width", styles={"flex-wrap": "wrap"})
    say = result.quantities.say
    return {name: _page_json(plot, i, say) for i, (name, plot) in enumerate(plots.items())}


def _translate(node: Any, say: Callable[[str], str], key: str = "") -> Any:
    """Return the JSON of a plot with its labels in the words of the run's quantities."""
    if isinstance(node, str):
        return say(node) if key in ("axis_label", "text", "value", "tooltips") else node
    if isinstance(node, list):
        # Change a tooltip's label, not its value, which names a column of the source.
        is_pair = key == "tooltips" and len(node) == 2 and isinstance(node[0], str)
        return [say(node[0]), node[1]] if is_pair else [_translate(item, say, key) for item in node]
    if isinstance(node, dict):
        return {name: _translate(item, say, name) for name, item in node.items()}
    return node


def _page_json(plot: models.Model, number: int, say: Callable[[str], str]) -> Markup:
    """Return a plot as JSON that is safe in HTML, and the same whenever it is drawn.

    Bokeh numbers its models throughout a process; here they are numbered within the plot.
    """
    document = Document()
    document.add_root(plot)
    item = {
        "root_id": plot.id,
        "doc": _translate(document.to_json(deferred=False), say),
        "version": __version__,
    }
    text = json.dumps(item)
    names: dict[str, str] = {}
    text = re.sub(
        r'"(p\d+)"', lambda old: f'"{names.setdefault(old[1], f"p{number}-{len(names)}")}"', text
    )
    for character in "<>&":
        text = text.replace(character, f"\\u{ord(character):04x}")
    return Markup(text)  # nothing in it can end the element


def _figure(height: int, ylabel: str, **options: Any) -> figure:
    """Return an empty plot, its height in CSS pixels."""
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
        axis.ticker = models.BasicTicker(desired_num_ticks=5)
        axis.update(axis_label_text_font_style="normal", axis_label_text_font_size=FONT_SIZE)
        axis.update(major_label_text_font_size=FONT_SIZE)
    return plot


def _add_legend(
    plot: figure, drawn: Mapping[str, list[GlyphRenderer[Glyph]]], columns: int
) -> None:
    """Put a legend above the plot, in which a click on an entry hides its lines and areas."""
    legend = Legend()
    legend.update(items=[LegendItem(label=n, renderers=shown) for n, shown in drawn.items()])
    legend.update(ncols=columns, click_policy="hide", border_line_color=None, padding=0)
    legend.update(label_text_font_size=FONT_SIZE, glyph_height=14, spacing=8, margin=4)
    plot.add_layout(legend, "above")


def _series(bands: Bands) -> models.Model:
    """Draw voltage, displacement with its bands, and readings minus mean, over one time."""
    thinned = [style.choose(s, kept(s, bands.time.size)) for s in style.segments(bands)]
    sources = [models.ColumnDataSource(_columns(segment, residuals=True)) for segment in thinned]
    voltage = _figure(130, "voltage (V)", x_range=models.DataRange1d(range_padding=0.01))
    residual = "band − mean (µm)" if bands.measured is None else "measured − mean (µm)"
    displacement, below = (
        _figure(height, label, x_range=voltage.x_range)
        for height, label in ((330, "displacement (µm)"), (230, residual))
    )
    for source in sources:
        voltage.add_glyph(
            source, models.Line(x="time", y="voltage", line_color=style.Color.MEASURED)
        )
    for plot, about in ((displacement, ""), (below, "_residual")):
        drawn: defaultdict[str, list[GlyphRenderer[Glyph]]] = defaultdict(list)
        for source in sources:
            for name, glyph in _glyphs(source, about):
                drawn[name].append(plot.add_glyph(source, glyph))
        hover = models.HoverTool(renderers=[*drawn["mean"]], mode="vline", tooltips=_tips(bands))
        plot.add_tools(hover)
        if not about:
            _add_legend(plot, drawn, 2)
        if bands.scored_from:
            left, right = bands.time[[0, min(bands.scored_from, bands.time.size - 1)]].tolist()
            look: style.Look = {"fill_color": style.Color.LEAD_IN, "fill_alpha": 0.35}
            plot.add_layout(BoxAnnotation(left=left, right=right, **look))
    below.xaxis.axis_label = style.time_label(bands.time_offset)
    voltage.xaxis.major_label_text_font_size = "0px"
    displacement.xaxis.major_label_text_font_size = "0px"
    grid: models.Model = gridplot(
        [[voltage], [displacement], [below]],
        sizing_mode="stretch_width",
        toolbar_location="above",
    )
    return grid


def _glyphs(source: models.ColumnDataSource, about: str) -> Iterator[tuple[str, Glyph]]:
    """Yield names and glyphs: bands, the sensor's with an edge, mean and readings."""
    for kind, name in style.BAND_NAMES.items():
        lower, upper = f"lower_{kind}{about}", f"upper_{kind}{about}"
        yield name, models.VArea(x="time", y1=lower, y2=upper, fill_color=style.BAND_COLORS[kind])
        if kind == "sensor":
            for edge in (lower, upper):
                look: style.Look = {"line_color": style.Color.EDGE, "line_dash": "dashed"}
                yield name, models.Line(x="time", y=edge, **look)
    for edge in (f"lower_corrected{about}", f"upper_corrected{about}"):
        if edge in source.data:
            line = models.Line(x="time", y=edge, line_color=style.Color.CORRECTED)
            yield style.CORRECTED, line
    yield "mean", models.Line(x="time", y=f"mean{about}", line_color=style.Color.MEAN)
    if f"measured{about}" in source.data:
        yield "measured", _dots("time", f"measured{about}", size=3.5, alpha=0.6)


def _dots(x: str, y: str, size: float, alpha: float) -> models.Scatter:
    color = style.Color.MEASURED
    return models.Scatter(x=x, y=y, size=size, fill_color=color, fill_alpha=alpha, line_color=None)


def _tips(bands: Bands) -> str:
    """Return the tooltip: each number of the sample below the pointer."""
    tips = {"time": "@time{0.0000} s", "voltage": "@voltage{0.00} V"}
    if bands.measured is not None:
        tips["measured"] = "@measured{0.000} µm"
    tips["mean"] = "@mean{0.000} µm"
    for kind, name in style.BAND_NAMES.items():
        tips[name] = f"@lower_{kind}{{0.000}} to @upper_{kind}{{0.000}} µm"
    return "".join(f"<div>{name}: <b>{text}</b></div>" for name, text in tips.items())


def kept(bands: Bands, samples: int, count: int = 500) -> IntArray:
    """Return the samples to draw of a window: the ends, and the extremes of each segment.

    The extremes are those of voltage, mean, and readings minus mean: no excursion is lost, and
    tooltips show real samples. A record of so many ``samples`` has at most ``count`` segments, each
    with up to six samples: more in all than a screen has pixels.
    """
    size = bands.time.size
    first = style.starts(size, -(-count * size // samples))
    stretch = np.searchsorted(first, np.arange(size), side="right")
    chosen = [np.array([0, size - 1])]
    residual = bands.mean if bands.measured is None else bands.measured - bands.mean
    for values in (bands.mean, bands.voltage, np.nan_to_num(residual)):
        # Sorted by segment and value, each segment begins with its least value.
        chosen += [np.lexsort((order * values, stretch))[first] for order in (1, -1)]
    return np.unique(np.concatenate(chosen))


def _columns(bands: Bands, *, residuals: bool) -> dict[str, FloatArray]:
    """Return all series to draw by name, single precision; ``residuals`` adds them minus mean."""
    series = {"mean": bands.mean}
    if bands.measured is not None:
        series["measured"] = bands.measured
    for kind in style.BAND_COLORS:
        series[f"lower_{kind}"] = bands.lower[kind, 95]
        series[f"upper_{kind}"] = bands.upper[kind, 95]
    if bands.corrected is not None:
        series["lower_corrected"], series["upper_corrected"] = bands.corrected
    columns = {"time": bands.time, "voltage": bands.voltage} | series
    if residuals:
        columns |= {f"{name}_residual": values - bands.mean for name, values in series.items()}
    return {name: values.astype(np.float32) for name, values in columns.items()}


def _loop(bands: Bands) -> figure:
    """Draw displacement against voltage, with sensor and parameter band."""
    plot = _figure(
        430,
        "displacement (µm)",
        x_axis_label="voltage (V)",
        title=bands.title.replace(" (", "\n("),  # a narrow plot cuts off its title
        toolbar_location="above",
        styles={"flex": "1 1 240px"},
    )
    # A quarter of the points that the picture has.
    paths = [path(segment, density=75) for segment in style.segments(bands)]
    drawn: defaultdict[str, list[GlyphRenderer[Glyph]]] = defaultdict(list)
    for kind in LOOP_KINDS:
        corners = [c.astype(np.float32) for along in paths for c in polygons(along, kind)]
        source = models.ColumnDataSource(
            {"x": [c[:, 0] for c in corners], "y": [c[:, 1] for c in corners]}
        )
        color = style.BAND_COLORS[kind]
        patches = models.Patches(xs="x", ys="y", fill_color=color, line_color=color)
        drawn[style.BAND_NAMES[kind]].append(plot.add_glyph(source, patches))
    if bands.measured is not None:
        read = kept(bands, bands.time.size)
        columns = {"voltage": bands.voltage, "measured": bands.measured}
        source = models.ColumnDataSource(
            {n: x[read].astype(np.float32) for n, x in columns.items()}
        )
        dots = _dots("voltage", "measured", size=3, alpha=0.4)
        drawn["measured"].append(plot.add_glyph(source, dots))
    for along in paths:
        line = models.Line(x="voltage", y="mean", line_color=style.Color.MEAN, line_width=1.5)
        source = models.ColumnDataSource(_columns(along, residuals=False))
        drawn["mean"].append(plot.add_glyph(source, line))
    hover = models.HoverTool(
        renderers=[*drawn["mean"]], line_policy="nearest", tooltips=_tips(bands)
    )
    plot.add_tools(hover)
    _add_legend(plot, drawn, 1)
    return plot
