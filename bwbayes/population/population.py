"""Population mean and spread of each parameter, shrunk specimens, and the specimen to come.

A population is normal in coordinates without a scale of their own: the logarithm of a parameter
that lies above zero, any other parameter as it is. Each specimen was fitted by itself, with a prior
of its own record's ranges perhaps; that prior is known, so what the record says remains when it is
divided out.

Each parameter by itself: specimens' coordinates y are drawn from N(μ, τ²), of which little is known
beforehand, or are outliers (:func:`~bwbayes.population.normal.population_density`), which neither
inflate the spread nor are pulled to the mean. The posterior of μ and τ comes from the draws of the
specimens' own posteriors, with their prior divided out,

    p(data of i | μ, τ) ∝ 1/S Σ_s p(y_is; μ, τ) / π_i(y_is),

so nothing is sampled again. Populations are proposed from the closed form for normal likelihoods
(:mod:`bwbayes.population.normal`), then, if need be, from a Student distribution around what that
came to, and reweighted. Pareto k says where that is not to be trusted: a specimen whose draws do
not reach where the population has it (k above 0.7, or few effective draws) is taken for normal, and
so are all if the populations' own weights fail.

Source: D. Lunn et al., Fully Bayesian hierarchical modeling in two stages, with application to
meta-analysis, J. R. Stat. Soc. C 62 (2013) 551; A. Vehtari et al., Pareto smoothed importance
sampling, J. Mach. Learn. Res. 25 (2024).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import astuple, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import scipy

from bwbayes.arrays import BoolArray, FloatArray
from bwbayes.errors import InputError
from bwbayes.inference.parameters import JointPrior
from bwbayes.inference.posterior import Posterior
from bwbayes.population.normal import (
    ODD,
    Hyperprior,
    NormalLikelihoods,
    left_out,
    population_density,
    spreads,
)
from bwbayes.prediction.prediction import thin_draws
from bwbayes.record.instruments import EXACT, Instruments, Scales
from bwbayes.sampling.diagnostics import MAX_PARETO_K, smoothed_weights
from bwbayes.shown import brief
from bwbayes.watching import Watch, unwatched, watched

# Specimens below which nothing is said of a spread.
FEWEST = 3

# Chance of a sound campaign to have an outlier among all specimens and parameters.
OFF = 0.05

# Draws of a specimen that are kept, populations that are drawn, and draws of each shrunk specimen.
DRAWS = 1000


@dataclass(frozen=True)
class Specimen:
    """The stored part of one specimen's posterior.

    Parameters
    ----------
    name
        The specimen's name.
    names, units
        The actuator's free parameters, and their units.
    logarithmic
        (parameters,) whether the coordinate is the logarithm.
    draws
        (draws, parameters) coordinates y of posterior draws: log x, or x.
    log_prior
        (draws, parameters) log marginal density of each coordinate under the specimen's prior, up
        to a constant.
    prior_mean, prior_sd
        (parameters,) of each coordinate under the prior.
    instruments
        Those that read its record. All numbers above are those of the readings.
    """

    name: str
    names: tuple[str, ...]
    units: tuple[str, ...]
    logarithmic: BoolArray
    draws: FloatArray
    log_prior: FloatArray
    prior_mean: FloatArray
    prior_sd: FloatArray
    instruments: Instruments = EXACT

    def save(self, path: Path) -> None:
        """Write it to an .npz file, whole or not at all."""
        arrays = {key: value for key, value in vars(self).items() if key != "name"}
        arrays["instruments"] = astuple(self.instruments)
        draft = path.with_suffix(".partial")
        with draft.open("wb") as file:
            np.savez(file, **arrays)
        draft.replace(path)

    @classmethod
    def load(cls, name: str, path: Path) -> Specimen:
        """Read it back."""
        with np.load(path) as file:
            arrays: dict[str, Any] = dict(file)
        arrays |= {key: tuple(arrays[key].tolist()) for key in ("names", "units")}
        arrays["instruments"] = Instruments(*arrays["instruments"].tolist())
        return cls(name, **arrays)


def specimen_of(
    name: str,
    posterior: Posterior,
    draws: FloatArray,
    generator: np.random.Generator,
    instruments: Instruments = EXACT,
) -> Specimen:
    """Keep of a specimen's posterior, whose record these ``instruments`` read, what is needed.

    The generator chooses ``DRAWS`` of the draws (draws, free), which have their own units.
    """
    prior = posterior.prior
    table = posterior.table
    of_actuator = {
        column.name
        for column in table.layout
        if column.name in table.physical and column.declaration.scope == "actuator"
    }
    columns = [i for i, p in enumerate(prior.free) if p.name in of_actuator]
    chosen = thin_draws(draws, generator, DRAWS)
    before = prior.draw(generator, 2000)
    logarithmic = np.array([prior.free[i].positive for i in columns], dtype=np.bool_)
    y = _coordinates(chosen[:, columns], logarithmic)
    prior_coordinates = _coordinates(before[:, columns], logarithmic)
    log_prior = np.empty_like(y)
    for n, i in enumerate(columns):
        log_prior[:, n] = _log_prior(prior, i, chosen[:, i], generator)
    log_prior += np.where(logarithmic, y, 0.0)  # dx/dy = x of the logarithm
    return Specimen(
        name,
        tuple(prior.free[i].name for i in columns),
        tuple(prior.free[i].unit for i in columns),
        logarithmic,
        y,
        log_prior,
        np.mean(prior_coordinates, axis=0),
        np.std(prior_coordinates, axis=0),
        instruments,
    )


def likelihoods(specimens: Sequence[Specimen], name: str) -> NormalLikelihoods:
    """Return normal likelihoods of one parameter: each posterior's less its prior's.

    With the moments of posterior and prior, 1/s² = 1/v₁ − 1/v₀ and m/s² = m₁/v₁ − m₀/v₀.
    """
    means, precisions = [], []
    for specimen in specimens:
        i = specimen.names.index(name)
        after, before = np.var(specimen.draws[:, i]) ** -1.0, specimen.prior_sd[i] ** -2.0
        precision = after - before
        if precision < 0.02 * before:  # the record tells nothing
            means.append(float(specimen.prior_mean[i]))
            precisions.append(0.0)
            continue
        pull = np.mean(specimen.draws[:, i]) * after - specimen.prior_mean[i] * before
        means.append(float(pull / precision))
        precisions.append(float(precision))
    return NormalLikelihoods(np.array(means), np.array(precisions))


def shared(specimens: Sequence[Specimen]) -> tuple[str, ...]:
    """Return the parameters that all specimens have, in the same coordinate."""
    first, *others = specimens
    logarithmic = dict(zip(first.names, first.logarithmic, strict=True))
    return tuple(
        name
        for name in first.names
        if all(
            name in specimen.names
            and specimen.logarithmic[specimen.names.index(name)] == logarithmic[name]
            for specimen in others
        )
    )


def _coordinates(values: FloatArray, logarithmic: BoolArray) -> FloatArray:
    return np.where(logarithmic, np.log(np.where(logarithmic, values, 1.0)), values)


def _log_prior(
    prior: JointPrior, column: int, x: FloatArray, generator: np.random.Generator
) -> FloatArray:
    """Log marginal density (draws,) of one parameter under the cut prior, up to a constant.

    Its own prior's, times the part of all others' prior that the constraints leave at x: by draws
    at some quantiles of x, and on straight lines between those.
    """
    places, n_others = 33, 400
    others = np.stack([p.draw(generator, n_others) for p in prior.free], axis=1)
    at = np.quantile(x, np.linspace(0, 1, places))
    tried = np.tile(others, (places, 1))
    tried[:, column] = np.repeat(at, n_others)
    inside = np.isfinite(prior.log_density(tried)).reshape(places, n_others)
    # A place where draws of the posterior lie has not nothing.
    possible = np.maximum(np.mean(inside, axis=1), 0.5 / n_others)
    density: FloatArray = prior.free[column].distribution.frozen.logpdf(x)
    density += np.interp(x, at, np.log(possible))
    return density


@dataclass(frozen=True)
class SpecimenEstimate:
    """One specimen's parameter among the others.

    ``lower``, ``median`` and ``upper`` are the 95% interval with the population for a prior, and
    ``own_lower``, ``own_median``, ``own_upper`` that of the record alone, both in the parameter's
    unit. ``p`` is how likely the record would be as far off, either way, from the population that
    all others show; ``outlier`` whether that is so unlikely that a sound campaign has one such
    among all specimens and parameters once in twenty.
    ``pareto_k`` judges the reweighting, and ``normal`` tells whether the specimen's likelihood was
    taken for normal because of it.
    """

    __repr__ = brief

    lower: float
    median: float
    upper: float
    own_lower: float
    own_median: float
    own_upper: float
    p: float
    outlier: bool
    pareto_k: float
    normal: bool


@dataclass(frozen=True)
class PopulationParameter:
    """A population's distribution of one parameter.

    Parameters
    ----------
    name, unit
        The parameter's.
    logarithmic
        Whether the population is normal in the logarithm. Then ``mean`` is its median and
        ``spread`` the sd of the logarithm, which is the relative one where it is small.
    mean, spread
        (DRAWS,) posterior draws, in the parameter's unit; of a logarithm, the spread is a number.
    new
        (DRAWS,) the parameter of a specimen that was not measured.
    factor
        (DRAWS,) by which the instruments' scales, which all specimens share, multiply the readings'
        numbers: it is in all of the above.
    specimens
        Results of each specimen, by name.
    pareto_k
        Pareto k of the populations' own weights.
    """

    __repr__ = brief

    name: str
    unit: str
    logarithmic: bool
    mean: FloatArray
    spread: FloatArray
    new: FloatArray
    factor: FloatArray
    specimens: Mapping[str, SpecimenEstimate]
    pareto_k: float

    def numbers(self) -> dict[str, object]:
        """Return it as ``campaign.json`` holds it."""
        return {
            "unit": self.unit,
            "logarithmic": self.logarithmic,
            "mean": _interval(self.mean),
            "spread": _interval(self.spread),
            "new_specimen": _interval(self.new),
            "pareto_k": self.pareto_k,
            "outliers": self.outliers,
        }

    @property
    def outliers(self) -> list[str]:
        """Names of the specimens that lie off the population."""
        return [name for name, among in self.specimens.items() if among.outlier]


@dataclass(frozen=True)
class Population:
    """The population of specimens: a :class:`PopulationParameter` for each, by its name."""

    __repr__ = brief

    names: tuple[str, ...]
    parameters: Mapping[str, PopulationParameter]

    def summary(self) -> dict[str, object]:
        """Return it as ``campaign.json`` holds it."""
        return {name: spread.numbers() for name, spread in self.parameters.items()}

    def to_pandas(self) -> object:
        """Return a pandas.DataFrame, a row for each parameter."""
        import pandas as pd  # noqa: PLC0415  # slow to load, and only needed here

        rows = {
            name: {
                f"{quantity}_{key}": value
                for quantity in ("mean", "spread", "new")
                for key, value in _interval(getattr(parameter, quantity)).items()
            }
            | {"unit": parameter.unit, "outliers": ", ".join(parameter.outliers)}
            for name, parameter in self.parameters.items()
        }
        return pd.DataFrame.from_dict(rows, orient="index")


def population(
    specimens: Sequence[Specimen], generator: np.random.Generator, watch: Watch = unwatched
) -> Population:
    """Return what specimens say together of the parameters that all of them have.

    Beforehand the population's mean is known as well as a specimen's parameter is under its prior,
    and its spread is half-normal, as wide as that: μ ~ N(m₀, s₀²), τ ~ |N(0, s₀²)|. ``watch`` is
    called with the share that is done.

    Raises
    ------
    InputError
        Fewer than ``FEWEST`` specimens, no parameter that all have, or unlike instruments.
    """
    count = len(specimens)
    if count < FEWEST:
        raise InputError(f"population: needs {FEWEST} specimens or more; there are {count}")
    names = shared(specimens)
    if not names:
        raise InputError("population: the specimens have no parameter of the actuator in common")
    instruments = specimens[0].instruments
    if any(specimen.instruments != instruments for specimen in specimens):
        raise InputError("population: records of other instruments; state the same of all")
    scales = instruments.scales(DRAWS, generator.spawn(1)[0])
    tests = count * len(names)
    return Population(
        tuple(specimen.name for specimen in specimens),
        {
            name: _population_of(specimens, name, generator, tests, scales)
            for name in watched(names, watch)
        },
    )


def next_specimen(
    population: Population, posterior: Posterior, draws: FloatArray, generator: np.random.Generator
) -> FloatArray:
    """Return draws of a specimen not measured yet, (draws, free), in their own units.

    The actuator's parameters are those of the population, drawn independently of each other; noise
    and what belongs to one record are as in a specimen that was measured. All are as the same
    instruments would read them.

    Parameters
    ----------
    population
        The fitted population.
    posterior, draws
        That of one of them, and (draws, free) of its parameters. Draws of the population that break
        the model's constraints are left out.
    generator
        Pairs them.

    Raises
    ------
    InputError
        The constraints leave hardly a draw.
    """
    prior = posterior.prior
    count = next(iter(population.parameters.values())).new.size
    specimens = draws[generator.choice(len(draws), count, replace=len(draws) < count)].copy()
    for column, parameter in enumerate(prior.free):
        if parameter.name in population.parameters:
            of_all = population.parameters[parameter.name]
            specimens[:, column] = of_all.new / of_all.factor
    possible = specimens[np.isfinite(prior.log_density(specimens))]
    if len(possible) < 0.1 * count:
        raise InputError("population: hardly a draw of it is a model; look at outliers and priors")
    return possible


def _population_of(
    specimens: Sequence[Specimen],
    name: str,
    generator: np.random.Generator,
    tests: int,
    scales: Scales,
) -> PopulationParameter:
    """Find the population of one parameter, in true um and V."""
    columns = [specimen.names.index(name) for specimen in specimens]
    pairs = list(zip(specimens, columns, strict=True))
    logarithmic = bool(specimens[0].logarithmic[columns[0]])
    width = float(np.mean([specimen.prior_sd[i] for specimen, i in pairs]))
    center = float(np.mean([specimen.prior_mean[i] for specimen, i in pairs]))
    prior = Hyperprior(center, width, width)
    normal = likelihoods(specimens, name)
    draws = [(specimen.draws[:, i], specimen.log_prior[:, i]) for specimen, i in pairs]
    p, inside = _inside(normal, prior, tests)
    outlier = ~inside | (p * tests < OFF)
    mean, spread, is_normal, shapes, k = _populations(draws, normal, inside, prior, generator)
    sound, odd = normal.marginal(mean, spread), normal.outlying(mean, spread)
    is_odd = scipy.special.expit(np.log(ODD) - np.log1p(-ODD) + odd - sound)
    is_odd = generator.uniform(size=is_odd.shape) < is_odd
    scale = np.exp if logarithmic else np.positive
    unit = specimens[0].units[columns[0]]
    factor = scales.factor(unit)

    def true(y: FloatArray) -> FloatArray:
        return y + np.log(factor[: y.size]) if logarithmic else y * factor[: y.size]

    among = {}
    for i, (specimen, (y, log_prior)) in enumerate(zip(specimens, draws, strict=True)):
        if is_normal[i]:
            shrunk = normal.shrunk(i, mean, spread, generator)
            shrunk[is_odd[i]] = generator.choice(y, np.count_nonzero(is_odd[i]))
        else:
            # From its own draws; a quarter of the populations are enough for a prior.
            by_population, _ = _weights(y, log_prior, mean[::4], spread[::4])
            weights = np.mean(by_population / np.sum(by_population, axis=0), axis=1)
            shrunk = generator.choice(y, DRAWS, p=weights / np.sum(weights))
        lower, median, upper = scale(np.quantile(true(shrunk), [0.025, 0.5, 0.975])).tolist()
        own_lower, own_median, own_upper = scale(np.quantile(true(y), [0.025, 0.5, 0.975])).tolist()
        among[specimen.name] = SpecimenEstimate(
            lower=lower,
            median=median,
            upper=upper,
            own_lower=own_lower,
            own_median=own_median,
            own_upper=own_upper,
            p=float(p[i]),
            outlier=bool(outlier[i]),
            pareto_k=float(shapes[i]),
            normal=bool(is_normal[i]),
        )
    new = scale(true(mean + spread * generator.standard_normal(DRAWS)))
    mean, spread = scale(true(mean)), spread if logarithmic else spread * factor
    return PopulationParameter(name, unit, logarithmic, mean, spread, new, factor, among, k)


def _inside(
    normal: NormalLikelihoods, prior: Hyperprior, tests: int
) -> tuple[FloatArray, BoolArray]:
    """Leave outliers out, the farthest first, each judged by the population of those that stay.

    Returns p (specimens,) and which specimens make the population (specimens,): ``FEWEST`` at
    least, and more than half of them.
    """
    count = normal.mean.size
    inside = np.ones(count, dtype=np.bool_)
    p = left_out(normal, prior)
    while np.sum(inside) > max(FEWEST, count // 2 + 1):
        farthest = int(np.argmin(np.where(inside, p, np.inf)))
        if p[farthest] * tests >= OFF:
            break
        inside[farthest] = False
        p = left_out(normal, prior, inside)
    return p, inside


def _populations(
    draws: Sequence[tuple[FloatArray, FloatArray]],
    normal: NormalLikelihoods,
    inside: BoolArray,
    prior: Hyperprior,
    generator: np.random.Generator,
) -> tuple[FloatArray, FloatArray, BoolArray, FloatArray, float]:
    """Propose populations, and weigh them by the specimens' draws.

    Returns means and spreads, (DRAWS,) each; which specimens are taken for normal, and the Pareto k
    of their draws reweighted to a typical population, (specimens,) each; Pareto k of the weights.
    """
    sound = normal.only(inside)
    posterior = spreads(sound, prior)
    mean, spread = posterior.draw(generator, DRAWS)
    shapes, effective = np.empty((2, len(draws)))
    for i, (y, log_prior) in enumerate(draws):
        z = (y - np.median(mean)) / np.median(spread)
        weights, shapes[i] = smoothed_weights(np.log(population_density(z)) - log_prior)
        effective[i] = 1 / np.sum(weights**2)
    is_normal = ~((shapes <= MAX_PARETO_K) & (effective >= 50))
    proposed = prior.log_density(mean, spread) + np.sum(sound.marginal(mean, spread), axis=0)
    k = 0.0
    for _ in range(4):
        # Log p(data of i | μ, τ), each up to a constant of its own.
        logs = normal.mixture_log_density(mean, spread)
        for i in np.flatnonzero(~is_normal).tolist():
            by_draw, largest = _weights(*draws[i], mean, spread)
            logs[i] = largest + np.log(np.sum(by_draw, axis=0))
        target = prior.log_density(mean, spread) + np.sum(logs, axis=0)
        weights, k = smoothed_weights(target - proposed)
        if k <= MAX_PARETO_K:
            break
        # Around these: a Student distribution of μ and log τ with the weighted moments.
        places = np.stack([mean, np.log(spread)], axis=1)
        center = weights @ places
        away = places - center
        covariance = (away * weights[:, np.newaxis]).T @ away
        covariance += np.diag(1e-3 * np.var(places, axis=0))
        student = scipy.stats.multivariate_t(center, covariance, df=5, seed=generator)
        drawn = student.rvs(DRAWS)
        # The density of τ is that of log τ over τ.
        mean, spread = drawn[:, 0], np.exp(drawn[:, 1])
        proposed = student.logpdf(drawn) - drawn[:, 1]
    else:
        # Nothing that reweights can be trusted: the normal likelihoods alone.
        mean, spread = posterior.draw(generator, DRAWS)
        is_normal, weights = np.ones(len(draws), dtype=np.bool_), np.full(DRAWS, 1 / DRAWS)
    chosen = generator.choice(DRAWS, DRAWS, p=weights)
    return mean[chosen], spread[chosen], is_normal, shapes, k


def _weights(
    y: FloatArray, log_prior: FloatArray, mean: FloatArray, spread: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """p(y_s | μ, τ)/π(y_s), (draws, n), over its largest of each population, and log of that.

    The logarithm is up to a constant.
    """
    weights = population_density((y[:, np.newaxis] - mean) / spread)
    weights *= np.exp(np.min(log_prior) - log_prior)[:, np.newaxis]
    largest = np.max(weights, axis=0)
    weights /= largest
    return weights, np.log(largest / spread)


def _interval(values: FloatArray) -> dict[str, float]:
    lower, median, upper = np.quantile(values, [0.025, 0.5, 0.975])
    return {"lower_95": float(lower), "median": float(median), "upper_95": float(upper)}
