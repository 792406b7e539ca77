"""The likelihood on the compiled engine: the same numbers as with NumPy, ten times faster.

Coefficients of the dynamics and of the noise's filter come from the same functions that the NumPy
likelihood uses; :mod:`bwbayes.inference.kernels` walks through the samples. It works out n = 1 with
|γ| ≤ β itself; for other models h comes from :func:`bwbayes.model.boucwen.hysteresis`, and the
rest of the work is compiled still.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from bwbayes.arrays import FloatArray
from bwbayes.inference import kernels
from bwbayes.inference.noise import LOG_TWO_PI, Noise, SteadyState
from bwbayes.model.actuator import Actuator
from bwbayes.model.boucwen import hysteresis

__all__ = ["log_likelihood"]


def log_likelihood(
    theta: FloatArray,
    voltage: FloatArray,
    displacement: FloatArray,
    training: Sequence[slice],
    actuator: Actuator,
    noise: Noise,
) -> FloatArray:
    """Log likelihood (models,) at θ (models, parameters), inside the model's domain.

    ``voltage`` and ``displacement`` are (samples,), V and um, from the record's first sample on;
    the columns of θ are the actuator's parameters followed by the noise's.
    """
    column = dict(zip((*actuator.parameters, *noise.parameters), theta.T, strict=True))
    steady = noise.steady_state(theta[:, len(actuator.parameters) :])
    closed = (column["exponent"] == 1.0) & (np.abs(column["gamma"]) <= column["beta"])
    recursion = actuator.recursion(column)
    models = _models(column, float(voltage[0]), recursion.numerator, recursion.denominator, steady)
    windows = np.array([(window.start, window.stop) for window in training], dtype=np.int64)
    samples = int(windows[-1, 1])
    result = np.empty(theta.shape[0])
    for rows in (closed, ~closed):
        if rows.any():
            known = np.empty((int(rows.sum()), 0))
            if rows is not closed:
                names = ("alpha", "beta", "gamma", "exponent", "initial")
                part = {name: column[name][rows] for name in names}
                known = hysteresis(voltage[:samples], **part)
            found = kernels.sums(voltage, displacement, windows, models[rows], known)
            kept = SteadyState(*(values[rows] for values in steady))
            result[rows] = sum(
                _log_density(kept, one, window[1] - window[0])
                for one, window in zip(found, windows.tolist(), strict=True)
            )
    return result


def _models(
    column: Mapping[str, FloatArray],
    first_voltage: float,
    numerator: FloatArray,
    denominator: FloatArray,
    steady: SteadyState,
) -> FloatArray:
    """Return the kernel's parameters, (models, parameters)."""
    nothing = np.zeros(numerator.shape[0])
    b = [*numerator.T, nothing, nothing]
    a = [*denominator.T, nothing, nothing]
    rest = column["d"] * first_voltage - column["initial"]
    rows = {
        "initial": column["initial"],
        "alpha": column["alpha"],
        "against": column["beta"] - column["gamma"],
        "ahead": column["beta"] + column["gamma"],
        "d": column["d"],
        "rest": rest,
        "level": rest + column["offset"],
        "b0": b[0],
        "b1": b[1],
        "b2": b[2],
        "a1": a[1],
        "a2": a[2],
        "decay": np.exp(steady.log_decay),
        # φ − a, without its cancellation.
        "gain": steady.kept * steady.predicted / steady.variance,
        "share": steady.surplus / (steady.surplus + steady.variance),
    }
    return np.stack([rows[name] for name in kernels.PARAMETERS], axis=1)


def _log_density(steady: SteadyState, sums: FloatArray, samples: int) -> FloatArray:
    """Log density (models,) of a window from the kernel's sums (3, models).

    As in :class:`~bwbayes.inference.noise.DiscrepancyNoise`, but with innovations η' that count
    from a first estimate ξ₀ = δ r₀ / (δ + S) of the start instead of zero:

        Σ(η − aᵗ ξ̂)²/S + ξ̂²/δ = Σ η'²/S + δ e² − δ (B' − e)² / (1 + δ A),   e = r₀ / (δ + S).
    """
    squares, pull, first = sums
    gain = steady.start_gain(samples)
    e = first / (steady.surplus + steady.variance)
    start = e**2 - (pull / steady.variance - e) ** 2 / gain
    logs = samples * (np.log(steady.variance) + LOG_TWO_PI) + np.log(gain)
    density: FloatArray = -0.5 * (squares / steady.variance + steady.surplus * start + logs)
    return density
