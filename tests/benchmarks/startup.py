"""How long a start takes: in a process of its own, from the interpreter to what is named."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory

from bwbayes.app.config.config import dump
from tests.benchmarks.cases import ROOT, Effort, config
from tests.benchmarks.measuring import Cell, Table, interleaved, timed

MAIN = "import sys; from bwbayes.app.commands.cli import main; sys.argv[0] = 'bwbayes'; main()"

# One model through all that is compiled.
COMPILED = """
import numpy as np
from bwbayes.inference.likelihood import Likelihood
from bwbayes.inference.noise import DiscrepancyNoise
from bwbayes.inference.readings import Readings
from bwbayes.model.actuator import Actuator
record = np.sin(np.arange(9.0))
readings = Readings.of(record, [slice(0, 9)])
parts = Actuator("lag", "first", 1e-3), DiscrepancyNoise(1e-3)
likelihood = Likelihood(record, readings, *parts, "numba", True, 1.0, 1.0)
likelihood.log_density(np.ones((1, len(likelihood.table.names))))
"""

STARTS: Mapping[str, list[str]] = {
    "python alone": ["-c", ""],
    "import numpy": ["-c", "import numpy"],
    "import numpy, scipy.signal, emcee": ["-c", "import numpy, scipy.signal, emcee"],
    "import bwbayes": ["-c", "import bwbayes"],
    "bwbayes --help": ["-c", MAIN, "--help"],
    "import all of a run": ["-c", "import bwbayes.app.running.run"],
    "import and load the compiled engine": ["-c", COMPILED],
}


def started(arguments: list[str], **environment: str) -> Callable[[], object]:
    """Return a call that runs Python with these arguments from the checkout."""
    return partial(
        subprocess.run,
        [sys.executable, *arguments],
        cwd=ROOT,
        env=os.environ | environment,
        capture_output=True,
        check=True,
    )


def startup(effort: Effort) -> Table:
    """Measure starts, and with everything the first of all, which compiles, and a whole command."""
    for arguments in STARTS.values():
        started(arguments)()  # caches: Python's, numba's and the system's
    calls = {name: started(arguments) for name, arguments in STARTS.items()}
    cost = interleaved(calls, effort.rounds)
    if effort.everything:
        with TemporaryDirectory() as folder:
            first = started(["-c", COMPILED], NUMBA_CACHE_DIR=folder)
            cost["compile the engine, once"] = timed(first)
            cost["bwbayes run, all of it"] = timed(started(_run(Path(folder))))
    rows: list[dict[str, Cell]] = [
        {"start": name, "s": result.wall, "core s": result.cpu} for name, result in cost.items()
    ]
    note = "a process each, best of several; compiling and the whole run are measured once"
    return Table("startup", "Start-up", note, rows)


def _run(folder: Path) -> list[str]:
    file = folder / "ring_bender.toml"
    file.write_text(dump(config()), encoding="utf-8")
    return ["-c", MAIN, "run", str(file), "--out", str(folder / "out"), "--quiet"]
