"""A whole fit of a million samples, from its start to its report, fits into 2 GiB."""

import pytest

from tests.measured import keep
from tests.memory import on_linux, peak

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
"""


@pytest.mark.slow
@on_linux
def test_whole_fit_of_million_samples_takes_two_gibibytes() -> None:
    """To convergence with 400 effective draws: more of them take longer, not more memory."""
    keys = {"dynamics": "lag", "ess": 400}
    whole = peak(SCRIPT.format(samples=1_000_000, keys=keys)) / 2**30
    keep("long fit", {"gib": whole})
    assert whole <= 2
