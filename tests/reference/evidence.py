"""Make the reference evidences: nested sampling of the plain posterior, aimed at its integral.

From the repository's root, ``python -m tests.reference.evidence virtual measured``; it needs what
``tests.reference.make`` needs. Slices along random directions keep to the shell however narrow the
ridge; the spread of independent runs is the error. Some minutes a run on one core.
"""

from __future__ import annotations

import json
import math
import sys
from importlib import import_module
from importlib.metadata import version
from pathlib import Path

import numpy as np

from tests.reference.make import compiled, digest, from_cube
from tests.reference.plain import FOLDER, Case, Floats, inside, load_case, log_likelihood

LIVE, RUNS = 1000, 4


def nested(case: Case, seed: int) -> tuple[float, float]:
    """Run dynesty once: log evidence, and the error that it states."""
    loops = compiled()

    def likelihood(free: Floats) -> float:
        theta = {**case.fixed, **dict(zip(case.free, free.tolist(), strict=True))}
        return log_likelihood(case, theta, loops) if inside(theta) else -math.inf

    sampler = import_module("dynesty").NestedSampler(
        likelihood,
        lambda cube: from_cube(case, cube),
        len(case.free),
        nlive=LIVE,
        sample="rslice",
        rstate=np.random.default_rng(seed),
    )
    sampler.run_nested(dlogz=0.02, print_progress=False)
    return float(sampler.results.logz[-1]), float(sampler.results.logzerr[-1])


def main(paths: list[str]) -> None:
    """Make the references of the named cases (or configs) and write them beside this file."""
    for path in paths:
        given = Path(path) if path.endswith(".toml") else FOLDER / f"{path}.toml"
        case = load_case(given)
        runs = []
        for seed in range(1, RUNS + 1):
            runs.append(nested(case, seed))
            said = {
                "digest": digest(case),
                "versions": {p: version(p) for p in ("numpy", "scipy", "numba", "dynesty")},
                "live_points": LIVE,
                "log_evidence": [one[0] for one in runs],
                "log_evidence_error": [one[1] for one in runs],
            }
            text = json.dumps(said, indent=2) + "\n"
            (FOLDER / f"{given.stem}_evidence.json").write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main(sys.argv[1:])
