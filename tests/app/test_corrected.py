"""A run whose bands fail on held-out readings has a corrected band wherever bands are shown.

The sensor's noise is said to be a fifth of what it is, so that bands are five times too narrow.
"""

import json
from dataclasses import asdict
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

import bwbayes as bw
from bwbayes.app.running.run import resume
from tests.app import small
from tests.app.conftest import Type

NARROW = (
    "gamma = { fixed = 0.0172 }",
    "gamma = { fixed = 0.0172 }\nsensor_sd = { fixed = 0.1 }\n"
    "[model]\nnoise = 'white'\nstages = []",
)
COLUMNS = ["corrected_lower_95_um", "corrected_upper_95_um"]


@pytest.fixture(scope="module")
def failed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = small.begun(tmp_path_factory.mktemp("failed") / "run", NARROW)
    with pytest.MonkeyPatch.context() as patch:
        small.without_explanations(patch)
        small.without_pictures(patch)
        resume(folder, small.quiet(), workers=1)
    return folder.path


def inside(table: pd.DataFrame, lower: str, upper: str) -> float:
    return float(np.mean(table["displacement_um"].between(table[lower], table[upper])))


def test_corrected_band_stands_beside_the_failed_one(failed: Path) -> None:
    fit = bw.open_run(failed)
    correction = fit.corrections["held-out"]
    assert correction.factor == pytest.approx(5, rel=0.5)
    assert correction.blocks >= 20
    numbers = json.loads((failed / "summary.json").read_text())["validation"]
    assert numbers["held-out"]["correction"] == asdict(correction)
    table = pd.read_csv(failed / "bands.csv").set_index("set")
    assert table.loc["training", COLUMNS].isna().all(axis=None)
    held_out = table.loc["held-out"]
    assert inside(held_out, "sensor_lower_95_um", "sensor_upper_95_um") < 0.6
    assert inside(held_out, *COLUMNS) >= 0.95
    np.testing.assert_allclose(
        held_out[COLUMNS[1]] - held_out["mean_um"],
        correction.factor * (held_out["sensor_upper_95_um"] - held_out["mean_um"]),
        rtol=1e-4,
    )
    page = (failed / "report.html").read_text(encoding="utf-8")
    assert f"held-out: {correction}" in page
    labels = [text.get_text() for text in fit.bands["held-out"].plot().legends[0].get_texts()]
    assert "95% sensor reading, corrected" in labels


def test_predictions_of_drives_alike_have_it_and_others_do_not(
    failed: Path, bwbayes: Type, tmp_path: Path
) -> None:
    record = bw.open_run(failed).problem.record
    for name, times in (("alike", 1.0), ("further", 1.3)):
        pd.DataFrame({"time_s": record.time, "voltage_V": times * record.voltage}).to_csv(
            tmp_path / f"{name}.csv", index=False
        )
        out = tmp_path / f"out/{name}.csv"
        assert bwbayes("predict", failed, "--voltage", f"{name}.csv", "--out", out).status == 3
        numbers = json.loads(out.with_suffix(".json").read_text())
        is_alike = name == "alike"
        assert is_alike is (numbers["correction"] is not None)
        assert is_alike is (set(COLUMNS) <= set(pd.read_csv(out)))


def test_nothing_is_shown_of_a_run_that_passed(run: Path, fit: bw.Run) -> None:
    assert fit.corrections == {}
    assert "corrected" not in (run / "report.html").read_text(encoding="utf-8")
    assert "correct" not in (run / "bands.csv").read_text().partition("\n")[0]
    assert '"correction"' not in (run / "summary.json").read_text()
