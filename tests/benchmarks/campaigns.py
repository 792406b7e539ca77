"""What a campaign of a thousand short records costs: fits, their folders, and combining them.

``python -m tests.benchmarks.campaigns`` draws actuators from the priors of
``runs/calibration.toml``, writes a record of 300 samples of each into a folder, and lets
``bwbayes campaign`` do with it what it does without pictures, with as many workers as there are
cores.
"""

from __future__ import annotations

import resource
import tempfile
import time
from pathlib import Path

import click
import numpy as np
from rich.console import Console

import bwbayes as bw
from bwbayes.app.config.config import load
from bwbayes.app.jobs.campaign import config_text, resume, start
from bwbayes.app.problem.problem import resolve
from bwbayes.app.running.campaign import Campaign
from tests.benchmarks.cases import ROOT
from tests.measured import keep

CONFIG = ROOT / "runs" / "calibration.toml"

# Medians and relative spreads of the population.
POPULATION = {"d": (0.7, 0.05), "alpha": (0.35, 0.1), "beta": (0.03, 0.1), "lag": (0.03, 0.2)}


def written(folder: Path, count: int) -> None:
    """Write the records of so many actuators of the population."""
    folder.mkdir()
    config, source = load(CONFIG), np.random.default_rng(5)
    for number in range(count):
        drawn = {
            name: float(median * np.exp(spread * source.standard_normal()))
            for name, (median, spread) in POPULATION.items()
        }
        stand = config.stand.model_copy(
            update={
                "parameters": config.stand.parameters | drawn,
                "model": config.stand.model.model_copy(update={"dynamics": "lag"}),
            }
        )
        one = config.model_copy(update={"seed": number + 1, "stand": stand})
        bw.write_record(resolve(one, ROOT / "runs").record, folder / f"s{number:04d}.csv")


def fitted(records: Path, out: Path, workers: int | None = None) -> tuple[Campaign, float]:
    """Fit the records of a folder, and return what came of it and the seconds it took."""
    begun = time.perf_counter()
    folder = start(records, config_text(CONFIG), ROOT / "runs", out, pictures=False)
    ended = resume(folder, Console(quiet=True), workers=workers)
    return ended, time.perf_counter() - begun


def core_seconds() -> float:
    """Return the CPU time (s) of this process and of those that it has waited for."""
    every = (resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))
    return sum(one.ru_utime + one.ru_stime for one in every)


def campaign_of(count: int, where: Path) -> dict[str, float]:
    """Fit so many records, and again when all are done, which leaves only combining them."""
    written(where / "records", count)
    begun = core_seconds()
    ended, first = fitted(where / "records", where / "out")
    used = core_seconds() - begun
    again = fitted(where / "records", where / "out")[1]
    kilobytes = sum(file.stat().st_size for file in (where / "out").rglob("*")) / 1024
    return {
        "records": count,
        "records a minute": 60 * count / first,
        "not converged": sum(row.status == "not converged" for row in ended.rows),
        "refused": sum(row.status == "refused" for row in ended.rows),
        "core s a record": (used - again) / count,
        "s to combine them": again,
        "KiB a record": kilobytes / count,
    }


@click.command()
@click.option("--records", default=1000, show_default=True)
def main(*, records: int) -> None:
    """Measure a campaign, print what it took, and keep it."""
    with tempfile.TemporaryDirectory() as folder:
        figures = campaign_of(records, Path(folder))
    for name, value in figures.items():
        click.echo(f"{name}: {value:.4g}")
    keep("benchmark of a campaign", figures)


if __name__ == "__main__":
    main()
