"""Explanations of failing bands: all extensions of the fitted model, ranked by evidence.

An explanation is a small extension of the fitted model, fitted from the known mode. It is worth the
rise of the log evidence, nats. The likely cause is the best one, if it is worth more than
:data:`LIMIT`; two that tie are both named. A cause whose fix leaves readings out is named only if
none ties with it whose fix keeps them.

Beside the defects (:mod:`bwbayes.diagnosis.defects`) the model itself may change: a key of [model],
another prior, or noise that has heavy tails, or grows with the drive.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace

import numpy as np
import scipy

from bwbayes.arrays import FloatArray
from bwbayes.diagnosis.consistency import conflict_fix
from bwbayes.diagnosis.defects import LONG_DELAY, QUICK, SLOW
from bwbayes.diagnosis.finding import Finding
from bwbayes.diagnosis.residual_analysis import (
    Explanation,
    ResidualAnalysis,
    Sighting,
    lines,
)
from bwbayes.inference import outliers
from bwbayes.inference.noise import DiscrepancyNoise
from bwbayes.inference.parameters import JointPrior
from bwbayes.inference.study import Stated
from bwbayes.model.declaration import Distribution, lognormal
from bwbayes.model.operators.extremum_memory import RemembersExtrema
from bwbayes.model.registry import HYSTERESIS
from bwbayes.model.spec import ModelSpec
from bwbayes.watching import Watch, unwatched

# A history that an operator's unknown start does not hold.
DEMAGNETIZED = "demagnetized, and then driven straight from 0 V to the record's first voltage"


def nonlinearity(analysis: ResidualAnalysis) -> Iterator[Explanation]:
    """Try quadratic and cubic terms of the voltage."""
    nonlinearity = analysis.posterior.single_record.actuator.nonlinearity
    present = set(nonlinearity.terms) if nonlinearity else set()
    for terms in (("quadratic",), ("cubic",), ("quadratic", "cubic")):
        if not present.issuperset(terms) and present.issubset(terms):
            yield from analysis.changed(f"{' and '.join(terms)} nonlinearity", stages=terms)


def creep(analysis: ResidualAnalysis) -> Iterator[Explanation]:
    """Try slow lags."""
    if analysis.posterior.single_record.actuator.creep is None:
        yield from analysis.changed("creep", stages=("creep",))


def dynamics(analysis: ResidualAnalysis) -> Iterator[Explanation]:
    """Try a mass on a spring; readings show the ratios of its parameters alone."""
    if analysis.posterior.single_record.actuator.dynamics == "second-order":
        return
    frequency = 10 / analysis.turn_time
    stiffness, damping = ((2 * np.pi * frequency) ** power for power in (2, 1))
    stated = {
        "mass": Stated(fixed=1.0),
        "stiffness": Stated(lognormal(stiffness, 2.0)),
        "damping": Stated(lognormal(damping, 2.0)),
    }
    starts = [{"stiffness": z, "damping": z / 2 - 1} for z in (-1.0, 0.0, 0.5, 1.0, 1.5, 2.0)]
    sighting = Sighting(stated, starts)
    yield from analysis.changed("second-order dynamics", "", ("second-order",), sighting)


def exponent(analysis: ResidualAnalysis) -> Iterator[Explanation]:
    """Try another exponent of the hysteresis's transition, if that is fixed at 1."""
    fixed = {parameter.name: parameter.fixed for parameter in analysis.posterior.prior.parameters}
    if fixed.get("exponent") == 1.0:
        # In nearly all published fits it lies below 5.
        prior = Distribution("lognorm", {"s": 1.0, "loc": 1.0, "scale": 0.7})
        starts = ({"exponent": -1.0}, {"exponent": 1.0})
        sighting = Sighting({"exponent": Stated(prior)}, starts)

        def words(values: Mapping[str, float]) -> tuple[str, str]:
            return f"transition of exponent {values['exponent']:.2g} instead of 1", ""

        yield from analysis.changed("free exponent", words, sighting=sighting)


