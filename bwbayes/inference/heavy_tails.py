"""Sensor noise of a Student t distribution: a filter that hardly hears what is far off.

A t distribution of ν degrees of freedom and scale s is a normal one of variance s² u whose
u = 1/w varies, w ~ Γ(ν/2, ν/2). Here s is such that ± one sd of a normal distribution hold as much
of it, 68%: so what most of the noise is hardly depends on how heavy its tails are. Summed over some
values u_k of weights a_k (:func:`scale_mixture`), a reading whose error from what is expected is e,
and whose expectation has the variance p, has the density

    p(e) = Σ a_k N(e; 0, V_k),   V_k = p + s² u_k.

The states' first two moments after the reading are exact: with weights π_k ∝ a_k N(e; 0, V_k),

    gain G = P c E[1/V],   x ← x + G e,   P ← P − P c cᵀ P (E[1/V] − e² Var[1/V]),

c the row that reads the states. These are Kalman's steps with a sensor variance of the reading's
own, R = 1/E[1/V] − p, and an uncertainty of whether the reading is an outlier besides. States are
those of the discrepancy, then the sizes of responses that stay as they are, such as an unknown
start. After each reading a normal distribution takes the place of the states' own, which is a sum
of ever more: this alone is approximate, and exact for ν → ∞.

C. J. Masreliez, Approximate non-Gaussian filtering with linear state and observation relations,
IEEE Transactions on Automatic Control 20, 107-110 (1975), doi:10.1109/TAC.1975.1100882.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import scipy

from bwbayes.arrays import FloatArray, IntArray

if TYPE_CHECKING:
    from bwbayes.inference.state_space import Noise

# Steps from one value of log w to the next in its sds, and how much they grow away from w = 1: the
# density is that of the t distribution to 2e-4 up to 20,000 scales for ν = 1, 1,000 for ν = 3.
STEPS, STRETCH = 0.85 * np.arange(-17, 7), 0.1


class Followed(NamedTuple):
    """The result of a filter along readings.

    ``log_density`` (models,), nats; the ``error`` of what was expected of each reading and its
    variance ``spread`` (models, readings), um and um²; ``sensor`` (models, readings), the variance
    that the reading's noise has in effect, um²; ``mean`` (models, states) and ``covariance``
    (models, states, states) of all states after the last.
    """

    log_density: FloatArray
    error: FloatArray
    spread: FloatArray
    sensor: FloatArray
    mean: FloatArray
    covariance: FloatArray


def scale_mixture(inverse_df: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the s² u_k of a t distribution and log a_k, each (models, values), at 1/ν (models,).

    In units of the variance of a normal distribution. By the trapezoidal rule in log w, whose
    density is ∝ exp(ν (log w − w)/2).
    """
    scale, inverse_df = scale_of(inverse_df)[:, np.newaxis], inverse_df[:, np.newaxis]
    log_w = np.sqrt(2 * inverse_df / (1 + inverse_df)) * np.sinh(STRETCH * STEPS) / STRETCH
    # At 1/ν = 0 all of them are zero.
    logs = (log_w - np.expm1(log_w)) / np.maximum(2 * inverse_df, np.finfo(float).tiny)
    logs = logs + np.log(np.cosh(STRETCH * STEPS))
    return scale**2 * np.exp(-log_w), logs - scipy.special.logsumexp(logs, axis=1, keepdims=True)


def scale_of(inverse_df: FloatArray) -> FloatArray:
    """Return s (models,), at 1/ν (models,), where ±1 holds as much as ±1 sd of a normal one."""
    # By its series where the quantile is that of a normal distribution to rounding.
    one_sd = 0.8413447460685429  # Φ(1), which a library would have to be loaded for
    exact = 1 / scipy.special.stdtrit(1 / np.maximum(inverse_df, 1e-6), one_sd)
    return np.where(inverse_df > 1e-6, exact, 1 - inverse_df / 2)


class Steps(NamedTuple):
    """The filter's input along readings: states of the discrepancy, then sizes of responses.

    ``transitions`` and ``gained`` are F and Q (gaps, models, states, states) over each gap, and
    ``gaps`` (readings,) which of them is just before a reading; ``variances``, um², and ``logs``
    (models, values) are those of :func:`mixture_of`; ``observe`` the row that reads the
    discrepancy; ``series`` (models, 1 + sizes, readings), um, the residual and the responses.
    """

    transitions: FloatArray
    gained: FloatArray
    gaps: IntArray
    variances: FloatArray
    logs: FloatArray
    observe: FloatArray
    series: FloatArray


