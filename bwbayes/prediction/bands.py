"""Displacement bands: where the displacement will be, in three senses that must not be confused.

``parameter``: where the model's displacement may lie because the parameters are uncertain.
``displacement``: where the actuator's displacement may lie, model discrepancy included.
``sensor``: where a new sensor reading may lie, sensor noise included; the only one that a
measurement can check.

Coverage alone proves little. A wide band covers too, so width, CRPS and interval score stand
beside it; and the residuals of one record are correlated, so that a window holds few independent
chances to miss. A block bootstrap says how far the coverage may lie from nominal by luck.

A band that has failed validation is corrected from the readings that it failed on. The held-out
readings fall into blocks longer than their residual is correlated, so that blocks are nearly
independent, and as good as a block of the next record of the same kind of drive. With F_j(f) the
share of block j's readings inside the band, f times as wide about its mean, and n blocks,

    f = the least one with  Σ_j F_j(f) >= level (n + 1),

which covers at least ``level`` of the next block's readings on average, whatever the model's error
is like: conformal risk control (Angelopoulos et al., ICLR 2024, equation (4)), with the share that
is missed for the risk. There is none with fewer than 19 blocks, and here with fewer than twenty.

A lead-in tells a record's offset from readings with the model's error, and the next record has
another lead-in. So each block is judged about the means that lead-ins elsewhere in the record would
have given, and F_j(f) is the mean over these. Other differences between records, such as an initial
state that a lead-in has told badly, the blocks of one record do not show: with these, the next
record is covered less.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal, Self

import numpy as np
import scipy

from bwbayes.arrays import BoolArray, FloatArray, IntArray
from bwbayes.errors import InputError
from bwbayes.sampling.diagnostics import autocorrelation_time
from bwbayes.shown import brief

Kind = Literal["parameter", "displacement", "sensor"]
KINDS: tuple[Kind, ...] = ("parameter", "displacement", "sensor")

# Probabilities of the bands, percent.
LEVELS = (50, 90, 95)

# Width of the 90% interval of a normal distribution in sds.
WIDTH_90 = float(2 * scipy.special.ndtri(0.95))


@dataclass(frozen=True)
class LeadIn:
    """The stretch that told a record's start, and how well it fits.

    It goes from ``start`` to ``stop`` in s and holds ``samples`` readings; ``p_value`` is that of
    a test of its innovations, small where the model cannot have made them. ``tells_offset`` says
    that it told the record's own offset.
    """

    start: float
    stop: float
    samples: int
    p_value: float
    tells_offset: bool = True


@dataclass(frozen=True)
class Correction:
    """How much wider a 95% sensor band has to be to cover what it states, on drives alike.

    Attributes
    ----------
    factor
        The corrected band's width over the model's, about the mean; None where ``blocks`` are too
        few to tell.
    blocks
        Independent blocks of held-out readings on which it rests.
    block_s
        Length of a block, s: the residual is correlated for a shorter time.
    needed_s
        Length of held-out readings that would do, s; None where there are enough.
    """

    factor: float | None
    blocks: int
    block_s: float
    needed_s: float | None = None

    def __str__(self) -> str:
        held_out = f"{self.blocks} independent blocks of {self.block_s:.2g} s"
        if self.factor is None:
            return (
                f"the band cannot be corrected from this record: its held-out readings are "
                f"{held_out}; hold out {self.needed_s:.2g} s of a drive like this one"
            )
        return (
            f"corrected 95% sensor band: {self.factor:.2g} times as wide, for drives like this "
            f"one, from {held_out}"
        )


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


@dataclass(frozen=True)
class Bands:
    """Pointwise bands along one stretch of samples.

    All arrays are (samples,): ``time`` in s, ``voltage`` in V, the others in um; ``measured`` and
    ``truth`` (the noise-free displacement) are None where there is none. ``lower`` and ``upper``
    hold a band's edges by kind and level. ``pit`` is the probability integral transform of each
    reading under the sensor's distribution, ``crps`` its continuous ranked probability score in
    um, ``log_score`` the log of its density there, nats; all None without a measurement. Samples
    before ``scored_from`` served to estimate the record's offset and are not judged. ``interval``
    is the sampling interval in s; ``training`` says that the samples were fitted to. ``lead_in``
    says how well the lead-in fits, if there was one. ``inside`` (samples,) tells which samples the
    bands are about, where they are several windows of a record: the others have no reading here.
    ``time_offset`` is what the file's own clock adds to the times, s; ``common_sd`` the sd of what
    the parameters leave unsure of all samples alike, as an offset does, um; ``separate`` says that
    it is another record than any that was fitted. The voltage is the path that drives the model.
    ``model_error_sd`` is what displacement and sensor bands have in them of how much more other
    models differ on this drive than in training, um; None of a drive like those of training, and
    where the model's error does not follow the drive. Where the sensor's scale is unsure,
    ``read_sds`` are the sds, um, that the parameter and displacement bands have without that.
    ``scores`` compare the bands with the readings; None until :meth:`with_scores` adds them.
    """

    __repr__ = brief

    name: str
    time: FloatArray
    voltage: FloatArray
    measured: FloatArray | None
    truth: FloatArray | None
    mean: FloatArray
    lower: dict[tuple[Kind, int], FloatArray]
    upper: dict[tuple[Kind, int], FloatArray]
    pit: FloatArray | None
    crps: FloatArray | None
    log_score: FloatArray | None
    interval: float
    scored_from: int = 0
    training: bool = False
    lead_in: LeadIn | None = None
    inside: BoolArray | None = None
    time_offset: float = 0.0
    common_sd: float = 0.0
    separate: bool = False
    model_error_sd: float | None = None
    correction: Correction | None = None
    read_sds: dict[Kind, FloatArray] | None = None
    scores: Scores | None = None

    @property
    def title(self) -> str:
        """The name of the bands, and what they are of."""
        kind = "training" if self.training else "separate record" if self.separate else "held out"
        return self.name if self.name == kind else f"{self.name} ({kind})"

    @property
    def corrected(self) -> tuple[FloatArray, FloatArray] | None:
        """Lower and upper edge (samples,) of the corrected 95% sensor band, um; None without."""
        if self.correction is None or self.correction.factor is None:
            return None
        factor, edges = self.correction.factor, (self.lower, self.upper)
        lower, upper = (self.mean + factor * (edge["sensor", 95] - self.mean) for edge in edges)
        return lower, upper

    @property
    def without_rivals(self) -> Bands:
        """The bands as they would be without the model's error, without scores of the readings.

        About the mean, by the ratio of the sds: of normal distributions.
        """
        if not self.model_error_sd:
            return self
        lower, upper, read_sds = dict(self.lower), dict(self.upper), self.read_sds
        if read_sds is not None:
            variance = np.maximum(read_sds["displacement"] ** 2 - self.model_error_sd**2, 0.0)
            read_sds = {**read_sds, "displacement": np.sqrt(variance)}
        for kind in KINDS[1:]:
            sd = self.sd(kind)
            ratio = np.sqrt(np.maximum(1 - (self.model_error_sd / sd) ** 2, 0.0))
            for level in LEVELS:
                for edges in (lower, upper):
                    edges[kind, level] = self.mean + ratio * (edges[kind, level] - self.mean)
        return replace(
            self,
            lower=lower,
            upper=upper,
            pit=None,
            crps=None,
            log_score=None,
            model_error_sd=None,
            read_sds=read_sds,
            scores=None,
        )

    def width(self, level: int = 95) -> float:
        """Return the mean width of the sensor band after the lead-in, um."""
        width = self.upper["sensor", level] - self.lower["sensor", level]
        return float(np.mean(width[self.scored_from :]))

    @property
    def model_error_note(self) -> str:
        """By how much the bands are wider for the model's error, and why; nothing if not."""
        if not self.model_error_sd:
            return ""
        width, before = self.width(), self.without_rivals.width()
        return (
            f"bands widened {width / before:.2g} times on this one (95% sensor band {width:.2g} um "
            f"wide instead of {before:.2g} um), because other models of the training record differ "
            f"by {self.model_error_sd:.2g} um more here"
        )

    @property
    def windows(self) -> list[slice]:
        """The windows that the bands are about, each without a gap."""
        if self.inside is None:
            return [slice(0, self.time.size)]
        edges = np.flatnonzero(np.diff(self.inside, prepend=False, append=False))
        return [slice(*edge) for edge in edges.reshape(-1, 2).tolist()]

    def sd(self, kind: Kind) -> FloatArray:
        """Sd (samples,) of a normal distribution whose 90% band is as wide, um."""
        width: FloatArray = self.upper[kind, 90] - self.lower[kind, 90]
        return width / WIDTH_90

    def read_sd(self, kind: Kind) -> FloatArray:
        """Sd (samples,) of a band in the sensor's readings, whatever its scale is, um."""
        return (self.read_sds or {}).get(kind, self.sd(kind))

    def scored(self, values: FloatArray | None) -> BoolArray:
        """Tell which samples count: those after a lead-in where values (samples,) are known."""
        counts = np.isfinite(np.full(self.time.size, np.nan) if values is None else values)
        counts[: self.scored_from] = False
        return counts

    def covers(self, kind: Kind, level: int, values: FloatArray) -> BoolArray:
        """Tell which values (samples,), um, a band covers; its edges belong to it."""
        covered: BoolArray = (self.lower[kind, level] <= values) & (
            values <= self.upper[kind, level]
        )
        return covered

    def with_scores(self, full: float) -> Self:
        """Return the bands with their scores if they have readings; ``full`` as in `score`."""
        if not self.scored(self.measured).any():
            return self
        return replace(self, scores=score(self, full))

    def within(self, windows: Sequence[slice]) -> Bands:
        """Return the bands of some windows: from the first sample of them to the last."""
        span = slice(windows[0].start, windows[-1].stop)
        inside = np.zeros(self.time.size, dtype=np.bool_)
        for window in windows:
            inside[window] = True
        changes = dict[str, Any]()
        for name in ("measured", "truth", "pit", "crps", "log_score"):
            values = getattr(self, name)
            if values is not None:
                changes[name] = np.where(inside, values, np.nan)[span]
        for name in ("time", "voltage", "mean"):
            changes[name] = getattr(self, name)[span]
        for name in ("lower", "upper"):
            changes[name] = {band: edge[span] for band, edge in getattr(self, name).items()}
        if self.read_sds is not None:
            changes["read_sds"] = {kind: sd[span] for kind, sd in self.read_sds.items()}
        inside = inside[span]
        return replace(self, **changes, inside=None if inside.all() else inside)

    def columns(self) -> Iterator[tuple[str, FloatArray]]:
        """Yield the names and values of the columns of ``bands.csv``."""
        rows = slice(None) if self.inside is None else self.inside
        yield "time_s", self.time[rows]
        if self.time_offset:
            yield "file_time_s", self.time_offset + self.time[rows]
        yield "voltage_V", self.voltage[rows]
        if self.measured is not None:
            yield "displacement_um", self.measured[rows]
        yield "mean_um", self.mean[rows]
        for kind in KINDS:
            for level in LEVELS:
                yield f"{kind}_lower_{level}_um", self.lower[kind, level][rows]
                yield f"{kind}_upper_{level}_um", self.upper[kind, level][rows]
        if self.corrected is not None:
            for side, edge in zip(("lower", "upper"), self.corrected, strict=True):
                yield f"corrected_{side}_95_um", edge[rows]


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


