"""A run's files are for everybody: they open with common tools where bwbayes is not installed."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from tests.app import small

# What a colleague types who has arviz, xarray, pandas and corner, and no bwbayes.
SCRIPT = """
import json, sys
from pathlib import Path

class Absent:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] == "bwbayes":
            raise ModuleNotFoundError(f"No module named {name!r}", name=name)

sys.meta_path.insert(0, Absent())
try:
    import bwbayes
except ModuleNotFoundError:
    pass
else:
    raise SystemExit("bwbayes is here after all")

import arviz as az
import corner
import matplotlib
import numpy as np
import pandas as pd
import xarray as xr

matplotlib.use("agg")
tree = az.from_netcdf("posterior.nc")
statistics = az.summary(tree, round_to="none")
draws = az.extract(tree)
names = list(tree["posterior"].data_vars)
figure = corner.corner(np.stack([draws[name].values for name in names], axis=1), labels=names)
blocks = [np.load(path) for path in sorted(Path("chain").glob("sampling-0*.npz"))]
chain = np.concatenate([block["log_density"] for block in blocks])  # (steps, ensembles, walkers)
coordinates = np.concatenate([block["coordinates"] for block in blocks]).shape
seed = json.loads(str(np.load("chain/start.npz")["text"]))["attributes"]["seed"]
posterior = xr.open_dataset("posterior.nc", group="posterior", engine="h5netcdf")
readings = xr.open_datatree("posterior.nc", engine="h5netcdf")["observed_data/displacement"]
bands = pd.read_csv("bands.csv")
with open("summary.json", encoding="utf-8") as file:
    summary = json.load(file)
print(json.dumps({
    "names": names,
    "mean": {name: float(statistics.loc[name, "mean"]) for name in names},
    "xarray_mean": {name: float(posterior[name].mean()) for name in names},
    "units": {name: posterior[name].attrs["units"] for name in names},
    "converged": int(tree.attrs["converged"]),
    "readings": int(readings.notnull().sum()),
    "panels": len(figure.axes),
    "chain": list(chain.shape),
    "coordinates": list(coordinates),
    "seed": seed,
    "sets": sorted(set(bands["set"])),
    "columns": list(bands.columns),
    "covered": float(
        bands.displacement_um.between(bands.sensor_lower_95_um, bands.sensor_upper_95_um).mean()
    ),
    "parameters": {name: row["mean"] for name, row in summary["parameters"].items()},
}))
"""


def test_files_open_with_arviz_xarray_pandas_corner_and_numpy(run: Path) -> None:
    """``-I`` keeps the checkout out of the script's path as well."""
    done = subprocess.run(
        [sys.executable, "-I", "-c", SCRIPT], cwd=run, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    seen: dict[str, Any] = json.loads(done.stdout.splitlines()[-1])
    for name, mean in seen["parameters"].items():
        assert seen["mean"][name] == pytest.approx(mean, rel=1e-6)
        assert seen["xarray_mean"][name] == pytest.approx(mean, rel=1e-6)
    assert ("um/V", "um", 1) == (seen["units"]["d"], seen["units"]["offset"], seen["converged"])
    assert seen["readings"] == 300
    assert seen["panels"] == len(seen["names"]) ** 2
    assert ["held-out", "sine", "training"] == seen["sets"]
    assert ["set", "time_s", "voltage_V", "displacement_um", "mean_um"] == seen["columns"][:5]
    assert 0.85 < seen["covered"] <= 1
    assert 3 == seen["seed"]
    assert [small.numbers(run)["steps"], 4, 18] == seen["chain"]
    assert [*seen["chain"], len(seen["names"])] == seen["coordinates"]
