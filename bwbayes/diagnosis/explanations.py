"""Explanations of failing bands: all extensions of the fitted model, ranked by evidence.

An explanation is a small extension of the fitted model, fitted from the known mode. It is worth the
rise of the log evidence, nats. The likely cause is the best one, if it is worth more than
:data:`LIMIT`; two that tie are both named. A cause whose fix leaves readings out is named only if
none ties with it whose fix keeps them.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import suppress
from dataclasses import replace

import numpy as np

from bwbayes.diagnosis import model
from bwbayes.diagnosis.defects import LONG_DELAY, QUICK, SLOW
from bwbayes.diagnosis.finding import Finding
from bwbayes.diagnosis.residual_analysis import Explanation, ResidualAnalysis
from bwbayes.watching import Watch, unwatched

# Functions that yield explanations of a fit. The first are small additions, which a good fit rules
# out at once; the others explain the part of the readings that the discrepancy takes up.
ADDITIONS: tuple[Callable[[ResidualAnalysis], Iterator[Explanation]], ...] = (
    *(defect.explanations for defect in QUICK),
    model.prior,
    model.heavy_tails,
    model.growing_noise,
)
CHANGES: tuple[Callable[[ResidualAnalysis], Iterator[Explanation]], ...] = (
    model.operator,
    model.history,
    LONG_DELAY.explanations,
    *(defect.explanations for defect in SLOW),
    model.exponent,
    model.nonlinearity,
    model.creep,
    model.dynamics,
    model.hold,
    model.smooth,
)

# On a good record a ratio of evidences exceeds k with a probability of at most 1/k (Markov's
# inequality), so that at most one good record in a hundred gets a cause, whatever the priors are.
LIMIT = float(np.log(100 * len(ADDITIONS + CHANGES)))

# Odds of twenty to one, nats: explanations nearer than this, or a fit without any, are tied.
TIED = float(np.log(20))


def explain(
    scene: ResidualAnalysis, watch: Watch = unwatched, is_over: Callable[[], bool] = lambda: False
) -> tuple[Explanation, ...]:
    """Fit explanations, and rank them, the best first.

    Only the additions are fitted if the discrepancy takes up too little for any other explanation
    to be worth more than :data:`LIMIT`, unless an addition is worth that: then all compete. If the
    discrepancy is smooth, all are first fitted with a rough one; those worth more than the limit
    are fitted with the smooth one as well, and each has the worth of its better fit. Other models
    are fitted to the beginning of a record that is too long. ``watch`` is called with the share
    that is done. Fits end when the time ``is_over``, and what is there then is ranked.
    """

    def hurry(_: float) -> None:
        if is_over():
            raise _OutOfTimeError

    best: dict[str, Explanation] = {}
    scene = replace(scene, watch=hurry)
    if scene.posterior.single_record.is_followed(scene.fit.displacement):
        return ()
    looked_at, rough = scene, scene.with_rough_noise()
    # With several records, the model of the actuator is a matter of all of them.
    kinds = (*ADDITIONS, *(CHANGES if scene.alone else (LONG_DELAY.explanations,)))
    if not scene.posterior.single_record.inputs.quantities.has_clock:
        # Besides stages that depend on time.
        timed = (model.growing_noise, model.creep, model.dynamics, model.hold, model.smooth)
        kinds = tuple(kind for kind in kinds if kind not in timed)
    for number, kind in enumerate(kinds):
        if is_over():
            break
        if number == sum(kind in ADDITIONS for kind in kinds):
            if scene.unexplained <= LIMIT and all(e.nats <= LIMIT for e in best.values()):
                break
            looked_at = scene.of_beginning()
            rough = rough if looked_at is scene else looked_at.with_rough_noise()
        explanations = [] if rough is None else [*_in_time(kind(rough))]
        lead = 0.0 if rough is None else rough.lead
        worth = frozenset(cause.kind for cause in explanations if cause.nats + lead > LIMIT)
        if rough is None:
            explanations = [*_in_time(kind(looked_at))]
        elif worth:
            explanations += _in_time(kind(replace(looked_at, kinds=worth)))
        for explanation in explanations:
            previous = best.get(explanation.kind, explanation)
            best[explanation.kind] = max(previous, explanation, key=lambda either: either.nats)
        watch((number + 1) / len(kinds))
    ranked = _ranked(best.values())
    # Only parts of a long record were fitted: confirm the leading explanations on all of it.
    noises = [explanation for explanation in ranked if explanation.noise]
    for explanation in (*better_models(ranked), *likely_causes(noises)):
        with suppress(_OutOfTimeError):
            best[explanation.kind] = scene.confirmed(explanation)
    watch(1.0)
    return _ranked(best.values())


class _OutOfTimeError(Exception):
    """The time for a fit is over."""


def _in_time(explanations: Iterator[Explanation]) -> Iterator[Explanation]:
    """Yield explanations until the time is over."""
    with suppress(_OutOfTimeError):
        yield from explanations


def _ranked(explanations: Iterable[Explanation]) -> tuple[Explanation, ...]:
    return tuple(sorted(explanations, key=lambda explanation: -explanation.nats))


def likely_causes[Cause: Finding](ranked: Sequence[Cause]) -> tuple[Cause, ...]:
    """Return the best of ranked explanations above the limit, and those that tie with it."""
    leading = [
        explanation
        for explanation in ranked
        if explanation.nats > max(LIMIT, ranked[0].nats - TIED)
    ]
    keeping = [explanation for explanation in leading if not explanation.removes]
    return tuple(keeping or leading)


def better_models(ranked: Sequence[Explanation]) -> tuple[Explanation, ...]:
    """Return the likely causes that would change the prediction for the next drive.

    Noise of another kind, such as heavy tails, is left out: the bands include its size already, and
    they fail where their coverage suffers. Misleading explanations are left out as well.
    """
    return likely_causes([one for one in ranked if not (one.noise or one.misleads)])


def followed_causes(ranked: Sequence[Explanation]) -> tuple[Explanation, ...]:
    """Return foreign effects, not of the actuator, that a fit may have followed.

    A likely cause is enough by itself: parameters that followed it need not return. Without one,
    even odds are enough if a parameter also moves by three sds: a good fit hardly ever has both.
    """
    near = likely_causes(ranked) or [
        explanation for explanation in ranked if explanation.nats > max(0.0, ranked[0].nats - TIED)
    ]
    return tuple(
        explanation
        for explanation in near
        if explanation.foreign and (explanation.nats > LIMIT or explanation.shift > 3)
    )