def without(analysis: ResidualAnalysis, names: Sequence[str]) -> Iterator[Explanation]:
    """Try the model without each of these stages: a stage whose removal gains is not needed."""
    for name in names:
        # An operator, hold or noise was replaced, not added: it cannot be removed.
        if name not in {*analysis.study.spec.chain} - {*HYSTERESIS}:
            continue
        spec = analysis.study.spec.without(name)
        posterior = analysis.rebuilt(analysis.study.with_model(spec))
        rows = [analysis.posterior.names.index(one) for one in posterior.names]
        fit = analysis.extended(posterior, analysis.places[:, rows])
        fix = lines(analysis.study.spec, spec)
        yield analysis.explained(name, f"no {name}", fix, fit, spec=spec)


def corners(analysis: ResidualAnalysis) -> Iterator[Explanation]:
    """Try a voltage that reaches the corners between its samples, where it has any."""
    record = analysis.study.records[analysis.whole.single_record.name]
    other = replace(record, corners=True)
    if record.corners or np.array_equal(other.path.voltage, record.path.voltage):
        return
    if analysis.whole.single_record.actuator.hold == "first":
        words = "voltage whose reversals fall between samples", "sample the voltage faster"
        yield from analysis.changed("corners", lambda _: words, hold="corners")


def hold(analysis: ResidualAnalysis) -> Iterator[Explanation]:
    """Try the other hold of the voltage between samples, and its corners there."""
    yield from corners(analysis)
    other = "first" if analysis.whole.single_record.actuator.hold == "zero" else "zero"
    text = "voltage that is held between samples"
    if other == "first":
        text = "voltage that changes steadily between samples"
    yield from analysis.changed("hold", text, hold=other)


def operator(analysis: ResidualAnalysis) -> Iterator[Explanation]:
    """Try other hysteresis operators."""
    present = type(analysis.posterior.single_record.actuator.hysteresis)
    # Try a compiled operator of each family, and plays of any weights, for loops without a formula.
    for name in ("bouc-wen", "bouc-wen-asymmetric", "prandtl-ishlinskii", "plays", "duhem"):
        if HYSTERESIS[name] is present:
            continue
        for spec in _histories(analysis, analysis.study.spec.with_stages(name)):
            kind, text = f"operator {name}", f"another operator, {name}"
            if spec.history != analysis.study.spec.history:
                kind, text = f"{kind}, demagnetized", f"{text}, {DEMAGNETIZED}"
            if not analysis.looks_for(kind):
                continue
            posterior = analysis.rebuilt(analysis.study.with_model(spec))
            # One start finds the best mode of nearly all records, in half of the time of five.
            places = analysis.local_minima(posterior, 1)
            fit = analysis.extended(posterior, places)
            yield analysis.explained(
                kind,
                text,
                lines(analysis.study.spec, spec),
                fit,
                spec=spec,
                mode=fit.by_name,
            )


def history(analysis: ResidualAnalysis) -> Iterator[Explanation]:
    """Try a voltage that came straight from 0 V, where the operator's start cannot be that."""
    for spec in _histories(analysis, analysis.study.spec)[1:]:
        yield from analysis.changed("history", f"hysteresis {DEMAGNETIZED}", history=spec.history)


def _histories(analysis: ResidualAnalysis, spec: ModelSpec) -> list[ModelSpec]:
    """Return a model as it is, and with the history that its unknown start does not hold, if any.

    On a first curve from zero volts, an operator that remembers extrema moves otherwise than after
    a drive over all voltages. The misfit of that half period spoils the fit of all others.
    """
    record = analysis.posterior.single_record
    if record.from_rest or spec.history != "unknown":
        return [spec]
    posterior = analysis.rebuilt(analysis.study.with_model(spec))
    if not isinstance(posterior.single_record.actuator.hysteresis, RemembersExtrema):
        return [spec]
    return [spec, replace(spec, history="demagnetized")]


def smooth(analysis: ResidualAnalysis) -> Iterator[Explanation]:
    """Try a discrepancy without corners, in place of a rough one."""
    if (
        isinstance(analysis.posterior.single_record.noise, DiscrepancyNoise)
        and analysis.before is None
    ):
        yield from analysis.changed("a smooth discrepancy", flags={"noise": True}, noise="smooth")


