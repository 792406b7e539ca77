"""The pages in a real browser: whole, readable, alone, to zoom and to hover.

Chromium opens each page as a reader does, on a telephone and on a screen, light and dark.
"""

from collections.abc import Iterator
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from matplotlib.figure import Figure

from bwbayes.app.jobs.campaign import STATUSES, Campaign, Row
from bwbayes.app.jobs.check import check
from bwbayes.app.running.folder import CampaignFolder
from bwbayes.comparison.design import Design, DesignScore
from bwbayes.diagnosis.validation import ValidationSummary
from bwbayes.model.inputs import Limits
from bwbayes.report.result import render
from tests.app import example, small
from tests.programs import needs

playwright = pytest.importorskip("playwright.sync_api", reason="playwright is not installed")

PAGES = ("run", "unconverged", "check", "design", "campaign")
FIGURES = ("loop", "bands_training", "bands_held-out", "coverage", "corner", "trace", "ranks")

# WCAG 2.2, level AA, for text of ordinary size.
LEAST_CONTRAST = 4.5

TIME_RANGES = """() => Bokeh.documents
  .map(d => Array.from(d._all_models.values()))
  .map(models => models.find(m => m.type === "Figure" && m.x_range && m.below
    .some(a => a.axis_label === "time (s)")))
  .filter(plot => plot !== undefined)
  .map(plot => plot.x_range.end - plot.x_range.start)"""

# The least contrast of any text with what is behind it, and that text.
CONTRAST = """() => {
  const parts = text => text.match(/[\\d.]+/g).map(Number);
  const light = ([r, g, b]) => {
    const [x, y, z] = [r, g, b].map(c => c / 255)
      .map(c => c <= 0.04045 ? c / 12.92 : ((c + 0.055) / 1.055) ** 2.4);
    return 0.2126 * x + 0.7152 * y + 0.0722 * z;
  };
  const behind = element => {
    for (let at = element; at; at = at.parentElement) {
      const color = parts(getComputedStyle(at).backgroundColor);
      if (color.length === 3 || color[3] === 1) return color;
    }
    return [255, 255, 255];
  };
  let least = [Infinity, ""];
  for (const element of document.querySelectorAll("body *")) {
    if (element.closest(".plot, script, style")) continue;
    const own = [...element.childNodes].filter(n => n.nodeType === 3).map(n => n.textContent);
    if (!own.join("").trim()) continue;
    const [a, b] = [parts(getComputedStyle(element).color), behind(element)].map(light);
    const ratio = (Math.max(a, b) + 0.05) / (Math.min(a, b) + 0.05);
    if (ratio < least[0]) least = [ratio, element.tagName + " " + own.join("").trim()];
  }
  return least;
}"""


def png() -> bytes:
    figure = Figure(figsize=(11, 5))
    figure.subplots().plot([0, 1])
    buffer = BytesIO()
    figure.savefig(buffer, dpi=150)
    return buffer.getvalue()


