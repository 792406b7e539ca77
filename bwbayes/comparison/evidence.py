"""How probable a record was under a model before it was seen: the evidence, by bridge sampling.

The evidence is the likelihood averaged over the prior. It weighs a better fit against the freedom
that the model had to find it, but only as far as priors and noise are believed. It is estimated
between the posterior's draws and a distribution fitted to other draws of it, whose integral is
known: what both cover bridges the unknown integral to the known one.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import scipy

from bwbayes.arrays import FloatArray
from bwbayes.inference.map_estimate import MAPEstimate
from bwbayes.inference.parameters import JointPrior
from bwbayes.inference.posterior import Posterior
from bwbayes.sampling.diagnostics import effective_draws
from bwbayes.sampling.proposals import StudentMixture
from bwbayes.watching import Watch, unwatched, watched


class Bridge(NamedTuple):
    """The log of an unknown integral, nats, its standard error, and effective draws behind it."""

    log_integral: float
    error: float
    effective: float


@dataclass(frozen=True)
class Evidence:
    """The log evidence log p(readings | model).

    Attributes
    ----------
    log_evidence
        Nats. The readings' density is per um to the power of their number, so that it compares
        models of the same readings alone.
    error
        Its standard error by Monte Carlo; infinite where the draws cannot tell.
    log_prior_mass
        Log of the part of the independent priors that meets the constraints, by which their
        product is divided.
    effective
        Effective draws at the bridge's posterior end.
    prior_share
        Cost of the priors' width in the evidence, nats: the mean log likelihood of the draws
        less the log evidence, which is how far the posterior is from the prior (Kullback-Leibler).
    max_log_likelihood
        The largest among the draws, nats.
    """

    log_evidence: float
    error: float
    log_prior_mass: float
    effective: float
    prior_share: float = np.nan
    max_log_likelihood: float = np.nan


def evidence(
    posterior: Posterior,
    draws: FloatArray,
    log_density: FloatArray,
    generator: np.random.Generator,
    watch: Watch = unwatched,
) -> Evidence:
    """Estimate the log evidence.

    In the coordinates z in which :class:`~bwbayes.inference.posterior.Posterior` gives its density,
    the integral of likelihood times φ(z) times the room that the bounds leave is the evidence times
    the prior's mass inside the constraints (:func:`log_prior_mass`); the Jacobian is in φ.

    Parameters
    ----------
    posterior
        The posterior that was sampled.
    draws
        (steps, ensembles, walkers, free), parameters in their own units. The mixture is fitted to
        half of the ensembles, and bridged to the other half: draws that it was fitted to would look
        better covered than they are.
    log_density
        (steps, ensembles, walkers), nats, as the chain has it.
    generator
        Draws from mixture and prior.
    watch
        Called with the share that is done.
    """
    free = draws.shape[-1]
    coordinates = posterior.prior.unconstrain(draws.reshape(-1, free))
    log_likelihood = log_density.ravel() - posterior.prior.constrain(coordinates)[1]
    coordinates = coordinates.reshape(draws.shape)
    half = draws.shape[1] // 2
    fitted = coordinates[:, :half].reshape(-1, free)
    max_draws = 20_000  # that the mixture is fitted to, and at the other end
    fitted = fitted[:: max(len(fitted) // max_draws, 1)]
    mass, mass_error = log_prior_mass(posterior.prior, generator)
    try:
        proposal = StudentMixture.fitted(fitted)
    except np.linalg.LinAlgError:  # too few draws
        highest = float(np.max(log_likelihood))
        return Evidence(np.nan, np.inf, mass, 0.0, max_log_likelihood=highest)
    thin = max(log_density[:, half:].size // max_draws, 1)
    sampled = coordinates[::thin, half:]
    at_draws = log_density[::thin, half:] - proposal.log_density(sampled)
    random = np.random.RandomState(generator.integers(2**32))
    places, proposed = proposal.evaluate(proposal.draw(random, 10_000))
    densities = [*map(posterior.log_density, watched(np.array_split(places, 20), watch))]
    at_places = np.concatenate(densities) - proposed
    bridged = bridge(at_draws, at_places)
    # The chain's density leaves out the constant of the standard normal φ.
    constant = -0.5 * free * np.log(2 * np.pi)
    log_evidence = bridged.log_integral + constant - mass
    return Evidence(
        log_evidence,
        float(np.hypot(bridged.error, mass_error)),
        mass,
        bridged.effective,
        float(np.mean(log_likelihood)) - log_evidence,
        float(np.max(log_likelihood)),
    )


def screening_evidence(
    posterior: Posterior, point: MAPEstimate, generator: np.random.Generator
) -> Evidence:
    """Return Laplace's approximation at a point fit, whose error nobody knows.

    log Z = log p(readings | z) − ½ |z|² + ½ log det C − log prior mass, with the covariance C at
    the mode z; the constants of the two normal densities cancel.
    """
    mass, _ = log_prior_mass(posterior.prior, generator)
    log_volume = 0.5 * float(np.linalg.slogdet(point.covariance)[1])
    log_likelihood = point.log_density - posterior.prior.constrain(point.mode[np.newaxis])[1][0]
    log_evidence = point.log_density + log_volume - mass
    share = float(log_likelihood) - log_evidence
    return Evidence(log_evidence, np.inf, mass, 0.0, share, float(log_likelihood))


def bridge(at_draws: FloatArray, at_places: FloatArray) -> Bridge:
    """Bridge from a known integral to an unknown one: the ratio r = ∫p / ∫q.

    With weights w = p/q at draws of p and at places from q, the optimal bridge solves

        r = mean over places of [w / (s w + (1 − s) r)] / mean over draws of [1 / (s w + (1 − s) r)]

    with s = n / (n + N), n effective draws and N places. The relative error follows from the
    variances of both means, that of the draws divided by their effective number.

    Parameters
    ----------
    at_draws
        (steps, ensembles, walkers) log p − log q at draws of p.
    at_places
        (N,) log p − log q at independent draws of q; −∞ where p is zero.

    Notes
    -----
    X.-L. Meng and W. H. Wong, Statistica Sinica 6 (1996) 831-860; S. Frühwirth-Schnatter,
    Econometrics Journal 7 (2004) 143-167, for the error.
    """
    shift = float(np.median(at_draws))
    draws, places = at_draws - shift, at_places - shift
    effective = _effective(np.tanh(draws))
    log_r, ends = 0.0, (np.empty(0), np.empty(0))
    for _ in range(2):
        # The effective number is that of what is averaged, which is known once r is.
        share = effective / (effective + places.size)
        with np.errstate(divide="ignore"):
            from_posterior, from_reference = np.log(share), np.log1p(-share)
        for _ in range(1000):  # some ten where the two distributions overlap at all
            # The logs of what is averaged at draws and at places.
            ends = (
                -np.logaddexp(from_posterior + draws, from_reference + log_r),
                places - np.logaddexp(from_posterior + places, from_reference + log_r),
            )
            means = [scipy.special.logsumexp(end) - np.log(end.size) for end in ends]
            before, log_r = log_r, float(means[1] - means[0])
            if not abs(log_r - before) > 1e-10:  # nan too
                break
        effective = _effective(np.exp(ends[0] - np.max(ends[0])))
    scaled = [np.exp(end - np.max(end)) for end in ends]
    variances = [np.var(end) / np.mean(end) ** 2 for end in scaled]
    error = float(np.sqrt(variances[0] / effective + variances[1] / places.size))
    return Bridge(log_r + shift, error if np.isfinite(error) else np.inf, effective)


def _effective(values: FloatArray) -> float:
    """Return what draws (steps, ensembles, walkers) of a bounded quantity are worth."""
    if np.ptp(values) == 0:
        return float(values.size)
    bulk, _ = effective_draws(values)
    return bulk if np.isfinite(bulk) else 1.0


def log_prior_mass(prior: JointPrior, generator: np.random.Generator) -> tuple[float, float]:
    """Return the log of the part of the independent priors inside all bounds, and its error.

    Bounds that depend on other parameters leave each draw its own room: the product of
    F(u) − F(l) over the parameters, zero where a constraint does not hold. Its mean over standard
    normal coordinates is the mass.
    """
    coordinates = generator.standard_normal((100_000, prior.dimensions))
    log_prior = prior.constrain(coordinates)[1]
    room = np.exp(log_prior + 0.5 * np.sum(coordinates**2, axis=1))
    mean = float(np.mean(room))
    if not mean > 0:
        return -np.inf, np.inf
    return float(np.log(mean)), float(np.std(room) / mean / np.sqrt(room.size))
