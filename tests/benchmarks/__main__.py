"""Measure everything, print tables, and write them as JSON: ``python -m tests.benchmarks``."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path

import click
import numpy as np
from rich.console import Console

from bwbayes.app.config.config import load
from bwbayes.app.jobs.calibrate import experiment
from bwbayes.app.problem.problem import resolve
from bwbayes.app.running.workers import one_thread
from bwbayes.calibration.replicates import replicate
from tests.benchmarks import effective, likelihood
from tests.benchmarks.cases import CREEPING, FULL, QUICK, ROOT, Effort, problem
from tests.benchmarks.control import inversion
from tests.benchmarks.measuring import Cell, Table, machine, write
from tests.benchmarks.startup import startup
from tests.benchmarks.waits import waits
from tests.measured import keep

Tables = Mapping[str, Table]


def _rate(tables: Tables, baseline: str) -> float:
    rates = {str(row["moves"]): row["draws/s"] for row in tables["effective_draws"].rows}
    return float(rates["ours"] or 0) / float(rates[baseline] or 1)


def _dearest_part(tables: Tables) -> float:
    """Return the cost of the dearest of some parts, over Bouc-Wen's; plays are ten."""
    table = tables["parts"]
    cost = {str(row["model"]): table.number("ns", i) for i, row in enumerate(table.rows)}
    return max(
        cost[f"{name}, {start}"] / cost[f"bouc-wen, {start}"]
        for name in ("plays", "preisach", "duhem", CREEPING)
        for start in likelihood.STARTS
    )


def _checks(tables: Tables) -> float:
    runs = tables["runs"]
    return runs.number("checks") / sum(map(runs.number, effective.PARTS))


# Name, sign and number of each target, and what it came to.
TARGETS: tuple[tuple[str, str, float, Callable[[Tables], float]], ...] = (
    (
        "effective draws/s, times emcee's defaults on a per-sample NumPy loop",
        ">=",
        300,
        lambda tables: _rate(tables, "stock"),
    ),
    (
        "effective draws/s, times emcee's defaults on our NumPy engine",
        ">=",
        100,
        lambda tables: _rate(tables, "numpy"),
    ),
    (
        "effective draws/s, times emcee's defaults on our compiled engine",
        ">=",
        12,
        lambda tables: _rate(tables, "numba"),
    ),
    (
        "ns per sample and model, compiled engine, one core",
        "<=",
        3,
        lambda tables: tables["engines"].number("numba"),
    ),
    (
        "plays, Preisach, Duhem, or gain and four creep lags, times Bouc-Wen",
        "<=",
        3,
        _dearest_part,
    ),
    (
        "speed-up of the likelihood in two threads",
        ">=",
        1.8,
        lambda tables: tables["threads"].number("speed-up"),
    ),
    (
        "speed-up of ensembles in two threads",
        ">=",
        1.8,
        lambda tables: tables["ensemble_threads"].number("speed-up"),
    ),
    (
        "s from the point fit to convergence with an ESS of 4,000",
        "<=",
        10,
        lambda tables: tables["runs"].number("s"),
    ),
    ("part of the time to convergence spent on checks", "<=", 0.05, _checks),
    (
        "CPU s of a calibration replicate of 300 samples",
        "<=",
        0.8,
        lambda tables: tables["replicates"].number("core s"),
    ),
)


@click.group(invoke_without_command=True)
@click.option("--quick", is_flag=True, help="Fewer rounds, no NumPy run.")
@click.option(
    "--out",
    type=click.Path(path_type=Path, dir_okay=False),
    default=Path("benchmarks.json"),
    show_default=True,
    help="Where the figures go.",
)
@click.option("--keep", "kept", is_flag=True, help="Store what tests/README.md quotes.")
@click.pass_context
def main(context: click.Context, *, quick: bool, out: Path, kept: bool) -> None:
    """Measure what the likelihood, the sampling and a start cost on this machine."""
    if context.invoked_subcommand is not None:
        return
    console = Console()
    console.width = max(console.width, 110)
    before = machine()
    tables: dict[str, Table] = {}
    with one_thread():
        for table in _measured(QUICK if quick else FULL):
            table.show(console)
            tables[table.name] = table
    rows: list[dict[str, Cell]] = []
    for name, sign, required, reached in TARGETS:
        result = reached(tables)
        met = result >= required if sign == ">=" else result <= required
        rows.append(
            {"target": name, "required": f"{sign} {required:g}", "measured": result, "met": met}
        )
    targets = Table("targets", "Targets", "for a quiet machine with two cores", rows)
    targets.show(console)
    about = before | {"load_after": machine()["load"], "quick": quick}
    write([*tables.values(), targets], about, out)
    if kept:
        keep("benchmarks", {str(r["target"]): float(f"{r['measured']:.3g}") for r in rows})
        ratios = {str(row["model"]): row["ratio"] for row in tables["inversion"].rows}
        keep("inverse over simulation", ratios)
    console.print(f"{out}: {before['platform']}, load {before['load']} before it began")


main.add_command(waits)


def _measured(effort: Effort) -> Iterator[Table]:
    posterior = problem("numba").posterior
    yield likelihood.engines(posterior, effort)
    yield likelihood.parts(posterior, effort)
    yield likelihood.threads(posterior, effort)
    yield from effective.sampling(effort)
    yield inversion(effort)
    yield startup(effort)
    yield replicates(100 if effort.everything else 5)


def replicates(count: int) -> Table:
    """Measure replicates of ``runs/calibration.toml``: records so short that Python counts."""
    common = experiment(resolve(load(ROOT / "runs" / "calibration.toml"), ROOT))
    costs = []
    for number in range(count + 1):
        begun = time.process_time()
        replicate(common, 1, number)
        costs.append(time.process_time() - begun)
    # The first one loads what is compiled.
    low, middle, high = np.quantile(costs[1:], [0.05, 0.5, 0.95]).tolist()
    row: dict[str, Cell] = {"replicates": count, "core s": middle, "from": low, "to": high}
    note = "CPU s, one thread; median, and from the fifth to the ninety-fifth per cent"
    return Table("replicates", "A calibration replicate of 300 samples", note, [row])


if __name__ == "__main__":
    main()
