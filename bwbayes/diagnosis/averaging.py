"""Parameters whichever model acts, of those that a record does not rule out.

A stage for which a record has some evidence, but not enough to add it, or another stage that ties
with one that was added, may act all the same. Without it the other parameters are elsewhere, and
their intervals know nothing of that. So the posterior of the parameters that models share is the
sum over all of them, each with its probability: a part of the draws of the chosen model is moved to
where another one has them, by Laplace's approximation. Before the readings, any extension at all is
as probable as none, and each one as probable as another. See Hoeting, Madigan, Raftery and
Volinsky, Bayesian Model Averaging: A Tutorial (1999).

Bands stay those of the chosen model: without its own stage, no draw of another model predicts.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass

import numpy as np
import scipy

from bwbayes.arrays import FloatArray
from bwbayes.diagnosis.explanations import KINDS
from bwbayes.diagnosis.laplace import LocalFit, climb
from bwbayes.diagnosis.residual_analysis import Explanation, of_readings, on_readings
from bwbayes.inference.posterior import Posterior
from bwbayes.inference.study import Study
from bwbayes.watching import Watch, unwatched, watched

# A model that is less probable adds nothing that shows in an interval.
LEAST = 0.001

# A model that is less probable is not named.
NAMED = 0.1


@dataclass(frozen=True)
class Alternative:
    """A model that was not chosen, and that the record does not rule out.

    It has a ``probability``. The parameters of these ``names`` are those of the chosen model, too:
    its mode has them ``shift`` (names,) away, with a ``covariance`` (names, names), in
    unconstrained coordinates.
    """

    text: str
    probability: float
    names: Sequence[str]
    shift: Sequence[float]
    covariance: Sequence[Sequence[float]]

    @classmethod
    def of(cls, text: str, probability: float, fit: LocalFit, chosen: LocalFit) -> Alternative:
        """Return another model as its fit has it, of the parameters with the same prior in both."""
        priors = {parameter.name: parameter for parameter in fit.posterior.prior.free}
        names = [
            shared.name
            for shared in chosen.posterior.prior.free
            if priors.get(shared.name) == shared
        ]
        ours, theirs = _columns(chosen.posterior, names), _columns(fit.posterior, names)
        shift = fit.coordinates[theirs] - chosen.coordinates[ours]
        covariance = fit.covariance[np.ix_(theirs, theirs)]
        return cls(text, probability, names, shift.tolist(), covariance.tolist())


def alternatives(
    study: Study, optima: FloatArray, others: Iterable[Explanation], watch: Watch = unwatched
) -> list[Alternative]:
    """Return the models of a study of one record that its record does not rule out.

    ``optima`` (optima, free) are the modes of its posterior, in unconstrained coordinates. Models
    with another operator, whose parameters mean something else, do not count. ``watch`` is called
    with the share that is done.
    """
    counted = [cause for cause in others if _counts(study, cause)]
    if not counted:
        return []
    chosen = climb(study.posterior, optima)
    fits, log_odds = dict[str, LocalFit](), dict[str, float]()
    for cause in watched(counted, watch):
        assert cause.spec is not None
        # One voltage may reach corners, where readings are left out, and another one not.
        other = of_readings(study.with_model(cause.spec, cause.stated).posterior, study.posterior)
        # Climb from where it was fitted, and from the mode with its stage.
        starts = {**chosen.by_name, **cause.mode}, {**cause.mode, **chosen.by_name}
        values = [[start.get(name, 0.0) for name in other.names] for start in starts]
        fit = climb(other, np.array(values))
        # A delay leaves out readings for which it needs a voltage beyond the record.
        compared = on_readings(chosen, other)
        nats = fit.log_evidence - compared.log_evidence - cause.cost
        if fit.follows and np.isfinite(nats):
            fits[cause.text], log_odds[cause.text] = fit, nats - np.log(KINDS)
    probabilities = scipy.special.softmax([0.0, *log_odds.values()])[1:].tolist()
    return [
        Alternative.of(text, probability, fit, chosen)
        for (text, fit), probability in zip(fits.items(), probabilities, strict=True)
        if probability > LEAST
    ]


def _counts(study: Study, cause: Explanation) -> bool:
    """Tell whether an explanation is another model, of the same operator and not improbable."""
    if cause.spec is None or not cause.mode or cause.misleads:
        return False
    return cause.spec.operator == study.spec.operator and cause.nats > np.log(LEAST * KINDS)


def _columns(posterior: Posterior, names: Sequence[str]) -> list[int]:
    return [posterior.names.index(name) for name in names]


def average(
    posterior: Posterior,
    draws: FloatArray,
    covariance: FloatArray,
    others: Sequence[Alternative],
    generator: np.random.Generator,
) -> FloatArray:
    """Return draws (..., free) of a model, in their own units, as draws of all models together.

    As many as an alternative is probable are moved from the mode, of this ``covariance``
    (free, free), to that of the alternative. A draw that the prior would exclude then stays.
    """
    flat = draws.reshape(-1, draws.shape[-1])
    coordinates, moved = posterior.prior.unconstrain(flat), flat.copy()
    center, chance, begin = coordinates.mean(axis=0), generator.random(len(flat)), 0.0
    for other in others:
        rows = np.flatnonzero((begin <= chance) & (chance < begin + other.probability))
        begin += other.probability
        columns = _columns(posterior, other.names)
        ours = np.linalg.cholesky(covariance[np.ix_(columns, columns)])
        theirs = np.linalg.cholesky(np.array(other.covariance))
        placed = coordinates[rows]
        away = (placed[:, columns] - center[columns]) @ np.linalg.solve(ours.T, theirs.T)
        placed[:, columns] = center[columns] + np.array(other.shift) + away
        values, log_prior = posterior.prior.constrain(placed)
        possible = np.isfinite(log_prior)
        moved[rows[possible]] = values[possible]
    return moved.reshape(draws.shape)


def remarks(others: Sequence[Alternative]) -> list[str]:
    """Return what intervals allow for, in one line; none if nothing is probable enough."""
    likely = [
        f"{other.text} (probability {other.probability:.0%})"
        for other in others
        if other.probability > NAMED
    ]
    if not likely:
        return []
    unsure = f"the record neither shows nor rules out {' or '.join(likely)}"
    return [f"{unsure}; the intervals allow for it"]


def to_text(others: Sequence[Alternative]) -> str:
    """Write alternatives as JSON."""
    return json.dumps([asdict(other) for other in others])


def from_text(text: str) -> list[Alternative]:
    """Read alternatives from JSON."""
    return [Alternative(**other) for other in json.loads(text)]
