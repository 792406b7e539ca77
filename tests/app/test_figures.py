"""Pictures show what they should, with units, and touch nothing global."""

from __future__ import annotations

import dataclasses
import itertools
import re
from collections.abc import Mapping
from io import BytesIO
from pathlib import Path

import hypothesis.strategies as st
import matplotlib as mpl
import matplotlib.pyplot as plt
import numpy as np
import pytest
from bokeh.models import ColumnDataSource
from hypothesis import given, settings
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.container import ErrorbarContainer
from matplotlib.figure import Figure
from matplotlib.patches import StepPatch
from PIL import Image

from bwbayes.app.figures import draw_all, interactive, save
from bwbayes.app.figures.chain import _rank_heights, draw_corner, draw_ranks, draw_trace
from bwbayes.app.figures.coverage import draw_coverage
from bwbayes.app.figures.loop import along, draw_loop
from bwbayes.app.figures.series import _around_largest_error, draw_bands
from bwbayes.app.figures.style import MEAN_COLOUR, STYLE, envelope, zigzag
from bwbayes.inference.parameters import Parameter
from tests.app import example

# What has no unit, and says so by its nature.
PURE = {"step", "$n$"}


@pytest.fixture(scope="module")
def figures() -> dict[str, Figure]:
    return draw_all(example.run())


def test_converged_run_shows_everything_in_order(figures: Mapping[str, Figure]) -> None:
    assert [
        "loop",
        "bands_training",
        "bands_held-out",
        "coverage",
        "corner",
        "trace",
        "ranks",
    ] == list(figures)


def test_run_without_convergence_shows_only_its_chains() -> None:
    assert ["trace", "ranks"] == list(draw_all(example.run(converged=False)))


def visible(figure: Figure) -> list[Axes]:
    return [panel for panel in figure.axes if panel.get_visible() and panel.get_frame_on()]


def places(panel: Axes) -> tuple[int, int]:
    spec = panel.get_subplotspec()
    assert spec is not None
    return spec.rowspan.start, spec.colspan.start


def test_lowest_panel_of_each_column_names_its_x_axis(figures: Mapping[str, Figure]) -> None:
    for name, figure in figures.items():
        lowest = {places(p)[1]: p for p in sorted(visible(figure), key=places)}
        assert all(panel.get_xlabel() for panel in lowest.values()), name


def test_first_panel_of_each_row_names_its_y_axis(figures: Mapping[str, Figure]) -> None:
    for name, figure in figures.items():
        first = [p for p in visible(figure) if places(p)[1] == 0 and len(p.get_yticks())]
        assert first, name
        assert all(panel.get_ylabel() for panel in first), name


def test_every_label_has_its_unit(figures: Mapping[str, Figure]) -> None:
    for figure in figures.values():
        labels = {p.get_xlabel() for p in figure.axes} | {p.get_ylabel() for p in figure.axes}
        for label in labels - {""} - PURE:
            assert re.search(r"\((.+)\)$", label), label
            assert "um" not in re.findall(r"\w+", label), label


def test_rank_panels_are_titled_with_symbol_and_unit(figures: Mapping[str, Figure]) -> None:
    titles = [panel.get_title() for panel in visible(figures["ranks"])]
    assert [r"$d$ (µm/V)", r"$\alpha$ (µm/V)", r"$\tau_\mathrm{lag}$ (s)", "$k$ (N/m)"] == titles


def test_saved_files_are_the_returned_pictures(tmp_path: Path) -> None:
    folder = tmp_path / "new" / "figures"
    pictures = save({"trace": Figure((1, 1)), "bands_a/b": Figure((2, 1))}, folder)
    assert ["trace", "bands_a/b"] == list(pictures)
    for name, file in (("trace", "trace.png"), ("bands_a/b", "bands_a%2Fb.png")):
        assert pictures[name] == (folder / file).read_bytes()
        assert b"\x89PNG\r\n" == pictures[name][:6]


