"""What a record taught: how far each parameter's posterior is narrower than its prior, and why.

The contraction 1 − (posterior sd / prior sd)² is near one where the record decided and near zero
where it told nothing. Scaling the power of the prior, or of the likelihood, by a little shows which
of them a posterior hangs on: one that moves with the prior and not with the likelihood is what was
put in.
"""

# mypy: allow-untyped-calls
# arviz_stats says that it has types, but its functions have none.

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass

import numpy as np
from scipy import linalg

from bwbayes.arrays import FloatArray
from bwbayes.diagnosis.conflict import normal_scores
from bwbayes.diagnosis.finding import Finding
from bwbayes.diagnosis.identifiability import LEFT_OPEN, combined, percent
from bwbayes.inference.parameters import JointPrior
from bwbayes.shown import brief

__all__ = ["Combination", "Learned", "Taught", "learned"]


@dataclass(frozen=True)
class Taught:
    """What is known of one parameter after a record.

    ``contraction`` as above, in the normal scores of its prior, so that it is the same for a
    parameter and its logarithm; below zero where the posterior is wider than the prior.
    ``prior`` and ``likelihood`` are the power-scaling sensitivities.
    """

    contraction: float
    prior: float
    likelihood: float

    @property
    def prior_decides(self) -> bool:
        """Whether it moves with the prior, and not with the likelihood."""
        small = 0.05  # Kallioinen and others, section 4
        return self.prior >= small > self.likelihood

    @property
    def numbers(self) -> dict[str, float | bool]:
        """What ``summary.json`` has of it."""
        return {
            "contraction": self.contraction,
            "prior_sensitivity": self.prior,
            "likelihood_sensitivity": self.likelihood,
            "prior_decides": self.prior_decides,
        }


@dataclass(frozen=True)
class Combination:
    """Parameters that were determined together worst, in words, and the prior's sd left of it."""

    text: str
    left: float


@dataclass(frozen=True)
class Learned:
    """What a record taught, by parameter, and the worst combinations, the worst first."""

    __repr__ = brief

    parameters: Mapping[str, Taught]
    combinations: tuple[Combination, ...]

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
        for combination in self.combinations[:1]:
            text = f"{combination.text}: {percent(combination.left)} of the prior's SD remains"
            fix = "quote its members together, or add a record that tells them apart"
            findings.append(Finding("determined worst", text, fix))
        return findings

    @property
    def numbers(self) -> dict[str, object]:
        """What ``summary.json`` has of it, as ``identifiability``."""
        return {
            "parameters": {name: taught.numbers for name, taught in self.parameters.items()},
            "combinations": [asdict(combination) for combination in self.combinations],
            "findings": [str(finding) for finding in self.findings],
        }


def learned(
    prior: JointPrior,
    draws: FloatArray,
    log_density: FloatArray,
    generator: np.random.Generator,
    count: int = 4000,
) -> Learned:
    """Hold the posterior against the prior.

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
    count
        Draws of the prior, and of the posterior, that are looked at.

    Notes
    -----
    N. Kallioinen, T. Paananen, P.-C. Bürkner, A. Vehtari, Detecting and diagnosing prior and
    likelihood sensitivity with power-scaling, Statistics and Computing 34 (2024) 57.
    """
    step = max(log_density.size // count, 1)
    thin = draws.reshape(-1, draws.shape[-1])[::step]
    log_likelihood = log_density.ravel()[::step] - prior.constrain(prior.unconstrain(thin))[1]
    before, after = (
        np.stack([normal_scores(*pair) for pair in zip(prior.free, every.T, strict=True)], axis=1)
        for every in (prior.draw(generator, count), thin)
    )
    contraction = 1 - np.var(after, axis=0) / np.var(before, axis=0)
    sensitivities = _sensitivities(prior, thin, log_likelihood)
    parameters = {
        name: Taught(float(contraction[i]), *sensitivities[name])
        for i, name in enumerate(prior.free_names)
    }
    return Learned(parameters, tuple(_combinations(prior.free_names, before, after)))


def _sensitivities(
    prior: JointPrior, draws: FloatArray, log_likelihood: FloatArray
) -> dict[str, tuple[float, float]]:
    """Return power-scaling sensitivities to prior and likelihood, by parameter.

    From draws (draws, free), taken as one chain: weights depend on no order.
    """
    import arviz_base  # noqa: PLC0415  # slow to load
    from arviz_stats import psense  # type: ignore[attr-defined]  # noqa: PLC0415

    tree = arviz_base.from_dict(
        {
            "posterior": {name: draws[np.newaxis, :, i] for i, name in enumerate(prior.free_names)},
            "log_prior": {"joint": prior.log_density(draws)[np.newaxis]},
            "log_likelihood": {"joint": log_likelihood[np.newaxis]},
        }
    )
    by_prior, by_likelihood = (psense(tree, group=group) for group in ("prior", "likelihood"))
    return {name: (float(by_prior[name]), float(by_likelihood[name])) for name in prior.free_names}


def _combinations(
    names: Sequence[str], before: FloatArray, after: FloatArray
) -> Iterator[Combination]:
    """Yield the three directions that keep most of their prior sd, in words.

    In the prior's own normal scores, whose spread the constraints may have changed: the
    eigenvectors of the posterior's covariance relative to the prior's.
    """
    prior, posterior = (np.atleast_2d(np.cov(z, rowvar=False)) for z in (before, after))
    variances, directions = linalg.eigh(posterior, prior)
    for i in range(len(variances) - 1, max(len(variances) - 4, -1), -1):
        sd = float(np.sqrt(max(variances[i], 0.0)))
        if sd >= LEFT_OPEN:
            # How the scores move together along it, and not what picks it out.
            yield Combination(combined(posterior @ directions[:, i], names), sd)
