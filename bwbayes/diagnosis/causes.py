"""Causes of bands that fail on readings that were not fitted: shapes in the residuals, by evidence.

Given the bands, residuals are jointly normal: the parameters' error, the discrepancy, the sensor's
noise. Each cause adds shapes of unknown size (a constant, a trend, a decay at the start, the mean
itself, ...) with a normal prior, so that its evidence is exact and costs one pass of the noise's
filter. Where residuals are too large, a cause has to explain most of the excess. For readings that
were fitted, :mod:`bwbayes.diagnosis.explanations` finds the causes.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import scipy

from bwbayes.arrays import FloatArray, IntArray
from bwbayes.diagnosis.defects import DEFECTS
from bwbayes.diagnosis.departures import ODDS
from bwbayes.diagnosis.explanations import likely_causes
from bwbayes.diagnosis.finding import Finding, join_findings
from bwbayes.diagnosis.model import tail_nats
from bwbayes.diagnosis.series_patterns import Line, scatter, strongest_line
from bwbayes.inference.noise import DiscrepancyNoise
from bwbayes.model.inputs import rate
from bwbayes.prediction.bands import KINDS, Bands
from bwbayes.record.io.grid import clock

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
