"""Default priors: broad, and from the record's ranges and the drive's own times alone.

With Y half the range of the displacement, U half the range of the voltage and T the typical time
from one turning point of the drive to the next, every scale of the model is known to within a
factor of a few: d is Y/U or twice that, α a part of it, β near 1/U, a lag some thousandths of T,
the sensor's noise some thousandth of the range, and what the model misses anything from
nothing to a tenth of it, correlated over about half a stretch from turn to turn. The sampling rate
does not enter: a record and its every k-th sample have the same priors.

The ranges are those of the training data, displacement included, so strictly the data are used
twice: once for these scales, once for the fit. The priors are wide enough that this does not show
(every one holds a factor of several), and they never come from a fit. They are resolved once to
explicit numbers, which a run prints and stores.

With half a range below about a third of 1/β a small drive shows no loop that closes; then these
priors, not the record, say how large β is, and leave room for the value that a large drive shows.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from bwbayes.arrays import FloatArray
from bwbayes.inference.distributions import Distribution
from bwbayes.inference.drive import time_between_turns

__all__ = ["CATALOGUE", "Defaults", "Meaning", "Ranges", "default_prior"]


class Meaning(NamedTuple):
    """What people call a parameter: unit, LaTeX label, description."""

    unit: str
    label: str
    description: str


CATALOGUE = {
    "d": Meaning("um/V", r"d", "piezoelectric coefficient"),
    "alpha": Meaning("um/V", r"\alpha", "hysteretic displacement per volt at h = 0"),
    "beta": Meaning("1/V", r"\beta", "hysteresis loop shape"),
    "gamma": Meaning("1/V", r"\gamma", "hysteresis loop shape, loading against unloading"),
    "exponent": Meaning("-", r"n", "smoothness of the transition"),
    "initial": Meaning("um", r"h_0", "hysteretic displacement at the first sample"),
    "lag": Meaning("s", r"\tau_\mathrm{lag}", "time constant of the first-order lag"),
    "mass": Meaning("kg", r"m", "effective mass"),
    "damping": Meaning("N s/m", r"b", "effective damping"),
    "stiffness": Meaning("N/m", r"k", "mechanical stiffness"),
    "offset": Meaning("um", r"y_0", "sensor offset"),
    "sensor_sd": Meaning("um", r"s", "sd of the sensor noise"),
    "discrepancy_sd": Meaning("um", r"\sigma", "sd of the model discrepancy"),
    "discrepancy_time": Meaning("s", r"\tau", "correlation time of the model discrepancy"),
}


@dataclass(frozen=True)
class Ranges:
    """All that a default prior may know of a record.

    ``voltage`` is U, half the range of the voltage, V; ``displacement`` is Y, um; ``middle`` the
    middle of the displacement's range, um; ``time`` is T, the typical time between turning points
    of the drive, s; ``bias`` the middle of the voltage's range, V.
    """

    voltage: float
    displacement: float
    middle: float
    time: float
    bias: float = 0.0

    @classmethod
    def of(
        cls,
        voltage: FloatArray,
        displacement: FloatArray,
        interval: float,
        windows: Sequence[slice] = (slice(None),),
    ) -> Ranges:
        """Take the ranges within windows of a record.

        ``voltage`` and ``displacement`` are the whole record's, (samples,), V and um; a missing
        reading is NaN; ``interval`` is the sampling interval, s.
        """
        volts = np.concatenate([voltage[window] for window in windows])
        readings = np.concatenate([displacement[window] for window in windows])
        low, high = float(np.nanmin(readings)), float(np.nanmax(readings))
        return cls(
            voltage=float(np.ptp(volts)) / 2,
            displacement=(high - low) / 2,
            middle=(high + low) / 2,
            time=time_between_turns(voltage, interval, windows),
            bias=float(np.min(volts) + np.max(volts)) / 2,
        )


def default_prior(
    name: str,
    ranges: Ranges,
    exponent: float | Distribution = 1.0,
    stiffness: float | None = None,
    *,
    gamma_free: bool = True,
) -> Distribution | float:
    """Return a parameter's default prior, or the value at which it is fixed by default.

    The exponent is one unless a config frees it. ``exponent``, its value or its prior, sets the
    scale of β and γ; ``stiffness`` the damping that gives such a lag; mass and
    stiffness have no default (a record shows at most their ratio to the damping). ``gamma_free``:
    whether γ has a prior, which cuts β's.

    Raises
    ------
    KeyError
        No default exists for that name.
    """
    voltage, displacement, time = ranges.voltage, ranges.displacement, ranges.time
    gain = displacement / voltage
    # What the voltage's distance from zero may add to offset and hysteresis.
    reach = displacement + gain * abs(ranges.bias)
    low, middle, high = (_log_rate(n, ranges) for n in _likely(exponent))
    priors: dict[str, Distribution | float] = {
        # A drive that is small for the loop shows d - α, which may be half of d.
        "d": _lognormal(1.6 * gain, 0.6),
        "alpha": _lognormal(0.7 * gain, 1.0),
        "beta": _lognormal(
            (BETA if gamma_free else 1.0) * _exp(middle), math.hypot(BETA_SIGMA, (high - low) / 4)
        ),
        "gamma": Distribution("normal", {"mean": 0.0, "sd": _round(GAMMA * _exp(max(low, high)))}),
        "exponent": 1.0,
        "initial": Distribution("normal", {"mean": 0.0, "sd": _round(0.3 * reach)}),
        "lag": _lognormal(LAG * time, LAG_SIGMA),
        "offset": Distribution(
            "normal",
            {"mean": _round(ranges.middle, displacement), "sd": _round(reach)},
        ),
        "sensor_sd": _lognormal(0.006 * displacement, 2.0),
        # Not even its order of magnitude is known. A prior that is level down to zero would claim
        # some discrepancy where there is none, and make a right model's bands too wide.
        "discrepancy_sd": _lognormal(1e-5 * displacement, 4.0),
        "discrepancy_time": _lognormal(0.5 * time, 0.8),
    }
    if stiffness is not None:
        priors["damping"] = _lognormal(LAG * time * stiffness, LAG_SIGMA)
    return priors[name]


@dataclass(frozen=True)
class Defaults:
    """The default priors of one record and model; the arguments are :func:`default_prior`'s."""

    ranges: Ranges
    exponent: float | Distribution = 1.0
    stiffness: float | None = None
    gamma_free: bool = True

    def of(self, name: str) -> Distribution | float:
        """Return a parameter's default, as :func:`default_prior` does."""
        return default_prior(
            name, self.ranges, self.exponent, self.stiffness, gamma_free=self.gamma_free
        )

    def priors(self, names: Collection[str]) -> dict[str, Distribution]:
        """Return the default priors of those of the parameters that have one."""
        without = {"exponent", "mass", "stiffness"}
        if self.stiffness is None:
            without.add("damping")
        known = {name: self.of(name) for name in names if name not in without}
        return {name: prior for name, prior in known.items() if isinstance(prior, Distribution)}


