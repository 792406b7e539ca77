"""Default priors: broad, and from the record's ranges alone.

With Y half the range of the displacement, U half the range of the voltage and Δ the sampling
interval, every scale of the model is known to within a factor of a few: d is near Y/U, α a part of
it, β near 1/U, a lag some samples, the sensor's noise some thousandth of the range, and what the
model leaves over anything from nothing to a tenth of it, correlated over some hundreds of samples.
These priors never come from a fit, so the data are not
used twice; they are resolved once to explicit numbers, which a run prints and stores.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from bwbayes.arrays import FloatArray
from bwbayes.inference.distributions import Distribution

__all__ = ["CATALOGUE", "Meaning", "Ranges", "default_prior"]


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
    middle of the displacement's range, um; ``interval`` is Δ, s.
    """

    voltage: float
    displacement: float
    middle: float
    interval: float

    @classmethod
    def of(cls, voltage: FloatArray, displacement: FloatArray, interval: float) -> Ranges:
        """Take the ranges of a voltage (samples,) and a displacement (samples,), nan if missing."""
        low, high = float(np.nanmin(displacement)), float(np.nanmax(displacement))
        return cls(float(np.ptp(voltage)) / 2, (high - low) / 2, (high + low) / 2, interval)


def default_prior(
    name: str, ranges: Ranges, exponent: float = 1.0, stiffness: float | None = None
) -> Distribution | float:
    """Return a parameter's default prior, or the value at which it is fixed by default.

    The exponent is one unless a config frees it. ``exponent`` sets the unit of β and γ,
    ``stiffness`` the damping that gives a lag of some samples; mass and stiffness have no default
    (a record shows at most their ratio to the damping).

    Raises
    ------
    KeyError
        No default exists for that name.
    """
    voltage, displacement, interval = ranges.voltage, ranges.displacement, ranges.interval
    gain = displacement / voltage
    # β |h|^(n-1) is a rate per volt; h is some fifth of the displacement.
    rate = (0.2 * displacement) ** (1 - exponent) / voltage
    priors: dict[str, Distribution | float] = {
        "d": _lognormal(1.2 * gain, 0.4),
        "alpha": _lognormal(0.4 * gain, 0.7),
        "beta": _lognormal(1.5 * rate, 0.8),
        "gamma": Distribution("normal", {"mean": 0.0, "sd": _round(1.5 * rate)}),
        "exponent": 1.0,
        "initial": Distribution("normal", {"mean": 0.0, "sd": _round(0.3 * displacement)}),
        "lag": _lognormal(3 * interval, 1.0),
        "offset": Distribution(
            "normal", {"mean": _round(ranges.middle), "sd": _round(displacement)}
        ),
        "sensor_sd": _lognormal(0.006 * displacement, 1.5),
        # Not even its order of magnitude is known. A prior that is level down to zero would claim
        # some discrepancy where there is none, and make a right model's bands too wide.
        "discrepancy_sd": _lognormal(1e-5 * displacement, 4.0),
        "discrepancy_time": _lognormal(250 * interval, 0.8),
    }
    if stiffness is not None:
        priors["damping"] = _lognormal(3 * interval * stiffness, 1.0)
    return priors[name]


def _lognormal(median: float, sigma: float) -> Distribution:
    return Distribution("lognormal", {"median": _round(median), "sigma": sigma})


def _round(value: float) -> float:
    """Keep three digits: a default prior is not more exact than that, and people read it."""
    return float(f"{value:.3g}")
