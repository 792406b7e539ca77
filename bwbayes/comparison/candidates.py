"""One model of a comparison: what it cost to fit, and what it was worth, in numbers.

Everything is about the same readings for all models: the held-out ones for scores and bands, these
and the later half of the training readings for what decides, all of the training readings for
evidence and information criteria.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from bwbayes.comparison.evidence import Evidence
from bwbayes.comparison.leave_future_out import Part
from bwbayes.diagnosis.validation import ValidationSummary
from bwbayes.prediction.bands import Bands
from bwbayes.prediction.scores import Scores
from bwbayes.shown import brief


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
    standing: ValidationSummary | None = None
    parts: Mapping[str, Part] = field(default_factory=dict)
    evidence: Evidence | None = None
    screened: bool = False

    @property
    def log_evidence(self) -> float:
        """Its log evidence, nats; −∞ if it is not known."""
        value = np.nan if self.evidence is None else self.evidence.log_evidence
        return value if np.isfinite(value) else -np.inf

    @property
    def log_likelihood(self) -> float | None:
        """The largest among the draws, or at the MAP estimate, nats."""
        return None if self.evidence is None else self.evidence.max_log_likelihood

    def criterion(self, penalty: float) -> float | None:
        """Return penalty times k − 2 log L: Akaike's with 2, Schwarz's with the log of readings."""
        if self.log_likelihood is None:
            return None
        return penalty * self.free - 2 * self.log_likelihood

    def log_score(self, parts: Collection[str]) -> float:
        """Return the sum of its log scores of parts by their names, nats."""
        return sum(float(np.sum(self.parts[name].log_scores)) for name in parts)

    @property
    def mean(self) -> dict[str, float] | None:
        """Means over all held-out readings, each counting the same; None without any.

        ``log_score`` in nats per reading, ``crps_um`` and ``width_um`` of the 95% sensor band in
        um, ``nrmse`` over the range of the readings; ``coverage`` of the 95% sensor band with its
        error.
        """
        counts = np.array([np.sum(b.scored(b.measured)) for b in self.held_out], dtype=np.float64)
        if not counts.sum():
            return None
        shares, scores = counts / counts.sum(), [self.scores[b.name] for b in self.held_out]
        covered, errors = (
            np.array([dict(values["sensor"] or {})[95] for values in several])
            for several in ([s.coverage for s in scores], [s.coverage_error for s in scores])
        )
        return {
            "log_score": float(shares @ [score.log_score for score in scores]),
            "crps_um": float(shares @ [score.crps_um for score in scores]),
            "nrmse": float(np.sqrt(shares @ np.square([score.nrmse for score in scores]))),
            "coverage": float(shares @ covered),
            "coverage_error": float(np.sqrt(shares**2 @ np.square(errors))),
            "width_um": float(shares @ [score.width_um[95] for score in scores]),
        }

    def numbers(self, voting: Collection[str]) -> dict[str, Any]:
        """Return what ``comparison.json`` holds of it; ``voting`` are the parts that decide."""
        evidence = {} if self.evidence is None else vars(self.evidence)
        return {
            "model": self.model,
            "converged": self.converged,
            "screened": self.screened,
            "stop_reason": self.stop_reason,
            "free": self.free,
            "readings": self.readings,
            "validation": None if self.standing is None else self.standing.status,
            "held_out": self.mean,
            "windows": {name: scores.numbers for name, scores in self.scores.items()},
            "parts": {
                name: {
                    "log_score": float(np.sum(section.log_scores)),
                    "readings": section.readings,
                    "independent": section.independent,
                    "joint": section.joint,
                    "votes": name in voting,
                }
                for name, section in self.parts.items()
            },
            "log_evidence": evidence.get("log_evidence"),
            "log_evidence_error": evidence.get("error"),
            "log_prior_mass": evidence.get("log_prior_mass"),
            "prior_share": evidence.get("prior_share"),
            "log_likelihood": self.log_likelihood,
            "aic": self.criterion(2.0),
            "bic": self.criterion(float(np.log(self.readings))),
        }
