"""Departures of readings from their bands: coverage, size of the residuals, bias, excess width.

The chance variation of a mean of many readings depends on their effective sample size, which is far
below their number: a discrepancy has a long correlation time, and the parameters' error is the same
all along. The sizes of these parts follow from the bands. A departure that chance may explain has
the probability of that on a record that the fitted model describes.

The causes of bands that fail on readings that were not fitted are shapes in the residuals. Given
the bands, residuals are jointly normal: the parameters' error, the discrepancy, the sensor's noise.
Each cause adds shapes of unknown size (a constant, a trend, a decay at the start, the mean itself,
...) with a normal prior, so that its evidence is exact and costs one pass of the noise's filter.
Where residuals are too large, a cause has to explain most of the excess. For readings that were
fitted, :mod:`bwbayes.diagnosis.explanations` finds the causes.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import scipy

from bwbayes.arrays import BoolArray, FloatArray, IntArray
from bwbayes.diagnosis.defects import DEFECTS
from bwbayes.diagnosis.explanations import likely_causes, tail_nats
from bwbayes.diagnosis.finding import Finding, join_findings
from bwbayes.diagnosis.series_patterns import Line, scatter, strongest_line
from bwbayes.inference.defaults import rounding_sd
from bwbayes.inference.noise import DiscrepancyNoise
from bwbayes.model.inputs import rate
from bwbayes.prediction.bands import KINDS, LEVELS, Bands
from bwbayes.record.io.grid import clock
from bwbayes.shown import rounded

# Probabilities of a false alarm of each test of coverage, size and bias, some ten for a record: a
# departure below the first fails, and one between both leaves the validation inconclusive.
ALARM, DOUBT = 2e-4, 0.01

# Coverage counts as off only if its odds are off by this factor: 92.6% instead of 95%, but not 94%.
ODDS = 1.5


@dataclass(frozen=True)
class StandardizedResiduals:
    """Standardized residuals of the scored readings, and their effective sample sizes.

    ``z`` (readings,) are residuals over the sensor band's sd; ``mean_size`` and ``square_size`` are
    the effective sample sizes of the record for the mean of z and for that of z². ``varying`` is z
    about its mean, scaled to a variance of one, and ``varying_size`` the effective sample size for
    the mean of its square; ``common`` is the part of the band's variance that all readings share,
    such as an offset's. ``noise_log_sd`` is the sd of the logarithm of the noise's sd.
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
        """Divide the residuals by their sd, and work out their effective sample sizes.

        With the shares c, p, q and w of a common error, of parameters, discrepancy and sensor in
        the variance, z at two samples t apart has the correlation c + p + q exp(-t/τ), and z² its
        square. The common error drops out of z about its mean. ``memory`` is τ, s.
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
            """Return the mean correlation of all pairs of squares."""
            return p**2 + 2 * p * q * once + q**2 * twice + (1 - (p + q) ** 2) * single

        mean = p + q * once + (1 - p - q) * single
        shared = (p - common) + q * (1 - once) + (1 - p - q) * (1 - single)
        # The bands may hold nothing but a common error, or there may be a single reading.
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
        """Number of independent readings that would determine the noise's sd as well as the fit."""
        return 1 / max(2 * self.noise_log_sd**2, 1e-9)

    @property
    def effective_size(self) -> float:
        """Effective sample size, about the mean, of record and fit together."""
        return 1 / (1 / self.varying_size + 1 / self.noise_size)

    def chances(self) -> list[tuple[str, float]]:
        """Return departures in coverage, size and bias, with their probabilities by chance.

        Each has its least likely departure in the list, if that probability is below ``DOUBT``.
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
        # A smaller bias does not show in the coverage.
        if abs(mean) >= 0.5:
            errors = abs(mean) * np.sqrt(self.mean_size)
            offset = f"{float(np.mean(self._residual)):+.3g} um off the mean"
            text = f"the readings lie {offset}, {errors:.2g} of its standard errors"
            # The size of the noise is uncertain: take a t distribution.
            biases.append((text, 2 * float(scipy.stats.t.sf(errors, self.noise_size))))
        departures = (self._coverage(), sizes, biases)
        rarest = [
            min(candidates, key=lambda pair: pair[1], default=("", 1.0))
            for candidates in departures
        ]
        return [(text, chance) for text, chance in rarest if chance < DOUBT]

    def reasons(self, span: tuple[float, float], extent: float) -> list[str]:
        """Return the reasons for a failure of the validation; none if it does not fail.

        ``span`` are the lowest and the highest voltage of training, V, ``extent`` is the range of
        its readings, um.
        """
        # A band that misses most of the readings has failed, unless chance may explain their
        # residuals even if all of them together are worth one independent reading.
        single = scipy.stats.f.sf(np.mean(self.z**2), 1, self.noise_size)
        limit = DOUBT if self._share_inside(95) < 0.5 and single < DOUBT else ALARM
        reasons = [
            *self._find_reversed(span),
            *(text for text, chance in self.chances() if chance < limit),
        ]
        # Test for five readings six sds off, so that a long record does not hide a bad start or
        # spikes: a good reading is so far off once in five hundred million. If the noise's size is
        # uncertain, it may well be larger here.
        rows = np.flatnonzero(np.abs(self.z) > 6 * np.exp(2 * self.noise_log_sd))
        if rows.size >= 5:
            first = clock(self.bands.time[self.scored][rows[0]], self.bands.interval)
            reasons.append(
                f"{rows.size} readings lie more than 6 SDs off the mean, first at {first} s, the "
                f"farthest {np.max(np.abs(self.z)):.2g} SDs"
            )
        if self.bands.training:
            # A fit fails if its residual exceeds the sensor's noise and 5% of the range: that of a
            # Bouc-Wen model is one or two percent of an actuator's displacement. The range is that
            # of all fitted readings: a short window's may be small.
            assert self.bands.measured is not None
            extent = max(extent, float(np.ptp(self.bands.measured[self.scored])))
            steps = np.diff(self._residual)
            # The median of a χ² variable of one degree of freedom is 0.4549.
            fast = float(np.sqrt(np.median(steps**2) / (2 * 0.4549))) if steps.size else 0.0
            rms = float(np.sqrt(np.mean(self._residual**2)))
            fast = max(fast, rounding_sd(self.bands.measured[self.scored]))
            # Subtract the sensor's noise, which no model follows.
            slow = np.sqrt(max(rms**2 - fast**2, 0.0))
            if slow > max(0.05 * extent, fast) and extent:
                reasons.append(f"NRMSE {percent(rms / extent)} on the training readings")
        square = float(np.mean(self.z**2))
        # A model that follows rounded readings exactly has a residual below that of rounding.
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
        """Note that the motion is smaller than the band, which any model would cover, or ""."""
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
        """Note that the band is at least three times as wide as the sensor's noise, or "".

        The model's error is nine tenths of such a band's variance, and the band covers nearly any
        response to the drive of training.
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
        """Note of a large share of the offset in the variance, with the lead-in to reduce it."""
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

    def _share_inside(self, level: int) -> float:
        """Return the part of the readings in a sensor band."""
        assert self.bands.measured is not None
        return float(np.mean(self.bands.covers("sensor", level, self.bands.measured)[self.scored]))

    def _coverage(self) -> Iterator[tuple[str, float]]:
        """Find levels at which fewer readings lie in the sensor band than stated."""
        # Equally probable factors on the noise's sd, within the fit's uncertainty.
        scales = np.empty(0)
        for level in reversed(LEVELS):
            covered, nominal = self._share_inside(level), level / 100
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

    def _find_reversed(self, span: tuple[float, float]) -> Iterator[str]:
        """Find readings that go against the voltage, if it goes up and down by enough.

        A model with a lag of many seconds and an absurd gain can follow even these.
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


# A lead-in whose test has a smaller p value than this does not fit.
LEAD_IN_ALARM = 0.002

# Cause of a failing training record without a fitted explanation, unless its cause is outliers.
UNEXPLAINED = Finding(
    "unknown",
    "unknown (no explanation takes most of the error away)",
    "look at the residuals in the figure, and compare other models of this record",
)


def cause(bands: Bands, memory: float, beyond: Sequence[Finding] = ()) -> Finding:
    """Return the likely cause of bands that fail, or the finding that no known cause explains it.

    Parameters
    ----------
    bands
        Bands with readings.
    memory
        Correlation time of the discrepancy, s.
    beyond
        Respects in which the drive goes beyond that of training.
    """
    ranked = sorted(
        _explanations(bands, np.flatnonzero(bands.scored(bands.measured)), memory),
        key=lambda finding: -finding.nats,
    )
    likely = join_findings(likely_causes(ranked)) or Finding(
        "unknown",
        "unknown (no pattern in the residuals)",
        "look at the residuals in the figure; train on a record like this one",
    )
    lead = bands.lead_in
    hidden = likely.kind in ("start", "offset", "noise", "unknown")
    if lead is not None and lead.p_value < LEAD_IN_ALARM and hidden:
        stop = clock(lead.stop, bands.interval)
        return Finding(
            "lead-in",
            "a start that the lead-in does not show (a transient, a drift, or another actuator)",
            f"set lead_in_start = {stop} in [validation.{bands.name}], or predict with "
            f"--lead-in-start {stop}; a longer --lead-in or a --window may help too",
            nats=likely.nats,
        )
    kinds = set(likely.kind.split(" or "))
    # Creep widens loops, and is too small for another gain, a delay or what looks like outliers.
    shapeless = kinds <= {"loop", "noise", "unknown"}
    possible = [finding for finding in beyond if shapeless or finding.kind in ("range", "speed")]
    if possible and kinds <= {"loop", "noise", "unknown", "gain", "delay", "outliers"}:
        return Finding("extrapolation", f"extrapolation: {possible[0].text}", possible[0].fix)
    return likely


def _explanations(  # noqa: PLR0915  # a cause after the other
    bands: Bands, rows: IntArray, memory: float
) -> list[Finding]:
    """Compare each cause with none by the readings at ``rows`` (readings,), in nats."""
    assert bands.measured is not None
    mean, time, interval = bands.mean[rows], bands.time[rows], bands.interval
    residual = bands.measured[rows] - mean
    parameter_variance, slow, total_variance = (
        float(np.mean(bands.read_sd(kind)[rows] ** 2)) for kind in KINDS
    )
    # No band is narrower than the resolution of floating-point numbers.
    largest = float(np.max(np.abs([bands.measured[rows], mean])))
    floor = max(1e-12 * total_variance, max(np.spacing(largest), 1e-150) ** 2)
    sds = np.sqrt(
        np.maximum([total_variance - slow, slow - parameter_variance if memory > 0 else 0.0], floor)
    )
    noise = np.array([[*sds, max(memory, interval)]])
    # Each of the parameters' errors has an independent standard normal size.
    varying = np.sqrt(max(parameter_variance - bands.common_sd**2, 0.0)) * (mean - np.mean(mean))
    errors = np.stack([np.full(rows.size, bands.common_sd), varying / (np.std(mean) or 1.0)])
    skipped = np.concatenate([[0.0], np.diff(rows) - 1.0])

    def weigh(
        added: FloatArray, residual: FloatArray = residual
    ) -> tuple[float, FloatArray, FloatArray, float]:
        """Explain a residual by shapes (shapes, readings) of standard normal sizes.

        Returns its log density up to a constant that all shapes share, the innovations (readings,)
        that the shapes leave, in sds, the sizes (shapes,), and the mean square of the residual that
        shapes and parameters leave, um².
        """
        series = np.concatenate([[residual], errors, added])
        white = DiscrepancyNoise(interval).whiten(noise, series[np.newaxis], skipped)[0][0]
        precision = np.eye(len(series) - 1) + white[1:] @ white[1:].T
        pull = white[1:] @ white[0]
        sizes = np.linalg.solve(precision, pull)
        squares = float(white[0] @ white[0] - pull @ sizes)
        log_volume = float(np.linalg.slogdet(precision)[1])
        log_density = -0.5 * (squares + log_volume)
        unexplained = float(np.mean((residual - sizes @ series[1:]) ** 2))
        return log_density, white[0] - sizes @ white[1:], sizes[len(errors) :], unexplained

    plain, white, _, missed = weigh(np.empty((0, rows.size)))
    along = (time - time[0]) / max(float(np.ptp(time)), interval)
    shapes = _shapes(bands, rows, along)
    weighed = {kind: weigh(added) for kind, added in shapes.items()}
    nats = {kind: fit[0] - plain for kind, fit in weighed.items()}
    unexplained = {kind: fit[-1] for kind, fit in weighed.items()}
    # Add twice the mean: readings of the opposite sign are the mean then.
    log_density, _, _, unexplained["sign"] = weigh(shapes["offset"], residual + 2 * mean)
    nats["sign"] = log_density - plain
    # Time constants of a bad start, as fractions of the record, evenly probable.
    constants = (1 / 3, 1 / 10, 1 / 30, 1 / 100)
    decays = [weigh(3 * shapes["offset"] * np.exp(-along / decay)) for decay in constants]
    starts = [fit[0] for fit in decays]
    unexplained["start"] = decays[int(np.argmax(starts))][-1]
    nats["start"] = float(scipy.special.logsumexp(starts)) - np.log(len(constants)) - plain
    nats["outliers"] = tail_nats(white)
    outlying = np.abs(white) > 5 * max(scatter(white), 1.0)
    unexplained["outliers"] = float(np.mean(np.where(outlying, 0.0, residual) ** 2))
    size = float(shapes["offset"][0, 0])
    # Try a step at the largest innovation and, for a discrepancy without memory, at the sample
    # where the means before and after it are farthest apart.
    order = np.arange(white.size)
    parted = np.cumsum(white) - white - np.mean(white) * order
    contrast = parted**2 / np.maximum(order * (white.size - order), 1)
    steps = []
    for later in (int(np.argmax(np.abs(white) * (order > 0))), int(np.argmax(contrast))):
        after = np.where(order >= later, size, 0.0)[np.newaxis]
        log_density, _, sizes, rest = weigh(after)
        steps.append((log_density, later, size * float(sizes[0]), rest))
    log_density, later, jump, unexplained["step"] = max(steps)
    nats["step"] = log_density - plain - np.log(rows.size)
    line = strongest_line(white, bands.voltage[rows], rows - rows[0], interval) or Line(0.0, "")
    phase = 2 * np.pi * line.frequency * time
    waves = size / 10 * np.stack([np.sin(phase), np.cos(phase)])
    log_density, _, swing, unexplained["oscillation"] = weigh(waves)
    nats["oscillation"] = log_density - plain - np.log(rows.size / 2)
    square = float(np.mean(white**2))
    nats["noise"] = 0.5 * (white.size * (square - 1 - np.log(square)) - np.log(white.size))
    unexplained["noise"] = missed / square
    settled = time[0] + 3 * constants[int(np.argmax(starts))] * float(np.ptp(time))
    words = {
        "name": bands.name,
        "settled": clock(settled, interval),
        "size": f"{np.mean(residual):+.3g}",
        "jump": f"{jump:+.2g}",
        "jumped": clock(time[later], interval),
        "swing": f"{size / 10 * np.hypot(*swing):.2g}",
        "line": f"{line.frequency:.4g} Hz{line.source}",
        "spikes": ", ".join(
            f"[{clock(t, interval)}, {clock(t + interval, interval)}]"
            for t in np.sort(time[np.argsort(-np.abs(white))[:3]]).tolist()
        ),
    }
    return [
        Finding(kind, text.format(**words), fix.format(**words), nats=nats[kind])
        for kind, (text, fix) in ((kind, DEFECTS[kind].in_bands) for kind in nats)
        # A named cause removes most of the excess over the bands, if that is large. Loops only
        # indicate a model that is too simple; they need not explain the excess.
        if kind == "loop"
        or missed < ODDS * total_variance
        or unexplained[kind] - total_variance < 0.5 * (missed - total_variance)
    ]


def _shapes(bands: Bands, rows: IntArray, along: FloatArray) -> dict[str, FloatArray]:
    """Return the shapes (shapes, readings) that may be added to the mean, by kind, um.

    ``along`` (readings,) goes from 0 to 1. Prior sds are a tenth of the mean's range; 0.3 for a
    gain; 0.3 of the time in which the mean changes by its sd for a delay.
    """
    mean, voltage = bands.mean[rows], bands.voltage[rows]
    slope = np.gradient(bands.mean, bands.interval)[rows]
    size = 0.1 * (float(np.ptp(mean)) or 1.0)
    level = (voltage - np.mean(voltage)) / (float(np.max(np.abs(voltage))) or 1.0)
    speed = rate(bands.voltage, bands.interval)[rows]
    sign_of_speed = np.tanh(3 * speed / (float(np.sqrt(np.mean(speed**2))) or 1.0))
    return {
        "drift": size * np.stack([along, along**2]),
        "offset": np.full((1, rows.size), size),
        "gain": 0.3 * (mean - np.mean(mean))[np.newaxis],
        "delay": 0.3 * np.std(mean) / (np.std(slope) or 1.0) * slope[np.newaxis],
        "loop": size
        * np.stack(
            [
                level,
                level**2,
                level**3,
                sign_of_speed,
                sign_of_speed * level,
                sign_of_speed * level**2,
            ]
        ),
    }