@pytest.fixture(scope="module")
def pages(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    folder = tmp_path_factory.mktemp("pages")
    picture = png()
    paths = {name: folder / f"{name}.html" for name in PAGES}
    for name in ("run", "unconverged"):
        run = example.run(converged=name == "run")
        page = example.page(run, pictures=dict.fromkeys(FIGURES, picture))
        paths[name].write_text(page, encoding="utf-8")
    with pytest.MonkeyPatch.context() as patch:
        small.without_explanations(patch)
        check(small.config(), folder, folder)
    wave = 100 * np.sin(np.arange(300) / 10)
    promises = [DesignScore("sine", 0.6, 0.01), DesignScore("far", np.nan, np.nan, "goes too far")]
    signals = {"sine": wave, "far": 9 * wave}
    limits = Limits(-100, 100)
    design = Design("a run", "beta", None, limits, signals, 0.01, ValidationSummary(), promises)
    reports = {"design": design.report(), "campaign": campaign().report()}
    drawn = dict.fromkeys(("promises", "best", "parameters"), picture)
    for name, report in reports.items():
        paths[name].write_text(render(report, drawn), encoding="utf-8")
    return paths


def campaign() -> Campaign:
    """Make up a campaign with a record for each way to end, and a dozen parameters."""
    known = {"unit": "um/V", "mean": 0.7, "sd": 0.01, "lower_95": 0.68, "upper_95": 0.72}
    numbers = {"parameters": {f"parameter_{number}": known for number in range(12)}}
    rows = [Row(status, "a.csv", status, "why", numbers) for status in STATUSES]
    return Campaign(CampaignFolder(Path("batch")), tuple(rows), "too few records")


@pytest.fixture(scope="module")
def chromium() -> Iterator[Any]:
    path = needs("chromium")
    with playwright.sync_playwright() as driver:
        browser = driver.chromium.launch(executable_path=path, args=["--no-sandbox"])
        yield browser
        browser.close()


class Opened:
    """A page that was opened, and what went wrong with it and beyond it."""

    def __init__(self, browser: Any, path: Path, width: int = 1400, **options: Any) -> None:
        self.page = browser.new_page(viewport={"width": width, "height": 900}, **options)
        self.wrong: list[str] = []
        self.requests: list[str] = []
        self.page.on("console", self._hear)
        self.page.on("pageerror", lambda error: self.wrong.append(str(error)))
        self.page.on("request", lambda request: self.requests.append(request.url))
        self.page.goto(path.as_uri())
        if options.get("java_script_enabled", True) and "Bokeh" in path.read_text("utf-8"):
            self.page.wait_for_function("Bokeh.documents.every(d => d.is_idle)")

    def _hear(self, message: Any) -> None:
        if message.type in ("error", "warning"):
            self.wrong.append(message.text)

    def __enter__(self) -> Any:
        return self

    def __exit__(self, *_: object) -> None:
        self.page.close()


def assert_can_be_read_aloud(page: Any) -> None:
    """Find language, landmarks, one heading at the top, words for pictures, headers for tables."""
    assert [1, 1, 1] == [page.locator(one).count() for one in ("html[lang=en]", "main", "h1")]
    for missing in (
        "img:not([alt]), img[alt='']",
        "th:not([scope])",
        "table:not([aria-label]):not([aria-labelledby])",
        "table:not(:has(th[scope=row]))",
    ):
        assert 0 == page.locator(missing).count(), missing


@pytest.mark.parametrize(
    ("width", "scheme"),
    [
        (400, "dark"),
        pytest.param(400, "light", marks=pytest.mark.slow),
        pytest.param(1400, "dark", marks=pytest.mark.slow),
        pytest.param(1400, "light", marks=pytest.mark.slow),
    ],
)
@pytest.mark.parametrize("name", PAGES)
def test_a_page_is_whole_alone_and_readable(
    chromium: Any, pages: dict[str, Path], name: str, width: int, scheme: str
) -> None:
    """No error, no missing picture, no request, no sideways scrolling, enough contrast."""
    with Opened(chromium, pages[name], width, color_scheme=scheme) as opened:
        page = opened.page
        page.evaluate("document.querySelectorAll('details').forEach(d => d.open = true)")
        sizes = page.evaluate("[...document.images].map(i => i.naturalWidth)")
        assert sizes
        assert all(sizes)
        assert width >= page.evaluate("document.documentElement.scrollWidth")
        ratio, text = page.evaluate(CONTRAST)
        assert ratio >= LEAST_CONTRAST, text
        dark = page.evaluate("getComputedStyle(document.body).backgroundColor")
        assert (scheme == "light") == (dark == "rgb(255, 255, 255)")
        outside = [u for u in opened.requests if not u.startswith(("data:", pages[name].as_uri()))]
        assert ([], []) == (opened.wrong, outside)
        assert_can_be_read_aloud(page)


def test_low_contrast_would_be_noticed(chromium: Any, pages: dict[str, Path]) -> None:
    with Opened(chromium, pages["run"]) as opened:
        opened.page.add_style_tag(content=":root { --quiet: #8a8a8a; }")
        assert opened.page.evaluate(CONTRAST)[0] < LEAST_CONTRAST


def test_intervals_are_seen_on_a_telephone(chromium: Any, pages: dict[str, Path]) -> None:
    """Every one lies on the page, behind the title of its column."""
    with Opened(chromium, pages["run"], 400) as opened:
        intervals = opened.page.locator("#parameters td[data-title='95% interval']")
        boxes = [one.bounding_box() for one in intervals.all()]
        assert 4 == len(boxes)
        assert all(0 <= box["x"] and box["x"] + box["width"] <= 400 for box in boxes)
        title = intervals.first.evaluate("e => getComputedStyle(e, '::before').content")
        assert "95% interval" in title


def middle_of(page: Any, name: str) -> tuple[float, float, float]:
    plot = page.locator(f"#{name} .plot")
    plot.scroll_into_view_if_needed()
    box = plot.bounding_box()
    return box["x"] + box["width"] / 2, box["y"] + 0.5 * box["height"], box["width"]


def test_dragging_zooms_in_and_reset_goes_back(chromium: Any, pages: dict[str, Path]) -> None:
    with Opened(chromium, pages["run"], 400) as opened:
        page = opened.page
        before = sorted(page.evaluate(TIME_RANGES))
        for name in ("bands_training", "bands_held-out"):
            x, y, wide = middle_of(page, name)
            page.mouse.move(x, y)
            page.mouse.down()
            page.mouse.move(x + 0.2 * wide, y + 30, steps=5)
            page.mouse.up()
        for old, new in zip(before, sorted(page.evaluate(TIME_RANGES)), strict=True):
            assert 0.1 < new / old < 0.5
        for button in page.locator("[title=Reset]:visible").all():
            button.click()
        assert before == pytest.approx(sorted(page.evaluate(TIME_RANGES)))
        assert [] == opened.wrong


def test_hovering_shows_the_sample_below_the_pointer(chromium: Any, pages: dict[str, Path]) -> None:
    bands = example.bands()
    with Opened(chromium, pages["run"]) as opened:
        page = opened.page
        x, y, _ = middle_of(page, "bands_held-out")
        page.mouse.move(x, y)
        page.mouse.move(x + 2, y, steps=3)
        tips = page.locator(".bk-Tooltip div:has(> b):visible")
        tips.first.wait_for()
        lines = [text.replace("\N{MINUS SIGN}", "-") for text in tips.all_inner_texts()]
    texts = dict(line.split(": ") for line in lines)
    numbers = {what: float(text.split()[0]) for what, text in texts.items()}
    at = int(np.argmin(np.abs(bands.time - numbers["time"])))
    assert bands.measured is not None
    assert bands.voltage[at] == pytest.approx(numbers["voltage"], abs=0.006)
    assert bands.mean[at] == pytest.approx(numbers["mean"], abs=6e-4)
    assert bands.measured[at] == pytest.approx(numbers["measured"], abs=6e-4)


def test_without_scripts_there_are_the_pictures(chromium: Any, pages: dict[str, Path]) -> None:
    with Opened(chromium, pages["run"], java_script_enabled=False) as opened:
        assert opened.page.locator("#loop img").is_visible()
        assert not opened.page.locator("#loop .plot").is_visible()
