"""A whole fit of a million samples, from its start to its report, fits into 2 GiB."""

from __future__ import annotations

import subprocess
import sys
from typing import NamedTuple

import pytest

from tests.measured import keep

GIB = 2**30
MILLION = 1_000_000

# All that a run does: point fit, sampling, bands, scores, replicated records, figures, report.
SCRIPT = """
import warnings
from pathlib import Path
from tempfile import TemporaryDirectory
import numpy as np
import bwbayes as bw

samples, keys = {samples}, {keys}
time = np.arange(samples) / 1000
decay = 1 - 0.9 * np.arange(samples) / samples
stand = bw.VirtualTestStand()
record = stand.run(100 * np.sin(2 * np.pi * time) * decay, np.random.default_rng(1))
warnings.simplefilter("ignore")
with TemporaryDirectory() as folder:
    run = Path(folder) / "run"
    edge = 0.75 * samples / 1000
    fit = bw.fit(
        record, folder=run, progress=False, workers=2, from_rest=True, train=(0, edge),
        validation={{"later": (edge, samples / 1000)}}, **keys,
    )
    assert fit.converged, fit.outcome.stop_reason
    assert fit.chain.ends[0].coordinates.shape[0] == 64
    assert (run / "report.html").is_file() and (run / "bands.csv").stat().st_size > 100 * samples
# Not ru_maxrss, which a process takes over from the one that starts it.
status = dict(line.split(":", 1) for line in Path("/proc/self/status").read_text().splitlines())
print(int(status["VmHWM"].split()[0]) * 1024)
"""


class Fitted(NamedTuple):
    """A fit of so many samples, and the largest memory of its process, bytes."""

    samples: int
    peak: int


def fitted(samples: int, **keys: object) -> Fitted:
    """Fit a record in a process of its own, write its files, and return its largest memory."""
    script = SCRIPT.format(samples=samples, keys=keys)
    done = subprocess.run([sys.executable, "-c", script], stdout=subprocess.PIPE, check=True)
    return Fitted(samples, int(done.stdout))


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="reads Linux's /proc")
def test_whole_fit_of_million_samples_takes_two_gibibytes() -> None:
    """To convergence with 400 effective draws: more of them take longer, not more memory."""
    whole = fitted(MILLION, dynamics="lag", ess=400)
    keep("long fit", {"gib": whole.peak / GIB})
    assert whole.peak <= 2 * GIB
