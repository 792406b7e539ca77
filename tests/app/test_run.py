"""A run leaves what it should, says nothing it cannot know, and does not depend on its pieces."""

from __future__ import annotations

import csv
import json
import shutil
from dataclasses import replace
from io import StringIO
from pathlib import Path
from typing import Any

import click
import numpy as np
import pytest
import xarray
from rich.console import Console

from bwbayes.app.commands.ending import finish
from bwbayes.app.config.config import load
from bwbayes.app.fit.fitted import finished
from bwbayes.app.running.assembling import assemble
from bwbayes.app.running.folder import RunFolder
from bwbayes.app.running.progress import Progress
from bwbayes.app.running.run import redraw, resume
from bwbayes.errors import InputError
from bwbayes.model.distributions import Distribution
from bwbayes.record import read_record
from bwbayes.sampling.chain import Phase
from bwbayes.sampling.diagnostics import Check
from bwbayes.sampling.storage import ChainFile
from tests.app import small

FREE = {"d", "alpha", "beta", "lag", "offset", "sensor_sd", "discrepancy_sd", "discrepancy_time"}
LEVELS = {"50", "90", "95"}


@pytest.fixture(scope="module")
def summary(run: Path) -> dict[str, Any]:
    answer: dict[str, Any] = json.loads((run / "summary.json").read_text())
    return answer


# What a run leaves


def test_run_leaves_these_files(run: Path) -> None:
    left = {path.name for path in run.iterdir()} - {".lock"}
    files = {"posterior.nc", "summary.json", "bands.csv", "result.npz", "report.html"}
    assert files | {"config.toml", "chain", "records", "figures"} == left
    pictures = {path.name for path in (run / "figures").iterdir()}
    assert {"loop.png", "corner.png", "trace.png", "ranks.png", "coverage.png"} <= pictures
    assert {f"bands_{name}.png" for name in ("training", "held-out", "sine")} <= pictures


def test_summary_says_how_the_run_ended(run: Path, summary: dict[str, Any]) -> None:
    assert summary["converged"] is True
    assert "converged (two consecutive checks)" == summary["stop_reason"]
    assert (3, RunFolder(run).problem().record.sha256) == (summary["seed"], summary["data_sha256"])
    assert 0 < summary["wall_s"]
    packages = {"python", "bwbayes", "numpy", "scipy", "emcee", "arviz", "h5py"}
    assert packages <= set(summary["versions"])


def test_summary_tells_the_acceptance_of_each_move_and_pareto_k(
    run: Path, summary: dict[str, Any]
) -> None:
    moves = ChainFile.read(run / "chain").moves("sampling")
    assert {"differential evolution", "snooker", "mixture"} == set(moves)
    sampling = summary["sampling"]
    assert {name: tried for name, (tried, _) in moves.items()} == sampling["proposals"]
    accepted = {name: count / tried for name, (tried, count) in moves.items()}
    assert accepted == sampling["acceptance"]
    overall = sum(count for _, count in moves.values()) / sum(tried for tried, _ in moves.values())
    assert overall == pytest.approx(summary["acceptance"])
    assert sampling["pareto_k"] < 0.7


def test_summary_has_every_free_parameter(summary: dict[str, Any]) -> None:
    parameters = summary["parameters"]
    assert set(parameters) == FREE
    for row in parameters.values():
        assert row["lower_95"] < row["median"] < row["upper_95"]
        assert row["lower_95"] < row["mean"] < row["upper_95"]
        assert min(row["ess_bulk"], row["ess_tail"]) >= 200
        assert row["rhat"] < 1.01
        assert 0 < row["mcse_mean"] < row["sd"]
    assert ["um/V", "1/V", "s"] == [parameters[n]["unit"] for n in ("d", "beta", "lag")]


def test_posterior_has_readings_log_likelihood_and_whether_it_has_converged(run: Path) -> None:
    """Of each draw it is that of all readings; with the log prior it makes the log density."""
    record, posterior = (
        read_record(run / "records/record.h5"),
        RunFolder(run).problem().posterior,
    )
    with xarray.open_datatree(run / "posterior.nc", engine="h5netcdf") as tree:
        assert 1 == tree.attrs["converged"] == tree["posterior"].attrs["converged"]
        for group, name in (("observed_data", "displacement"), ("constant_data", "voltage")):
            values = tree[group].to_dataset()[name]
            assert (("time",), "s") == (values.dims, values["time"].attrs["units"])
            np.testing.assert_array_equal(record.time, values["time"].values)
            np.testing.assert_array_equal(getattr(record, name), values.values)
        found = tree["log_likelihood"].to_dataset()["displacement"]
        drawn = tree["posterior"].to_dataset()
        free = np.array([[float(drawn[n][c, 3]) for n in posterior.names] for c in (0, 20, 71)])
        expected = posterior.log_likelihood(posterior.prior.theta(free))
        np.testing.assert_allclose(found.values[[0, 20, 71], 3], expected, rtol=0, atol=1e-6)
        assert found.shape == tree["sample_stats"].to_dataset()["lp"].shape


