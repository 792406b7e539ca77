"""Which parameter of a fit moves most when something is left out of its readings.

A fit that has followed what the actuator did not do, such as a transient or a drift of its sensor,
has other parameters without it: the one that moves by most of its sds shows best what went wrong.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from bwbayes.arrays import FloatArray
from bwbayes.inference.posterior import Dataset, Posterior

__all__ = ["Moved", "moved"]


@dataclass(frozen=True)
class Moved:
    """The physical parameter that moves most when something is left out of the readings.

    ``whole`` and ``rest`` are its median and sd with it and without it; ``sds`` is how far apart
    these are, in sds of both together.
    """

    name: str
    unit: str
    whole: tuple[float, float]
    rest: tuple[float, float]
    sds: float

    @property
    def line(self) -> str:
        """Both values, as the end of a line that says what is left out."""
        (whole, sd), (rest, its_sd) = self.whole, self.rest
        return (
            f"{self.name} is {rest:.4g} +- {its_sd:.2g} {self.unit}, "
            f"with it {whole:.4g} +- {sd:.2g}"
        )


def moved(
    posterior: Posterior, one: Dataset, draws: FloatArray, coordinates: FloatArray
) -> Moved | None:
    """Return the actuator's parameter that moves most, if it has one that can.

    Parameters
    ----------
    posterior, one
        The posterior, and the one of its records that is looked at.
    draws
        (draws, free), parameters in their own units, with what is left out.
    coordinates
        (draws, free), unconstrained, without it.
    """
    free, density = posterior.prior.constrain(coordinates)
    free = free[np.isfinite(density)]
    physical = [
        i
        for i, p in enumerate(posterior.prior.free)
        if p.plain in one.actuator.parameters and p.plain not in one.table.of_scope("record")
    ]
    if not physical or len(free) < len(coordinates) // 4:
        return None
    (whole, sd), (rest, its_sd) = (_middle(some[:, physical]) for some in (draws, free))
    sds = np.abs(rest - whole) / np.sqrt(sd**2 + its_sd**2 + np.finfo(float).tiny)
    most = int(np.argmax(sds))
    return Moved(
        posterior.prior.free[physical[most]].name,
        posterior.prior.free[physical[most]].unit,
        (float(whole[most]), float(sd[most])),
        (float(rest[most]), float(its_sd[most])),
        float(sds[most]),
    )


def _middle(draws: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Median and half the width of the middle 68 % of draws (draws, parameters)."""
    low, middle, high = np.quantile(draws, [0.16, 0.5, 0.84], axis=0)
    return middle, (high - low) / 2