def prior(analysis: ResidualAnalysis) -> Iterator[Explanation]:
    """Try the default prior of each parameter that has another one.

    The fit may have left the other prior, or further parameters may have compensated for it.
    """
    before, defaults = analysis.posterior.prior, analysis.study.defaults if analysis.alone else {}
    for parameter in before.free:
        default = defaults.get(parameter.name)
        if default is None or parameter.prior == default:
            continue
        parameters = [replace(p, prior=default) if p is parameter else p for p in before.parameters]
        posterior = replace(analysis.posterior, prior=JointPrior(parameters, before.constraint))
        places = [
            posterior.prior.unconstrain(before.constrain(analysis.places)[0]),
            analysis.local_minima(posterior, 1),
        ]
        fit = analysis.extended(posterior, np.concatenate(places))
        text = f"prior of {parameter.name}, {parameter.prior}, that excludes the record's value"
        fix = conflict_fix(parameter.name, default)
        yield analysis.explained(f"prior of {parameter.name}", text, fix, fit, foreign=True)


def heavy_tails(analysis: ResidualAnalysis) -> Iterator[Explanation]:
    """Try innovations of a Student t distribution of any scale, if there is an outlier."""
    white = analysis.innovations
    far = np.abs(white) > 5
    if not far.any():
        return
    text = f"outliers ({np.sum(far)} of {white.size} innovations beyond 5 SD)"
    others = (analysis.posterior.single_record.readings.values - analysis.fit.displacement)[~far]
    rmse = analysis.without[0], float(np.sqrt(np.mean(others**2)))
    fix, spec, nats = "set outliers = true in [model]", None, tail_nats(white)
    # Add no tails if outliers are few and far off: such tails would be too heavy for the others.
    before, tailed = analysis.study.spec, analysis.posterior.single_record.noise.tailed
    paced = analysis.posterior.single_record.noise.paced
    if analysis.alone and not (tailed or paced) and nats > isolated_nats(white):
        spec = replace(before, noise=f"{before.noise} + student")
        fix = lines(before, spec)
    yield Explanation(
        "heavy tails",
        text,
        fix,
        nats=nats - analysis.lead,
        rmse=rmse,
        foreign=True,
        noise=True,
        spec=spec,
    )


def tail_nats(white: FloatArray) -> float:
    """Return the gain of a t distribution over a normal one, nats, for innovations (readings,)."""
    densities, tried = [], (1.5, 2.0, 3.0, 4.0, 6.0, 10.0, 20.0)  # evenly probable
    for degrees in tried:

        def cost(log_scale: float, degrees: float = degrees) -> float:
            return -float(np.sum(scipy.stats.t.logpdf(white, degrees, scale=np.exp(log_scale))))

        densities.append(
            -scipy.optimize.minimize_scalar(cost, bounds=(-5.0, 5.0), method="bounded").fun
        )
    normal = float(np.sum(scipy.stats.norm.logpdf(white)))
    # The cost of the scale: its posterior sd is 1/√(2 n) for n readings, its prior's is one.
    cost_of_scale = 0.5 * np.log(2 * white.size)
    return float(scipy.special.logsumexp(densities) - np.log(len(tried)) - cost_of_scale) - normal


def isolated_nats(white: FloatArray) -> float:
    """Return the gain, nats, of normal innovations (readings,), in sds, with isolated outliers.

    Each is an outlier with the same probability, uniform over their range; outliers are those
    beyond 6 sds of the others.
    """
    far = np.abs(white) > outliers.LIMIT * min(
        1.0, np.median(np.abs(white)) / scipy.special.ndtri(0.75)
    )
    others, share, size = white[~far], np.mean(far), white.size
    if share > outliers.MOST:
        return -np.inf  # so many are not outliers
    density = float(np.sum(scipy.stats.norm.logpdf(others, 0, np.std(others))))
    density -= float(np.sum(scipy.stats.norm.logpdf(white)))
    density -= float(np.sum(far) * np.log(np.ptp(white)))
    # Share and sd have a cost as the scale in `tail_nats` has.
    cost = size * float(scipy.stats.bernoulli(share).entropy()) + float(np.log(2 * size))
    return density - cost