def test_bands_have_every_window_and_kind(run: Path) -> None:
    with (run / "bands.csv").open() as file:
        rows = list(csv.DictReader(file))
    kinds = ("parameter", "displacement", "sensor")
    edges = {f"{k}_{e}_{n}_um" for k in kinds for e in ("lower", "upper") for n in LEVELS}
    names = {"set", "time_s", "voltage_V", "displacement_um", "mean_um"}
    assert names | edges == set(rows[0])
    counts = {n: sum(row["set"] == n for row in rows) for n in ("training", "held-out", "sine")}
    assert {"training": 250, "held-out": 50, "sine": 200} == counts
    assert all(np.isfinite(float(v)) for row in rows for n, v in row.items() if n != "set")


# The same bits, in however many pieces


def test_interrupted_command_says_how_to_go_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    made, seen = small.begun(tmp_path / "a"), 0
    with pytest.raises(InputError, match="does not exist"):
        finished(made)

    def interrupt(_: Progress, phase: Phase, check: Check | None) -> None:
        nonlocal seen
        seen += phase == "pilot" and check is None
        if seen == 5:  # blocks of single ensembles
            raise KeyboardInterrupt

    monkeypatch.setattr(Progress, "__call__", interrupt)
    with pytest.raises(click.exceptions.Exit) as ended:
        finish(made.path, workers=1, quiet=True)
    assert 130 == ended.value.exit_code
    said = capsys.readouterr()
    assert ("", f"interrupted; resume with `bwbayes resume {made.path}`\n") == (said.out, said.err)
    assert 1 == ChainFile.read(made.chain).blocks("pilot")
    with pytest.raises(InputError, match=r"no draws yet; resume with `bwbayes\.resume"):
        finished(made)


@pytest.mark.usefixtures("_without_pictures")
def test_larger_target_is_reached_with_the_same_draws_first(run: Path, copy: RunFolder) -> None:
    required = float(np.ceil(1.3 * small.lowest_ess(run)))
    assert resume(copy, small.quiet(), workers=1, ess=required).converged
    first, longer = ChainFile.read(run / "chain"), ChainFile.read(copy.chain)
    steps = first.steps("sampling")
    assert steps < longer.steps("sampling")
    np.testing.assert_array_equal(
        first.coordinates("sampling"), longer.coordinates("sampling")[:steps]
    )
    assert small.lowest_ess(copy.path) >= required


def test_pictures_of_an_earlier_end_do_not_stay(copy: RunFolder) -> None:
    """A target that is missed takes back the intervals that a lower one had given."""
    steps = ChainFile.read(copy.chain).steps("sampling")
    assert not resume(copy, small.quiet(), workers=1, ess=1e6, steps=steps).converged
    assert {"trace.png", "ranks.png"} == {p.name for p in (copy.path / "figures").iterdir()}
    assert small.numbers(copy.path)["validation"] is None
    assert not (copy.path / "bands.csv").exists()


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


def test_a_prior_that_the_record_contradicts_is_a_remark(run: Path) -> None:
    folder = RunFolder(run)
    fit = finished(folder)
    problem, chain, outcome = fit.problem, fit.chain, fit.outcome
    outcome = replace(outcome, converged=False)  # no bands are needed
    assert () == assemble(problem, chain, outcome).remarks
    nanometres = Distribution("lognormal", {"median": 1e-3, "sigma": 0.6})
    odd = replace(problem, defaults={**problem.defaults, "d": nanometres})
    (remark,) = assemble(odd, chain, outcome).remarks
    assert "Fix: check its unit" in remark


# A run remembers its engine


def test_chain_file_and_summary_name_the_engine(run: Path) -> None:
    assert "numba" == load(RunFolder(run).config).sampling.engine
    attributes = ChainFile.read(RunFolder(run).chain).attributes()
    assert "numba" == attributes["engine"]
    assert "numba" in json.loads(str(attributes["versions"]))
    assert "numba" in small.numbers(run)["versions"]


def test_another_engine_is_refused_unless_asked_for(copy: RunFolder) -> None:
    text = copy.config.read_text().replace('engine = "numba"', 'engine = "numpy"')
    copy.config.write_text(text)
    before = ChainFile.read(copy.chain).steps("sampling")
    with pytest.raises(InputError, match=r'sampled with the numba engine, not numpy.*`engine="num'):
        resume(copy, small.quiet(), workers=1)
    assert before == ChainFile.read(copy.chain).steps("sampling")


@pytest.mark.slow
def test_asked_for_another_engine_goes_on_and_is_said(run: Path, copy: RunFolder) -> None:
    said = StringIO()
    ess = 2 * small.lowest_ess(run)
    result = resume(copy, Console(file=said, width=200), workers=1, ess=ess, engine="numpy")
    assert result.outcome.converged
    assert "resuming with the numpy engine a chain begun with numba" in said.getvalue()
    assert "numpy" == load(copy.config).sampling.engine
