"""Report and pictures say what the summary says, with units, and need nothing but themselves."""

import dataclasses
import re
from base64 import b64encode
from collections.abc import Callable, Mapping
from concurrent.futures import Executor, Future
from concurrent.futures.process import BrokenProcessPool
from hashlib import sha256
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
from bwbayes.diagnosis.finding import Finding
from bwbayes.diagnosis.validation import BandValidation
from bwbayes.inference.parameters import Parameter
from bwbayes.model.declaration import Distribution
from bwbayes.report.figures import interactive, picture_of, pictures, plots_of, save_pictures
from bwbayes.report.figures.fit import _rank_heights, draw_trace
from bwbayes.report.figures.series import _around_largest_error, draw_bands, draw_loop
from bwbayes.report.figures.style import Color, envelope, zigzag
from bwbayes.report.report import as_text, digits, symbol
from bwbayes.report.result import NO_PLOTS, Result, summary
from bwbayes.report.run import run_report
from tests.app import example

PICTURES = {
    name: f"\x89PNG {name}".encode("latin-1")
    for name in ("loop", "bands_training", "bands_held-out", "coverage", "corner", "trace", "ranks")
}


def page(run: Result) -> str:
    return example.page(run, pictures=PICTURES)


def rows(text: str, table: str) -> dict[str, list[str]]:
    """Return a table's cells by their row's first cell, without tags."""
    body = re.findall(rf'<table id="{table}"[^>]*>.*?<tbody>(.*?)</tbody>', text, re.DOTALL)[0]
    seen = {}
    for row in re.findall(r"<tr.*?</tr>", body, re.DOTALL):
        cells = re.findall(r"<t[hd].*?>(.*?)</t[hd]>", row, re.DOTALL)
        first, *rest = (re.sub(r"<.*?>", "", cell) for cell in cells)
        seen[first] = rest
    return seen


def words(parameter: Parameter) -> str:
    return f"{parameter.description}, {symbol(parameter).striptags()}"


def test_numbers_of_the_parameters_are_the_summarys() -> None:
    """Estimates to a twentieth of the standard deviation, which is two digits of it."""
    run = example.run()
    numbers: Any = summary(run)["parameters"]
    table, of_sampling = (rows(page(run), name) for name in ("parameters", "sampling"))
    for parameter in run.free:
        expected = numbers[parameter.name]
        mean_and_sd, interval, unit, _ = table[words(parameter)]
        bulk, tail, rhat, mcse, median, _ = of_sampling[words(parameter)]
        shown = [
            float(text) for text in (*mean_and_sd.split(" ± "), median, *interval.split(" to "))
        ]
        estimates = [expected[key] for key in ("mean", "sd", "median", "lower_95", "upper_95")]
        assert estimates == pytest.approx(shown, abs=0.0503 * expected["sd"], rel=0)
        assert [round(expected["ess_bulk"]), round(expected["ess_tail"])] == [int(bulk), int(tail)]
        assert expected["rhat"] == pytest.approx(float(rhat), abs=5e-5)
        assert expected["mcse_mean"] == pytest.approx(float(mcse), rel=0.05)
        assert parameter.unit.replace("um", "µm") == unit


def test_scores_are_shown_for_each_of_the_bands() -> None:
    run = example.run()
    run = dataclasses.replace(
        run,
        predictions=(
            run.predictions[0],
            *example.scored(run.predictions[1:], example.scores(truth=False)),
        ),
    )
    text = page(run)
    coverage = "48.1 ± 4.1, 89.2 ± 2.2, 94.3 ± 1.3%"
    expected = ["–", "1.23%", "5.52 µm", "6.13 µm", coverage]
    assert {"held-out (held out)": expected, "training": expected} == rows(text, "validation")
    table = rows(text, "scores")
    assert ["0.817 µm"] * 2 == table["CRPS"]
    assert ["–", "91.5 ± 2.5%"] == table["90% displacement band covers displacement"]
    assert ["12.1%"] * 2 == table["50% sensor band: worst second"]
    assert ["6.13 µm"] * 2 == table["95% sensor band: mean width"]
    assert ["8.22 µm"] * 2 == table["90% sensor band: interval score"]


