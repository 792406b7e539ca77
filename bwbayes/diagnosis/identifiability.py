"""Parameters and combinations that a record does not identify, before and after sampling.

Before, by Fisher's information at a point fit (:func:`undetermined_directions`). Every fit leaves a
discrepancy of about a percent of the range, which comes back whenever the voltage repeats itself: a
hundred periods of one sine show one loop, not a hundred. So each distinct branch of the voltage
counts once, under a discrepancy of that percent. The posterior itself, which assumes that the noise
model is right, may be narrower.

After, by the draws (:func:`information_gain`). The contraction 1 − (posterior sd / prior sd)² is
near one where the record determines a parameter and near zero where it does not. Both checks use
the effective prior: γ, which lies within β, is compared with the β of the record. Scaling the power
of the prior, or of the likelihood, by a little shows which of them a posterior depends on: one that
moves with the prior and not with the likelihood repeats the prior.
"""

# mypy: allow-untyped-calls
# arviz_stats says that it has types, but its functions have none.

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import scipy

from bwbayes.arrays import FloatArray, IntArray
from bwbayes.diagnosis.finding import Finding
from bwbayes.inference.likelihood import Likelihood
from bwbayes.inference.map_estimate import MAPEstimate
from bwbayes.inference.mode_finding import value_and_jacobian
from bwbayes.inference.noise import DiscrepancyNoise
from bwbayes.inference.parameters import JointPrior, Parameter
from bwbayes.inference.posterior import Posterior
from bwbayes.model.inputs import monotone_stretches, turning_points
from bwbayes.shown import brief
from bwbayes.watching import Watch, part, unwatched, watched

# The discrepancy that every fit leaves, as a part of the range.
USUAL_ERROR = 0.01

# A combination is undetermined when this part of its prior sd or more is left.
LEFT_OPEN = 1 / 3


def undetermined_directions(posterior: Posterior, point: MAPEstimate) -> Iterator[Finding]:
    """Yield the combinations of loop parameters that the record determines least, two at most.

    For each, more than a third of the prior's sd is left at a point fit; the finding says how much,
    and what to measure. The second one says how many more there are.
    """
    names = [posterior.names[i] for i in _columns(posterior, posterior.table.loop)]
    if not names:
        return
    parts, directions = spectrum(posterior, point)
    count = int(np.count_nonzero(parts > LEFT_OPEN))
    if not count:
        return
    # Choose the advice on what to measure.
    windows = [data.voltage[window] for data in posterior.datasets for window in data.training]
    half = max(float(np.ptp(voltage)) / 2 for voltage in windows)
    swings = np.concatenate([np.abs(np.diff(v[turning_points(v)])) for v in windows])
    free = posterior.prior.constrain(point.mode[np.newaxis])[0]
    _, single, record_free = next(posterior.each(free))
    columns = single.single_record.table.columns(single.prior.theta(record_free))
    opening = single.single_record.actuator.hysteresis.opening(columns, half)
    advice = "add larger and smaller amplitudes"
    # A loop closes where its opening is about one; below 0.3 it hardly opens.
    if opening is not None and opening[0] < 0.3:
        advice = f"drive over more than {2 * half:.3g} V peak to peak, if the actuator allows it"
    elif swings.size < 2 or swings.min() > 0.8 * swings.max():
        advice = "vary the amplitude: let it decay to a tenth over ten periods"
    for i in range(min(count, 2)):
        text = (
            f"{in_words(directions[:, i], names)}: {remaining(parts[i])} if the model is off by "
            f"{USUAL_ERROR:.0%} of the range"
        )
        if i == count - 1 < parts.size - 1:
            text += f" (next {in_words(directions[:, i + 1], names)}: {percent(parts[i + 1])})"
        elif i == 1:
            text += f", and more than {percent(LEFT_OPEN)} of {count - 2} other combinations"
        yield Finding("not identifiable", text, advice)


def percent(share: float) -> str:
    """Write the remaining part of a prior's sd, "all" even if a posterior is wider."""
    return "all" if share >= 0.995 else f"{share:.0%}"


def remaining(share: float) -> str:
    """Write the part of a prior's sd that is left after the constraints and the record."""
    return f"{percent(share)} of the effective prior's SD remains"


def spectrum(posterior: Posterior, point: MAPEstimate) -> tuple[FloatArray, FloatArray]:
    """Return the part of the prior sd that is left along each principal direction of the loop.

    Returns the parts (loop parameters,), the largest first, and the directions as columns, in units
    of each parameter's prior sd: relative to its value for a positive one, to its bounds for γ.
    """
    prior, columns = posterior.prior, _columns(posterior, posterior.table.physical)
    free, _ = prior.constrain(point.mode[np.newaxis])
    values = dict(zip(prior.names, prior.theta(free)[0], strict=True))
    sds = np.zeros((len(columns), free.shape[1]))
    sds[np.arange(len(columns)), columns] = [
        _prior_sd(prior, prior.free[column], values) for column in columns
    ]

    information = sum(_information(posterior, data, free, sds) for data in posterior.datasets)
    remaining = scipy.linalg.inv(np.eye(len(columns)) + information)
    loop = [columns.index(column) for column in _columns(posterior, posterior.table.loop)]
    variance, directions = scipy.linalg.eigh(remaining[np.ix_(loop, loop)])
    return np.sqrt(variance[::-1]), directions[:, ::-1]


