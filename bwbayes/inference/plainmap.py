"""The map from normal scores to parameters that nothing cuts: a formula for each, all at once.

Most priors are normal or lognormal and have no bounds but their own. On a short record a call for
each of them would cost more than the likelihood.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from bwbayes.arrays import FloatArray, IntArray
from bwbayes.model.distributions import Scored

__all__ = ["PlainMap"]

# Places among the free parameters, and centers and scales as columns.
_Kind = tuple[IntArray, FloatArray, FloatArray]


@dataclass(frozen=True)
class PlainMap:
    """Parameters x = c + s z, and others x = c exp(s z), of normal scores z.

    ``rows`` are their places among the free ones; ``normal`` and ``lognormal`` the two kinds.
    """

    rows: frozenset[int]
    normal: _Kind
    lognormal: _Kind

    @classmethod
    def of(cls, formulas: Mapping[int, Scored | None]) -> PlainMap:
        """Take the parameters, by their places, that have a formula."""
        forms = {row: form for row, form in formulas.items() if form is not None}
        kinds = (
            [
                (row, form.center, form.scale)
                for row, form in forms.items()
                if form.logarithmic == kind
            ]
            for kind in (False, True)
        )
        return cls(frozenset(forms), *(_columns(kind) for kind in kinds))

    def fill(self, free: FloatArray, scores: FloatArray) -> None:
        """Write the values of their scores, both (free, models)."""
        rows, center, scale = self.normal
        if rows.size:
            free[rows] = center + scale * scores[rows]
        rows, center, scale = self.lognormal
        if rows.size:
            free[rows] = center * np.exp(scale * scores[rows])


def _columns(kind: list[tuple[int, float, float]]) -> _Kind:
    rows, centers, scales = np.array(kind).reshape(-1, 3).T
    return rows.astype(np.int64), centers[:, np.newaxis], scales[:, np.newaxis]
