"""The stock path: what one would write without this package.

emcee with its defaults, on a likelihood whose hysteresis is a plain NumPy loop over the samples.
It is a generous stock: the loop takes all walkers at once, though emcee's default is one call for
each, and dynamics and noise go through ``scipy.signal.lfilter`` as on the NumPy engine.
"""

from dataclasses import dataclass, fields

import numpy as np

from bwbayes.arrays import FloatArray
from bwbayes.inference.posterior import Posterior


def hysteresis_loop(
    voltage: FloatArray, alpha: FloatArray, beta: FloatArray, gamma: FloatArray, initial: FloatArray
) -> FloatArray:
    """Step equation (6) of the paper from sample to sample; arguments as in the package.

    Exact but for the step within which h passes zero, where its rate should change on the way.
    """
    h = np.empty((voltage.size, alpha.size))
    h[0] = now = initial
    against, ahead = beta - gamma, beta + gamma
    for t in range(1, voltage.size):
        step = voltage[t] - voltage[t - 1]
        direction = 1.0 if step > 0 else -1.0
        start = direction * now
        rate = np.where(start < 0, against, ahead)
        gone = -np.expm1(-rate * abs(step))
        now = direction * (start + (alpha / rate - start) * gone)
        h[t] = now
    return h.T


@dataclass(frozen=True)
class StockPosterior(Posterior):
    """A posterior with the loop for its hysteresis, for n = 1."""

    def log_likelihood(
        self,
        theta: FloatArray,
        displacement: FloatArray | None = None,  # noqa: ARG002  # it is simulated each time
    ) -> FloatArray:
        """Log likelihood (models,) at θ (models, parameters)."""
        column = dict(zip(self.prior.names, theta.T, strict=True))
        shape = (column[name] for name in ("alpha", "beta", "gamma", "initial"))
        one = self.single_record
        drive = column["d"][:, np.newaxis] * one.voltage - hysteresis_loop(one.voltage, *shape)
        rest = drive[:, :1].copy()
        (recursion,) = one.actuator.sections(column).recursions
        moved = recursion.run(drive - rest, recursion.at_rest())
        residual = one.displacement - moved - rest - column["offset"][:, np.newaxis]
        noise = theta[:, len(one.actuator.parameters) :]
        parts = [one.noise.log_density(noise, residual[:, window]) for window in one.training]
        return np.asarray(np.sum(parts, axis=0), dtype=np.float64)


def stock(posterior: Posterior) -> StockPosterior:
    return StockPosterior(**{f.name: getattr(posterior, f.name) for f in fields(posterior)})
