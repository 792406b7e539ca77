"""One model of a comparison: what it cost to fit, and what it was worth, in numbers.

Everything is about the same readings for all models: the held-out ones for scores and bands, these
and the later half of the training readings for what decides, all of the training readings for
evidence and information criteria.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from bwbayes.arrays import BoolArray, FloatArray
from bwbayes.comparison.evidence import Evidence
from bwbayes.comparison.leave_future_out import Part
from bwbayes.diagnosis.standing import Standing
from bwbayes.prediction.bands import Bands
from bwbayes.prediction.scores import Scores
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
        Whether its run's bands hold; None if that was not worked out.
    parts
        Its log scores of later readings, by the part's name.
    evidence
        Its log evidence.
    screened
        Whether it was only screened: its evidence, by Laplace's approximation at the MAP estimate,
        and its likelihood are too far behind for sampling it to be worth while.
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
    standing: Standing | None = None
    parts: Mapping[str, Part] = field(default_factory=dict)
    evidence: Evidence | None = None
    screened: bool = False

    @property
    def log_evidence(self) -> float:
        """Its log evidence, nats; −∞ if it is not known."""
        finite = self.evidence is not None and np.isfinite(self.evidence.log_evidence)
        return self.evidence.log_evidence if finite and self.evidence is not None else -np.inf

    @property
    def log_likelihood(self) -> float | None:
        """The largest among the draws, or at the MAP estimate, nats."""
        return None if self.evidence is None else self.evidence.max_log_likelihood

    @property
    def aic(self) -> float | None:
        """Akaike's criterion 2 k − 2 log L, with :attr:`log_likelihood`."""
        if self.log_likelihood is None:
            return None
        return 2 * self.free - 2 * self.log_likelihood

    @property
    def bic(self) -> float | None:
        """Schwarz's criterion k log n − 2 log L, with :attr:`log_likelihood`."""
        if self.log_likelihood is None:
            return None
        return self.free * float(np.log(self.readings)) - 2 * self.log_likelihood

    def log_score(self, parts: Iterable[str]) -> float:
        """Return the sum of its log scores of parts by their names, nats."""
        return sum(float(np.sum(self.parts[name].log_scores)) for name in parts)

    @property
    def log_scores(self) -> FloatArray | None:
        """Log scores (readings,) of all held-out readings, nats; None without any."""
        scores = [
            bands.log_score[judged(bands)] for bands in self.held_out if bands.log_score is not None
        ]
        return np.concatenate(scores) if scores else None

    @property
    def mean(self) -> Mean | None:
        """Return what the held-out readings say together; None without any."""
        if self.log_scores is None:
            return None
        scores: Sequence[Scores] = [self.scores[bands.name] for bands in self.held_out]
        counts = np.array([np.sum(judged(bands)) for bands in self.held_out], dtype=np.float64)
        parts = counts / counts.sum()
        sensor = [score.coverage["sensor"] or {} for score in scores]
        errors = [score.coverage_error["sensor"] or {} for score in scores]
        return Mean(
            log_score=float(np.mean(self.log_scores)),
            crps_um=float(parts @ [score.crps_um for score in scores]),
            nrmse=float(np.sqrt(parts @ np.square([score.nrmse for score in scores]))),
            coverage=float(parts @ [coverage[LEVEL] for coverage in sensor]),
            coverage_error=float(np.sqrt(parts**2 @ np.square([error[LEVEL] for error in errors]))),
            width_um=float(parts @ [score.width_um[LEVEL] for score in scores]),
        )


def judged(bands: Bands) -> BoolArray:
    """Tell which samples of bands have a reading that is judged."""
    assert bands.measured is not None
    inside: BoolArray = np.isfinite(bands.measured)
    inside[: bands.scored_from] = False
    return inside
