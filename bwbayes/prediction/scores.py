"""How good a prediction was: error of the mean, width and coverage of the bands, proper scores.

Coverage alone proves little. A wide band covers too, so width, CRPS and interval score stand
beside it; and the residuals of one record are correlated, so that a window holds few independent
chances to miss. A block bootstrap says how far the coverage may lie from nominal by luck.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from bwbayes.arrays import BoolArray, FloatArray
from bwbayes.errors import InputError
from bwbayes.prediction.bands import LEVELS, Bands, Kind
from bwbayes.sampling.diagnostics import autocorrelation_time
from bwbayes.shown import brief


@dataclass(frozen=True)
class Scores:
    """Scores of one stretch, over its samples from ``scored_from`` on.

    Attributes
    ----------
    nrmse, nrmse_full
        Root mean square of measured - mean over the range of the measured (nan if there is none),
        and over that of all readings that were fitted (None if it is not known).
    max_error_um
        Largest absolute measured - mean.
    log_score, crps_um
        Mean log density of a reading under the sensor's distribution, nats, per um, and mean
        continuous ranked probability score.
    width_um
        Mean width of the sensor band by level.
    interval_score_um
        Mean interval score of the sensor band by level: width + 2/a times the distance of a
        reading outside of the band to it, a = 1 - level (Gneiting and Raftery 2007, eq. (43)).
    coverage
        Fraction of readings inside the sensor band, and of the noise-free displacement inside
        the displacement band, by level; None without a truth.
    coverage_error
        Standard errors of ``coverage`` by block bootstrap. Its distribution is skewed: on a window
        of some twenty correlation times coverage is more than two errors off in one of seven
        perfect predictions.
    worst_second
        Lowest coverage of the sensor band over any second, by level.
    """

    __repr__ = brief

    nrmse: float
    max_error_um: float
    log_score: float
    crps_um: float
    width_um: dict[int, float]
    interval_score_um: dict[int, float]
    coverage: dict[str, dict[int, float] | None]
    coverage_error: dict[str, dict[int, float] | None]
    worst_second: dict[int, float]
    nrmse_full: float | None = None

    @property
    def numbers(self) -> dict[str, object]:
        """The numbers of ``validation.NAME`` in summary.json; null where there is none."""

        def by_level(values: dict[int, float] | None) -> dict[str, float] | None:
            return None if values is None else {str(level): x for level, x in values.items()}

        return {
            "nrmse": self.nrmse if np.isfinite(self.nrmse) else None,
            "nrmse_full": self.nrmse_full,
            "max_error_um": self.max_error_um,
            "log_score": self.log_score if np.isfinite(self.log_score) else None,
            "crps_um": self.crps_um,
            **{f"width_{level}_um": width for level, width in self.width_um.items()},
            **{f"interval_score_{level}_um": s for level, s in self.interval_score_um.items()},
            "coverage": {kind: by_level(x) for kind, x in self.coverage.items()},
            "coverage_error": {kind: by_level(x) for kind, x in self.coverage_error.items()},
            "worst_second": by_level(self.worst_second),
        }


def score(bands: Bands, full: float = 0.0) -> Scores:
    """Judge bands against what was measured, and against the truth where it is known.

    ``full`` is the range of all readings that were fitted, um, if it is known.

    Raises
    ------
    InputError
        If there is no measurement to judge by, or no reading from ``scored_from`` on.
    """
    if bands.measured is None or bands.crps is None or bands.log_score is None:
        raise InputError(
            f"{bands.name}: nothing was measured, so the bands cannot be scored; "
            "give a record with a displacement"
        )
    rows = bands.scored(bands.measured)
    if not rows.any():
        raise InputError(f"{bands.name}: all readings are missing; judge another window")
    measured = bands.measured[rows]
    residual = measured - bands.mean[rows]
    extent, rmse = float(np.ptp(measured)), float(np.sqrt(np.mean(residual**2)))
    coverage: dict[str, dict[int, float] | None] = {}
    error: dict[str, dict[int, float] | None] = {}
    targets: dict[Kind, FloatArray | None] = {
        "sensor": bands.measured,
        "displacement": bands.truth,
    }
    for kind, values in targets.items():
        coverage[kind] = error[kind] = None
        if values is not None:
            counts = bands.scored(values)
            hits = {level: bands.covers(kind, level, values)[counts] for level in LEVELS}
            coverage[kind] = {level: float(hit.mean()) for level, hit in hits.items()}
            error[kind] = _coverage_errors(hits, (values - bands.mean)[counts])
    width, interval_score, worst = {}, {}, {}
    scored = slice(bands.scored_from, None)
    for level in LEVELS:
        lower, upper = (edge["sensor", level][rows] for edge in (bands.lower, bands.upper))
        distance = np.maximum(lower - measured, 0) + np.maximum(measured - upper, 0)
        width[level] = float(np.mean(upper - lower))
        interval_score[level] = float(np.mean(upper - lower + 2 / (1 - level / 100) * distance))
        inside = bands.covers("sensor", level, bands.measured)
        worst[level] = _worst_second(inside[scored], rows[scored], bands.interval)
    return Scores(
        nrmse=rmse / extent if extent > 0 else np.nan,
        nrmse_full=rmse / full if full else None,
        max_error_um=float(np.abs(residual).max()),
        log_score=float(bands.log_score[rows].mean()),
        crps_um=float(bands.crps[rows].mean()),
        width_um=width,
        interval_score_um=interval_score,
        coverage=coverage,
        coverage_error=error,
        worst_second=worst,
    )


def _bootstrap_error(hits: BoolArray, block: int) -> float:
    """Estimate the standard error of the mean of a correlated series by a circular block bootstrap.

    The series is closed to a ring, and whole blocks are drawn from it with replacement until they
    make up its length: their mean has the variance of a block's mean over their number. Means of
    blocks scatter around the mean of the series, not around the unknown one, which loses the share
    block / samples of the variance; it is given back. Zero if all hits are equal, since then the
    series shows no variance.

    D. N. Politis and J. P. Romano, A circular block-resampling procedure for stationary data,
    in Exploring the Limits of Bootstrap, Wiley 1992, 263-270.
    """
    samples = hits.size
    if (hits == hits[0]).all():
        return 0.0
    block = max(1, min(block, samples // 4))  # fewer than four say little
    total = np.concatenate([[0.0], np.cumsum(np.concatenate([hits, hits[: block - 1]]))])
    means = (total[block:] - total[:-block]) / block
    return float(np.sqrt(means.var() * block / (samples - block)))


def _coverage_errors(hits: dict[int, BoolArray], residual: FloatArray) -> dict[int, float]:
    """Estimate the errors of coverage by level, also where a band is hardly ever missed.

    With few misses, or none, the bootstrap takes the luck of the window for certainty. The level
    nearest a half shows best how many independent hits m the window is worth, p (1 - p) / m being
    the squared error; another level's error is at least that of m hits at Jeffreys' estimate
    (m p + 1/2) / (m + 1) of its coverage.
    """
    # Three integrated autocorrelation times of the residual. A hit depends on its size, not on its
    # sign, and the square of a Gaussian series forgets twice as fast as the series, so that a block
    # is at least six times as long as the hits' own time.
    time = autocorrelation_time(residual[np.newaxis])
    block = max(1, round(3 * time)) if np.isfinite(time) else 1
    errors = {level: _bootstrap_error(hit, block) for level, hit in hits.items()}
    covered = {level: float(hit.mean()) for level, hit in hits.items()}
    nearest = min(covered, key=lambda level: abs(covered[level] - 0.5))
    p = covered[nearest]
    worth = hits[nearest].size / block
    if errors[nearest] > 0:
        worth = p * (1 - p) / errors[nearest] ** 2
    for level, p in covered.items():
        estimate = (worth * p + 0.5) / (worth + 1)
        errors[level] = max(errors[level], float(np.sqrt(estimate * (1 - estimate) / worth)))
    return errors


def _worst_second(hits: BoolArray, scored: BoolArray, interval: float) -> float:
    """Lowest coverage of the readings in a second, in all of them if they last less.

    A second that holds fewer than half as many readings as the fullest one says little, and is
    left out.
    """
    block = max(1, min(round(1 / interval), hits.size))
    covered, readings = (
        np.concatenate([[0], np.cumsum(flags)]) for flags in (hits & scored, scored)
    )
    counts = readings[block:] - readings[:-block]
    full = 2 * counts >= counts.max()
    return float(((covered[block:] - covered[:-block])[full] / counts[full]).min())