# Of T: drives are mostly slow for the actuator. Wide, because its lag does not follow the drive.
LAG, LAG_SIGMA = 0.005, 2.3

# Of β and γ, in units of the rate scale. |γ| ≤ β cuts the joint prior, which takes small β away:
# what is left for β has its median a little above 1/U, and room for a factor of thirty either way.
BETA, BETA_SIGMA = 0.15, 2.3
GAMMA = 4.0

# Beyond this the hysteresis hardly changes: a prior that goes further still gets a scale for this.
LARGEST_EXPONENT = 20.0


def _log_rate(exponent: float, ranges: Ranges) -> float:
    """Return the logarithm of the scale of β and γ, um^(1-n)/V.

    β |h|^(n-1) is a rate per volt, about 1/U; h is some fifth of the displacement.
    """
    return (1 - exponent) * math.log(0.2 * ranges.displacement) - math.log(ranges.voltage)


def _exp(logarithm: float) -> float:
    """Return the exponential, or a number that is out of proportion instead of an overflow."""
    return math.exp(min(logarithm, 700.0))


def _likely(exponent: float | Distribution) -> tuple[float, float, float]:
    """Return the exponent's 2.5 %, 50 % and 97.5 % quantiles above one."""
    if not isinstance(exponent, Distribution):
        return exponent, exponent, exponent
    below = float(exponent.frozen.cdf(1.0))
    if below >= 1:
        return 1.0, 1.0, 1.0
    likely = exponent.frozen.ppf(below + (1 - below) * np.array([0.025, 0.5, 0.975]))
    low, middle, high = (float(n) for n in np.minimum(likely, LARGEST_EXPONENT))
    return low, middle, high


def _lognormal(median: float, sigma: float) -> Distribution:
    return Distribution("lognormal", {"median": _round(median), "sigma": _round(sigma)})


def _round(value: float, scale: float | None = None) -> float:
    """Keep three digits of the value, or of another ``scale`` that it need not be more exact than.

    A default prior is not more exact than that, and people read it.
    """
    size = abs(value if scale is None else scale)
    if not size > 0:
        return value
    return round(value, 2 - math.floor(math.log10(size)))
