"""The linear part of an actuator as a discrete system of ``scipy.signal``.

What follows the hysteresis is linear: dynamics and creep. Sampled at an interval, with a drive that
is held or goes straight between samples, it is a state-space system whose response at the samples
is exact, and everything that control engineering knows about such systems can be done with it.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import scipy
from scipy.linalg import block_diag

from bwbayes.arrays import ArrayLike, FloatArray
from bwbayes.control.sampled import SampledSections, sections_of
from bwbayes.errors import InputError
from bwbayes.model.actuator import Actuator

__all__ = ["frequency_response", "linear_part"]


def linear_part(actuator: Actuator, theta: ArrayLike) -> Any:
    """Return what follows the hysteresis as a discrete ``scipy.signal.StateSpace``.

    With the drive w in um, from hysteresis and gain, and x the displacement in um, both as
    differences from rest,

        z[t+1] = A z[t] + B w[t],   x[t] = C z[t] + D w[t],

    which is the recursion of the actuator's own dynamics and creep
    (:class:`~bwbayes.model.linear.Sections`), with the states that ``scipy.signal.lfilter`` has. If
    the creep grows with the voltage, w (1 + κ |u| / U) is a second input.

    Parameters
    ----------
    actuator
        Parts, hold and sampling interval.
    theta
        (parameters,), the columns and their units as in ``actuator.declarations``.

    Returns
    -------
    scipy.signal.StateSpace
        With ``dt`` in s.

    Raises
    ------
    InputError
        Parameters of another number, or outside the model's domain.
    """
    row = np.atleast_2d(np.asarray(theta, dtype=np.float64))
    if row.shape != (1, len(actuator.parameters)):
        raise InputError(
            f"theta: has shape {np.shape(theta)}; give one value each of "
            f"{', '.join(actuator.parameters)}"
        )
    column = actuator.columns(row)
    actuator.filter.check(column)
    numerator, denominator, gains, crept = (values[0] for values in sections_of(actuator, column))
    growing = actuator.creep is not None and actuator.creep.growing
    a, b, c = [], [], []
    d = np.zeros((1, 1 + growing))
    for top, bottom, gain, is_creep in zip(numerator, denominator, gains, crept, strict=True):
        order = max(int(np.max(np.nonzero([top, bottom])[1], initial=0)), 1)
        shift = np.eye(order, k=1)
        shift[:, 0] -= bottom[1 : order + 1]
        entry = np.zeros((order, 1 + growing))
        entry[:, int(growing and is_creep)] = top[1 : order + 1] - bottom[1 : order + 1] * top[0]
        d[0, int(growing and is_creep)] += gain * top[0]
        a.append(shift)
        b.append(entry)
        c.append(gain * np.eye(1, order))
    return scipy.signal.StateSpace(
        block_diag(*a), np.vstack(b), np.hstack(c), d, dt=actuator.interval
    )


def frequency_response(sections: SampledSections, turns: FloatArray) -> FloatArray:
    """Return the complex response (models, frequencies) of dynamics and creep together.

    ``turns`` (frequencies,) are angles per sample, rad.
    """
    powers = np.exp(-1j * np.outer(np.arange(3), turns))
    responses = (sections.numerator @ powers) / (sections.denominator @ powers)
    total: Any = np.einsum("ms,msf->mf", sections.gains, responses)
    return np.asarray(total)
