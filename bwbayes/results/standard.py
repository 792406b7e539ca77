"""Residuals against their bands, and how many independent readings they are worth.

What luck alone may do to a mean of many readings depends on how many independent ones they are
worth, and that is far fewer than there are: a discrepancy forgets slowly, and the parameters' error
is one and the same all along. The bands themselves say how large each part is.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy
from scipy.special import ndtri

from bwbayes.arrays import BoolArray, FloatArray
from bwbayes.results.bands import Bands, Kind

__all__ = ["Z_90", "Standard", "standardized"]

# Half the width of a 90 % band, in sds.
Z_90 = float(ndtri(0.95))

# Sds of the noise, as a fit allows them, over which a chance is averaged.
SCALES = 200


@dataclass(frozen=True)
class Standard:
    """Readings of the judged part against their bands, and what they are worth.

    ``z`` (readings,) residuals over the sensor band's sd; ``for_mean`` and ``for_size``
    independent readings that the record is worth to the mean of z and to that of z²; ``unsure``
    is the sd of the logarithm of the noise's sd. ``varying`` is z about its mean, scaled to a
    variance of one, worth ``for_varying`` readings to that of its square; ``common`` is the part of
    the band's variance that is one and the same for all readings, such as an offset's.
    """

    z: FloatArray
    for_mean: float
    for_size: float
    unsure: float
    varying: FloatArray
    for_varying: float
    common: float

    @property
    def known(self) -> float:
        """Independent readings that would tell the noise's sd as well as the fit has done."""
        return 1 / max(2 * self.unsure**2, 1e-9)

    @property
    def worth(self) -> float:
        """Independent readings, about their mean, that record and fit together are worth."""
        return 1 / (1 / self.for_varying + 1 / self.known)

    @property
    def scales(self) -> FloatArray:
        """Factors on the noise's sd, evenly probable, that the fit allows."""
        chance = (np.arange(SCALES) + 0.5) / SCALES
        factors: FloatArray = np.sqrt(self.known / scipy.stats.chi2.ppf(chance, self.known))
        return factors


def _sd(bands: Bands, kind: Kind, judged: BoolArray) -> FloatArray:
    """Sd of a band's quantity, um, from its 90 % edges."""
    width = bands.upper[kind, 90][judged] - bands.lower[kind, 90][judged]
    sd: FloatArray = width / (2 * Z_90)
    return sd


def standardized(bands: Bands, judged: BoolArray, memory: float, unsure: float) -> Standard:
    """Take the residuals over their sd, and work out how many independent ones they are worth.

    With c, p, q and w the shares of a common error, of parameters, discrepancy and sensor in the
    variance, z at two samples t apart has the correlation c + p + q exp(-t/τ), and z² that squared.
    About its mean the common error drops out.
    """
    assert bands.measured is not None
    sensor = np.maximum(_sd(bands, "sensor", judged), np.finfo(float).tiny)
    z = (bands.measured - bands.mean)[judged] / sensor
    total = float(np.mean(sensor**2))
    p = min(float(np.mean(_sd(bands, "parameter", judged) ** 2)) / total, 1.0)
    q = min(float(np.mean(_sd(bands, "displacement", judged) ** 2)) / total, 1.0) - p
    q = max(q, 0.0) if memory > 0 else 0.0
    pairs = _pairs(judged)
    lags = bands.interval * np.arange(pairs.size, dtype=np.float64)
    once, twice = (_mean_correlation(pairs, lags, memory / power) for power in (1, 2))
    alone = 1 / z.size
    common = min(bands.common_sd**2 / total, p)

    def correlated(p: float, q: float) -> float:
        """Mean correlation of all pairs of squares."""
        return p**2 + 2 * p * q * once + q**2 * twice + (1 - (p + q) ** 2) * alone

    mean = p + q * once + (1 - p - q) * alone
    shared = (p - common) + q * (1 - once) + (1 - p - q) * (1 - alone)
    varying = (z - np.mean(z)) / np.sqrt(shared)
    rest = correlated(min((p - common) / shared, 1.0), min(q * (1 - once) / shared, 1.0))
    worth = 1 / correlated(p, q), unsure, varying, 1 / rest, common
    return Standard(z, 1 / mean, *worth)


def _pairs(judged: BoolArray) -> FloatArray:
    """Count the pairs of judged samples at each lag, (lags,), those in either order."""
    there = judged[slice(*np.flatnonzero(judged)[[0, -1]] + [0, 1])].astype(np.float64)
    counts = np.rint(scipy.signal.correlate(there, there, method="fft")[there.size - 1 :])
    counts[1:] *= 2
    result: FloatArray = counts
    return result


def _mean_correlation(pairs: FloatArray, lags: FloatArray, memory: float) -> float:
    """Mean correlation of all pairs of readings of a process that forgets by exp(-lag/memory)."""
    if memory <= 0:
        return float(pairs[0] / pairs.sum())
    return float(pairs @ np.exp(-lags / memory) / pairs.sum())
