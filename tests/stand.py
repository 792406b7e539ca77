"""The paper's ring bender on a stand: records whose parameters, discrepancy and noise are known."""

from dataclasses import dataclass

import numpy as np
from scipy.signal import lfilter

from bwbayes.arrays import FloatArray
from bwbayes.model.actuator import Actuator
from bwbayes.record import Record


def process(samples: int, step: float, generator: np.random.Generator) -> FloatArray:
    """Draw an Ornstein-Uhlenbeck process (samples,) of unit variance, from stationarity.

    It forgets by exp(-step) from sample to sample.
    """
    return autoregressive(np.exp(-step), samples, (), generator)


def autoregressive(
    kept: float, steps: int, shape: tuple[int, ...], generator: np.random.Generator
) -> FloatArray:
    """Draw stationary AR(1) series (steps, *shape) of unit variance."""
    shocks = generator.standard_normal((steps, *shape))
    shocks[1:] *= np.sqrt(1 - kept**2)
    drawn: FloatArray = lfilter([1.0], [1.0, -kept], shocks, axis=0)
    return drawn


def play(values: FloatArray, threshold: float) -> FloatArray:
    followed, reached = np.empty_like(values), 0.0
    for number, value in enumerate(values.tolist()):
        reached = min(max(reached, value - threshold), value + threshold)
        followed[number] = reached
    return followed


@dataclass(frozen=True)
class Stand:
    """The ring bender: its lag (s), discrepancy (um, s) and sensor (um), and the rate (Hz)."""

    lag: float = 0.02
    discrepancy: float = 0.3
    memory: float = 0.3
    sensor: float = 0.1
    rate: float = 100.0
    d: float = 0.7

    @property
    def truth(self) -> dict[str, float]:
        """True values by name, but for the offset, which each record has of its own."""
        known = {"d": self.d, "alpha": self.d * 0.51, "beta": 0.0272, "gamma": 0.0172}
        known |= {"exponent": 1.0, "initial": 0.0, "lag": self.lag, "sensor_sd": self.sensor}
        return known | {"discrepancy_sd": self.discrepancy, "discrepancy_time": self.memory}

    def measure(
        self,
        voltage: FloatArray,
        generator: np.random.Generator,
        *,
        offset: float = 2.0,
        cut: int = 0,
    ) -> Record:
        """Drive it from rest along ``voltage`` (samples,) and record all but the first ``cut``."""
        actuator = Actuator("lag", "first", 1 / self.rate)
        known = self.truth | {"offset": offset}
        theta = np.array([[known[name] for name in actuator.parameters]])
        displacement = actuator.displacement(theta, voltage)[0]
        step = 1 / self.rate / self.memory
        displacement += self.discrepancy * process(voltage.size, step, generator)
        displacement += self.sensor * generator.standard_normal(voltage.size)
        return Record(voltage[cut:], displacement[cut:], interval=1 / self.rate, origin="stand")
