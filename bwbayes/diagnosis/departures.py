"""How readings may depart from their bands: too few covered, too far off, to one side, too near.

What luck alone may do to a mean of many readings depends on how many independent ones they are
worth, far fewer than there are: a discrepancy forgets slowly, and the parameters' error is one and
the same all along. The bands themselves say how large each part is. Where luck may do it too, a
departure comes with the chance of that on a record that the fitted model describes.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import scipy

from bwbayes.arrays import BoolArray, FloatArray
from bwbayes.inference.defaults import rounding_sd
from bwbayes.model.reversals import rate
from bwbayes.prediction.bands import KINDS, LEVELS, Bands
from bwbayes.record.io.grid import clock
from bwbayes.shown import rounded

# False alarms of each of the tests of coverage, size and bias: some ten of them look at a record.
# Above the first a failure may be luck, and below the second a success may be none.
ALARM, DOUBT = 2e-4, 0.01

# Coverage counts as off only where its odds are off by this factor: 95% is not 92.6%, but 94.
ODDS = 1.5


@dataclass(frozen=True)
class StandardizedResiduals:
    """Scored readings against their bands, and how many independent ones they are worth.

    ``z`` (readings,) are residuals over the sensor band's sd; ``mean_size`` and ``square_size`` are
    how many independent readings the record is worth to the mean of z and to that of z².
    ``varying`` is z about its mean, scaled to a variance of one, worth ``varying_size`` readings to
    that of its square; ``common`` is the part of the band's variance that all readings share, such
    as an offset's. ``noise_log_sd`` is the sd of the logarithm of the noise's sd.
    """

    bands: Bands
    scored: BoolArray
    z: FloatArray
    mean_size: float
    square_size: float
    varying: FloatArray
    varying_size: float
    common: float
    noise_log_sd: float

    @classmethod
    def of(cls, bands: Bands, memory: float, noise_log_sd: float) -> StandardizedResiduals:
        """Take the residuals over their sd, and work out how many independent ones they are worth.

        With c, p, q and w the shares of a common error, of parameters, discrepancy and sensor in
        the variance, z at two samples t apart has the correlation c + p + q exp(-t/τ), and z² that
        squared. About its mean the common error drops out. ``memory`` is τ, s.
        """
        assert bands.measured is not None

        rows = bands.scored(bands.measured)
        parameter_sd, slow, sensor = (bands.read_sd(kind)[rows] for kind in KINDS)
        # No band is narrower than a floating-point number's resolution.
        largest = float(np.max(np.abs([bands.measured[rows], bands.mean[rows]])))
        sensor = np.maximum(sensor, max(np.spacing(largest), 1e-150))
        z = (bands.measured - bands.mean)[rows] / sensor
        total = float(np.mean(sensor**2))
        p = min(float(np.mean(parameter_sd**2)) / total, 1.0)
        q = min(float(np.mean(slow**2)) / total, 1.0) - p
        q = max(q, 0.0) if memory > 0 else 0.0
        # Pairs of scored samples at each lag, those in either order.
        present = rows.astype(np.float64)
        pairs = np.rint(scipy.signal.correlate(present, present, method="fft")[present.size - 1 :])
        pairs[1:] *= 2
        lags, single = bands.interval * np.arange(pairs.size), 1 / z.size
        decay = np.exp(-lags / memory) if memory > 0 else (lags == 0).astype(np.float64)
        # Mean correlation, and mean squared one, of all of them.
        once, twice = (float(pairs @ decay**power / pairs.sum()) for power in (1, 2))
        common = min(bands.common_sd**2 / total, p)

        def of_squares(p: float, q: float) -> float:
            """Mean correlation of all pairs of squares."""
            return p**2 + 2 * p * q * once + q**2 * twice + (1 - (p + q) ** 2) * single

        mean = p + q * once + (1 - p - q) * single
        shared = (p - common) + q * (1 - once) + (1 - p - q) * (1 - single)
        # A common error may be all that the bands allow for, or the reading the only one.
        shared = max(shared, float(np.finfo(float).eps))
        varying = of_squares(min((p - common) / shared, 1.0), min(q * (1 - once) / shared, 1.0))
        return cls(
            bands,
            rows,
            z,
            1 / mean,
            1 / of_squares(p, q),
            (z - np.mean(z)) / np.sqrt(shared),
            1 / varying,
            common,
            noise_log_sd,
        )

    @property
    def noise_size(self) -> float:
        """Independent readings that would tell the noise's sd as well as the fit has done."""
        return 1 / max(2 * self.noise_log_sd**2, 1e-9)

    @property
    def effective_size(self) -> float:
        """Independent readings, about their mean, that record and fit together are worth."""
        return 1 / (1 / self.varying_size + 1 / self.noise_size)

    def chances(self) -> list[tuple[str, float]]:
        """Return what is off in coverage, size and bias, with the chance that luck does it.

        Of each the least likely, if its chance is below ``DOUBT``.
        """
        sizes = []
        for z, size, about in (
            (self.z, self.square_size, ""),
            (self.varying, self.varying_size, " about their mean"),
        ):
            square = float(np.mean(z**2))
            if square > ODDS:
                ratio = f"{np.sqrt(square):.2g} times as large{about}"
                text = f"the residuals are {ratio} as the sensor band predicts"
                sizes.append((text, float(scipy.stats.f.sf(square, size, self.noise_size))))
        biases, mean = [], float(np.mean(self.z))
        # A smaller one cannot be seen in the coverage.
        if abs(mean) >= 0.5:
            errors = abs(mean) * np.sqrt(self.mean_size)
            offset = f"{float(np.mean(self._residual)):+.3g} um off the mean"
            text = f"the readings lie {offset}, {errors:.2g} of its standard errors"
            # As sure as the size of the noise is.
            biases.append((text, 2 * float(scipy.stats.t.sf(errors, self.noise_size))))
        departures = (self._coverage(), sizes, biases)
        rarest = [
            min(candidates, key=lambda pair: pair[1], default=("", 1.0))
            for candidates in departures
        ]
        return [(text, chance) for text, chance in rarest if chance < DOUBT]

    def reasons(self, span: tuple[float, float], extent: float) -> list[str]:
        """Return why validation fails; nothing if it does not.

        ``span`` are the lowest and the highest voltage of training, V, ``extent`` is the range of
        its readings, um.
        """
        # A band that misses most of the readings has failed, unless they are off by so little that
        # luck may do it if all of them are worth one independent reading.
        single = scipy.stats.f.sf(np.mean(self.z**2), 1, self.noise_size)
        limit = DOUBT if self._covered(95) < 0.5 and single < DOUBT else ALARM
        reasons = [
            *self._reversed(span),
            *(text for text, chance in self.chances() if chance < limit),
        ]
        # Five readings six sds off, so that a bad start or spikes are not lost in a long record: a
        # good one has them once in five hundred million. A noise whose size is hardly known may
        # well be larger here.
        rows = np.flatnonzero(np.abs(self.z) > 6 * np.exp(2 * self.noise_log_sd))
        if rows.size >= 5:
            first = clock(self.bands.time[self.scored][rows[0]], self.bands.interval)
            reasons.append(
                f"{rows.size} readings lie more than 6 SDs off the mean, first at {first} s, the "
                f"farthest {np.max(np.abs(self.z)):.2g} SDs"
            )
        if self.bands.training:
            # A fit that misses its own readings by more than a sensor's noise would, by 5% of the
            # range: a Bouc-Wen model misses one or two percent of an actuator's displacement. The
            # range is that of all that was fitted: a short window's may be small.
            assert self.bands.measured is not None
            extent = max(extent, float(np.ptp(self.bands.measured[self.scored])))
            steps = np.diff(self._residual)
            # The median of a χ² variable of one degree of freedom is 0.4549.
            fast = float(np.sqrt(np.median(steps**2) / (2 * 0.4549))) if steps.size else 0.0
            rms = float(np.sqrt(np.mean(self._residual**2)))
            fast = max(fast, rounding_sd(self.bands.measured[self.scored]))
            # Of a sensor's noise, which no model follows, nothing is the model's fault.
            slow = np.sqrt(max(rms**2 - fast**2, 0.0))
            if slow > max(0.05 * extent, fast) and extent:
                reasons.append(f"NRMSE {percent(rms / extent)} on the training readings")
        square = float(np.mean(self.z**2))
        # A model that follows rounded readings exactly misses less than rounding would.
        assert self.bands.measured is not None
        if rounding := rounding_sd(self.bands.measured[self.scored]):
            widths = np.maximum(self.bands.sd("sensor")[self.scored], rounding)
            square = max(square, float(np.mean((rounding / widths) ** 2)))
        chance = scipy.stats.f.cdf(square, self.square_size, self.noise_size)
        if square < 0.25 and chance < ALARM:
            ratio = 1 / max(np.sqrt(square), 1e-9)
            reasons.append(f"the sensor band is {rounded(ratio, 2)} times too wide")
        return reasons

    @property
    def idle(self) -> str:
        """That the readings decide nothing: any model covers a motion smaller than its band."""
        width = float(np.mean((self.bands.upper["sensor", 95] - self.bands.mean)[self.scored])) * 2
        motion = float(np.ptp(self.bands.mean[self.scored]))
        if motion >= width:
            return ""
        return (
            f"the 95% sensor band, {width:.3g} um, is wider than the motion of {motion:.3g} um; "
            "validate on readings that move more"
        )

    @property
    def excess_width(self) -> str:
        """That the band is many times as wide as the sensor's noise; three are nine tenths of it.

        Such a band covers nearly anything that the drive of training does.
        """
        total, displacement = (
            float(np.mean(self.bands.read_sd(kind)[self.scored] ** 2))
            for kind in ("sensor", "displacement")
        )
        ratio = np.sqrt(total / max(total - displacement, 1e-9 * total))
        if ratio < 3:
            return ""
        return (
            f"the 95% sensor band is {rounded(ratio, 2)} times as wide as the sensor's noise "
            "alone; most of it is the model's error"
        )

    @property
    def offset_advice(self) -> str:
        """A large share of the offset in the variance, and the lead-in that makes it small."""
        lead, small = self.bands.lead_in, 0.15
        if lead is None or self.common <= small:
            return ""
        # The variance of a mean of correlated readings falls with their time.
        length = (lead.stop - lead.start) * self.common / small
        half_duration = float(np.ptp(self.bands.time[self.scored])) / 2
        longer = (
            f"lead_in = {length:.2g}"
            if length < half_duration
            else f"a record of {3 * length:.2g} s"
        )
        return (
            f"; the offset, estimated from a lead-in of {lead.stop - lead.start:.3g} s, makes "
            f"{percent(self.common)} of the band's variance; use {longer} for {percent(small)}"
        )

    @property
    def _residual(self) -> FloatArray:
        assert self.bands.measured is not None
        residual: FloatArray = (self.bands.measured - self.bands.mean)[self.scored]
        return residual

    def _covered(self, level: int) -> float:
        """Part of the readings in a sensor band."""
        assert self.bands.measured is not None
        return float(np.mean(self.bands.covers("sensor", level, self.bands.measured)[self.scored]))

    def _coverage(self) -> Iterator[tuple[str, float]]:
        """Find levels at which fewer readings lie in the sensor band than stated."""
        # Factors on the noise's sd, evenly probable, that the fit allows.
        scales = np.empty(0)
        for level in reversed(LEVELS):
            covered, nominal = self._covered(level), level / 100
            odds = covered / max(1 - covered, 1e-12) * (1 - nominal) / nominal
            if odds >= 1 / ODDS:
                continue
            if not scales.size:
                chance = (np.arange(200) + 0.5) / 200
                scales = np.sqrt(self.noise_size / scipy.stats.chi2.ppf(chance, self.noise_size))
            # The binomial distribution function, for a number of readings that is not whole.
            inside = covered * self.square_size
            outside = 2 * scipy.special.ndtr(scipy.special.ndtri((1 - nominal) / 2) / scales)
            chances = scipy.special.betainc(self.square_size - inside, inside + 1, outside)
            text = f"the {level}% sensor band covers {percent(covered)} of readings"
            yield text, float(np.mean(chances))

    def _reversed(self, span: tuple[float, float]) -> Iterator[str]:
        """Find readings that go against the voltage, where it goes up and down by enough.

        A lag of many seconds and a gain beyond all reason can follow even these.
        """
        bands, scored = self.bands, self.scored
        assert bands.measured is not None
        change = rate(bands.voltage, bands.interval)[scored] * bands.interval
        travel = min(float(np.sum(np.maximum(sign * change, 0))) for sign in (1, -1))
        if travel < (span[1] - span[0]) / 2 or not np.ptp(bands.measured[scored]):
            return
        correlation = float(np.corrcoef(bands.voltage[scored], bands.measured[scored])[0, 1])
        if correlation < -0.5:
            yield f"the readings fall where the voltage rises (correlation {correlation:.2f})"


def percent(share: float) -> str:
    """Return a part in percent."""
    return f"{100 * share:.3g}%"
