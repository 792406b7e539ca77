"""One specimen as a population sees it: draws of its parameters, and the prior to divide out.

A population is normal in coordinates without a scale of their own: the logarithm of a parameter
that lies above zero, any other parameter as it is. Each specimen was fitted by itself, with a prior
of its own record's ranges perhaps; that prior is known, so what the record says remains when it is
divided out.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from bwbayes.arrays import BoolArray, FloatArray
from bwbayes.inference.parameters import JointPrior
from bwbayes.inference.posterior import Posterior
from bwbayes.population.normal import NormalLikelihoods
from bwbayes.prediction.prediction import thin_draws

# Draws of a specimen that are kept.
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
    """

    name: str
    names: tuple[str, ...]
    units: tuple[str, ...]
    logarithmic: BoolArray
    draws: FloatArray
    log_prior: FloatArray
    prior_mean: FloatArray
    prior_sd: FloatArray

    def save(self, path: Path) -> None:
        """Write it to an .npz file, whole or not at all."""
        arrays = {key: value for key, value in vars(self).items() if key != "name"}
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
        return cls(name, **arrays)


def specimen_of(
    name: str, posterior: Posterior, draws: FloatArray, generator: np.random.Generator
) -> Specimen:
    """Keep of a specimen's posterior what a population needs.

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
