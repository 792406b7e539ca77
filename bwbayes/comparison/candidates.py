"""One model of a comparison: what it cost to fit, and what it was worth, in numbers.

Everything is about the same readings for all models: the held-out ones for scores and bands, the
later half of the training readings for what it foretold of its own future, all of the training
readings for evidence and information criteria.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from bwbayes.arrays import BoolArray, FloatArray
from bwbayes.comparison.evidence import Evidence
from bwbayes.comparison.future import Future
from bwbayes.results.bands import Bands
from bwbayes.results.scores import Scores
from bwbayes.results.standing import Standing
from bwbayes.shown import brief

__all__ = ["Candidate", "Mean", "judged"]

# The band whose coverage and width stand in the table.
LEVEL = 95


@dataclass(frozen=True)
class Mean:
    """What all held-out readings say together, each counting the same.

    ``log_score`` in nats per reading, ``crps_um`` and ``width_um`` of the 95 % sensor band in um,
    ``nrmse`` over the range of the readings; ``coverage`` of the 95 % sensor band with its error.
    """

    log_score: float
    crps_um: float
    nrmse: float
    coverage: float
    coverage_error: float
    width_um: float


@dataclass(frozen=True)
class Candidate:
    """A model that was fitted.

    Attributes
    ----------
    name
        Its name in the comparison.
    model
        Its parts, in words.
    converged, stop_reason
        How its sampling ended; all below stays empty unless converged.
    free
        Number of free parameters.
    readings
        Number of training readings.
    hysteresis
        Whether it has any hysteresis.
    held_out, scores
        Bands of what was held out and measured, and their scores by the bands' name.
    standing
        Whether its run's bands hold.
    joint
        Log density of the held-out readings of the training records together, nats, and Pareto k̂
        of the ratios that it is a mean of; None if there are none.
    future
        What it foretold of its training readings; None if that was left out.
    evidence
        Its log evidence.
    log_likelihood
        The largest among the draws, nats.
    """

    __repr__ = brief

    name: str
    model: str
    converged: bool
    stop_reason: str
    free: int
    readings: int
    hysteresis: bool = True
    held_out: tuple[Bands, ...] = ()
    scores: Mapping[str, Scores] = field(default_factory=dict)
    standing: Standing = field(default_factory=Standing)
    joint: tuple[float, float] | None = None
    future: Future | None = None
    evidence: Evidence | None = None
    log_likelihood: float | None = None

    @property
    def aic(self) -> float | None:
        """Akaike's criterion 2 k − 2 log L, with the largest likelihood among the draws."""
        if self.log_likelihood is None:
            return None
        return 2 * self.free - 2 * self.log_likelihood

    @property
    def bic(self) -> float | None:
        """Schwarz's criterion k log n − 2 log L, with the largest likelihood among the draws."""
        if self.log_likelihood is None:
            return None
        return self.free * float(np.log(self.readings)) - 2 * self.log_likelihood

    @property
    def log_scores(self) -> FloatArray | None:
        """Log scores (readings,) of all held-out readings, nats; None without any."""
        scores = [one.log_score[judged(one)] for one in self.held_out if one.log_score is not None]
        return np.concatenate(scores) if scores else None

    @property
    def mean(self) -> Mean | None:
        """Return what the held-out readings say together; None without any."""
        if self.log_scores is None:
            return None
        every: Sequence[Scores] = [self.scores[one.name] for one in self.held_out]
        counts = np.array([np.sum(judged(one)) for one in self.held_out], dtype=np.float64)
        parts = counts / counts.sum()
        sensor = [one.coverage["sensor"] or {} for one in every]
        errors = [one.coverage_error["sensor"] or {} for one in every]
        return Mean(
            log_score=float(np.mean(self.log_scores)),
            crps_um=float(parts @ [one.crps_um for one in every]),
            nrmse=float(np.sqrt(parts @ np.square([one.nrmse for one in every]))),
            coverage=float(parts @ [one[LEVEL] for one in sensor]),
            coverage_error=float(np.sqrt(parts**2 @ np.square([one[LEVEL] for one in errors]))),
            width_um=float(parts @ [one.width_um[LEVEL] for one in every]),
        )


def judged(bands: Bands) -> BoolArray:
    """Tell which samples of bands have a reading that is judged."""
    assert bands.measured is not None
    known: BoolArray = np.isfinite(bands.measured)
    known[: bands.scored_from] = False
    return known
