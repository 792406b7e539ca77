"""Pictures show what they should, with units, and touch nothing global."""

import dataclasses
import re
from collections.abc import Callable, Mapping
from concurrent.futures import Executor, Future
from concurrent.futures.process import BrokenProcessPool
from pathlib import Path
from typing import Any

import hypothesis.strategies as st
import matplotlib as mpl
import matplotlib.pyplot as plt
import numpy as np
import pytest
from bokeh.models import ColumnDataSource
from hypothesis import given
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.colors import to_rgba
from matplotlib.figure import Figure

from bwbayes.app.running.workers import FigureWorker, open_figure_worker
from bwbayes.report.figures import interactive, picture_of, pictures, plots_of, save_pictures
from bwbayes.report.figures.fit import _rank_heights, draw_trace
from bwbayes.report.figures.series import _around_largest_error, draw_bands, draw_loop
from bwbayes.report.figures.style import Color, envelope, zigzag
from bwbayes.report.result import NO_PLOTS, Result
from tests.app import example


@pytest.fixture(scope="module")
def figures() -> dict[str, Figure]:
    return example.figures(example.run())


def test_converged_run_shows_everything_in_order(figures: Mapping[str, Figure]) -> None:
    """And a chain that has not converged itself alone; no global setting is left behind."""
    chains = ["trace", "ranks"]
    assert ["loop", "bands_training", "bands_held-out", "coverage", "corner", *chains] == list(
        figures
    )
    before = dict(mpl.rcParams)
    assert chains == list(example.figures(example.run(converged=False)))
    assert [] == plt.get_fignums()
    assert before == dict(mpl.rcParams)


def visible(figure: Figure) -> list[Axes]:
    return [panel for panel in figure.axes if panel.get_visible() and panel.get_frame_on()]


def places(panel: Axes) -> tuple[int, int]:
    spec = panel.get_subplotspec()
    assert spec is not None
    return spec.rowspan.start, spec.colspan.start


def names(panel: Axes) -> list[str]:
    return [text.get_text() for text in panel.texts]


def test_outer_axes_are_named_with_their_units(figures: Mapping[str, Figure]) -> None:
    for name, figure in figures.items():
        panels = sorted(visible(figure), key=places)
        lowest = {places(panel)[1]: panel for panel in panels}
        leftmost = [p for p in panels if places(p)[1] == 0 and len(p.get_yticks())]
        assert leftmost, name
        if name != "corner":
            assert all(panel.get_xlabel() for panel in lowest.values()), name
            assert all(panel.get_ylabel() for panel in leftmost), name
        labels = {p.get_xlabel() for p in figure.axes} | {p.get_ylabel() for p in figure.axes}
        if name in ("corner", "trace", "ranks"):
            labels |= {label for panel in figure.axes for label in names(panel)}
        for label in labels - {"", "step", "$n$", "mean of the walkers, and 90% of them"}:
            assert re.search(r"\((.+)\)$", label), label
            assert "um" not in re.findall(r"\w+", label), label
    known = [r"$d$ (µm/V)", r"$\alpha$ (µm/V)", r"$\tau_\mathrm{lag}$ (s)", "$k$ (N/m)"]
    (corner,), ranks = figures["corner"].axes, figures["ranks"].axes
    assert (known[::2], known[1::2]) == tuple(map(names, ranks))
    assert set(known) == set(names(corner))
    assert 7 == len(names(corner))


def test_names_are_read_as_mathematics_only_if_they_are() -> None:
    odd = dataclasses.replace(example.PARAMETERS[0], label=r"\nonsense{", unit="$")
    exponent = dataclasses.replace(odd, name="exponent", unit="-", label="n")
    for parameter, label in ((odd, r"d (\$)"), (exponent, "$n$")):
        run = example.run(False, example.draws()[..., :1], (parameter,))
        figure = draw_trace(run)
        figure.draw_without_rendering()
        assert label == names(figure.axes[0])[0]
    figure = draw_loop([example.bands(r"$\nonsense{$")])
    figure.draw_without_rendering()
    assert r"\$\nonsense{\$ (held out)" == figure.axes[0].get_title()


@pytest.mark.parametrize("value", [1.0, np.nan, np.inf])
def test_chains_without_a_spread_can_be_drawn(value: float) -> None:
    run = example.run(False, np.full((60, 4, 10, 1), value), example.PARAMETERS[:1])
    unknown = dataclasses.replace(run.outcome.check, autocorrelation=np.full(4, np.nan))
    run = dataclasses.replace(run, outcome=dataclasses.replace(run.outcome, check=unknown))
    for figure in example.figures(run).values():
        figure.draw_without_rendering()


def test_one_parameter_and_bands_at_rest_without_a_measurement_can_be_drawn() -> None:
    """A held-out window may hold a constant voltage; a truth may lie far from the draws."""
    samples = 200
    level = np.full(samples, 1.0)
    bands = example.bands(samples=samples, lead_in=0, measured=False)
    rest = dataclasses.replace(
        bands,
        name="rest",
        voltage=0 * level,
        mean=0 * level,
        lower=dict.fromkeys(bands.lower, -level),
        upper=dict.fromkeys(bands.upper, level),
    )
    run = example.run(
        values=example.draws()[..., :1], parameters=example.PARAMETERS[:1], every=(bands, rest)
    )
    figures = example.figures(dataclasses.replace(run, truth={"d": 0.8}))
    for figure in figures.values():
        figure.draw_without_rendering()
    assert "coverage" not in figures
    assert "band − mean (µm)" == figures["bands_held-out"].axes[4].get_ylabel()
    (corner,) = figures["corner"].axes
    assert ["$d$ (µm/V)"] == names(corner)
    lines = [drawn for drawn in corner.collections if isinstance(drawn, LineCollection)]
    truth_color = [*to_rgba(Color.TRUTH)]
    (truth, *_) = [line for line in lines if np.asarray(line.get_color()).tolist() == [truth_color]]
    assert 0 < truth.get_segments()[0][0, 0] < 1