def correct(bands: Bands) -> Correction:
    """Return the correction of a 95% sensor band from its readings after ``scored_from``.

    Each window is cut into blocks that are as long as the residual remembers, or longer.
    """
    assert bands.measured is not None
    scored = bands.scored(bands.measured)
    residual = np.where(scored, bands.measured - bands.mean, 0.0)
    edges = [edge["sensor", 95] - bands.mean for edge in (bands.lower, bands.upper)]

    length = math.ceil(residual_memory(residual / np.maximum(bands.sd("sensor"), 1e-150), scored))
    blocks: list[IntArray] = []
    for window in bands.windows:
        rows = np.arange(max(window.start, bands.scored_from), window.stop)
        count = rows.size // length
        if count:
            blocks += [block[scored[block]] for block in np.array_split(rows, count)]
    blocks = [block for block in blocks if block.size]
    block_s = length * bands.interval
    least = 20
    if len(blocks) < least:
        return Correction(None, len(blocks), block_s, least * block_s)
    shifts = _shifts(bands)
    rows = np.concatenate(blocks)
    share = np.concatenate([np.full(one.size, 1 / one.size / shifts.size) for one in blocks])
    share = np.tile(share, shifts.size)
    # Each reading's own factor: how much wider the band has to be to reach it.
    away = (residual[rows] - shifts[:, np.newaxis]).ravel()
    below, above = (np.tile(np.abs(edge[rows]), shifts.size) for edge in edges)
    reached = np.abs(away) / np.maximum(np.where(away < 0, below, above), np.finfo(float).tiny)
    order = np.argsort(reached)
    # The share of all blocks inside, as the band grows; rounding must not ask for one reading more.
    inside = np.cumsum(share[order]) + 1e-9
    first = int(np.searchsorted(inside, 0.95 * (len(blocks) + 1)))
    return Correction(float(reached[order][first]), len(blocks), block_s)