def _columns(posterior: Posterior, names: tuple[str, ...]) -> list[int]:
    return [i for i, name in enumerate(posterior.names) if name in names]


def _prior_sd(prior: JointPrior, parameter: Parameter, values: dict[str, float]) -> float:
    """Return a parameter's prior sd around its value in ``values``."""
    columns = {name: np.array([value]) for name, value in values.items()}
    lower, upper = parameter.declared.limits(prior.values_for_record(columns, parameter.record))
    if np.isfinite(lower).all() and np.isfinite(upper).all():
        # The sd of a uniform distribution between the bounds.
        return float(np.max(upper) - np.min(lower)) / float(np.sqrt(12))
    # Half of the central 68 % stands for the sd: some distributions have none.
    low, high = (float(v) for v in parameter.distribution.frozen.ppf([0.16, 0.84]))
    if parameter.positive:
        return float(values[parameter.name] * np.log(high / low) / 2)
    return (high - low) / 2


def _information(
    posterior: Posterior, dataset: Likelihood, free: FloatArray, sds: FloatArray
) -> FloatArray:
    """Return a record's Fisher information (physical, physical); each distinct branch counts once.

    The derivatives are along steps ``sds`` (physical, free) from ``free`` (1, free).
    """

    def simulate(scores: FloatArray) -> FloatArray:
        return posterior.simulate(posterior.prior.theta(free + scores @ sds), record=dataset.name)

    slopes = value_and_jacobian(simulate, np.zeros((1, len(sds))))[1][0]
    theta = posterior.table.of(posterior.prior.theta(free), dataset.name)
    noise_parameters = dataset.table.noise(theta)
    _, sensor = dataset.noise.marginal_sd(noise_parameters)
    rows = np.concatenate([np.arange(w.start, w.stop) for w in dataset.training])
    weights, duration = stretches_once(dataset.voltage, rows)
    # The discrepancy changes along the path, over about half a branch.
    noise = DiscrepancyNoise(1.0)
    values = np.array([[sensor[0], USUAL_ERROR * dataset.extent, duration / 2]])
    total = np.zeros((len(slopes), len(slopes)))
    for window in dataset.training:
        (white,), _ = noise.whiten(values, slopes[np.newaxis, :, window])
        total += (white * weights[window]) @ white.T
    return total


def stretches_once(voltage: FloatArray, rows: IntArray) -> tuple[FloatArray, float]:
    """Return a weight for each sample, and the mean number of samples in a branch.

    The weight is one over the number of times that ``rows`` hold the sample's branch. Branches of
    one direction are the same if they start within a percent of the voltage's range. A branch that
    ends early, such as a record's last one, counts as a part.
    """
    stretches = list(monotone_stretches(voltage))
    starts = np.array([[voltage[s.first], s.direction] for s in stretches])
    starts[:, 0] = np.round((starts[:, 0] - voltage.min()) / (0.01 * np.ptp(voltage) or 1))
    _, kind = np.unique(starts, axis=0, return_inverse=True)
    used = np.bincount(rows, minlength=voltage.size)
    samples = np.array([np.sum(used[s.first + 1 : s.last + 1]) for s in stretches])
    longest = np.zeros(kind.max() + 1)
    np.maximum.at(longest, kind, samples)
    share = np.maximum(longest, 1) / np.maximum(np.bincount(kind, samples), 1)
    weights = np.empty(voltage.size)
    for stretch, weight in zip(stretches, share[kind], strict=True):
        weights[stretch.first : stretch.last + 1] = weight
    return weights, voltage.size / len(stretches)


def in_words(direction: FloatArray, names: Sequence[str]) -> str:
    """Name a direction (names,) in words, the largest component first.

    ``alpha with beta`` means that both may grow together, ``alpha against beta`` that one grows
    while the other falls; components below a fifth of the largest are left out, and all after four.
    """
    shares = direction / direction[np.argmax(np.abs(direction))]
    order = np.argsort(-np.abs(shares), kind="stable")[:4]
    first, *others = [i for i in order if abs(shares[i]) > 0.2]
    return " ".join(
        [names[first], *(f"{'with' if shares[i] > 0 else 'against'} {names[i]}" for i in others)]
    )