def growing_noise(analysis: ResidualAnalysis) -> Iterator[Explanation]:
    """Try innovations of sd exp(a + b g), g the drive's speed or distance from its center."""
    rows, white = analysis.posterior.single_record.readings.rows, analysis.innovations
    center = (analysis.voltage.max() + analysis.voltage.min()) / 2
    for kind, drive in (("speed", analysis.rate), ("voltage", analysis.voltage - center)):
        growth = np.abs(drive)[rows]
        if not np.std(growth) > 0:
            continue
        growth = (growth - np.mean(growth)) / np.std(growth)

        def cost(coordinates: FloatArray, growth: FloatArray = growth) -> float:
            level, slope = coordinates
            logs = level + slope * growth
            return float(np.sum(logs + 0.5 * white**2 * np.exp(-2 * logs)) + 0.5 * slope**2)

        # Gain of b, nats, with b ~ N(0, 1); the level is as well known with it as without.
        optimum = scipy.optimize.minimize(cost, np.zeros(2), method="BFGS")
        level, slope = np.log(np.sqrt(np.mean(white**2))), optimum.x[1]
        nats = cost(np.array([level, 0.0])) - optimum.fun - 0.5 * np.log(1 + 2 * white.size)
        text = f"noise that {'grows' if slope > 0 else 'falls'} with the voltage"
        text += "'s speed" if kind == "speed" else "'s distance from its center"
        rmse = analysis.without[0], analysis.fit.rmse
        fix = "train on a record driven as the plans are: the bands' width is the mean one"
        spec, noise = None, analysis.posterior.single_record.noise
        if kind == "speed" and slope > 0 and analysis.alone and not (noise.tailed or noise.paced):
            spec = replace(analysis.study.spec, noise=f"{analysis.study.spec.noise} + paced")
            fix = lines(analysis.study.spec, spec)
        explanation = Explanation(
            f"noise by {kind}", text, fix, nats=float(nats - analysis.lead), rmse=rmse
        )
        yield replace(explanation, noise=True, spec=spec)


# Functions that yield explanations of a fit. The first are small additions, which a good fit rules
# out at once; the others explain the part of the readings that the discrepancy takes up.
ADDITIONS: tuple[Callable[[ResidualAnalysis], Iterator[Explanation]], ...] = (
    *(defect.explanations for defect in QUICK),
    prior,
    heavy_tails,
    growing_noise,
)
CHANGES: tuple[Callable[[ResidualAnalysis], Iterator[Explanation]], ...] = (
    LONG_DELAY.explanations,
    *(defect.explanations for defect in SLOW),
    exponent,
    nonlinearity,
    creep,
    dynamics,
    hold,
    smooth,
    # Other operators take the longest: if the time is over, all stages have been fitted.
    operator,
    history,
)

# On a good record a ratio of evidences exceeds k with a probability of at most 1/k (Markov's
# inequality), so that at most one good record in a hundred gets a cause, whatever the priors are.
KINDS = len(ADDITIONS + CHANGES)
LIMIT = float(np.log(100 * KINDS))

# Odds of twenty to one, nats: explanations nearer than this, or a fit without any, are tied.
TIED = float(np.log(20))


def explain(
    analysis: ResidualAnalysis,
    watch: Watch = unwatched,
    is_over: Callable[[], bool] = lambda: False,
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
    analysis = replace(analysis, watch=hurry)
    if analysis.posterior.single_record.is_followed(analysis.fit.displacement):
        return ()
    looked_at, rough = analysis, analysis.with_rough_noise()
    # With several records, the model of the actuator is a matter of all of them.
    kinds = (*ADDITIONS, *(CHANGES if analysis.alone else (LONG_DELAY.explanations,)))
    if not analysis.posterior.single_record.inputs.quantities.has_clock:
        # Besides stages that depend on time.
        timed = (growing_noise, creep, dynamics, hold, smooth)
        kinds = tuple(kind for kind in kinds if kind not in timed)
    for number, kind in enumerate(kinds):
        if is_over():
            break
        if number == sum(kind in ADDITIONS for kind in kinds):
            if analysis.unexplained <= LIMIT and all(e.nats <= LIMIT for e in best.values()):
                break
            looked_at = analysis.of_beginning()
            rough = rough if looked_at is analysis else looked_at.with_rough_noise()
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
            best[explanation.kind] = analysis.confirmed(explanation)
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
