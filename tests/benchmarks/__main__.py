"""Measure everything and print tables: ``python -m tests.benchmarks``."""

from collections.abc import Callable, Iterator, Mapping

import click
from rich.console import Console

from bwbayes.app.running.workers import one_thread
from tests.benchmarks import models, runs
from tests.benchmarks.campaigns import campaigns
from tests.benchmarks.measuring import Cell, Table
from tests.benchmarks.waits import waits
from tests.measured import keep

Tables = Mapping[str, Table]


def _times(baseline: str) -> Callable[[Tables], float]:
    """Return how many times as fast as a baseline's our effective draws come."""

    def ratio(tables: Tables) -> float:
        rows = [row["moves"] for row in tables["draws"].rows]
        return tables["draws"].number("ours, times", rows.index(baseline))

    return ratio


def _cell(table: str, column: str) -> Callable[[Tables], float]:
    return lambda tables: tables[table].number(column)


def _checks(tables: Tables) -> float:
    run = tables["run"]
    return run.number("checks") / sum(map(run.number, runs.PARTS))


# The figures that tests/README.md quotes.
QUOTED: dict[str, Callable[[Tables], float]] = {
    "effective draws/s, times emcee's defaults on a per-sample NumPy loop": _times("stock"),
    "effective draws/s, times emcee's defaults on our NumPy engine": _times("numpy"),
    "effective draws/s, times emcee's defaults on our compiled engine": _times("numba"),
    "ns per sample and model, compiled engine, one core": _cell("engines", "numba"),
    "speed-up of the likelihood in two threads": _cell("threads", "speed-up"),
    "speed-up of ensembles in two threads": _cell("ensembles", "speed-up"),
    "s from the point fit to convergence with an ESS of 4,000": _cell("run", "s"),
    "part of the time to convergence spent on checks": _checks,
    "CPU s of a calibration replicate of 300 samples": _cell("replicates", "core s"),
}


@click.group(invoke_without_command=True)
@click.option("--quick", is_flag=True, help="Fewer rounds.")
@click.option("--keep", "kept", is_flag=True, help="Store what tests/README.md quotes.")
@click.pass_context
def main(context: click.Context, *, quick: bool, kept: bool) -> None:
    """Measure what the likelihood, the sampling and the inverse cost on this machine."""
    if context.invoked_subcommand is not None:
        return
    console = Console()
    console.width = max(console.width, 110)
    tables: dict[str, Table] = {}
    with one_thread():
        for name, table in _measured(quick=quick):
            table.show(console)
            tables[name] = table
    rows: list[dict[str, Cell]] = [
        {"quoted": name, "measured": of(tables)} for name, of in QUOTED.items()
    ]
    Table("Quoted", "in tests/README.md, of a quiet machine with two cores", rows).show(console)
    if kept:
        keep("benchmarks", {str(r["quoted"]): float(f"{r['measured']:.3g}") for r in rows})
        ratios = {str(row["model"]): row["ratio"] for row in tables["inversion"].rows}
        keep("inverse over simulation", ratios)


main.add_command(waits)
main.add_command(campaigns)


def _measured(*, quick: bool) -> Iterator[tuple[str, Table]]:
    rounds = 2 if quick else 7
    posterior = models.paper_record().study.posterior
    yield "engines", models.engines(posterior, rounds)
    yield "threads", models.threads(posterior, rounds)
    yield from runs.sampling(rounds, 800 if quick else 6000)
    yield "inversion", models.inversion(rounds)
    yield "replicates", runs.replicates(5 if quick else 100)


if __name__ == "__main__":
    main()
