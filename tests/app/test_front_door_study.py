"""The first minute, to its end: `bwbayes run FILE` on ordinary records and on instruments' files.

200 records of random length, rate, start, drive, size, units and separator are run to their report
with a small budget; none may be refused. Whether such a short sampling converges is not asked here.
"""

import warnings
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from bwbayes.app.commands.cli import cli
from bwbayes.app.config.proposal import draft_config
from bwbayes.app.running.folder import RunFolder
from bwbayes.app.running.run import resume
from bwbayes.app.study.resolve import resolve_config
from bwbayes.errors import InputError, InputWarning
from tests.app import small
from tests.app.test_front_door import SEPARATORS, UNITS, drive, moved, written
from tests.measured import keep
from tests.record.instruments import Written
from tests.record.makers import INSTRUMENTS

RECORDS = 200


def ordinary(folder: Path, number: int) -> Path:
    generator = np.random.default_rng([20261123, number])
    samples = int(np.exp(generator.uniform(np.log(200), np.log(8000))))
    kind = str(generator.choice(["sine", "decaying", "growing", "unipolar", "chirp", "triangle"]))
    voltage = drive(kind, generator.uniform(1.5, 20), np.arange(samples) / samples)
    size = float(np.exp(generator.uniform(np.log(0.01), np.log(10))))
    displacement = size * moved(voltage, generator) + generator.normal(0, 100)
    options: dict[str, Any] = {
        "rate": float(f"{10 ** generator.uniform(0, 5):.4g}"),
        "start": float(generator.choice([0.0, -1.5, 12.5, 3600.0, 1.7e9])),
        "units": tuple(str(generator.choice(list(table))) for table in UNITS.values()),
        "separator": str(generator.choice(SEPARATORS)),
    }
    return written(folder / f"record_{number}.csv", voltage, displacement, **options)


def ended(path: Path, folder: Path) -> str:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", InputWarning)
        config = draft_config(path, path.parent).config
        begun = RunFolder.create(folder / path.stem, resolve_config(config, path.parent))
        result = resume(begun, small.quiet(), workers=1, ess=100, steps=300)
    assert (begun.path / "report.html").is_file()
    return result.standing.status if result.outcome.converged else "not converged"


@pytest.mark.slow
def test_no_ordinary_record_is_refused(tmp_path: Path) -> None:
    counts: Counter[str] = Counter()
    refused = []
    for number in range(RECORDS):
        try:
            counts[ended(ordinary(tmp_path, number), tmp_path / "runs")] += 1
        except InputError as error:
            refused.append(f"{number}: {error}")
        print(number, dict(counts), refused[-1:], flush=True)
    keep("ordinary records", {"records": RECORDS, "refused": refused, **counts})
    assert not refused


def arguments(written: Written) -> list[str]:
    path, columns, units, fs = written
    said = [f"--column={name}={value}" for name, value in columns.items()]
    said += [f"--unit={name}={value}" for name, value in units.items()]
    return [str(path), *said, *([] if fs is None else [f"--fs={fs}"])]


@pytest.mark.slow
@pytest.mark.parametrize("name", INSTRUMENTS)
def test_no_file_of_an_instrument_is_refused(tmp_path: Path, name: str) -> None:
    given = arguments(INSTRUMENTS[name](tmp_path))
    run = ["run", *given, "--out", str(tmp_path / "run"), "--workers", "1", "--quiet"]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", InputWarning)
        assert cli.main(run, standalone_mode=False) in {0, 3, 4, 5}
    assert (tmp_path / "run/report.html").is_file()