def run(steps: Steps, mean: FloatArray, covariance: FloatArray) -> tuple[FloatArray, ...]:
    """Take the states' mean and covariance, in their places, from before the readings to after.

    Returns log density, error, spread and sensor as :class:`Followed` has them.
    """
    models, count, readings = steps.series.shape
    log_density = np.full(models, -0.5 * readings * np.log(2 * np.pi))
    error, spread, sensor = np.empty((3, models, readings))
    row = np.tile(np.append(steps.observe, np.zeros(count - 1)), (models, 1))
    for t in range(readings):
        if t:
            f_matrix = steps.transitions[steps.gaps[t]]
            mean[:] = _times(f_matrix, mean)
            covariance[:] = (
                f_matrix @ covariance @ f_matrix.swapaxes(1, 2) + steps.gained[steps.gaps[t]]
            )
        row[:, steps.observe.size :] = steps.series[:, 1:, t]
        shared = _times(covariance, row)
        spread[:, t] = np.sum(row * shared, axis=1)
        error[:, t] = steps.series[:, 0, t] - np.sum(row * mean, axis=1)
        # The π_k, and 1/V_k.
        inverse, squares = 1 / (spread[:, t, np.newaxis] + steps.variances), error[:, t] ** 2
        log_parts = steps.logs + 0.5 * (np.log(inverse) - squares[:, np.newaxis] * inverse)
        top = np.max(log_parts, axis=1, keepdims=True)
        parts = np.exp(log_parts - top)
        total = np.sum(parts, axis=1, keepdims=True)
        log_density += (top + np.log(total))[:, 0]
        parts /= total
        rate = np.sum(parts * inverse, axis=1)
        doubt = squares * np.sum(parts * (inverse - rate[:, np.newaxis]) ** 2, axis=1)
        # Without a difference: R, where next to nothing was known.
        sensor[:, t] = np.sum(parts * steps.variances * inverse, axis=1) / rate
        gain = shared * rate[:, np.newaxis]
        mean += gain * error[:, t, np.newaxis]
        # Joseph's form, (1 − G c) P (1 − G c)ᵀ + R G Gᵀ, whose rounding is that of what is left.
        covariance -= _outer(gain, shared)
        cross = _times(covariance, row)
        covariance += _outer(sensor[:, t, np.newaxis] * gain - cross, gain)
        covariance += _outer(doubt[:, np.newaxis] * shared, shared)
        covariance[:] = (covariance + covariance.swapaxes(1, 2)) / 2
    return log_density, error, spread, sensor


def follow(
    noise: Noise,
    theta: FloatArray,
    series: FloatArray,
    start_sd: FloatArray,
    skipped: FloatArray | None = None,
    along: Callable[[Steps, FloatArray, FloatArray], tuple[FloatArray, ...]] = run,
) -> Followed:
    """Filter residuals beside responses of unknown sizes.

    Parameters
    ----------
    noise, theta
        The noise for the interval between readings, whose sensor has a t distribution, and its
        parameters (models, parameters).
    series
        (models, 1 + unknowns, readings), um: the residual, then the responses.
    start_sd
        Prior sds (models, unknowns) of the responses' sizes.
    skipped
        As in :meth:`~bwbayes.inference.state_space.Noise.whiten`.
    along
        Function that goes along the readings, as :func:`run` does.
    """
    models, count, readings = series.shape
    states, size = noise.states, noise.states + count - 1
    missing, gaps = np.unique(
        np.zeros(readings) if skipped is None else skipped, return_inverse=True
    )
    # Sizes stay as they are.
    transitions = np.tile(np.eye(size), (missing.size, models, 1, 1))
    gained = np.zeros_like(transitions)
    for number, over in enumerate((1.0 + missing).tolist()):
        transitions[number, :, :states, :states] = noise.transition(theta, over)
        gained[number, :, :states, :states] = noise.process_covariance(theta, over)
    mean, covariance, sizes = (
        np.zeros((models, size)),
        np.zeros_like(gained[0]),
        range(states, size),
    )
    covariance[:, :states, :states] = noise.stationary(theta)
    covariance[:, sizes, sizes] = start_sd**2
    steps = Steps(transitions, gained, gaps, *mixture_of(noise, theta), noise.observe, series)
    log_density, error, spread, sensor = along(steps, mean, covariance)
    return Followed(log_density, error, spread, sensor, mean, covariance)


def mixture_of(noise: Noise, theta: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the variances s² u_k, um², and log a_k of a noise's sensor, each (models, values)."""
    scales, logs = scale_mixture(noise.inverse_df(theta))
    return theta[:, :1] ** 2 * scales, logs


def normal_scores(noise: Noise, theta: FloatArray, followed: Followed) -> FloatArray:
    """Turn errors into numbers that are standard normal if the noise is right (models, readings).

    z = Φ⁻¹(Σ a_k Φ(e/√V_k)), from the side of the nearer tail.
    """
    variances, logs = mixture_of(noise, theta)
    away, scores = -np.abs(followed.error), np.empty_like(followed.error)
    for model, spread in enumerate(followed.spread):
        sds = np.sqrt(spread[:, np.newaxis] + variances[model])
        below = scipy.special.log_ndtr(away[model, :, np.newaxis] / sds) + logs[model]
        scores[model] = scipy.special.ndtri_exp(scipy.special.logsumexp(below, axis=1))
    return -np.sign(followed.error) * scores


def quantiles(inverse_df: FloatArray, scores: FloatArray) -> FloatArray:
    """Turn normal scores (models, samples) into those of t distributions, at 1/ν (models,)."""
    df = 1 / np.maximum(inverse_df, 1e-9)[:, np.newaxis]
    below = scipy.special.ndtr(-np.abs(scores))
    away = -np.sign(scores) * scipy.special.stdtrit(df, below)
    return np.where(
        inverse_df[:, np.newaxis] > 1e-9, scale_of(inverse_df)[:, np.newaxis] * away, scores
    )


def _outer(first_vector: FloatArray, other: FloatArray) -> FloatArray:
    """Return the products (models, states, states) of each two numbers of (models, states)."""
    return first_vector[:, :, np.newaxis] * other[:, np.newaxis]


def _times(matrices: FloatArray, vectors: FloatArray) -> FloatArray:
    """Return each matrix (models, states, states) times its vector (models, states)."""
    product: FloatArray = (matrices @ vectors[..., np.newaxis])[..., 0]
    return product