def test_zoom_is_at_the_largest_judged_error_and_makes_the_bands_tall() -> None:
    """The sensor band takes at least a tenth of the zoomed displacement."""
    bands = example.bands(samples=50_000, lead_in=300)
    assert bands.measured is not None
    bands.measured[100] += 100
    bands.measured[2000] += 50
    shown = _around_largest_error(bands)
    assert shown.start <= 2000 < shown.stop
    assert not shown.start <= 100 < shown.stop
    width = bands.upper["sensor", 95][0] - bands.lower["sensor", 95][0]
    assert 10 * width > np.ptp(bands.mean[shown])


def test_no_line_or_band_goes_from_one_window_to_the_next() -> None:
    bands = example.bands(lead_in=0).within([slice(0, 1000), slice(2000, 3000)])
    along_time = draw_bands(bands)
    for panel in along_time.axes[::2]:
        for line in panel.lines:
            x, y = np.asarray(line.get_xdata(), float), np.asarray(line.get_ydata(), float)
            assert not np.isfinite(y[(x > 1.01) & (x < 1.99)]).any()
            if line.get_linestyle() != "None" and x.size > 2:
                assert np.ptp(x) < 1.01
        for drawn in panel.collections:
            for path in drawn.get_paths():
                polygons = [np.asarray(corners) for corners in path.to_polygons()]
                assert all(np.ptp(corners[:, 0]) < 1.01 for corners in polygons)
    whole = draw_loop([bands]).axes[0]
    sizes = [np.size(line.get_xdata()) for line in whole.lines if line.get_color() == Color.MEAN]
    assert 2 == len(sizes)
    every = interactive._series(bands).references()
    times = [np.asarray(one.data["time"]) for one in every if isinstance(one, ColumnDataSource)]
    assert 2 == len(times)
    assert all(np.ptp(time) < 1 for time in times)


def test_ranks_of_independent_draws_keep_inside_the_gray_band() -> None:
    """Ninety-five percent of them, whatever the distribution."""
    ensembles, bins = 4, 20
    generator = np.random.default_rng(5)
    draws = [generator.standard_exponential((50, ensembles, 20)) for _ in range(50)]
    heights = np.stack([_rank_heights(d) for d in draws])
    reach = 1.96 * np.sqrt((bins - 1) * (ensembles - 1) / draws[0].size)
    assert 0.95 == pytest.approx(np.mean(np.abs(heights - 1) < reach), abs=0.01)
    np.testing.assert_allclose(np.ones(bins), heights[0].mean(axis=0))


@given(st.lists(st.floats(-1e6, 1e6), min_size=1, max_size=300), st.integers(1, 50))
def test_thinned_series_keep_their_extremes(values: list[float], most: int) -> None:
    y = np.asarray(values)
    time = np.arange(y.size, dtype=np.float64)
    at, low, high = envelope(time, y, y, most)
    assert at.size <= most
    segment = np.searchsorted(at, time, side="right") - 1
    assert (low[segment] <= y).all()
    assert (y <= high[segment]).all()
    assert (y.min(), y.max()) == (low.min(), high.max())
    thin_time, thin = zigzag(time, y, most)
    assert thin_time.size == thin.size <= max(2 * most, 1)
    assert (y.min(), y.max()) == (thin.min(), thin.max())


def test_plots_keep_the_extremes_and_few_samples() -> None:
    bands = example.bands(samples=60_000)
    assert bands.measured is not None
    bands.measured[12_345] += 30.0
    bands.measured[54_321] = np.nan
    at = interactive.kept(bands, bands.time.size)
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


# Pictures that another process draws are those that this one draws, whatever comes of it


class Broken(Executor):
    """Loses its processes at every call."""

    def submit(self, _: Callable[..., Any], /, *__: Any, **___: Any) -> Future[Any]:
        """Return what has failed already."""
        future: Future[Any] = Future()
        future.set_exception(BrokenProcessPool())
        return future


def short() -> Result:
    training = example.bands("training", 300, 0, training=True)
    every = training, example.bands(samples=300, lead_in=30)
    return example.run(True, example.draws()[..., :1], example.PARAMETERS[:1], every)


def test_another_process_draws_the_same_pictures_in_the_same_order(tmp_path: Path) -> None:
    run = short()
    with open_figure_worker(2) as figure_worker:
        if figure_worker.pool is None:
            pytest.skip("this machine has one core")
        figure_worker.draw(dataclasses.replace(run, predictions=(), innovations={}))
        drawn, plots = figure_worker.collect(run, tmp_path / "apart")
    here = {name: picture_of(picture.draw) for name, picture in pictures(run).items()}
    save_pictures(here, tmp_path / "here")
    assert list(here.items()) == list(drawn.items())
    assert plots_of(run).drawn == plots.drawn
    assert {path.name: path.read_bytes() for path in (tmp_path / "here").iterdir()} == {
        path.name: path.read_bytes() for path in (tmp_path / "apart").iterdir()
    }


def test_without_convergence_there_are_the_chains(tmp_path: Path) -> None:
    figure_worker, run = FigureWorker(Broken()), example.run(converged=False)
    figure_worker.draw(run)
    drawn, plots = figure_worker.collect(run, tmp_path)
    assert plots == NO_PLOTS
    assert ["trace", "ranks"] == list(drawn)
    assert {"trace.png", "ranks.png"} == {path.name for path in tmp_path.iterdir()}
