"""Chains that must never count as converged, each broken in one way; and how a good one is made.

All are made from autoregressive walkers whose draws are good: standard normal, with an
autocorrelation time of three steps. So what a test finds missing is what was broken.
"""

import numpy as np

from bwbayes.arrays import FloatArray, IntArray
from tests.stand import autoregressive

STEPS, ENSEMBLES, WALKERS, FREE = 600, 4, 18, 2
BLOCK = 50


def good(
    generator: np.random.Generator, *, kept: float = 0.5, walkers: int = WALKERS
) -> FloatArray:
    """Return good draws (steps, ensembles, walkers, free)."""
    return autoregressive(kept, STEPS, (ENSEMBLES, walkers, FREE), generator)


def moved(draws: FloatArray) -> IntArray:
    """Count the moves (blocks, ensembles, walkers) that draws show."""
    changes = np.any(np.diff(draws, axis=0, prepend=draws[:1]) != 0, axis=-1)
    moves: IntArray = changes.reshape(-1, BLOCK, *changes.shape[1:]).sum(axis=1)
    return moves


HARD = (
    "one block", "two blocks", "stuck walker of 256", "walker stuck from the middle on",
    "stuck ensemble", "clusters that never move", "common cloud that never moves",
    "common cloud that trembles", "heavy autocorrelation", "random walks", "drift of all",
    "drift of one parameter in one ensemble", "late arrival", "slow wave",
    "one ensemble in another mode", "ensembles in two modes", "modes of different weight",
    "modes of equal weight", "one ensemble of another width", "walkers on one path",
    "constant parameter",
)  # fmt: skip


def hard(kind: str, generator: np.random.Generator) -> FloatArray:
    """Return draws (steps, ensembles, walkers, free) that are broken in one way."""
    # Many walkers hide from R-hat what one of them, or none, does.
    crowd = kind in ("stuck walker of 256", "walker stuck from the middle on") or "tremble" in kind
    kept = 0.995 if kind == "heavy autocorrelation" else 0.5
    draws = good(generator, kept=kept, walkers=64 if crowd else WALKERS)
    ramp = np.linspace(-1, 1, STEPS)[:, np.newaxis, np.newaxis]
    third, cloud = STEPS // 3, generator.standard_normal(draws.shape[1:])
    match kind:
        case "one block":
            draws = draws[:BLOCK]
        case "two blocks":
            draws = draws[: 2 * BLOCK]
        case "stuck walker of 256":
            draws[:, 1, 7] = 0.3
        case "walker stuck from the middle on":
            draws[STEPS // 2 :, 2, 11] = draws[STEPS // 2, 2, 11]
        case "stuck ensemble":
            draws[:, 3] = draws[0, 3]
        case "clusters that never move":
            draws[:] = 3 * generator.standard_normal((ENSEMBLES, 1, FREE)) + 0.2 * cloud
        case "common cloud that never moves":
            draws[:] = cloud
        case "common cloud that trembles":  # every move is accepted, and nobody gets anywhere
            draws = cloud + 0.01 * draws
        case "random walks":
            draws = np.cumsum(generator.standard_normal(draws.shape), axis=0) / np.sqrt(STEPS)
        case "drift of all":
            draws += 0.6 * ramp[..., np.newaxis]
        case "drift of one parameter in one ensemble":
            draws[:, 0, :, 0] += 1.5 * ramp[:, 0]
        case "late arrival":  # of one ensemble, after a third of the steps
            draws[:third, 2] += 4 * np.linspace(1, 0, third)[:, np.newaxis, np.newaxis]
        case "slow wave":  # all go up and down together, so that ensembles and halves agree
            draws += np.sin(2 * np.pi * ramp[..., np.newaxis])
        case "one ensemble in another mode":
            draws[:, 1] += 6
        case "ensembles in two modes":
            draws[:, ::2] += 6
        case "modes of different weight":  # each has walkers in both, none of which ever changes
            for ensemble, share in enumerate((3, 6, 9, 12)):
                draws[:, ensemble, :share] += 6
        case "modes of equal weight":  # in every ensemble, so that ensembles and halves agree
            draws[:, :, ::2] += 6
        case "one ensemble of another width":
            draws[:, 2] *= 3
        case "walkers on one path":
            draws = autoregressive(0.9, STEPS, (ENSEMBLES, 1, FREE), generator) + 0.01 * draws
        case "constant parameter":
            draws[..., 0] = 0.5
    return draws
