"""A run leaves what it should, says nothing it cannot know, and does not depend on its pieces."""

import json
import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import xarray

from bwbayes.app.fit.fitted import STAGES, Run, open_finished
from bwbayes.app.running.folder import RunFolder
from bwbayes.app.running.run import redraw, resume
from bwbayes.errors import InputError
from bwbayes.model.declaration import Distribution
from bwbayes.record import read_record
from bwbayes.sampling import sampler
from bwbayes.sampling.storage import ChainFile
from tests.app import small


def test_posterior_has_readings_log_likelihood_and_whether_it_has_converged(run: Path) -> None:
    """Of each draw it is that of all readings; with the log prior it makes the log density."""
    record, posterior = (
        read_record(run / "records/record.h5"),
        Run(RunFolder(run)).study.posterior,
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


@pytest.mark.usefixtures("_without_pictures", "_without_explanations")
def test_larger_target_is_reached_with_the_same_draws_first(
    run: Path, copy: RunFolder, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Where none are set aside: for a larger target that may pay where it did not before."""
    monkeypatch.setattr(sampler._Sampling, "_is_early", False)
    required = float(np.floor(small.lowest_ess(run)) + 1)
    assert resume(copy, small.quiet(), workers=1, ess=required).converged
    first, longer = ChainFile.read(run / "chain"), ChainFile.read(copy.chain)
    steps = first.steps("sampling")
    assert steps < longer.steps("sampling")
    np.testing.assert_array_equal(
        first.coordinates("sampling"), longer.coordinates("sampling")[:steps]
    )
    assert small.lowest_ess(copy.path) >= required


@pytest.mark.usefixtures("_without_pictures")
def test_what_is_finished_is_not_worked_out_again(
    copy: RunFolder, monkeypatch: pytest.MonkeyPatch
) -> None:
    numbers, before = copy.numbers(), copy.summary.stat().st_mtime_ns
    for stage in STAGES.values():
        monkeypatch.setattr(stage, "compute", None)
    fit = resume(copy, small.quiet(), workers=1)
    assert fit.converged
    assert copy.summary.stat().st_mtime_ns == before
    copy.summary.unlink()
    resume(copy, small.quiet(), workers=1)
    again = copy.numbers()
    assert {k: v for k, v in again.items() if k != "wall_s"} == {
        k: v for k, v in numbers.items() if k != "wall_s"
    }


def test_pictures_of_an_earlier_end_do_not_stay(copy: RunFolder) -> None:
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
    fit = open_finished(folder)
    outcome = replace(fit.outcome, converged=False)  # no bands are needed
    fit = fit.with_cache(outcome=outcome, kept={})
    assert () == fit.remarks
    nanometres = Distribution("lognormal", {"median": 1e-3, "sigma": 0.6})
    study = replace(fit.study)
    vars(study)["defaults"] = {**fit.study.defaults, "d": nanometres}
    (remark,) = open_finished(folder).with_cache(study=study, outcome=outcome, kept={}).remarks
    assert "Fix: check its unit" in remark


def test_another_engine_is_refused_unless_asked_for(copy: RunFolder) -> None:
    text = copy.config.read_text().replace('engine = "numba"', 'engine = "numpy"')
    copy.config.write_text(text)
    before = ChainFile.read(copy.chain).steps("sampling")
    with pytest.raises(InputError, match=r'sampled with the numba engine, not numpy.*`engine="num'):
        resume(copy, small.quiet(), workers=1)
    assert before == ChainFile.read(copy.chain).steps("sampling")


# A run's files are for everybody: they open with common tools where bwbayes is not installed

# What a colleague types who has arviz, xarray, pandas and corner, and no bwbayes.
SCRIPT = """
import json, sys
from pathlib import Path

sys.modules["bwbayes"] = None  # nothing may import it

import arviz as az
import corner
import matplotlib
import numpy as np
import pandas as pd
import xarray as xr

matplotlib.use("agg")
summary = json.loads(Path("summary.json").read_text(encoding="utf-8"))
means = {name: row["mean"] for name, row in summary["parameters"].items()}
tree = az.from_netcdf("posterior.nc")
assert set(means) == set(tree["posterior"].data_vars)
assert tree.attrs["converged"] == 1
statistics, draws = az.summary(tree, round_to="none"), az.extract(tree)
posterior = xr.open_dataset("posterior.nc", group="posterior", engine="h5netcdf")
for name, mean in means.items():
    assert np.isclose(statistics.loc[name, "mean"], mean, rtol=1e-6)
    assert np.isclose(posterior[name].mean(), mean, rtol=1e-6)
assert [posterior[name].attrs["units"] for name in ("d", "offset")] == ["um/V", "um"]
readings = xr.open_datatree("posterior.nc", engine="h5netcdf")["observed_data/displacement"]
assert readings.notnull().sum() == 300
figure = corner.corner(np.stack([draws[name].values for name in means], axis=1), labels=[*means])
assert len(figure.axes) == len(means) ** 2
blocks = [np.load(path) for path in sorted(Path("chain").glob("sampling-0*.npz"))]
chain = np.concatenate([block["log_density"] for block in blocks])  # (steps, ensembles, walkers)
assert chain.shape == (summary["steps"], 4, 18)
coordinates = np.concatenate([block["coordinates"] for block in blocks])
assert coordinates.shape == (*chain.shape, len(means))
assert json.loads(str(np.load("chain/start.npz")["text"]))["attributes"]["seed"] == 3
bands = pd.read_csv("bands.csv")
assert set(bands["set"]) == {"training", "held-out", "sine"}
assert [*bands][:5] == ["set", "time_s", "voltage_V", "displacement_um", "mean_um"]
inside = bands.displacement_um.between(bands.sensor_lower_95_um, bands.sensor_upper_95_um)
assert 0.85 < inside.mean()
"""


def test_files_open_with_arviz_xarray_pandas_corner_and_numpy(run: Path) -> None:
    """``-I`` keeps the checkout out of the script's path as well."""
    done = subprocess.run(
        [sys.executable, "-I", "-c", SCRIPT], cwd=run, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
