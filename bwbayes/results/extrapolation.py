"""Where a prediction leaves what was fitted: remarks on the voltage's range and its speed.

There the bands know how sure the parameters are, and nothing of what else the actuator does.
"""

from __future__ import annotations

import math

import numpy as np

from bwbayes.arrays import FloatArray
from bwbayes.inference.posterior import Posterior
from bwbayes.model.drive import fastest, time_between_turns

__all__ = ["beyond_training"]

# Part of the fitted voltages' range that others may lie beyond it: a sensor's noise.
SLACK = 0.02

# A voltage that moves faster than the fitted one by more than this factor tells more of the lag
# than the record did. Noise and the sampling change a speed by a tenth or so.
FASTER = 1.5

# Part of the time between turning points over which a speed is taken: a sine's peak speed is then
# 0.4 % too low, and noise of 1 % of its range adds a tenth.
PART = 0.1


def beyond_training(posterior: Posterior, voltage: FloatArray, interval: float) -> list[str]:
    """Say, a line each, how a drive leaves what the model was fitted to: its range, its speed.

    Parameters
    ----------
    posterior
        The posterior of the records that were fitted.
    voltage
        The drive that is to be predicted, (samples,), V.
    interval
        Its sampling interval, s.
    """
    fitted = [one.voltage[window] for one in posterior.datasets for window in one.training]
    remarks = [_range(np.concatenate(fitted), voltage), _speed(posterior, voltage, interval)]
    return [remark for remark in remarks if remark is not None]


def _range(fitted: FloatArray, voltage: FloatArray) -> str | None:
    low, high = float(np.min(fitted)), float(np.max(fitted))
    slack = SLACK * (high - low)
    if np.min(voltage) >= low - slack and np.max(voltage) <= high + slack:
        return None
    return (
        f"the voltage goes from {np.min(voltage):.4g} to {np.max(voltage):.4g} V, and only "
        f"{low:.4g} to {high:.4g} V were fitted: beyond that the bands are an extrapolation"
    )


def _speed(posterior: Posterior, voltage: FloatArray, interval: float) -> str | None:
    before = now = math.inf
    for one in posterior.datasets:
        own = one.actuator.interval
        times = (
            time_between_turns(one.voltage, own, one.training),
            time_between_turns(voltage, interval),
        )
        over = PART * min(times)
        its, this = fastest(one.voltage, own, over, one.training), fastest(voltage, interval, over)
        # Of several records the one that comes nearest to the drive.
        if this * before <= now * its or before == math.inf:
            before, now = its, this
    if now <= FASTER * before:
        return None
    return (
        f"the voltage moves at up to {now:.3g} V/s, and only up to {before:.3g} V/s were fitted: "
        "faster than that the bands are an extrapolation, because the record says little about "
        "the lag; fit a record with a drive as fast as this one"
    )
