"""Chains that must never count as converged, each broken in one way; and how a good one is made.

All are made from autoregressive walkers whose draws are good: standard normal, with an
autocorrelation time of three steps. So what a test finds missing is what was broken.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from types import MappingProxyType

import numpy as np

from bwbayes.arrays import FloatArray, IntArray

STEPS, ENSEMBLES, WALKERS, FREE = 600, 4, 18, 2
BLOCK = 50

Generator = np.random.Generator


def autoregressive(
    kept: float, steps: int, shape: tuple[int, ...], generator: Generator
) -> FloatArray:
    """Draw stationary AR(1) series (steps, *shape) of unit variance."""
    draws = np.empty((steps, *shape))
    draws[0] = generator.standard_normal(shape)
    for step in range(1, steps):
        shocks = generator.standard_normal(shape)
        draws[step] = kept * draws[step - 1] + np.sqrt(1 - kept**2) * shocks
    return draws


def good(
    generator: Generator, free: int = FREE, *, kept: float = 0.5, walkers: int = WALKERS
) -> FloatArray:
    """Return good draws (steps, ensembles, walkers, free)."""
    return autoregressive(kept, STEPS, (ENSEMBLES, walkers, free), generator)


def moved(draws: FloatArray) -> IntArray:
    """Count the moves (blocks, ensembles, walkers) that draws show."""
    changes = np.any(np.diff(draws, axis=0, prepend=draws[:1]) != 0, axis=-1)
    moves: IntArray = changes.reshape(-1, BLOCK, *changes.shape[1:]).sum(axis=1)
    return moves


def ramp() -> FloatArray:
    """Rise from -1 to 1 over the chain, (steps, 1, 1, 1)."""
    return np.linspace(-1, 1, STEPS)[:, np.newaxis, np.newaxis, np.newaxis]


def one_block(generator: Generator, free: int) -> FloatArray:
    return good(generator, free)[:BLOCK]


def two_blocks(generator: Generator, free: int) -> FloatArray:
    return good(generator, free)[: 2 * BLOCK]


def stuck_walker_of_256(generator: Generator, free: int) -> FloatArray:
    draws = good(generator, free, walkers=64)
    draws[:, 1, 7] = 0.3
    return draws


def walker_stuck_from_the_middle_on(generator: Generator, free: int) -> FloatArray:
    draws = good(generator, free, walkers=64)
    draws[STEPS // 2 :, 2, 11] = draws[STEPS // 2, 2, 11]
    return draws


def stuck_ensemble(generator: Generator, free: int) -> FloatArray:
    draws = good(generator, free)
    draws[:, 3] = draws[0, 3]
    return draws


def clusters_that_never_move(generator: Generator, free: int) -> FloatArray:
    far = 3 * generator.standard_normal((ENSEMBLES, 1, free))
    clusters = far + 0.2 * generator.standard_normal((ENSEMBLES, WALKERS, free))
    return np.tile(clusters, (STEPS, 1, 1, 1))


def common_cloud_that_never_moves(generator: Generator, free: int) -> FloatArray:
    cloud = generator.standard_normal((ENSEMBLES, WALKERS, free))
    return np.tile(cloud, (STEPS, 1, 1, 1))


def common_cloud_that_trembles(generator: Generator, free: int) -> FloatArray:
    """Every move is accepted, and nobody gets anywhere; many walkers hide it from R-hat."""
    cloud = generator.standard_normal((ENSEMBLES, 64, free))
    return cloud + 0.01 * good(generator, free, walkers=64)


def heavy_autocorrelation(generator: Generator, free: int) -> FloatArray:
    return good(generator, free, kept=0.995)


def random_walks(generator: Generator, free: int) -> FloatArray:
    steps = generator.standard_normal((STEPS, ENSEMBLES, WALKERS, free))
    walk: FloatArray = np.cumsum(steps, axis=0) / np.sqrt(STEPS)
    return walk


def drift_of_all(generator: Generator, free: int) -> FloatArray:
    return good(generator, free) + 0.6 * ramp()


def drift_of_one_parameter_in_one_ensemble(generator: Generator, free: int) -> FloatArray:
    draws = good(generator, free)
    draws[:, 0, :, 0] += 1.5 * ramp()[:, 0, :, 0]
    return draws


def late_arrival(generator: Generator, free: int) -> FloatArray:
    """One ensemble comes to the posterior only after a third of the steps."""
    draws = good(generator, free)
    draws[: STEPS // 3, 2] += 4 * np.linspace(1, 0, STEPS // 3)[:, np.newaxis, np.newaxis]
    return draws


def slow_wave(generator: Generator, free: int) -> FloatArray:
    """All go up and down together, so that ensembles and halves agree."""
    return good(generator, free) + np.sin(2 * np.pi * ramp())


def one_ensemble_in_another_mode(generator: Generator, free: int) -> FloatArray:
    draws = good(generator, free)
    draws[:, 1] += 6
    return draws


def ensembles_in_two_modes(generator: Generator, free: int) -> FloatArray:
    draws = good(generator, free)
    draws[:, ::2] += 6
    return draws


def modes_of_different_weight(generator: Generator, free: int) -> FloatArray:
    """Each ensemble has walkers in both modes, none of which ever changes."""
    draws = good(generator, free)
    for ensemble, share in enumerate((3, 6, 9, 12)):
        draws[:, ensemble, :share] += 6
    return draws


def modes_of_equal_weight(generator: Generator, free: int) -> FloatArray:
    """As many walkers in either mode of every ensemble, so that ensembles and halves agree."""
    draws = good(generator, free)
    draws[:, :, ::2] += 6
    return draws


def one_ensemble_of_another_width(generator: Generator, free: int) -> FloatArray:
    draws = good(generator, free)
    draws[:, 2] *= 3
    return draws


def walkers_on_one_path(generator: Generator, free: int) -> FloatArray:
    path = autoregressive(0.9, STEPS, (ENSEMBLES, 1, free), generator)
    return path + 0.01 * good(generator, free)


def constant_parameter(generator: Generator, free: int) -> FloatArray:
    draws = good(generator, free)
    draws[..., 0] = 0.5
    return draws


HARD: Mapping[str, Callable[[Generator, int], FloatArray]] = MappingProxyType(
    {
        case.__name__.replace("_", " "): case
        for case in (
            one_block,
            two_blocks,
            stuck_walker_of_256,
            walker_stuck_from_the_middle_on,
            stuck_ensemble,
            clusters_that_never_move,
            common_cloud_that_never_moves,
            common_cloud_that_trembles,
            heavy_autocorrelation,
            random_walks,
            drift_of_all,
            drift_of_one_parameter_in_one_ensemble,
            late_arrival,
            slow_wave,
            one_ensemble_in_another_mode,
            ensembles_in_two_modes,
            modes_of_different_weight,
            modes_of_equal_weight,
            one_ensemble_of_another_width,
            walkers_on_one_path,
            constant_parameter,
        )
    }
)
