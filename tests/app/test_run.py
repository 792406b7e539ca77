"""A run leaves what it should, says nothing it cannot know, and does not depend on its pieces."""

from __future__ import annotations

import csv
import json
import re
import shutil
import time
from io import StringIO
from pathlib import Path
from typing import Any

import click
import numpy as np
import pytest
import xarray
from rich.console import Console

from bwbayes.app.commands.ending import finish
from bwbayes.app.fit.fitted import finished
from bwbayes.app.running.folder import RunFolder
from bwbayes.app.running.progress import Progress
from bwbayes.app.running.run import redraw, resume
from bwbayes.errors import InputError
from bwbayes.record import read_record
from bwbayes.sampling.chain import Phase
from bwbayes.sampling.diagnostics import Check
from bwbayes.sampling.storage import ChainFile
from tests.app import small

FREE = ("d", "alpha", "beta", "lag", "offset", "sensor_sd", "discrepancy_sd", "discrepancy_time")
LEVELS = {"50", "90", "95"}


# What a run leaves


def test_run_leaves_these_files(run: Path) -> None:
    assert {
        "config.toml",
        "chain",
        "posterior.nc",
        "summary.json",
        "bands.csv",
        "result.npz",
        "report.html",
        "figures",
        "records",
        ".lock",
    } == {path.name for path in run.iterdir()} | {".lock"}
    pictures = {path.name for path in (run / "figures").iterdir()}
    assert {"loop.png", "corner.png", "trace.png", "ranks.png", "coverage.png"} <= pictures
    assert {f"bands_{name}.png" for name in ("training", "held-out", "sine")} <= pictures


def assert_numbers(table: dict[str, Any], *names: str) -> None:
    for name in names:
        assert type(table[name]) is float, name


def test_summary_says_how_the_run_ended(run: Path) -> None:
    answer = json.loads((run / "summary.json").read_text())
    assert answer["converged"] is True
    assert "converged on two checks in a row" == answer["stop_reason"]
    assert 3 == answer["seed"]
    assert_numbers(answer, "wall_s")
    assert 0 < answer["wall_s"]
    assert {"python", "bwbayes", "numpy", "scipy", "emcee", "arviz", "h5py"} <= set(
        answer["versions"]
    )
    assert all(isinstance(text, str) for text in answer["versions"].values())
    problem = RunFolder(run).problem()
    assert problem.record.sha256 == answer["data_sha256"]


def test_summary_tells_the_acceptance_of_each_move_and_pareto_k(run: Path) -> None:
    answer = json.loads((run / "summary.json").read_text())
    chain = ChainFile.read(run / "chain")
    moves = chain.moves("sampling")
    assert {"differential evolution", "snooker", "mixture"} == set(moves)
    sampling = answer["sampling"]
    assert {name: tried for name, (tried, _) in moves.items()} == sampling["proposals"]
    assert {name: kept / tried for name, (tried, kept) in moves.items()} == sampling["acceptance"]
    overall = sum(kept for _, kept in moves.values()) / sum(tried for tried, _ in moves.values())
    assert overall == pytest.approx(answer["acceptance"])
    assert sampling["pareto_k"] < 0.7


def test_summary_has_every_free_parameter(run: Path) -> None:
    answer = json.loads((run / "summary.json").read_text())["parameters"]
    assert set(FREE) == set(answer)
    for name, row in answer.items():
        assert_numbers(row, "mean", "sd", "median", "lower_95", "upper_95")
        assert_numbers(row, "ess_bulk", "ess_tail", "rhat", "mcse_mean")
        assert isinstance(row["unit"], str), name
        assert row["lower_95"] < row["median"] < row["upper_95"]
        assert row["lower_95"] < row["mean"] < row["upper_95"]
        assert min(row["ess_bulk"], row["ess_tail"]) >= 200
        assert row["rhat"] < 1.01
        assert 0 < row["mcse_mean"] < row["sd"]
    assert ("um/V", "1/V", "s") == tuple(answer[n]["unit"] for n in ("d", "beta", "lag"))


def test_summary_judges_every_prediction(run: Path) -> None:
    answer = json.loads((run / "summary.json").read_text())["validation"]
    assert {"held-out", "sine"} <= set(answer)
    for row in answer.values():
        assert_numbers(row, "nrmse", "max_error_um", "crps_um", "width_95_um")
        assert 0 < row["nrmse"] < 0.1
        for kind in ("sensor", "displacement"):
            assert LEVELS == set(row["coverage"][kind])
            assert all(0 <= part <= 1 for part in row["coverage"][kind].values())


def test_posterior_says_whether_it_has_converged_and_when_samples_were(run: Path) -> None:
    record = read_record(run / "records/record.h5")
    with xarray.open_datatree(run / "posterior.nc", engine="h5netcdf") as tree:
        assert 1 == tree.attrs["converged"] == tree["posterior"].attrs["converged"]
        for group, name in (("observed_data", "displacement"), ("constant_data", "voltage")):
            values = tree[group].to_dataset()[name]
            assert ("time",) == values.dims
            np.testing.assert_array_equal(record.time, values["time"].values)
            assert "s" == values["time"].attrs["units"]
            np.testing.assert_array_equal(getattr(record, name), values.values)


def test_posterior_has_the_log_likelihood_of_each_draw(run: Path) -> None:
    """It is that of all readings together, and with the log prior it makes the log density."""
    posterior = RunFolder(run).problem().posterior
    with xarray.open_datatree(run / "posterior.nc", engine="h5netcdf") as tree:
        answer = tree["log_likelihood"].to_dataset()["displacement"]
        drawn = tree["posterior"].to_dataset()
        free = np.array([[float(drawn[n][c, 3]) for n in posterior.names] for c in (0, 20, 71)])
        expected = posterior.log_likelihood(posterior.prior.theta(free))
        np.testing.assert_allclose(answer.values[[0, 20, 71], 3], expected, rtol=0, atol=1e-6)
        assert answer.shape == tree["sample_stats"].to_dataset()["lp"].shape


