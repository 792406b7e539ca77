"""Which noises there are: white, rough or smooth, or one's own by its import path."""

from __future__ import annotations

from collections.abc import Callable, Mapping

from bwbayes.inference.noise import Noise, WhiteNoise
from bwbayes.inference.rough import DiscrepancyNoise
from bwbayes.inference.smooth import SmoothNoise
from bwbayes.model.registry import made

__all__ = ["NOISES", "noise_model"]

NOISES: Mapping[str, Callable[..., Noise]] = {
    "discrepancy": DiscrepancyNoise,
    "smooth": SmoothNoise,
    "white": WhiteNoise,
}


def noise_model(kind: str, interval: float) -> Noise:
    """Return the noise of that name (or import path) for readings ``interval`` seconds apart.

    Raises
    ------
    InputError
        No noise goes by that name.

    Examples
    --------
    >>> [declared.name for declared in noise_model("discrepancy", 1e-3).declarations]
    ['sensor_sd', 'discrepancy_sd', 'discrepancy_time']
    """
    return made("noise", kind, NOISES, {"interval": interval}, Noise)
