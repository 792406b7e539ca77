"""Derivatives in the coordinates of a posterior, by finite differences with one step rule each.

The coordinates z are standard normal under the prior, so that models vary over distances of order
one, and one step h suits all parameters. Central differences have the error

    h² |f‴| / 6 + ε |f| / h,   ε = 2⁻⁵²,

for h = :data:`STEP` about 2e-9 of f‴ and 2e-12 of f.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from bwbayes.arrays import FloatArray, IntArray

# Step of first derivatives, in prior sds.
STEP = 1e-4

Function = Callable[[FloatArray], FloatArray]


def value_and_jacobian(
    function: Function,
    coordinates: FloatArray,
    moving: IntArray | None = None,
    value: FloatArray | None = None,
) -> tuple[FloatArray, FloatArray]:
    """Return a function at coordinates (models, free), (models, ...), and (models, moving, ...).

    Parameters
    ----------
    function
        Maps coordinates (models, free) to (models, ...), in one call for all steps; nan, or −∞,
        where there is no model. A derivative is one-sided where one side has none, and zero where
        neither has.
    coordinates
        Where.
    moving
        The coordinates to differentiate in, all by default.
    value
        The function there, if it is known.
    """
    models, free = coordinates.shape
    steps = STEP * np.eye(free)[slice(None) if moving is None else moving]
    center = np.zeros((int(value is None), free))
    places = coordinates[:, np.newaxis] + np.concatenate([steps, -steps, center])
    values = function(places.reshape(-1, free))
    values = values.reshape(models, places.shape[1], *values.shape[1:])
    forth, back, here = np.split(values, [len(steps), 2 * len(steps)], axis=1)
    here = here if value is None else value[:, np.newaxis]
    with np.errstate(invalid="ignore"):  # no number less none
        slopes: FloatArray = (forth - back) / (2 * STEP)
        if not np.isfinite(slopes).all():
            for one_sided in ((forth - here) / STEP, (here - back) / STEP, np.zeros_like(forth)):
                slopes = np.where(np.isfinite(slopes), slopes, one_sided)
    return here[:, 0], slopes


def gradient_and_hessian(
    function: Function, free: int, step: float, value: float | None = None
) -> tuple[FloatArray, FloatArray]:
    """Return a function's gradient (free,) and Hessian (free, free) at w = 0.

    ``function`` maps (models, free) to (models,), in one call; ``value`` is f(0), if it is known.
    If ``function`` is several side by side, (models, functions), these come last in the results:
    (free, functions) and (free, free, functions).
    With f± a ``step`` h along a coordinate, or along two,

        gᵢ = (fᵢ₊ − fᵢ₋) / 2h,   Hᵢⱼ = (fᵢⱼ₊ + fᵢⱼ₋ − fᵢ₊ − fᵢ₋ − fⱼ₊ − fⱼ₋ + 2f) / 2h²,

    with errors of h² times the third and fourth derivatives, and of 8 ε |f| / h² by rounding: so a
    step is a fiftieth to a tenth of what the function varies over.
    """
    i, j = np.tril_indices(free, -1)
    single = step * np.eye(free)
    steps = np.concatenate([single, single[i] + single[j]])
    center = np.zeros((int(value is None), free))
    values = function(np.concatenate([steps, -steps, center]))
    forth, back, here = np.split(values, [len(steps), 2 * len(steps)])
    second = forth + back - 2 * (here if value is None else value)
    hessian, diagonal = np.zeros((free, free, *second.shape[1:])), np.arange(free)
    hessian[diagonal, diagonal] = second[:free]
    hessian[i, j] = hessian[j, i] = (second[free:] - second[i] - second[j]) / 2
    return (forth - back)[:free] / (2 * step), hessian / step**2