def rows(path: Path) -> list[dict[str, str]]:
    with path.open() as file:
        return list(csv.DictReader(file))


def test_bands_have_every_window_and_kind(run: Path) -> None:
    answer = rows(run / "bands.csv")
    kinds = ("parameter", "displacement", "sensor")
    edges = {f"{k}_{e}_{n}_um" for k in kinds for e in ("lower", "upper") for n in LEVELS}
    names = {"set", "time_s", "voltage_V", "displacement_um", "mean_um"}
    assert names | edges == set(answer[0])
    counts = {n: sum(row["set"] == n for row in answer) for n in ("training", "held-out", "sine")}
    assert {"training": 250, "held-out": 50, "sine": 200} == counts
    assert all(np.isfinite(float(v)) for row in answer for n, v in row.items() if n != "set")


# The same bits, in however many pieces


def watch_until(monkeypatch: pytest.MonkeyPatch, last: str, count: int) -> None:
    """Interrupt the next run after so many blocks of single ensembles in a phase."""
    seen = 0

    def watched(_: Progress, phase: Phase, answer: Check | None) -> None:
        nonlocal seen
        seen += phase == last and answer is None
        if seen == count:
            raise KeyboardInterrupt

    monkeypatch.setattr(Progress, "__call__", watched)


def test_interrupted_command_says_how_to_go_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    made = small.begun(tmp_path / "a")
    watch_until(monkeypatch, "pilot", 5)
    with pytest.raises(click.exceptions.Exit) as ended:
        finish(made.path, workers=1, quiet=True)
    assert 130 == ended.value.exit_code
    printed = capsys.readouterr()
    assert f"interrupted; resume with `bwbayes resume {made.path}`\n" == printed.err
    assert "" == printed.out
    assert 1 == ChainFile.read(made.chain).blocks("pilot")


def test_progress_shows_rate_eta_acceptance_rhat_and_ess(run: Path) -> None:
    problem = RunFolder(run).problem()
    outcome = finished(RunFolder(run)).outcome
    said = StringIO()
    progress = Progress(Console(file=said, width=40), problem.plan)
    progress.begun = progress.printed = time.monotonic() - 60
    progress("sampling", outcome.check)  # of a run that goes on: nothing was done yet
    for _ in range(4):
        progress("sampling", None)
    assert re.search(r" 30 models/s   ETA unknown   acceptance 0", progress.line("sampling"))
    line = r"sampling +\d+ steps +0 models/s   ETA unknown   acceptance 0\.\d\d   R-hat 1\.\d{3}   "
    assert re.fullmatch(line + r"ESS \d+ of 200   Pareto k -?\d\.\d\d\n", said.getvalue())


# A larger target


@pytest.mark.usefixtures("_without_pictures")
def test_larger_target_is_reached_with_the_same_draws_first(run: Path, copy: RunFolder) -> None:
    before = small.numbers(run)["parameters"]
    fewest = min(min(row["ess_bulk"], row["ess_tail"]) for row in before.values())
    required = float(np.ceil(1.3 * fewest))
    result = resume(copy, small.quiet(), workers=1, ess=required)
    assert result.outcome.converged
    first, longer = ChainFile.read(run / "chain"), ChainFile.read(copy.chain)
    steps = first.steps("sampling")
    assert steps < longer.steps("sampling")
    np.testing.assert_array_equal(
        first.coordinates("sampling"), longer.coordinates("sampling")[:steps]
    )
    answer = small.numbers(copy.path)["parameters"]
    assert all(min(row["ess_bulk"], row["ess_tail"]) >= required for row in answer.values())


# Files that do not fit together


# Drawing again


def test_report_is_drawn_again_with_the_same_numbers(run: Path, copy: RunFolder) -> None:
    for name in ("report.html", "bands.csv", "posterior.nc"):
        (copy.path / name).unlink()
    shutil.rmtree(copy.path / "figures")
    redraw(copy)
    assert json.loads((run / "summary.json").read_text()) == json.loads(copy.summary.read_text())
    small.assert_same_end(run, copy.path)
    assert (copy.path / "report.html").stat().st_size > 100_000
    names = {path.name for path in (run / "figures").iterdir()}
    assert names == {path.name for path in (copy.path / "figures").iterdir()}


def test_unfinished_run_is_not_drawn(copy: RunFolder) -> None:
    copy.summary.unlink()
    with pytest.raises(InputError, match=r"not finished; resume with `bwbayes\.resume"):
        redraw(copy)


def test_chain_without_draws_predicts_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    made = small.begun(tmp_path / "a")
    with pytest.raises(InputError, match="does not exist"):
        finished(made)
    watch_until(monkeypatch, "pilot", 5)
    with pytest.raises(KeyboardInterrupt):
        resume(made, small.quiet(), workers=1)
    with pytest.raises(InputError, match=r"no draws yet; resume with `bwbayes\.resume"):
        finished(made)


def test_pictures_of_an_earlier_end_do_not_stay(copy: RunFolder) -> None:
    """A target that is missed takes back the intervals that a lower one had given."""
    steps = ChainFile.read(copy.chain).steps("sampling")
    result = resume(copy, small.quiet(), workers=1, ess=1e6, steps=steps)
    assert not result.outcome.converged
    assert {"trace.png", "ranks.png"} == {p.name for p in (copy.path / "figures").iterdir()}
    assert small.numbers(copy.path)["validation"] is None
    assert not (copy.path / "bands.csv").exists()
