"""Possible changes of the model: a key of [model], another prior, or noise of another kind.

Another model has its own evidence; noise may have heavy tails, or grow with the drive.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace

import numpy as np
import scipy

from bwbayes.arrays import FloatArray
from bwbayes.diagnosis.consistency import conflict_fix
from bwbayes.diagnosis.residual_analysis import (
    Explanation,
    ResidualAnalysis,
    Sighting,
    lines,
)
from bwbayes.inference.noise import DiscrepancyNoise
from bwbayes.inference.outliers import LIMIT, MOST
from bwbayes.inference.parameters import JointPrior
from bwbayes.inference.study import Stated
from bwbayes.model.declaration import Distribution, lognormal
from bwbayes.model.operators.extremum_memory import RemembersExtrema
from bwbayes.model.registry import HYSTERESIS
from bwbayes.model.spec import ModelSpec

# A history that an operator's unknown start does not hold.
DEMAGNETIZED = "demagnetized, and then driven straight from 0 V to the record's first voltage"


def nonlinearity(scene: ResidualAnalysis) -> Iterator[Explanation]:
    """Try quadratic and cubic terms of the voltage."""
    nonlinearity = scene.posterior.single_record.actuator.nonlinearity
    present = set(nonlinearity.terms) if nonlinearity else set()
    for terms in (("quadratic",), ("cubic",), ("quadratic", "cubic")):
        if not present.issuperset(terms) and present.issubset(terms):
            yield from scene.changed(f"{' and '.join(terms)} nonlinearity", stages=terms)


def creep(scene: ResidualAnalysis) -> Iterator[Explanation]:
    """Try slow lags."""
    if scene.posterior.single_record.actuator.creep is None:
        yield from scene.changed("creep", stages=("creep",))


def dynamics(scene: ResidualAnalysis) -> Iterator[Explanation]:
    """Try a mass on a spring; readings show the ratios of its parameters alone."""
    if scene.posterior.single_record.actuator.dynamics == "second-order":
        return
    frequency = 10 / scene.turn_time
    stiffness, damping = ((2 * np.pi * frequency) ** power for power in (2, 1))
    stated = {
        "mass": Stated(fixed=1.0),
        "stiffness": Stated(lognormal(stiffness, 2.0)),
        "damping": Stated(lognormal(damping, 2.0)),
    }
    starts = [{"stiffness": z, "damping": z / 2 - 1} for z in (-1.0, 0.0, 0.5, 1.0, 1.5, 2.0)]
    sighting = Sighting(stated, starts)
    yield from scene.changed("second-order dynamics", "", ("second-order",), sighting)


def exponent(scene: ResidualAnalysis) -> Iterator[Explanation]:
    """Try another exponent of the hysteresis's transition, if that is fixed at 1."""
    fixed = {parameter.name: parameter.fixed for parameter in scene.posterior.prior.parameters}
    if fixed.get("exponent") == 1.0:
        # In nearly all published fits it lies below 5.
        prior = Distribution("lognorm", {"s": 1.0, "loc": 1.0, "scale": 0.7})
        starts = ({"exponent": -1.0}, {"exponent": 1.0})
        sighting = Sighting({"exponent": Stated(prior)}, starts)

        def words(values: Mapping[str, float]) -> tuple[str, str]:
            return f"transition of exponent {values['exponent']:.2g} instead of 1", ""

        yield from scene.changed("free exponent", words, sighting=sighting)


def without(scene: ResidualAnalysis, names: Sequence[str]) -> Iterator[Explanation]:
    """Try the model without each of these stages: a stage whose removal gains is not needed."""
    for name in names:
        # An operator, hold or noise was replaced, not added: it cannot be removed.
        if name not in {*scene.study.spec.chain} - {*HYSTERESIS}:
            continue
        spec = scene.study.spec.without(name)
        posterior = scene.rebuilt(scene.study.with_model(spec))
        rows = [scene.posterior.names.index(one) for one in posterior.names]
        fit = scene.extended(posterior, scene.places[:, rows])
        fix = lines(scene.study.spec, spec)
        yield scene.explained(name, f"no {name}", fix, fit, spec=spec)


def hold(scene: ResidualAnalysis) -> Iterator[Explanation]:
    """Try the other hold of the voltage between samples."""
    other = "first" if scene.whole.single_record.actuator.hold == "zero" else "zero"
    text = "voltage that is held between samples"
    if other == "first":
        text = "voltage that changes steadily between samples"
    yield from scene.changed("hold", text, hold=other)


def operator(scene: ResidualAnalysis) -> Iterator[Explanation]:
    """Try other hysteresis operators."""
    present = type(scene.posterior.single_record.actuator.hysteresis)
    # Try a compiled operator of each family, and plays of any weights, for loops without a formula.
    for name in ("bouc-wen", "bouc-wen-asymmetric", "prandtl-ishlinskii", "plays", "duhem"):
        if HYSTERESIS[name] is present:
            continue
        for spec in _histories(scene, scene.study.spec.with_stages(name)):
            kind, text = f"operator {name}", f"another operator, {name}"
            is_other = spec.history != scene.study.spec.history
            if is_other:
                kind, text = f"{kind}, demagnetized", f"{text}, {DEMAGNETIZED}"
            if not scene.looks_for(kind):
                continue
            posterior = scene.rebuilt(scene.study.with_model(spec))
            # One start finds the best mode of nearly all records, in half of the time of five.
            places = scene.local_minima(posterior, 1)
            fit = scene.extended(posterior, places)
            # Another history is only named: a next record's own is told by its lead-in alone, which
            # a spectrum of plays that is nearly right is too sure of.
            yield scene.explained(
                kind,
                text,
                lines(scene.study.spec, spec),
                fit,
                spec=None if is_other else spec,
                coordinates=fit.coordinates,
            )