def test_every_figure_can_be_saved(
    figures: Mapping[str, Figure], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(STYLE, "savefig.dpi", 30)
    assert set(figures) == set(save(figures, tmp_path))


def test_no_global_figure_or_setting_is_left_behind() -> None:
    before = dict(mpl.rcParams)
    draw_all(example.run(parameters=example.PARAMETERS[:2], values=example.draws()[..., :2]))
    assert [] == plt.get_fignums()
    assert before == dict(mpl.rcParams)


def test_label_that_is_no_mathtext_becomes_the_name() -> None:
    odd = dataclasses.replace(example.PARAMETERS[0], label=r"\nonsense{", unit="$")
    figure = draw_trace(example.run(parameters=(odd, *example.PARAMETERS[1:])))
    figure.draw_without_rendering()
    assert r"d (\$)" == figure.axes[0].get_ylabel()


def test_band_names_are_not_read_as_mathematics() -> None:
    figure = draw_loop([example.bands(r"$\nonsense{$")])
    figure.draw_without_rendering()
    assert r"\$\nonsense{\$ (held out)" == figure.axes[0].get_title()


@pytest.mark.parametrize("value", [1.0, np.nan, np.inf])
def test_chains_without_a_spread_can_be_drawn(value: float) -> None:
    run = example.run(False, np.full((60, 4, 10, 1), value), example.PARAMETERS[:1])
    unknown = dataclasses.replace(run.outcome.check, autocorrelation=np.full(4, np.nan))
    run = dataclasses.replace(run, outcome=dataclasses.replace(run.outcome, check=unknown))
    figures = draw_all(run)
    assert ["trace", "ranks"] == list(figures)
    for figure in figures.values():
        figure.draw_without_rendering()


def test_one_free_parameter_can_be_drawn() -> None:
    run = example.run(parameters=example.PARAMETERS[:1], values=example.draws()[..., :1])
    for draw in (draw_corner, draw_trace, draw_ranks):
        draw(run).draw_without_rendering()
    assert "$d$ (µm/V)" == draw_corner(run).axes[0].get_xlabel()


def test_bands_without_a_measurement_can_be_drawn() -> None:
    figure = draw_bands(example.bands(measured=False))
    figure.draw_without_rendering()
    assert "band − mean (µm)" == figure.axes[4].get_ylabel()


@pytest.mark.parametrize("wider", [1.0, 30.0])
def test_frame_of_the_tip_lies_within_the_loop(wider: float) -> None:
    """However wide the bands are."""
    bands = example.bands()
    middle = {key: (bands.lower[key] + bands.upper[key]) / 2 for key in bands.lower}
    bands = dataclasses.replace(
        bands,
        lower={key: middle[key] + wider * (bands.lower[key] - middle[key]) for key in middle},
        upper={key: middle[key] + wider * (bands.upper[key] - middle[key]) for key in middle},
    )
    figure = draw_loop([bands])
    figure.draw_without_rendering()
    whole, tip = visible(figure)
    assert np.ptp(tip.get_ylim()) <= 0.55 * np.ptp(whole.get_ylim())
    assert np.ptp(tip.get_xlim()) <= 0.55 * np.ptp(whole.get_xlim())


def test_loop_without_a_measurement_can_be_drawn() -> None:
    draw_loop([example.bands(measured=False)]).draw_without_rendering()


def test_coverage_needs_a_measurement() -> None:
    run = example.run(
        parameters=example.PARAMETERS[:1],
        values=example.draws()[..., :1],
        every=(example.bands(measured=False),),
    )
    assert "coverage" not in draw_all(run)


def test_bands_at_rest_can_be_drawn() -> None:
    """A held-out window may hold a constant voltage."""
    moving = example.bands(samples=200, lead_in=0)
    still = {key: np.full(200, -1.0) for key in moving.lower}
    rest = dataclasses.replace(
        moving,
        voltage=np.zeros(200),
        mean=np.zeros(200),
        lower=still,
        upper={key: -edge for key, edge in still.items()},
    )
    draw_bands(rest).draw_without_rendering()
    draw_loop([rest]).draw_without_rendering()


def test_lead_in_is_marked_where_there_is_one(figures: Mapping[str, Figure]) -> None:
    def named(name: str) -> list[str]:
        return figures[name].axes[4].get_legend_handles_labels()[1]

    assert "lead-in, not judged" in named("bands_held-out")
    assert "lead-in, not judged" not in named("bands_training")


def test_zoom_is_at_the_largest_judged_error() -> None:
    bands = example.bands(lead_in=300)
    assert bands.measured is not None
    bands.measured[100] += 100
    bands.measured[2000] += 50
    shown = _around_largest_error(bands)
    assert shown.start <= 2000 < shown.stop
    assert not shown.start <= 100 < shown.stop


def test_zoom_makes_the_bands_tall() -> None:
    """The sensor band takes at least a tenth of the zoomed displacement."""
    bands = example.bands(samples=50_000)
    shown = _around_largest_error(bands)
    width = bands.upper["sensor", 95][0] - bands.lower["sensor", 95][0]
    assert 10 * width > np.ptp(bands.mean[shown])


def test_three_kinds_of_bands_are_drawn_with_the_widest_first(
    figures: Mapping[str, Figure],
) -> None:
    labels = figures["bands_held-out"].axes[4].get_legend_handles_labels()[1]
    kinds = ["95 % sensor reading", "95 % displacement", "95 % parameters alone"]
    assert kinds == [label for label in labels if label.startswith("95 %")]


def test_coverage_is_drawn_in_percent_with_its_error(figures: Mapping[str, Figure]) -> None:
    """In the order of the legend: sensor, then displacement, of each of the bands."""
    panel = figures["coverage"].axes[0]
    lines = [c.lines for c in panel.containers if isinstance(c, ErrorbarContainer)]
    drawn = [np.asarray(points.get_ydata(), dtype=np.float64) for points, _, _ in lines]
    whiskers = [np.asarray(bars[0].get_segments()) for _, _, bars in lines]
    sensor, displacement = [48.1, 89.2, 94.3], [51.4, 91.5, 96.6]
    np.testing.assert_allclose(np.array([sensor, displacement] * 2), np.stack(drawn))
    np.testing.assert_allclose(np.array([44.0, 52.2]), whiskers[0][0, :, 1])


def test_no_line_or_band_goes_from_one_window_to_the_next() -> None:
    """Between 1 and 2 s nothing is drawn; nor is there a path of the loop."""
    bands = example.bands(lead_in=0).within([slice(0, 1000), slice(2000, 3000)])
    along_time = draw_bands(bands)
    for panel in along_time.axes[::2]:
        for line in panel.lines:
            x, y = np.asarray(line.get_xdata(), float), np.asarray(line.get_ydata(), float)
            if x.size > 2:
                assert np.diff(x[np.isfinite(y)]).max() > 0.9
                assert not np.isfinite(y[(x > 1.01) & (x < 1.99)]).any()
        for drawn in panel.collections:
            for path in drawn.get_paths():
                polygons = [np.asarray(corners) for corners in path.to_polygons()]
                assert all(np.ptp(corners[:, 0]) < 1.01 for corners in polygons)
    whole = draw_loop([bands]).axes[0]
    sizes = [np.size(line.get_xdata()) for line in whole.lines if line.get_color() == MEAN_COLOUR]
    assert 2 == len(sizes)
    every = interactive._series(bands).references()
    times = [np.asarray(one.data["time"]) for one in every if isinstance(one, ColumnDataSource)]
    assert 2 == len(times)
    assert all(np.ptp(time) < 1 for time in times)


def test_file_time_stands_beside_the_time_axis() -> None:
    """The time stamp of time zero, whole; the axis counts from there."""
    stamped = dataclasses.replace(example.bands(), time_offset=1.7e9)
    assert "time after 1700000000 s (s)" == draw_bands(stamped).axes[4].get_xlabel()
    assert (
        "time after 1700000000 s (s)"
        in interactive.draw(example.run(every=(stamped,)))["bands_held-out"]
    )


def test_pit_leaves_out_the_lead_in() -> None:
    bands = example.bands(lead_in=300)
    assert bands.pit is not None
    bands.pit[:300] = 0.5
    bands.pit[300:] = 0.01
    drawn = draw_coverage([bands], {bands.name: example.scores()}).axes[1].patches[0]
    assert isinstance(drawn, StepPatch)
    assert [20.0] + [0.0] * 19 == pytest.approx(list(drawn.get_data()[0]))


def test_corner_marks_the_known_truth_alone(figures: Mapping[str, Figure]) -> None:
    panels = {places(panel): panel for panel in figures["corner"].axes}

    def upright(panel: Axes) -> list[float]:
        lines = [np.asarray(line.get_xdata()) for line in panel.lines]
        return [float(x[0]) for x in lines if x.size == 2 and x[0] == x[1]]

    assert [0.7] == upright(panels[0, 0])
    assert [] == upright(panels[1, 1])
    assert [2e-3] == upright(panels[3, 2])


def test_corner_shows_a_truth_far_from_the_draws() -> None:
    run = example.run(parameters=example.PARAMETERS[:1], values=example.draws()[..., :1])
    run = dataclasses.replace(run, truth={"d": 0.8})
    low, high = draw_corner(run).axes[0].get_xlim()
    assert low < 0.8 < high


def test_ranks_of_independent_draws_keep_inside_the_grey_band() -> None:
    """Ninety-five percent of them, whatever the distribution."""
    ensembles, bins = 4, 20
    generator = np.random.default_rng(5)
    draws = [generator.standard_exponential((50, ensembles, 20)) for _ in range(50)]
    heights = np.stack([_rank_heights(d) for d in draws])
    reach = 1.96 * np.sqrt((bins - 1) * (ensembles - 1) / draws[0].size)
    assert 0.95 == pytest.approx(np.mean(np.abs(heights - 1) < reach), abs=0.01)
    np.testing.assert_allclose(np.ones(bins), heights[0].mean(axis=0))


def test_ranks_show_an_ensemble_that_stays_apart() -> None:
    draws = example.draws()[..., 0]
    draws[:, 2] += 1.0
    heights = _rank_heights(draws)
    assert pytest.approx(4.0) == heights[2, -1]
    assert 0 == heights[2, 0]


@settings(deadline=None)
@given(
    st.lists(st.floats(-1e6, 1e6), min_size=1, max_size=300),
    st.integers(1, 50),
)
def test_thinned_series_keep_their_extremes(values: list[float], most: int) -> None:
    y = np.asarray(values)
    time = np.arange(y.size, dtype=np.float64)
    at, low, high = envelope(time, y, y, most)
    assert at.size <= most
    assert (y.min(), y.max()) == (low.min(), high.max())
    thin_time, thin = zigzag(time, y, most)
    assert thin_time.size == thin.size <= max(2 * most, 1)
    assert (y.min(), y.max()) == (thin.min(), thin.max())


def test_thinned_band_holds_the_band_everywhere() -> None:
    time = np.arange(997.0)
    lower = np.sin(time)
    upper = lower + 1
    at, low, high = envelope(time, lower, upper, 40)
    stretch = np.searchsorted(at, time, side="right") - 1
    assert (low[stretch] <= lower).all()
    assert (upper <= high[stretch]).all()


def test_loop_keeps_the_samples_of_a_fast_signal_and_few_of_a_slow_one() -> None:
    time = np.arange(20_000) / 1000
    fast, slow = (np.sin(2 * np.pi * f * time) for f in (97.3, 0.05))
    assert 19_900 < along(fast, fast).size
    assert 1_200 > along(slow, slow).size > 600


def test_loop_is_drawn_to_its_last_sample() -> None:
    voltage = np.linspace(0, 1, 777)
    kept = along(voltage, voltage)
    assert (0, 776) == (kept[0], kept[-1])


def test_dimensionless_parameter_has_no_empty_brackets() -> None:
    free = Parameter("exponent", "-", "n", "s", example.PARAMETERS[0].prior)
    run = example.run(converged=False, parameters=(free,), values=example.draws()[..., :1])
    assert "$n$" == draw_trace(run).axes[0].get_ylabel()


def test_tick_labels_of_the_corner_picture_do_not_collide() -> None:
    """Along the bottom row and the left column, whose panels touch each other."""
    figure = draw_corner(example.run())
    renderer = FigureCanvasAgg(figure).get_renderer()  # type: ignore[no-untyped-call]
    panels = {places(panel): panel for panel in figure.axes}
    free = 4
    lowest, first = (
        [panels[at] for at in panels if free - 1 == at[0]],
        [panels[at] for at in panels if 0 == at[1]],
    )
    for axes, along_x in ((lowest, True), (first, False)):
        labels = [
            label.get_window_extent(renderer)
            for panel in axes
            for label in (panel.get_xticklabels() if along_x else panel.get_yticklabels())
            if label.get_text() and label.get_visible()
        ]
        assert len(labels) >= free - 1
        for one, two in itertools.combinations(labels, 2):
            assert not one.overlaps(two)


def test_plots_keep_the_extremes_and_few_samples() -> None:
    """Of voltage, mean and residual, wherever they are; and the ends."""
    bands = example.bands(samples=60_000)
    assert bands.measured is not None
    bands.measured[12_345] += 30.0
    bands.measured[54_321] = np.nan
    at = interactive.kept(bands)
    assert at.size < 5_000
    assert {0, 12_345, 59_999} <= set(at)
    for values in (bands.voltage, bands.mean, bands.measured - bands.mean):
        assert (np.nanmin(values), np.nanmax(values)) == (
            np.nanmin(values[at]),
            np.nanmax(values[at]),
        )


def test_plots_are_the_same_whenever_they_are_drawn_and_end_no_element() -> None:
    odd = dataclasses.replace(example.bands(), name="</script><b>")
    run = example.run(every=(odd,))
    plots = interactive.draw(run)
    assert plots == interactive.draw(run)
    assert ["bands_</script><b>", "loop"] == list(plots)
    assert not any("<" in text for text in plots.values())
    assert {} == interactive.draw(example.run(converged=False))


def test_pictures_have_few_colours_and_look_the_same(tmp_path: Path) -> None:
    """Half the size, all but one pixel in a thousand within 12 of 255, and white is white."""
    figure = draw_loop(example.run().bands)
    small = save({"loop": figure}, tmp_path)["loop"]
    figure.set_layout_engine("none")  # it stays where it is
    canvas = FigureCanvasAgg(figure)
    plain = BytesIO()
    with mpl.rc_context(STYLE):
        canvas.print_png(plain)  # type: ignore[no-untyped-call]
    drawn, shown = (
        np.asarray(Image.open(BytesIO(png)).convert("RGB")).astype(int)
        for png in (plain.getvalue(), small)
    )
    assert 2 * len(small) < len(plain.getvalue())
    assert 0.999 < np.mean(np.abs(drawn - shown).max(axis=-1) <= 12)
    assert [255] * 3 == list(shown[0, 0])
