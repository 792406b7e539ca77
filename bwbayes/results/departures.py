"""How readings may depart from their bands: too few covered, too far off, to one side, too near.

Where luck may do it too, the departure comes with the chance of that on a record that the fitted
model describes.
"""

from __future__ import annotations

import numpy as np
import scipy
from scipy import special

from bwbayes.arrays import BoolArray
from bwbayes.data.io.grid import clock
from bwbayes.results.bands import LEVELS, Bands
from bwbayes.results.standard import Standard

__all__ = [
    "ALARM",
    "DOUBT",
    "coverage",
    "extremes",
    "leaning",
    "missed",
    "percent",
    "size",
    "too_wide",
]

# A root mean square error, in parts of the range, above which a fit misses its readings: a
# Bouc-Wen model misses one or two percent of an actuator's displacement.
POOR = 0.05

# False alarms of each of the tests of coverage, size and bias: some ten of them look at a record.
# Above the first a failure may be luck, and below the second a success may be none.
ALARM, DOUBT = 2e-4, 0.01

# A mean of the residuals of fewer sds than this cannot be seen in the coverage.
LEANING = 0.5

# Coverage counts as off only where its odds are off by this factor: 95 % is not 92.6 %, but 94.
ODDS = 1.5

# Bands count as too wide where the residuals are smaller than they say by this factor or more.
TOO_WIDE = 0.5

# So many readings so many sds off are a failure by themselves, so that a bad start or spikes are
# not lost in a long record: of a good one a reading is that far off once in five hundred million.
EXTREME, FAR = 5, 6.0


def coverage(bands: Bands, judged: BoolArray, standard: Standard) -> list[tuple[str, float]]:
    """Say where fewer readings lie in the sensor band than promised, with the chance of that."""
    assert bands.measured is not None
    worth = standard.for_size
    chances = []
    for level in reversed(LEVELS):
        covered = float(np.mean(bands.covers("sensor", level, bands.measured)[judged]))
        nominal = level / 100
        odds = covered / max(1 - covered, 1e-12) * (1 - nominal) / nominal
        if odds >= 1 / ODDS:
            continue
        hits = covered * worth
        # The binomial distribution function, for a number of readings that is not whole, where the
        # noise's sd is any that the fit allows.
        within = 1 - 2 * scipy.stats.norm.sf(
            scipy.stats.norm.isf((1 - nominal) / 2) / standard.scales
        )
        chance = float(np.mean(special.betainc(worth - hits, hits + 1, 1 - within)))
        chances.append((f"the {level}% sensor band covers {percent(covered)} of readings", chance))
    return _least_likely(chances)


def size(standard: Standard) -> list[tuple[str, float]]:
    """Say whether the residuals are larger than the sensor band, with the chance of that.

    As they are, and about their mean: an offset's error is one and the same for all of them.
    """
    chances = []
    for z, worth, about in (
        (standard.z, standard.for_size, ""),
        (standard.varying, standard.for_varying, " about their mean"),
    ):
        square = float(np.mean(z**2))
        chance = float(scipy.stats.f.sf(square, worth, standard.known))
        if square > ODDS:
            ratio = f"{np.sqrt(square):.2g} times as large{about}"
            text = f"the residuals are {ratio} as the sensor band predicts"
            chances.append((text, chance))
    return _least_likely(chances)


def leaning(bands: Bands, judged: BoolArray, standard: Standard) -> list[tuple[str, float]]:
    """Say whether the residuals lean to one side by more than the band allows."""
    assert bands.measured is not None
    mean = float(np.mean(standard.z))
    if abs(mean) < LEANING:
        return []
    # As sure as the size of the noise is.
    errors = abs(mean) * np.sqrt(standard.for_mean)
    chance = 2 * float(scipy.stats.t.sf(errors, standard.known))
    residual = float(np.mean((bands.measured - bands.mean)[judged]))
    text = f"the readings lie {residual:+.3g} um off the mean, {errors:.2g} of its standard errors"
    return _least_likely([(text, chance)])


def _least_likely(found: list[tuple[str, float]]) -> list[tuple[str, float]]:
    """Return the least likely of what was found, if that is not likely."""
    rarest = min(found, key=lambda pair: pair[1], default=None)
    return [rarest] if rarest and rarest[1] < DOUBT else []


def too_wide(standard: Standard) -> list[str]:
    """Say whether the residuals are far smaller than the sensor band says."""
    square = float(np.mean(standard.z**2))
    chance = scipy.stats.f.cdf(square, standard.for_size, standard.known)
    if square >= TOO_WIDE**2 or chance >= ALARM:
        return []
    return [f"the sensor band is {1 / max(np.sqrt(square), 1e-9):.2g} times too wide"]


def extremes(bands: Bands, judged: BoolArray, standard: Standard) -> list[str]:
    """Say that several readings are farther off than a good record has any."""
    # A noise whose size is hardly known may well be larger here.
    far = np.flatnonzero(np.abs(standard.z) > FAR * np.exp(2 * standard.unsure))
    if far.size < EXTREME:
        return []
    first = clock(bands.time[judged][far[0]], bands.interval)
    largest = float(np.max(np.abs(standard.z)))
    return [
        f"{far.size} readings lie more than {FAR:g} SDs off the mean, first at {first} s, the "
        f"farthest {largest:.2g} SDs"
    ]


def missed(bands: Bands, judged: BoolArray, extent: float) -> list[str]:
    """Say whether a fit misses its own readings by more than a sensor's noise would.

    Against the range ``extent`` of all that was fitted, um: that of a short window may be small.
    """
    assert bands.measured is not None
    reading = bands.measured[judged]
    extent = max(extent, float(np.ptp(reading)))
    residual = (bands.measured - bands.mean)[judged]
    steps = np.diff(residual)
    fast = float(np.sqrt(np.median(steps**2) / (2 * 0.4549))) if steps.size else 0.0
    rms = float(np.sqrt(np.mean(residual**2)))
    # Of a sensor's noise, which no model follows, nothing is the model's fault.
    slow = np.sqrt(max(rms**2 - fast**2, 0.0))
    if extent == 0 or slow <= POOR * extent or slow <= fast:
        return []
    return [f"NRMSE {percent(rms / extent)} on the training readings"]


def percent(share: float) -> str:
    """Return a part in percent."""
    return f"{100 * share:.3g}%"