def history(scene: ResidualAnalysis) -> Iterator[Explanation]:
    """Try a voltage that came straight from 0 V, where the operator's start cannot be that."""
    for spec in _histories(scene, scene.study.spec)[1:]:
        yield from scene.changed("history", f"hysteresis {DEMAGNETIZED}", history=spec.history)


def _histories(scene: ResidualAnalysis, spec: ModelSpec) -> list[ModelSpec]:
    """Return a model as it is, and with the history that its unknown start does not hold, if any.

    On a first curve from zero volts, an operator that remembers extrema moves otherwise than after
    a drive over all voltages. The misfit of that half period spoils the fit of all others.
    """
    record = scene.posterior.single_record
    operator = HYSTERESIS[spec.operator.name]
    known = record.from_rest or spec.history != "unknown"
    if known or not (isinstance(operator, type) and issubclass(operator, RemembersExtrema)):
        return [spec]
    return [spec, replace(spec, history="demagnetized")]


def smooth(scene: ResidualAnalysis) -> Iterator[Explanation]:
    """Try a discrepancy without corners, in place of a rough one."""
    if isinstance(scene.posterior.single_record.noise, DiscrepancyNoise) and scene.before is None:
        yield from scene.changed("a smooth discrepancy", flags={"noise": True}, noise="smooth")


def prior(scene: ResidualAnalysis) -> Iterator[Explanation]:
    """Try the default prior of each parameter that has another one.

    The fit may have left the other prior, or further parameters may have compensated for it.
    """
    before, defaults = scene.posterior.prior, scene.study.defaults if scene.alone else {}
    for parameter in before.free:
        default = defaults.get(parameter.name)
        if default is None or parameter.prior == default:
            continue
        parameters = [replace(p, prior=default) if p is parameter else p for p in before.parameters]
        posterior = replace(scene.posterior, prior=JointPrior(parameters, before.constraint))
        places = [
            posterior.prior.unconstrain(before.constrain(scene.places)[0]),
            scene.local_minima(posterior, 1),
        ]
        fit = scene.extended(posterior, np.concatenate(places))
        text = f"prior of {parameter.name}, {parameter.prior}, that excludes the record's value"
        fix = conflict_fix(parameter.name, default)
        yield scene.explained(f"prior of {parameter.name}", text, fix, fit, foreign=True)


def heavy_tails(scene: ResidualAnalysis) -> Iterator[Explanation]:
    """Try innovations of a Student t distribution of any scale, if there is an outlier."""
    white = scene.innovations
    far = np.abs(white) > 5
    if not far.any():
        return
    text = f"outliers ({np.sum(far)} of {white.size} innovations beyond 5 SD)"
    others = (scene.posterior.single_record.readings.values - scene.fit.displacement)[~far]
    rmse = scene.without[0], float(np.sqrt(np.mean(others**2)))
    fix, spec, nats = "set outliers = true in [model]", None, tail_nats(white)
    # Add no tails if outliers are few and far off: such tails would be too heavy for the others.
    before, tailed = scene.study.spec, scene.posterior.single_record.noise.tailed
    paced = scene.posterior.single_record.noise.paced
    if scene.alone and not (tailed or paced) and nats > isolated_nats(white):
        spec = replace(before, noise=f"{before.noise} + student")
        fix = lines(before, spec)
    yield Explanation(
        "heavy tails",
        text,
        fix,
        nats=nats - scene.lead,
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
    far = np.abs(white) > LIMIT * min(1.0, np.median(np.abs(white)) / scipy.special.ndtri(0.75))
    others, share, size = white[~far], np.mean(far), white.size
    if share > MOST:
        return -np.inf  # so many are not outliers
    density = float(np.sum(scipy.stats.norm.logpdf(others, 0, np.std(others))))
    density -= float(np.sum(scipy.stats.norm.logpdf(white)))
    density -= float(np.sum(far) * np.log(np.ptp(white)))
    # Share and sd have a cost as the scale in `tail_nats` has.
    cost = size * float(scipy.stats.bernoulli(share).entropy()) + float(np.log(2 * size))
    return density - cost


def growing_noise(scene: ResidualAnalysis) -> Iterator[Explanation]:
    """Try innovations of sd exp(a + b g), g the drive's speed or distance from its center."""
    rows, white = scene.posterior.single_record.readings.rows, scene.innovations
    center = (scene.voltage.max() + scene.voltage.min()) / 2
    for kind, drive in (("speed", scene.rate), ("voltage", scene.voltage - center)):
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
        rmse = scene.without[0], scene.fit.rmse
        fix = "train on a record driven as the plans are: the bands' width is the mean one"
        spec, noise = None, scene.posterior.single_record.noise
        if kind == "speed" and slope > 0 and scene.alone and not (noise.tailed or noise.paced):
            spec = replace(scene.study.spec, noise=f"{scene.study.spec.noise} + paced")
            fix = lines(scene.study.spec, spec)
        explanation = Explanation(
            f"noise by {kind}", text, fix, nats=float(nats - scene.lead), rmse=rmse
        )
        yield replace(explanation, noise=True, spec=spec)
