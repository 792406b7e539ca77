"""Whether bands hold on a record: the verdict that stands first on screen and report.

Bands are held against the readings in three ways: how many readings they cover, how large the
residuals are, and whether the residuals lean to one side. What luck alone may do to these three
depends on how many independent readings a record is worth, and that is far fewer than it has: its
discrepancy forgets slowly, and the parameters' error is one and the same all along. The bands
themselves say how large each part is, so that the number follows from the model; a record that is
worth too few to tell anything gets no verdict. A fit is judged on its own readings too. There the
noise model grows until it covers whatever the model misses, so that a fit fails when it misses
more than a part of the displacement's range.

A verdict that says no names the likeliest cause (:mod:`bwbayes.results.causes`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import special, stats

from bwbayes.arrays import BoolArray, FloatArray
from bwbayes.inference.posterior import Posterior
from bwbayes.results.bands import LEVELS, Bands, Switched
from bwbayes.results.causes import Cause, Residuals, cause, drifts, likeliest
from bwbayes.results.drift import Drift
from bwbayes.results.innovations import OddStart
from bwbayes.results.standard import Z_90, Standard, standardised
from bwbayes.results.transient import DOUBTED, Transient

__all__ = ["Background", "Verdict", "assess"]

# A root mean square error, in parts of the range, above which a fit misses its readings: a
# Bouc-Wen model misses one or two percent of an actuator's displacement.
POOR = 0.05

# False alarms of each of the tests of coverage and size: some ten of them look at a record.
ALARM = 2e-4

# Standard errors that the mean of the residuals may be off.
LEANING = 4.5

# Coverage counts as off only where its odds are off by this factor: 95 % is not 92.6 %, but 94.
ODDS = 1.5

# Bands count as too wide where the residuals are smaller than they say by this factor or more.
TOO_WIDE = 0.5

# Residuals beyond this many sds count as this many, where their size is judged.
FAR = 6.0

# Readings in a row that are judged by themselves, so that a bad start is not lost in a long record.
IN_A_ROW = 5

# Worth fewer independent readings than this a record cannot show that bands hold.
FEWEST = 5.0

# The quantile of the discrepancy's time that the judgement goes by: rather too long than too short.
LONG = 0.9

# A lead-in whose test says less than this does not fit.
LEAD_IN_ALARM = 0.002

# Nats that a transient at another record's start must add, as at that of a fit's. It must be so
# many times as large as the sensor band's sd: smaller ones hardly move the offset by more than the
# band allows.
SWITCHED, SIZE = 9.0, 3.0


@dataclass(frozen=True)
class Background:
    """What a verdict needs to know of the fit, besides the bands.

    Parameters
    ----------
    memory
        Correlation time of the discrepancy, s; to be on the safe side, a high quantile of its
        posterior. Zero without a discrepancy.
    unsure
        Sd of the logarithm of the noise's sd over the draws: how well its size is known.
    fitted
        Lowest and highest voltage that was fitted, V.
    extent
        Range of all readings of a record that were fitted, um, whatever their windows.
    """

    memory: float = 0.0
    unsure: float = 0.0
    fitted: tuple[float, float] = (-np.inf, np.inf)
    extent: float = 0.0

    @classmethod
    def of(cls, posterior: Posterior, draws: FloatArray) -> Background:
        """Return what a posterior and its draws (draws, free) say."""
        memory, unsure = [], []
        for _, alone, its in posterior.each(draws):
            one = alone.only
            noise = one.table.noise(alone.prior.theta(its))
            memory.append(float(np.quantile(one.noise.memory(noise), LONG)))
            sds = one.noise.marginal_sd(noise)
            unsure.append(float(np.std(np.log(np.sqrt(sum(sd**2 for sd in sds))))))
        every = posterior.datasets
        voltage = np.concatenate([one.voltage[window] for one in every for window in one.training])
        return cls(
            max(memory),
            max(unsure),
            (float(voltage.min()), float(voltage.max())),
            max(one.extent for one in every),
        )


@dataclass(frozen=True)
class Verdict:
    """Whether bands hold on one record or window.

    Attributes
    ----------
    name, training
        Those of the bands.
    holds
        False if the bands fail one of the tests; None if the record is too short to tell, or may
        start with a transient.
    reasons
        What is off and by how much, one line each; of None, why nothing can be told.
    cause
        The likeliest cause with its remedy, if the bands do not hold.
    """

    name: str
    training: bool
    holds: bool | None
    reasons: tuple[str, ...] = ()
    cause: Cause | None = None

    @property
    def line(self) -> str:
        """The verdict in one line."""
        what = f"{self.name}, {'fitted' if self.training else 'not fitted'}"
        if self.holds is not False:
            known = "holds" if self.holds else "cannot be told"
            return f"{what}: {known}{''.join(f'; {r}' for r in self.reasons)}"
        cause = "" if self.cause is None else f"; {self.cause.line}"
        return f"{what}: does not hold: {'; '.join(self.reasons)}{cause}"

    @property
    def summary(self) -> dict[str, object]:
        """The verdict as ``validation.NAME`` in summary.json has it."""
        return {
            "holds": self.holds,
            "reasons": list(self.reasons),
            "cause": None if self.cause is None else self.cause.kind,
            "remedy": None if self.cause is None else self.cause.remedy,
        }


def assess(
    bands: Bands,
    background: Background,
    *,
    start: OddStart | None = None,
    transient: Transient | None = None,
    drift: Drift | None = None,
    beyond: Sequence[str] = (),
) -> Verdict | None:
    """Judge bands by the readings after ``scored_from``; None if there are none.

    A good record, one that the fitted model describes, fails with a probability below 1 %.

    Parameters
    ----------
    bands
        Bands with readings.
    background
        What is known of the fit.
    start
        Of a fitted record, a start that does not go with the rest.
    transient
        Of a fitted record, a transient at its start that the fit has swallowed.
    drift
        Of a fitted record, a drift that the fit has swallowed.
    beyond
        In what the record's drive leaves the one that was fitted, a line each.
    """
    if bands.measured is None:
        return None
    judged = np.isfinite(bands.measured)
    judged[: bands.scored_from] = False
    if not judged.any():
        return None
    standard = standardised(bands, judged, background.memory, background.unsure)
    residuals = Residuals.of(bands, judged, background.fitted)
    reasons = [
        *residuals.reversed,
        *_lead_in(bands),
        *_odd(start),
        *([transient.line] if transient and transient.sure else []),
        *([drift.line] if drift else []),
        *_coverage(bands, judged, standard),
        *_size(standard),
        *_leaning(bands, judged, standard),
        *_locally(bands, judged, standard),
        *(_missed(bands, judged, background.extent) if bands.training else []),
        *residuals.isolated,
    ]
    wide = _too_wide(standard)
    if reasons or wide:
        why = likeliest(residuals) if reasons else cause("noise", residuals)
        if _lead_in(bands) and why.kind in ("start", "offset", "noise", "unknown"):
            why = cause("lead-in", residuals)
        sure = transient if transient and transient.sure else None
        if (start or sure) and why.kind not in ("sign", "outliers"):
            until = max(one.until for one in (start, sure) if one is not None)
            # A start that is off bends the fit, and looks like a drift that ends soon.
            if why.kind != "drift" or not drifts(residuals, until):
                why = cause("start", residuals, until)
        if drift and why.kind not in ("sign", "outliers", "start"):
            why = cause("drift", residuals)
        if beyond and why.kind in ("gain", "delay", "loop", "noise", "unknown"):
            why = Cause(
                "extrapolation",
                f"extrapolation: {beyond[0]}",
                "fit a record that is driven as far and as fast",
            )
        return Verdict(bands.name, bands.training, False, (*reasons, *wide), why)
    doubts = _doubts(bands, transient)
    if standard.worth < FEWEST:
        few = f"the record is worth {standard.worth:.1f} independent readings: too few to tell"
        doubts.insert(0, few)
    if doubts:
        return Verdict(bands.name, bands.training, None, tuple(doubts))
    return Verdict(bands.name, bands.training, True)


def _coverage(bands: Bands, judged: BoolArray, standard: Standard) -> list[str]:
    """Say where fewer readings lie in the sensor band than chance allows."""
    assert bands.measured is not None
    reading, worth = bands.measured[judged], standard.for_size
    for level in reversed(LEVELS):
        low, high = (edge["sensor", level][judged] for edge in (bands.lower, bands.upper))
        covered = float(np.mean((low <= reading) & (reading <= high)))
        nominal = level / 100
        odds = covered / max(1 - covered, 1e-12) * (1 - nominal) / nominal
        hits = covered * worth
        # The binomial distribution function, for a number of readings that is not whole, where the
        # noise's sd is any that the fit allows.
        within = 1 - 2 * stats.norm.sf(stats.norm.isf((1 - nominal) / 2) / standard.scales)
        chances = special.betainc(worth - hits, hits + 1, 1 - within) if covered < 1 else 1.0
        chance = float(np.mean(chances))
        if odds < 1 / ODDS and chance < ALARM:
            return [f"the {level} % sensor band covers {_percent(covered)} of the readings"]
    return []


def _size(standard: Standard) -> list[str]:
    """Say whether the residuals are larger than the sensor band says."""
    # A few spikes are told as such.
    square = float(np.mean(np.clip(standard.z, -FAR, FAR) ** 2))
    if square <= ODDS or stats.f.sf(square, standard.for_size, standard.known) >= ALARM:
        return []
    ratio = float(np.sqrt(np.mean(standard.z**2)))
    return [f"the residuals are {ratio:.2g} times as large as the band says"]


def _too_wide(standard: Standard) -> list[str]:
    """Say whether the residuals are far smaller than the sensor band says."""
    square = float(np.mean(standard.z**2))
    chance = stats.f.cdf(square, standard.for_size, standard.known)
    if square >= TOO_WIDE**2 or chance >= ALARM:
        return []
    return [f"the band is {1 / max(np.sqrt(square), 1e-9):.2g} times as wide as the residuals are"]


def _locally(bands: Bands, judged: BoolArray, standard: Standard) -> list[str]:
    """Say where readings in a row are farther off than any good record has them."""
    if standard.z.size < IN_A_ROW:
        return []
    rows = np.convolve(standard.z, np.ones(IN_A_ROW) / IN_A_ROW, mode="valid")
    at = int(np.argmax(np.abs(rows)))
    # A noise whose size is hardly known may well be larger here.
    if np.abs(rows[at]) <= FAR * np.exp(2 * standard.unsure):
        return []
    return [
        f"at {bands.time[judged][at]:.4g} s the readings lie {abs(rows[at]):.2g} sds off the mean"
    ]


def _leaning(bands: Bands, judged: BoolArray, standard: Standard) -> list[str]:
    """Say whether the residuals lean to one side by more than the band allows."""
    assert bands.measured is not None
    mean = float(np.mean(standard.z))
    # Less than this cannot be seen in the coverage.
    if abs(mean) * np.sqrt(standard.for_mean) <= LEANING or abs(mean) < 0.5:
        return []
    residual = float(np.mean((bands.measured - bands.mean)[judged]))
    sd = residual / mean if mean else 0.0
    return [f"the readings lie {residual:+.3g} um off the mean, {abs(mean):.2g} sds of {sd:.2g} um"]


def _missed(bands: Bands, judged: BoolArray, extent: float) -> list[str]:
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
    return [
        f"the mean misses the readings that were fitted by {_percent(rms / extent)} of their "
        "range (rms)"
    ]


def _odd(start: OddStart | None) -> list[str]:
    """Say that the start of a fitted record does not go with the rest."""
    if start is None:
        return []
    return [
        f"the first readings, until {start.until:.4g} s, do not go with the rest "
        f"({start.size:.2g} sds)"
    ]


def _lead_in(bands: Bands) -> list[str]:
    """Say whether the lead-in does not fit, or takes a transient for an offset."""
    lead = bands.lead_in
    if lead is None:
        return []
    lines = []
    if lead.p_value < LEAD_IN_ALARM:
        lines = [
            f"the lead-in of {lead.start:.4g} to {lead.stop:.4g} s does not fit the model "
            f"(p = {lead.p_value:.1g})"
        ]
    if lead.transient and lead.transient.nats > SWITCHED and _matters(bands, lead.transient):
        lines.append(lead.transient.line(lead.start, sure=True))
    return lines


def _matters(bands: Bands, transient: Transient | Switched) -> bool:
    """Tell whether a transient is so large that an offset or a parameter might follow it."""
    width = bands.upper["sensor", 90] - bands.lower["sensor", 90]
    return abs(transient.size) > SIZE * float(np.mean(width)) / (2 * Z_90)


def _doubts(bands: Bands, transient: Transient | None) -> list[str]:
    """Say what may be a transient, and may be chance."""
    lines = []
    if transient is not None and not transient.sure and _matters(bands, transient):
        lines.append(transient.line)
    lead = bands.lead_in
    if (
        lead
        and lead.transient
        and lead.transient.nats > DOUBTED
        and _matters(bands, lead.transient)
    ):
        lines.append(lead.transient.line(lead.start, sure=False))
    return lines


def _percent(part: float) -> str:
    return f"{100 * part:.3g} %"
