"""Which noise a record speaks for: white, or with a discrepancy that is rough or smooth.

Each is fitted from the mode of the rough one, and taken if its evidence leads by odds of twenty to
one: the rough discrepancy claims least, because it has white noise as a limit, and corners that a
smooth one has not.
"""

from __future__ import annotations

import numpy as np

from bwbayes.app.problem.problem import Problem
from bwbayes.diagnosis.explanations import TIED
from bwbayes.diagnosis.laplace import climb
from bwbayes.inference.map_estimate import PointFit
from bwbayes.inference.noise import NOISES

__all__ = ["chosen_noise"]

ROUGH = "discrepancy"


def chosen_noise(problem: Problem, point: PointFit) -> tuple[str, str]:
    """Return the noise of a problem whose ``noise`` is ``auto``, and a line that says why.

    Parameters
    ----------
    problem
        Its posterior has the rough discrepancy; of several records that stays.
    point
        Where that posterior is.
    """
    if len(problem.records) > 1:
        return ROUGH, f"noise: {ROUGH}, which is not chosen by evidence for several records"
    posterior = problem.posterior
    rough = climb(posterior, point.optima)
    worth = {ROUGH: rough.log_evidence}
    for noise in NOISES.keys() - worth:
        other = problem.reconfigured({"noise": noise}, {})
        named = dict(zip(posterior.names, point.optima.T, strict=True))
        # What only the other noise has starts at its prior's median.
        nothing = np.zeros(len(point.optima))
        places = np.stack([named.get(name, nothing) for name in other.names], axis=1)
        worth[noise] = climb(other, places, least=rough.log_density).log_evidence
    best = max(worth, key=lambda noise: worth[noise])
    if worth[best] < worth[ROUGH] + TIED:
        best = ROUGH
    against = ", ".join(
        f"{worth[best] - worth[noise]:+.3g} nats against {noise}"
        for noise in NOISES
        if noise != best
    )
    return best, f"noise: {best} ({against})"