def _shifts(bands: Bands) -> FloatArray:
    """Return by how much lead-ins elsewhere in the record would have moved the mean, um.

    These are the means of the residual over stretches as long as the lead-in, which itself has
    none; evenly along the record, a hundred or as many as memory allows.
    """
    assert bands.measured is not None
    residual = bands.measured - bands.mean
    if bands.lead_in is None or not bands.lead_in.tells_offset:
        return np.zeros(1)
    length = round((bands.lead_in.stop - bands.lead_in.start) / bands.interval)
    count = min(max(10_000_000 // residual.size, 1), 100)
    starts = np.linspace(0, max(residual.size - length, 0), count).astype(int)
    known = np.isfinite(residual)
    sums, counts = (
        np.concatenate([[0.0], np.cumsum(values)])
        for values in (np.where(known, residual, 0.0), known)
    )
    readings = (counts[length:] - counts[:-length])[starts]
    totals = (sums[length:] - sums[:-length])[starts]
    shifts: FloatArray = totals[readings > 0] / readings[readings > 0]
    return shifts


def residual_memory(z: FloatArray, scored: BoolArray) -> float:
    """Return the integrated autocorrelation time, in samples, of residuals z (samples,).

    Those ``scored``; zero elsewhere. About zero, not their mean: an error that stays is correlated
    all along. The sum ends where pairs of neighbors no longer fall or are negative (Geyer's initial
    monotone sequence), and is twice the time of an exponential correlation.
    """
    products, pairs = (
        scipy.signal.correlate(series, series, method="fft")[z.size - 1 :]
        for series in (z, scored.astype(np.float64))
    )
    has_pairs = np.rint(pairs) > 0
    correlation = np.where(has_pairs, products, 0.0) / np.maximum(np.rint(pairs), 1.0)
    if correlation[0] <= 0:
        return 1.0
    correlation = correlation[: 2 * (z.size // 2)] / correlation[0]
    sums = correlation.reshape(-1, 2).sum(axis=1)
    last = int(np.argmax(sums <= 0)) if (sums <= 0).any() else sums.size
    return max(float(2 * np.sum(np.minimum.accumulate(sums[:last])) - 1), 1.0)