def test_bands_that_do_not_hold_come_before_the_answer_with_the_fix() -> None:
    cause = Finding("noise", "the noise is not like that", "try another noise")
    failed = BandValidation("held-out (held out)", False, False, ("covers 60%",), cause)
    held = BandValidation("training", True, True)
    run = dataclasses.replace(example.run(), validation={"training": held, "held-out": failed})
    text = page(run)
    places = [text.index(said) for said in ("VALIDATION FAILED", "try another noise", "94.3 ± 1.3")]
    assert sorted(places) == places
    assert "Converged, and" not in text
    statuses = {row: cells[0] for row, cells in rows(text, "validation").items()}
    assert {"held-out (held out)": "failed", "training": "passed"} == statuses
    for kind, status in (("bad", "failed"), ("good", "passed")):
        assert f'<span class="mark {kind}">{status}</span>' in text


@pytest.mark.parametrize("held_out", [True, False])
def test_a_run_that_holds_nothing_out_says_so_on_page_and_screen(held_out: bool) -> None:
    validation = {"training": BandValidation("training", True, True)}
    if held_out:
        validation["held-out"] = BandValidation("held-out (held out)", False, True)
    run = dataclasses.replace(example.run(), validation=validation)
    for text in (page(run), as_text(run_report(run, {}), 400)):
        assert held_out == ("no readings are held out: the bands are validated on" not in text)
        assert held_out == ("under [validation.held_out]" not in text)


@pytest.mark.parametrize("value", [1.0, np.nan])
def test_chains_without_a_spread_can_be_reported(value: float) -> None:
    run = example.run(converged=False, values=np.full((60, 4, 10, 4), value))
    unknown = dataclasses.replace(run.outcome.check, rhat=np.full(4, np.nan))
    run = dataclasses.replace(run, outcome=dataclasses.replace(run.outcome, check=unknown))
    assert "nan" == rows(page(run), "sampling")["stiff, k"][2]


@pytest.mark.parametrize("converged", [True, False])
def test_page_needs_nothing_from_elsewhere(converged: bool) -> None:
    """Nor does it run any script but its own, which is there only if there are plots."""
    text = page(example.run(converged=converged))
    assert text.startswith("<!DOCTYPE html>")
    own = [str(script) for script in interactive.scripts()] if converged else []
    assert own == re.findall(r"<script>(.*?)</script>", text, re.DOTALL)
    digests = re.findall(r"'sha256-(.*?)'", text[: text.index("<title>")])
    assert [b64encode(sha256(script.encode()).digest()).decode() for script in own] == digests
    text = re.sub(r"<script( type=.application/json.)?>.*?</script>", "", text, flags=re.DOTALL)
    for outside in ("http:", "https:", "//", "<script", "<link", "@import", "url(", "srcset"):
        assert outside not in text.replace("base64,//", "")
    assert all(s.startswith("data:") for s in re.findall(r'src="(.*?)"', text))
    assert all(s.startswith(("#", "data:text/csv")) for s in re.findall(r'href="(.*?)"', text))


@pytest.mark.parametrize(
    ("label", "expected"),
    [
        ("d", "<i>d</i>"),
        (r"\alpha", "<i>α</i>"),
        ("h_0", "<i>h</i><sub>0</sub>"),
        (r"\tau_\mathrm{lag}", "<i>τ</i><sub>lag</sub>"),
        (r"k_{12}", "<i>k</i><sub>12</sub>"),
        (r"\frac{a}{b}", "<i>some_name</i>"),
        ("", "<i>some_name</i>"),
    ],
)
def test_labels_become_readable_symbols(label: str, expected: str) -> None:
    parameter = dataclasses.replace(example.PARAMETERS[0], name="some_name", label=label)
    assert expected == symbol(parameter)


@pytest.mark.parametrize(
    ("value", "sd", "expected"),
    [
        (0.69712, 0.0061234, "0.6971"),
        (410123.0, 1234.0, "410100"),
        (1.0, 0.5, "1.00"),
        (-0.0004, 0.12, "0.00"),
        (1.23456e-9, 1.2e-11, "1.235e-09"),
        (0.0, 1e-12, "0e+00"),
        (1.5, 0.0, "1.5"),
        (np.nan, 1.0, "nan"),
    ],
)
def test_digits_follow_the_standard_deviation(value: float, sd: float, expected: str) -> None:
    assert expected == digits(value, sd)


