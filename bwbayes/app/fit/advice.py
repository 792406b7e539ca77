"""What a fit advises: which model to take, and what to measure next."""

from __future__ import annotations

from typing import Any

from bwbayes.app.fit.compared import Compared, Finished, compared
from bwbayes.app.jobs.design import design_draws
from bwbayes.arrays import ArrayLike
from bwbayes.comparison.design import Promise
from bwbayes.errors import NotConvergedError
from bwbayes.sampling.sampler import draws

__all__ = ["Advice"]


class Advice:
    """Comparison and design, for whatever has a problem, a chain and an outcome."""

    def compare(self: Finished, *others: Finished, **options: Any) -> Compared:
        """Compare this fit with others of the same readings, to tell which model to take.

        ``options`` (future, workers) and errors are as of
        :func:`bwbayes.app.fit.compared.compared`.
        """
        return compared((self, *others), **options)

    def design(self: Finished, target: str | ArrayLike, **options: Any) -> list[Promise]:
        """Rank signals by what they would leave of an sd, or of a band's width; the best first.

        ``target`` is a parameter's name, or a drive in V whose band is to be narrow; ``options``
        (candidates, voltage, slew, current, capacitance) and errors are as of
        :func:`bwbayes.app.jobs.design.design_draws`.

        Raises
        ------
        NotConvergedError
            The sampling has not converged.
        """
        if not self.outcome.converged:
            raise NotConvergedError("not converged: nothing is known to start from; see fit.resume")
        posterior = self.problem.posterior
        flat = draws(posterior, self.chain).reshape(-1, len(posterior.names))
        return design_draws(self.problem, flat, target, **options)
