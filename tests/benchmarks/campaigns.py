"""Cost of a campaign of a thousand short records: fits, their folders, and combining them.

``python -m tests.benchmarks campaigns`` draws actuators around those of
``runs/calibration.toml``, writes a record of 300 samples of each into a folder, and lets
``bwbayes campaign`` do with it what it does without pictures, with as many workers as there are
cores.
"""

import tempfile
from functools import partial
from pathlib import Path

import click
import numpy as np
from rich.console import Console

import bwbayes as bw
from bwbayes.app.config.config import load
from bwbayes.app.jobs.campaign import Campaign, config_text, resume, start
from bwbayes.app.study.resolve import resolve_config
from tests.benchmarks.measuring import ROOT, timed
from tests.measured import keep

CONFIG = ROOT / "runs" / "calibration.toml"

# Medians and relative spreads of the population.
POPULATION = {"d": (0.7, 0.05), "alpha": (0.35, 0.1), "beta": (0.03, 0.1), "lag": (0.03, 0.2)}


def written(folder: Path, count: int) -> None:
    folder.mkdir()
    config, source = load(CONFIG), np.random.default_rng(5)
    model = config.stand.model.model_copy(update={"dynamics": "lag"})
    for number in range(count):
        drawn = {
            name: float(median * np.exp(spread * source.standard_normal()))
            for name, (median, spread) in POPULATION.items()
        }
        parts = {"parameters": config.stand.parameters | drawn, "model": model}
        stand = config.stand.model_copy(update=parts)
        one = config.model_copy(update={"seed": number + 1, "stand": stand})
        bw.write_record(
            resolve_config(one, ROOT / "runs").study.record, folder / f"s{number:04d}.csv"
        )


@click.command()
@click.option("--records", default=1000, show_default=True)
def campaigns(*, records: int) -> None:
    """Measure a campaign, and again when all is fitted, which leaves only combining; keep it."""
    ended: list[Campaign] = []

    def campaign(where: Path) -> None:
        text = config_text(CONFIG)
        folder = start(where / "records", text, ROOT / "runs", where / "out", pictures=False)
        ended.append(resume(folder, Console(quiet=True)))

    with tempfile.TemporaryDirectory() as folder:
        where = Path(folder)
        written(where / "records", records)
        first, again = (timed(partial(campaign, where)) for _ in range(2))
        size = sum(file.stat().st_size for file in (where / "out").rglob("*"))
    status = [row.status for row in ended[0].rows]
    figures = {
        "records": records,
        "records a minute": 60 * records / first.wall,
        "not converged": status.count("not converged"),
        "refused": status.count("refused"),
        "core s a record": (first.cpu - again.wall) / records,
        "s to combine them": again.wall,
        "KiB a record": size / 1024 / records,
    }
    for name, value in figures.items():
        click.echo(f"{name}: {value:.4g}")
    keep("benchmark of a campaign", figures)