@given(st.floats(-1e6, 1e6), st.floats(1e-15, 1e9))
def test_rounding_costs_at_most_a_twentieth_of_a_standard_deviation(
    value: float, sd: float
) -> None:
    assert abs(float(digits(value, sd)) - value) <= 0.0503 * sd + 1e-15 * abs(value)


def test_a_stored_summary_and_the_truth_are_shown() -> None:
    run = example.run()
    stored: Any = summary(run)
    stored["parameters"]["d"] |= {"mean": 0.12345, "sd": 0.001}
    text = example.page(run, stored)
    table = rows(text, "parameters")
    assert table["coefficient, d"][0].startswith("0.1235 ± 0.0010")
    assert ("0.7", "–") == (table["coefficient, d"][3], table["part, α"][3])
    assert "<i>τ</i><sub>lag</sub>" in text
    assert "Truth" not in page(dataclasses.replace(run, truth={}))


def test_priors_are_listed_with_what_the_constraints_leave_of_them() -> None:
    """The bound d takes the upper part of a prior of alpha that reaches beyond it."""
    bounded = dataclasses.replace(example.PARAMETERS[0], lower=0.1, upper=2.0)
    close = dataclasses.replace(
        example.PARAMETERS[1], prior=Distribution("normal", {"mean": 0.7, "sd": 0.1})
    )
    text = page(example.run(parameters=(bounded, close, *example.PARAMETERS[2:])))
    table = rows(text, "priors")
    assert len(example.PARAMETERS) == len(table)
    assert "normal(mean = 0.7, sd = 0.1), at least 0.1, at most 2" == table["coefficient, d"][0]
    assert ["fixed at 1", ""] == table["smoothness, n"][:2]
    median, upper = (float(text) for text in re.findall(r"[\d.]+", table["part, α"][1])[::2])
    assert 0.62 < median < 0.67
    assert upper < 0.83
    assert '<span id="constraints">0 &lt; alpha &lt; d</span>' in text
    without = example.run(parameters=example.PARAMETERS[:1], values=example.draws()[..., :1])
    assert 'id="constraints"' not in page(without)


def test_what_is_not_known_has_no_row() -> None:
    run = example.run()
    unknown = example.scored(run.predictions, example.scores(truth=False))
    table = rows(page(dataclasses.replace(run, predictions=unknown)), "scores")
    assert 10 == len(table)
    assert not any("displacement" in row or {"–"} >= set(cells) for row, cells in table.items())
    without = dataclasses.replace(run.outcome.check, pareto_k=None)
    text = example.page(
        dataclasses.replace(
            example.run(every=(example.bands(measured=False),)),
            outcome=dataclasses.replace(run.outcome, check=without),
        )
    )
    assert "No mixture proposed these draws" in text
    assert "Pareto k of" not in text
    assert 'id="validation"' not in text
    assert "There are no readings to check the bands against." in text


def test_verdict_says_why_and_what_to_do() -> None:
    text = page(example.run())
    assert "<strong>Converged" in text
    assert "NOT CONVERGED" not in text
    assert "two good checks" in text
    run = example.run(converged=False)
    resuming = {"go_on": "bwbayes resume results/a --steps 40000"}
    text = example.page(run, summary(run) | resuming, PICTURES)
    assert "<strong>NOT CONVERGED</strong>" in text
    assert "step limit 120 reached: R-hat 1.2" in text
    assert "<code>bwbayes resume results/a --steps 40000</code>" in text
    assert {"#trace", "#ranks"} <= set(re.findall(r'href="(.*?)"', text))


def test_page_without_convergence_speaks_of_the_chains_alone() -> None:
    """Which parameter lags; nothing of the others, even if their pictures are handed in."""
    text = page(example.run(converged=False))
    assert ["2103", "2203", "1.0040"] == rows(text, "sampling")["stiff, k"]
    assert ["trace", "ranks"] == re.findall(r'<figure id="(.*?)">', text)
    text = re.sub(r'src="data:[^"]*"', "", text).lower()
    for word in ("95", "band", "median</th>", "coverage", "validation", "mcse", "truth"):
        assert word not in text


# Pictures show what they should, with units, and touch nothing global


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
