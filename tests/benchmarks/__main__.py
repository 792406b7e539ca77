"""Measure everything, print tables, and write them as JSON: ``python -m tests.benchmarks``."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import click
from rich.console import Console

from bwbayes.app.running.workers import one_thread
from tests.benchmarks import effective, likelihood
from tests.benchmarks.cases import CREEPING, FULL, QUICK, Effort, problem
from tests.benchmarks.control import inversion
from tests.benchmarks.replicates import replicates
from tests.benchmarks.startup import startup
from tests.benchmarks.tables import Cell, Table, machine, printed, written
from tests.benchmarks.waits import waits
from tests.measured import keep

# Name, sign and number of each target; what each came to is in `_reached`.
TARGETS: tuple[tuple[str, str, float], ...] = (
    ("effective draws/s, times emcee's defaults on a per-sample NumPy loop", ">=", 300),
    ("effective draws/s, times emcee's defaults on our NumPy engine", ">=", 100),
    ("effective draws/s, times emcee's defaults on our compiled engine", ">=", 12),
    ("ns per sample and model, compiled engine, one core", "<=", 3),
    ("plays, Preisach, Duhem, or gain and four creep lags, times Bouc-Wen", "<=", 3),
    ("speed-up of the likelihood in two threads", ">=", 1.8),
    ("speed-up of ensembles in two threads", ">=", 1.8),
    ("s from the point fit to convergence with an ESS of 4,000", "<=", 10),
    ("part of the time to convergence spent on checks", "<=", 0.05),
    ("CPU s of a calibration replicate of 300 samples", "<=", 0.8),
)

# Parts that are held against Bouc-Wen; plays are ten.
COMPARED = ("plays", "preisach", "duhem", CREEPING)

# Columns of the screen that the widest table takes.
WIDTH = 110


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
    console.width = max(console.width, WIDTH)
    before, tables = machine(), []
    with one_thread():
        for table in _measured(QUICK if quick else FULL):
            printed(table, console)
            tables.append(table)
    tables.append(_targets({table.name: table for table in tables}))
    printed(tables[-1], console)
    written(tables, before | {"load_after": machine()["load"], "quick": quick}, out)
    if kept:
        quoted = {str(row["target"]): float(f"{row['measured']:.3g}") for row in tables[-1].rows}
        keep("benchmarks", quoted)
        (inverse,) = (table for table in tables if table.name == "inversion")
        keep("inverse over simulation", {str(row["model"]): row["ratio"] for row in inverse.rows})
    console.print(f"{out}: {before['processor']}, load {before['load']} before it began")


main.add_command(waits)


def _measured(effort: Effort) -> Iterator[Table]:
    posterior = problem("numba").posterior
    yield likelihood.engines(posterior, effort)
    yield likelihood.parts(posterior, effort)
    yield likelihood.threads(posterior, effort)
    yield from effective.sampling(effort)
    yield inversion(effort)
    yield startup(effort)
    yield replicates(effort)


def _targets(tables: dict[str, Table]) -> Table:
    rows: list[dict[str, Cell]] = []
    for (name, sign, required), result in zip(TARGETS, _reached(tables), strict=True):
        met = result >= required if sign == ">=" else result <= required
        rows.append(
            {"target": name, "required": f"{sign} {required:g}", "measured": result, "met": met}
        )
    return Table("targets", "Targets", "for a quiet machine with two cores", rows)


def _reached(tables: dict[str, Table]) -> Iterator[float]:
    """Pick what the targets are about, in their order."""
    rate = {row["moves"]: _number(row["draws/s"]) for row in _rows(tables, "effective_draws")}
    yield from (rate["ours"] / rate[name] for name in ("stock", "numpy", "numba"))
    yield _number(_rows(tables, "engines")[0]["numba"])
    cost = {str(row["model"]): _number(row["ns"]) for row in _rows(tables, "parts")}
    yield max(
        cost[f"{name}, {start}"] / cost[f"bouc-wen, {start}"]
        for name in COMPARED
        for start in likelihood.STARTS
    )
    yield _number(_rows(tables, "threads")[0]["speed-up"])
    yield _number(_rows(tables, "ensemble_threads")[0]["speed-up"])
    (run,) = _rows(tables, "runs")
    yield _number(run["s"])
    yield _number(run["checks"]) / sum(_number(run[part]) for part in effective.PARTS)
    yield _number(_rows(tables, "replicates")[0]["core s"])


def _rows(tables: dict[str, Table], name: str) -> list[dict[str, Cell]]:
    return list(tables[name].rows)


def _number(cell: Cell) -> float:
    assert isinstance(cell, int | float)
    return float(cell)


if __name__ == "__main__":
    main()
