"""Make the reference posteriors: nested sampling of the plain posterior, by dynesty.

From the repository's root, ``python -m tests.reference.make virtual measured measured_evidence``.
It needs dynesty and numba, which the package and its tests do not; numba compiles the plain loops.
Independent runs of dynamic nested sampling, aimed at the posterior, are pooled. It takes five and
ten minutes on one core.
"""

import hashlib
import json
import math
import sys
from collections.abc import Callable
from importlib import import_module
from importlib.metadata import version
from itertools import starmap
from types import MappingProxyType
from typing import Any

import numpy as np
from scipy.special import ndtri

from tests.reference.plain import (
    FOLDER,
    PLAIN,
    Case,
    Floats,
    Loops,
    inside,
    load_case,
    log_likelihood,
)

# The measured record leaves the discrepancy's time a long tail, which takes more.
RUNS = MappingProxyType({"virtual": 2, "measured": 4})
LIVE = 500
WALKS = 60
# For each run.
EFFECTIVE = 10_000
MOST_CALLS = 12_000_000


def compiled() -> Loops:
    compiler: Callable[[Any], Any] = import_module("numba").njit
    return Loops(*(compiler(loop) for loop in (PLAIN.hysteresis, PLAIN.dynamics, PLAIN.kalman)))


def from_cube(case: Case, cube: Floats) -> Floats:
    """Map a point of the unit cube (free,) to independent draws from the priors (free,)."""

    def quantile(p: float, distribution: str, arguments: tuple[float, ...]) -> float:
        match distribution:
            case "normal":
                return arguments[0] + arguments[1] * float(ndtri(p))
            case "lognormal":
                return arguments[0] * math.exp(arguments[1] * float(ndtri(p)))
        assert distribution == "halfnormal"
        return arguments[0] * float(ndtri((1 + p) / 2))

    rows = ((p, *case.priors[name]) for p, name in zip(cube.tolist(), case.free, strict=True))
    return np.array(list(starmap(quantile, rows)))


def nested(case: Case, seed: int, *, aim: str = "posterior") -> Any:
    """Run dynesty once, aimed at the posterior or at its integral, the evidence.

    The physical constraints are where the likelihood is zero. For the evidence, slices along random
    directions keep to the shell however narrow the ridge.
    """
    loops, dynesty = compiled(), import_module("dynesty")

    def likelihood(free: Floats) -> float:
        theta = {**case.fixed, **dict(zip(case.free, free.tolist(), strict=True))}
        return log_likelihood(case, theta, loops) if inside(theta) else -math.inf

    problem = likelihood, lambda cube: from_cube(case, cube), len(case.free)
    rng, shown = np.random.default_rng(seed), sys.stderr.isatty()
    if aim == "evidence":
        sampler = dynesty.NestedSampler(*problem, nlive=2 * LIVE, sample="rslice", rstate=rng)
        sampler.run_nested(dlogz=0.02, print_progress=shown)
    else:
        sampler = dynesty.DynamicNestedSampler(
            *problem, nlive=LIVE, sample="rwalk", walks=WALKS, rstate=rng
        )
        sampler.run_nested(
            wt_kwargs={"pfrac": 1.0},
            n_effective=EFFECTIVE,
            maxcall=MOST_CALLS,
            print_progress=shown,
        )
    return sampler.results


def statistics(draws: Floats, weights: Floats) -> dict[str, Floats]:
    """Return mean, sd and quantiles, (free,) each, of draws (draws, free) with weights (draws,)."""
    mean = np.average(draws, axis=0, weights=weights)
    outcome = {
        "mean": mean,
        "sd": np.sqrt(np.average((draws - mean) ** 2, axis=0, weights=weights)),
    }
    for level in (5, 50, 95):
        outcome[f"quantile_{level}"] = np.array(
            [
                np.quantile(column, level / 100, weights=weights, method="inverted_cdf")
                for column in draws.T
            ]
        )
    return outcome


def digest(case: Case) -> str:
    """Hash of what a posterior depends on: the samples that enter, the model, the priors."""
    said = (
        case.interval,
        [(part.start, part.stop) for part in case.training],
        (case.dynamics, case.hold, case.names),
        sorted(case.priors.items()),
        sorted(case.fixed.items()),
    )
    data = case.voltage.tobytes() + case.displacement.tobytes()
    return hashlib.sha256(data + repr(said).encode()).hexdigest()


def reference(name: str) -> dict[str, object]:
    """Make one reference, or with ``_evidence`` one of the evidence by four runs aimed at it."""
    evidence = name.endswith("_evidence")
    case = load_case(FOLDER / f"{name.removesuffix('_evidence')}.toml")
    aim, count = ("evidence", 4) if evidence else ("posterior", RUNS[name])
    runs = [nested(case, seed, aim=aim) for seed in range(1, count + 1)]
    made: dict[str, object] = {
        "digest": digest(case),
        "versions": {p: version(p) for p in ("numpy", "scipy", "numba", "dynesty")},
        "log_evidence": [float(run.logz[-1]) for run in runs],
        "log_evidence_error": [float(run.logzerr[-1]) for run in runs],
    }
    if evidence:
        return made
    weights = [run.importance_weights() for run in runs]
    # Each run counts the same.
    pooled = np.concatenate([w / (count * w.sum()) for w in weights])
    result = statistics(np.concatenate([run.samples for run in runs]), pooled)
    parameters = {
        parameter: {key: float(values[i]) for key, values in result.items()}
        for i, parameter in enumerate(case.free)
    }
    return made | {"ess": float(1 / np.sum(pooled**2)), "parameters": parameters}


def main(names: list[str]) -> None:
    """Make the named references and write them beside this file."""
    for name in names:
        made = reference(name).items()
        lines = ",\n".join(f"{json.dumps(key)}: {json.dumps(value)}" for key, value in made)
        (FOLDER / f"{name}.json").write_text(f"{{\n{lines}\n}}\n", encoding="utf-8")


if __name__ == "__main__":
    main(sys.argv[1:])
