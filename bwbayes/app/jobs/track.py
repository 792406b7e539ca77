"""How well a displacement would be followed, with and without the model: ``fit.track()``.

On the virtual test stand the posterior's draws are the actuators, and its mean is the model that a
controller has.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from bwbayes.app.jobs.at_work import command_limits
from bwbayes.app.jobs.export import at_rate
from bwbayes.app.problem.records import generator
from bwbayes.control.gains import Robustness
from bwbayes.control.loop import LoopNoise, Stand
from bwbayes.control.tracking import Tracking
from bwbayes.control.tracking import track as tracked
from bwbayes.errors import InputError
from bwbayes.prediction.prediction import thinned

if TYPE_CHECKING:
    from bwbayes.app.fit.fitted import Fit


def track(
    fit: Fit,
    *,
    frequencies: tuple[float, ...] | None = None,
    amplitude: float | None = None,
    voltage: tuple[float, float] | None = None,
    rate: float = 1000.0,
    delay: int = 1,
    gain_margin: float = 2.0,
    phase_margin: float = 60.0,
    draws: int = 200,
) -> Tracking:
    """Say how well a closed loop would follow the paper's signals, with and without the model.

    Parameters
    ----------
    fit
        What is built on; of several records the first.
    frequencies
        Frequency of the references, Hz; may be given again; default: 0.1 Hz to where dynamics
        matter.
    amplitude
        Amplitude of the references, um; default: 80 % of the mean model's reach.
    voltage
        Lowest and highest voltage of the amplifier, V; default: what was fitted, and 0 V.
    rate
        Samples a second.
    delay
        Whole samples from a reading to the command that answers it.
    gain_margin
        Gain margin that all draws keep, a factor.
    phase_margin
        Phase margin that all draws keep, degrees.
    draws
        Simulated actuators. The margins hold for a thousand draws.

    Raises
    ------
    NotConvergedError
        The sampling has not converged.
    InputError
        A model that cannot be stepped or inverted, or options that make no sense.
    """
    if not 0 <= delay <= 100:
        raise InputError(f"delay: {delay} samples; give 0 to 100")
    if draws < 2:
        raise InputError(f"draws: {draws} is too few for an uncertainty estimate; use at least 2")
    problem, posterior, seed = fit.problem, fit.problem.posterior, fit.problem.config.seed
    dataset = posterior.datasets[0]
    free = thinned(fit.flat_draws, generator(seed, "draws"))
    theta = posterior.table.of(posterior.prior.theta(free), dataset.name)
    alone = posterior.alone(dataset.name)
    parameters = alone.noise_of_new(theta[:draws], generator(seed, "noise"))
    discrepancy, sensor = dataset.noise.marginal_sd(parameters)
    memory = dataset.noise.correlation_time(parameters)
    tracking = tracked(
        at_rate(dataset.actuator, rate, "zero"),
        dataset.table.actuator(theta[:draws]),
        # A white noise has no discrepancy, so that any time will do.
        LoopNoise(sensor, discrepancy, np.where(memory > 0, memory, 1.0)),
        Stand(command_limits(problem, voltage), delay),
        generator(seed, "track"),
        robustness=Robustness(gain_margin, phase_margin),
        frequencies=frequencies or None,
        amplitude=amplitude,
        all_theta=dataset.table.actuator(theta),
    )
    name = problem.config.name or problem.record.origin
    return replace(tracking, standing=fit.standing, name=name)
