"""How long a person waits for what is done ten times a day, against another checkout.

``python -m tests.benchmarks waits --against ../before`` does each thing with this checkout and with
the other one, in turns, each in a process of its own with the checkout's own ``.venv``, and prints
CPU seconds of all its processes and their ratio: the machine may be busy with other things. Each
step opens the run's folder that an earlier one leaves.
"""

import os
import subprocess
import sys
from pathlib import Path
from tempfile import TemporaryDirectory

import click
from rich.console import Console

from tests.benchmarks.measuring import ROOT, Cell, Table

PREAMBLE = """
import os, resource, sys
sys.path.insert(0, "")

def spent():
    return sum(os.times()[:4])

def command(*words):
    from bwbayes.app.commands.cli import main
    sys.argv = ["bwbayes", *words, "--quiet"]
    try:
        main()
    except SystemExit as ended:
        assert ended.code in (0, 3, 4, 5), ended.code

def silence(*words):
    # Seconds for which a command shows nothing new on a terminal, at most.
    import pty, time
    child, screen = pty.fork()
    if not child:
        os.execv(sys.executable, [sys.executable, "-m", "bwbayes", *words])
    longest, before = 0.0, time.monotonic()
    shown = b""
    while True:
        try:
            piece = os.read(screen, 65536)
        except OSError:  # it has ended
            piece = b""
        now = time.monotonic()
        if piece.strip() != shown.strip():
            longest, before, shown = max(longest, now - before), now, piece
        if not piece:
            os.waitpid(child, 0)
            return longest

def few(readings, seeds):
    import numpy as np
    import bwbayes
    for seed in range(seeds):
        rng, t = np.random.default_rng(seed), np.linspace(0, 3, 300)
        u = 75 * np.exp(-t / 4) * np.sin(2 * np.pi * t)
        x = 0.7 * u - bwbayes.hysteresis(u, alpha=0.36, beta=0.027, gamma=0.017).ravel()
        x += 0.3 * np.sin(2.2 * t + seed) + rng.normal(0, 0.1, t.size)
        x[np.setdiff1d(np.arange(300), np.linspace(0, 299, readings).astype(int))] = np.nan
        record = bwbayes.Record.from_arrays(u, x, interval=float(t[1]))
        bwbayes.fit(record, progress=False)

def stand(samples, dynamics="none", **keys):
    import numpy as np
    import bwbayes
    t = np.linspace(0, 20, samples)
    u = 100 * np.exp(-t / 20) * np.sin(2 * np.pi * t)
    noise = np.random.default_rng(1).normal(0, 0.05, samples)
    x = 0.7 * u - bwbayes.hysteresis(u, alpha=0.36, beta=0.027, gamma=0.017).ravel() + noise
    record = bwbayes.Record.from_arrays(u, x, interval=float(t[1]))
    return bwbayes.fit(record, dynamics=dynamics, progress=False, **keys)

def chirp(samples, seconds, fastest):
    import numpy as np
    import bwbayes
    import scipy.signal
    t = np.linspace(0, seconds, samples)
    u = 50 - 50 * np.cos(2 * np.pi * (t + (fastest - 1) * t**2 / (2 * seconds)))
    x = 0.7 * u - bwbayes.hysteresis(u, alpha=0.36, beta=0.027, gamma=0.017).ravel()
    kept = np.exp(-t[1] / 2e-3)
    x = x[0] + scipy.signal.lfilter([0, 1 - kept], [1, -kept], x - x[0])
    x += np.random.default_rng(1).normal(0, 0.05, samples)
    record = bwbayes.Record.from_arrays(u, x, interval=float(t[1]))
    return bwbayes.fit(record, progress=False)

def plan():
    import numpy as np
    import bwbayes
    u = 90 * np.sin(2 * np.pi * 0.7 * np.arange(10_000) / 1000)
    return bwbayes.Record.from_arrays(u, None, interval=1e-3)

out = os.environ["WAITS"]
result = None
"""

RING = 'command("run", "runs/ring_bender.toml", "--out", out + "/{}")'

