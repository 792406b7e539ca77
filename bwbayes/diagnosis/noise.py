"""What the noise may be besides normal and of one size: heavy tails, or more where the drive is."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import scipy
from scipy.special import logsumexp

from bwbayes.arrays import FloatArray
from bwbayes.diagnosis.scene import Explanation, Scene

__all__ = ["growing_noise", "heavy_tails", "tail_nats"]


def heavy_tails(scene: Scene) -> Iterator[Explanation]:
    """Try innovations of a Student t distribution, of whatever scale."""
    white = scene.innovations
    text = f"outliers ({int(np.sum(np.abs(white) > 5))} of {white.size} innovations beyond 5 SD)"
    rmse = scene.fit.rmse, scene.fit.rmse
    fix = "set outliers = true in [model]"
    yield Explanation("heavy tails", text, fix, nats=tail_nats(white), rmse=rmse)


def tail_nats(white: FloatArray) -> float:
    """Return by how many nats a t distribution explains innovations (readings,) better, in sds."""
    densities, tried = [], (1.5, 2.0, 3.0, 4.0, 6.0, 10.0, 20.0)  # evenly probable
    for degrees in tried:

        def cost(log_scale: float, degrees: float = degrees) -> float:
            return -float(np.sum(scipy.stats.t.logpdf(white, degrees, scale=np.exp(log_scale))))

        densities.append(
            -scipy.optimize.minimize_scalar(cost, bounds=(-5.0, 5.0), method="bounded").fun
        )
    normal = float(np.sum(scipy.stats.norm.logpdf(white)))
    # The scale is paid for as its sd of a half over the root of the readings, of a prior's of one.
    cost_of_scale = 0.5 * np.log(2 * white.size)
    return float(logsumexp(densities) - np.log(len(tried)) - cost_of_scale) - normal


def growing_noise(scene: Scene) -> Iterator[Explanation]:
    """Try innovations of sd exp(a + b g), g the drive's speed or distance from its center."""
    rows, white = scene.posterior.only.readings.rows, scene.innovations
    center = (scene.voltage.max() + scene.voltage.min()) / 2
    for kind, drive in (("speed", scene.rate), ("voltage", scene.voltage - center)):
        growth = np.abs(drive)[rows]
        if not np.std(growth) > 0:
            continue
        growth = (growth - np.mean(growth)) / np.std(growth)
        nats, slope = _grown(white, growth)
        text = f"noise that {'grows' if slope > 0 else 'falls'} with the voltage"
        text += "'s speed" if kind == "speed" else "'s distance from its center"
        rmse = scene.fit.rmse, scene.fit.rmse
        fix = "train on a record driven as the plans are: the bands' width is the mean one"
        yield Explanation(f"noise by {kind}", text, fix, nats=nats, rmse=rmse)


def _grown(white: FloatArray, growth: FloatArray) -> tuple[float, float]:
    """Return the nats that b adds, with b ~ N(0, 1), and b."""

    def cost(coordinates: FloatArray) -> float:
        level, slope = coordinates
        logs = level + slope * growth
        return float(np.sum(logs + 0.5 * white**2 * np.exp(-2 * logs)) + 0.5 * slope**2)

    optimum = scipy.optimize.minimize(cost, np.zeros(2), method="BFGS")
    level = np.log(np.sqrt(np.mean(white**2)))
    gained = cost(np.array([level, 0.0])) - float(optimum.fun)
    return gained - 0.5 * float(np.log(1 + 2 * white.size)), float(optimum.x[1])
