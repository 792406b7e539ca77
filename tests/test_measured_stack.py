"""The measured piezo stack: convergence, held-out error, calibrated bands, against white noise."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from bwbayes.app import cli

ROOT = Path(__file__).resolve().parents[1]
RECORD = ROOT.parent / "shared" / "data" / "picma_stack_open_loop.csv"

pytestmark = pytest.mark.skipif(
    not RECORD.is_file(), reason="the measured record is not part of the project, and not here"
)


def run(folder: Path, config: Path) -> Any:
    """Run a config on the measured record and return its summary."""
    argv = ["bwbayes", "run", str(config), "--record", str(RECORD), "--out", str(folder), "--quiet"]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("sys.argv", argv)
        with pytest.raises(SystemExit) as ended:
            cli.main()
    assert ended.value.code == 0
    return json.loads((folder / "summary.json").read_text(encoding="utf-8"))


@pytest.fixture(scope="module")
def honest(tmp_path_factory: pytest.TempPathFactory) -> Any:
    """Run the config as it stands."""
    return run(tmp_path_factory.mktemp("honest") / "out", ROOT / "runs/measured_stack.toml")


@pytest.fixture(scope="module")
def white(tmp_path_factory: pytest.TempPathFactory) -> Any:
    """Run the same with white noise alone."""
    folder = tmp_path_factory.mktemp("white")
    text = (ROOT / "runs/measured_stack.toml").read_text(encoding="utf-8")
    start = text.index("[parameters.discrepancy_time]")
    text = text[:start] + text[text.index("[sampling]") :]
    config = folder / "white.toml"
    config.write_text(text.replace('hold = "first"', 'hold = "first"\nnoise = "white"'))
    return run(folder / "out", config)


def test_it_converges(honest: Any) -> None:
    assert honest["converged"] is True
    for row in honest["parameters"].values():
        assert min(row["ess_bulk"], row["ess_tail"]) >= 2000


def test_the_held_out_mean_misses_by_less_than_085_percent_of_the_range(honest: Any) -> None:
    assert honest["validation"]["held_out"]["nrmse"] < 0.0085


def test_the_95_percent_sensor_band_is_right_and_narrow(honest: Any) -> None:
    """Within two block-bootstrap errors of nominal, at a mean width of at most 1.6 um."""
    held_out = honest["validation"]["held_out"]
    error = held_out["coverage_error"]["sensor"]["95"]
    assert abs(held_out["coverage"]["sensor"]["95"] - 0.95) <= 2 * error
    assert held_out["width_95_um"] <= 1.6


def test_white_noise_scores_worse_and_its_parameters_look_too_sure(honest: Any, white: Any) -> None:
    """The twin: the same test fails for the noise model that ignores the discrepancy."""
    for name in ("crps_um", "interval_score_95_um"):
        assert honest["validation"]["held_out"][name] < white["validation"]["held_out"][name]
    for name in ("d", "alpha", "beta", "gamma"):
        assert white["parameters"][name]["sd"] < 0.6 * honest["parameters"][name]["sd"]