# A wait: a call before it that is not measured, and the one that is.
WAITS: dict[str, tuple[str, str]] = {
    "first run, everything compiled": ("", RING.format("cold")),
    "run": ("", RING.format("warm")),
    "bwbayes.fit, the name": ("", "import bwbayes; bwbayes.fit"),
    "open_run": ("", "import bwbayes; bwbayes.open_run(out + '/warm')"),
    "open_run and its bands": ("", "import bwbayes; bwbayes.open_run(out + '/warm').bands"),
    "predict 10,000 samples": (
        "import bwbayes; fit = bwbayes.open_run(out + '/warm'); record = plan(); fit.converged",
        "fit.predict(record)",
    ),
    "fit of 20 readings": ("", "stand(20)"),
    "fit of 300 readings": ("", "stand(300)"),
    "six fits of 20 readings, lag and discrepancy": ("", "few(20, 6)"),
    "six fits of 300 readings, lag and discrepancy": ("", "few(300, 6)"),
    "fit with creep": ("", "stand(20_000, creep=True, folder=out + '/creep')"),
    "predict with creep": (
        "import bwbayes; fit = bwbayes.open_run(out + '/creep'); record = plan(); fit.converged",
        "fit.predict(record)",
    ),
    "joint campaign": (
        "",
        'command("run", "runs/ring_bender_campaign.toml", "--out", out + "/joint")',
    ),
    "compare seven models": (
        "",
        'command("compare", "runs/ring_bender.toml", "--out", out + "/models")',
    ),
    "20 replicates of a calibration": (
        "",
        'command("calibrate", "runs/calibration.toml", "--replicates=20", "--out", out + "/c")',
    ),
    "chirp of 30,001 samples": ("", "chirp(30_001, 10, 100)"),
    "chirp of a million samples": ("", "chirp(1_000_000, 100, 10)"),
    "longest silence of a run on a terminal, s": (
        "",
        'result = silence("run", "runs/ring_bender.toml", "--out", out + "/silent")',
    ),
    "longest silence of track on a terminal, s": (
        "",
        'result = silence("track", out + "/warm", "--out", out + "/track")',
    ),
    "memory of a fit of a million samples, GiB": (
        "",
        "stand(1_000_000)\nresult = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20",
    ),
}


def waited(name: str, checkout: Path, folder: Path) -> float | None:
    """Return the CPU seconds (or what the step measures) of a step; None if it fails there."""
    before, measured = WAITS[name]
    python = checkout / ".venv" / "bin" / "python"
    code = (
        f"{PREAMBLE}\n{before}\nbegin = spent()\n{measured}\n"
        "print(spent() - begin if result is None else result)"
    )
    environment = {
        "WAITS": str(folder),
        "NUMBA_CACHE_DIR": str(folder / "numba"),
        "OMP_NUM_THREADS": "1",
    }
    ended = subprocess.run(
        [python if python.exists() else sys.executable, "-W", "ignore", "-c", code],
        cwd=checkout,
        env=os.environ | environment,
        capture_output=True,
        text=True,
        check=False,
    )
    return float(ended.stdout.split()[-1]) if ended.returncode == 0 else None


@click.command()
@click.option("--against", type=click.Path(path_type=Path, file_okay=False, exists=True))
@click.option("--only", multiple=True, help="Part of a step's name; may be given again.")
def waits(*, against: Path | None, only: tuple[str, ...]) -> None:
    """Measure what a person waits for, here and in another checkout."""
    console, rows = Console(), []
    checkouts = [ROOT, *([against.resolve()] if against else [])]
    with TemporaryDirectory() as folder:
        homes = [Path(folder) / str(number) for number in range(len(checkouts))]
        for home in homes:
            home.mkdir()
        for name in WAITS:
            if not only or any(word in name for word in only):
                results = [
                    waited(name, root, home) for root, home in zip(checkouts, homes, strict=True)
                ]
                here, there = results[0], results[1] if len(results) > 1 else None
                ratio = here / there if here is not None and there else None
                rows.append(dict[str, Cell](wait=name, here=here, there=there, ratio=ratio))
                console.print(f"{name}: {results}", highlight=False)
    note = "CPU seconds of all processes, once; `-`: it fails there"
    Table("What a person waits for", note, rows).show(console)