@dataclass(frozen=True)
class ParameterInformation:
    """Information about one parameter from a record.

    ``contraction`` is defined as above, in the joint prior's coordinates, so that it is the same
    for a parameter and its logarithm; it is below zero if the posterior is wider than the prior.
    ``prior`` and ``likelihood`` are the power-scaling sensitivities.
    """

    contraction: float
    prior: float
    likelihood: float

    @property
    def prior_decides(self) -> bool:
        """True if the posterior moves with the prior, and not with the likelihood."""
        small = 0.05  # Kallioinen and others, section 4
        return self.prior >= small > self.likelihood

    @property
    def numbers(self) -> dict[str, float | bool]:
        """Numbers for ``summary.json``."""
        return {
            "contraction": self.contraction,
            "prior_sensitivity": self.prior,
            "likelihood_sensitivity": self.likelihood,
            "prior_decides": self.prior_decides,
        }


@dataclass(frozen=True)
class InformationGain:
    """Information gain from a record, by parameter.

    ``combinations`` are the combinations of parameters, in words, that the record determines least,
    the worst first, and the part of the prior's sd that is left of each.
    """

    __repr__ = brief

    parameters: Mapping[str, ParameterInformation]
    combinations: tuple[tuple[str, float], ...]

    @property
    def findings(self) -> list[Finding]:
        """Parameters that the prior decides, and the combination that is determined worst."""
        findings = [
            Finding(
                name,
                f"the prior decides (power-scaling sensitivity {taught.prior:.2f} to the prior, "
                f"{taught.likelihood:.2f} to the readings; contraction {taught.contraction:.2f})",
                "give it the prior that is known, or a record that shows it",
            )
            for name, taught in self.parameters.items()
            if taught.prior_decides
        ]
        for combination, sd_ratio in self.combinations[:1]:
            text = f"{combination}: {remaining(sd_ratio)}"
            fix = "quote its members together, or add a record that tells them apart"
            findings.append(Finding("determined worst", text, fix))
        return findings

    @property
    def numbers(self) -> dict[str, object]:
        """Numbers for ``identifiability`` in ``summary.json``."""
        return {
            "parameters": {name: taught.numbers for name, taught in self.parameters.items()},
            "combinations": [
                {"text": text, "left": sd_ratio} for text, sd_ratio in self.combinations
            ],
            "findings": [str(finding) for finding in self.findings],
        }


def information_gain(
    prior: JointPrior,
    draws: FloatArray,
    log_density: FloatArray,
    generator: np.random.Generator,
    watch: Watch = unwatched,
) -> InformationGain:
    """Compare the posterior with the prior.

    Parameters
    ----------
    prior
        The joint prior.
    draws
        (steps, ensembles, walkers, free), parameters in their own units.
    log_density
        (steps, ensembles, walkers), nats, as the chain has it: in its coordinates.
    generator
        Draws from the prior.
    watch
        Called with the share that is done.

    Notes
    -----
    N. Kallioinen, T. Paananen, P.-C. Bürkner, A. Vehtari, Detecting and diagnosing prior and
    likelihood sensitivity with power-scaling, Statistics and Computing 34 (2024) 57.
    """
    import arviz_base  # noqa: PLC0415  # slow to load
    from arviz_stats import psense  # noqa: PLC0415

    count = 4000  # number of draws of the prior, and of the posterior, that are used
    step = max(log_density.size // count, 1)
    thin = draws.reshape(-1, draws.shape[-1])[::step]
    before, after = (prior.unconstrain(sample) for sample in (prior.draw(generator, count), thin))
    log_likelihood = log_density.ravel()[::step] - prior.constrain(after)[1]
    contraction = 1 - np.var(after, axis=0) / np.var(before, axis=0)
    watch(0.5)
    # Take the draws as one chain: weights do not depend on their order.
    tree = arviz_base.from_dict(
        {
            "posterior": {name: thin[np.newaxis, :, i] for i, name in enumerate(prior.free_names)},
            "log_prior": {"joint": prior.log_density(thin)[np.newaxis]},
            "log_likelihood": {"joint": log_likelihood[np.newaxis]},
        }
    )
    to_prior, to_likelihood = (
        psense(tree, group=group)
        for group in watched(("prior", "likelihood"), part(watch, 0.5, 1.0))
    )
    parameters = {
        name: ParameterInformation(float(share), float(to_prior[name]), float(to_likelihood[name]))
        for name, share in zip(prior.free_names, contraction, strict=True)
    }
    # The three directions that keep most of their prior sd, in coordinates, whose spread the
    # constraints may have changed: the eigenvectors of the posterior's covariance relative to the
    # prior's.
    prior_covariance, posterior_covariance = (
        np.atleast_2d(np.cov(z, rowvar=False)) for z in (before, after)
    )
    variances, directions = scipy.linalg.eigh(posterior_covariance, prior_covariance)
    combinations = []
    for i in range(len(variances) - 1, max(len(variances) - 4, -1), -1):
        sd = float(np.sqrt(max(variances[i], 0.0)))
        if sd >= LEFT_OPEN:
            # Name the joint move of the scores along the direction, not the direction's weights.
            combinations.append(
                (in_words(posterior_covariance @ directions[:, i], prior.free_names), sd)
            )
    return InformationGain(parameters, tuple(combinations))
