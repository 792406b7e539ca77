"""What a replicate of ``runs/calibration.toml`` costs: records so short that Python counts.

    python -m tests.benchmarks.replicates --against ../before     # in turns with another checkout

CPU seconds of a process with one thread, the first replicate left out, which loads what is
compiled. The same replicates in both checkouts, a few at a time in turns, so that what else the
machine does hits both alike.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import click
import numpy as np

from bwbayes.arrays import FloatArray
from tests.benchmarks.cases import ROOT, Effort
from tests.benchmarks.tables import Cell, Table

NOTE = "CPU s, one thread; median, and from the fifth to the ninety-fifth per cent"

REPLICATES = {True: 100, False: 5}
TOGETHER = 5

# Works in every checkout since there are replicates: it asks for nothing newer.
CODE = """
import json, sys, time
from pathlib import Path
from bwbayes.app.config.config import load
try:
    from bwbayes.app.jobs.calibrate import experiment
except ImportError:
    from bwbayes.app.commands.calibrate import experiment  # where it was before
from bwbayes.app.problem.problem import resolve
from bwbayes.results.replicates import replicate

root, first, last = Path.cwd(), int(sys.argv[1]), int(sys.argv[2])
common = experiment(resolve(load(root / "runs" / "calibration.toml"), root))
replicate(common, 1, first)
costs = []
for number in range(first, last):
    begun = time.process_time()
    replicate(common, 1, number)
    costs.append(time.process_time() - begun)
print(json.dumps(costs))
"""


def seconds(checkout: Path, first: int, last: int) -> list[float]:
    """Return the CPU seconds of replicates ``first`` to ``last`` in a checkout."""
    ran = subprocess.run(
        [sys.executable, "-c", CODE, str(first), str(last)],
        cwd=checkout,
        env=os.environ | {"PYTHONPATH": str(checkout), "OMP_NUM_THREADS": "1"},
        capture_output=True,
        check=True,
        text=True,
    )
    costs: list[float] = json.loads(ran.stdout)
    return costs


def replicates(effort: Effort) -> Table:
    """Measure the replicates of this checkout."""
    count = REPLICATES[effort.everything]
    costs = np.concatenate([*_turns([ROOT], count)], axis=1)[0]
    return Table("replicates", "A calibration replicate of 300 samples", NOTE, [_row(costs)])


def _turns(checkouts: list[Path], count: int) -> Iterator[FloatArray]:
    """Yield the costs (checkouts, replicates) of a few replicates at a time."""
    for first in range(1, count + 1, TOGETHER):
        last = min(first + TOGETHER, count + 1)
        yield np.array([seconds(checkout, first, last) for checkout in checkouts])


def _row(costs: FloatArray) -> dict[str, Cell]:
    low, middle, high = np.quantile(costs, [0.05, 0.5, 0.95]).tolist()
    return {"replicates": float(costs.size), "core s": middle, "from": low, "to": high}


@click.command()
@click.option("--against", "before", type=click.Path(path_type=Path), required=True)
@click.option("--count", default=REPLICATES[True], show_default=True)
def main(*, before: Path, count: int) -> None:
    """Compare the replicates of this checkout with those of another."""
    pairs = np.concatenate([*_turns([before.resolve(), ROOT], count)], axis=1)
    slow, fast = np.median(pairs, axis=1).tolist()
    load = os.getloadavg()[0] if hasattr(os, "getloadavg") else float("nan")
    click.echo(
        f"CPU s, median of {count}: {slow:.3f} before, {fast:.3f} now; {slow / fast:.2f} times as "
        f"fast (load {load:.1f})"
    )


if __name__ == "__main__":
    main()
