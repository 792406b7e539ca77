"""Bands whose error is known, and records that spoil them: to test verdicts without sampling.

A record is a loop; its bands have an error of the parameters (an offset and a gain,
drawn once a record), an Ornstein-Uhlenbeck discrepancy and white sensor noise, of just the sizes
that the bands say.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from scipy.special import ndtr, ndtri

from bwbayes.arrays import FloatArray
from bwbayes.prediction.bands import KINDS, LEVELS, Bands, Kind
from tests.stand import process


@dataclass(frozen=True)
class Made:
    """A record that its bands describe: arrays (samples,), um, V, s; ``memory`` in s."""

    time: FloatArray
    voltage: FloatArray
    mean: FloatArray
    error: FloatArray
    sds: dict[Kind, FloatArray]
    memory: float
    sensor: float


def made(
    generator: np.random.Generator,
    length: float = 20.0,
    interval: float = 0.01,
    memory: float = 0.3,
    discrepancy: float = 1.0,
    sensor: float = 0.3,
    parameters: float = 0.3,
) -> Made:
    """Make a good record of ``length`` seconds; sds of the parts in um."""
    time = interval * np.arange(round(length / interval), dtype=np.float64)
    frequency = generator.uniform(0.3, 2.0)
    voltage = 100 * np.sin(2 * np.pi * frequency * time) * np.exp(-0.03 * time)
    mean = 0.55 * voltage - 6 * np.cos(2 * np.pi * frequency * time) * np.exp(-0.03 * time)
    about = (mean - mean.mean()) / np.std(mean)
    shifts = generator.normal(size=2) * parameters / np.sqrt(2)
    error = shifts[0] + shifts[1] * about
    error = error + discrepancy * process(time.size, interval / memory, generator)
    error = error + sensor * generator.normal(size=time.size)
    own = parameters * np.sqrt((1 + about**2) / 2)
    slow = np.sqrt(own**2 + discrepancy**2)
    sds: dict[Kind, FloatArray] = {
        "parameter": own,
        "displacement": slow,
        "sensor": np.sqrt(slow**2 + sensor**2),
    }
    return Made(time, voltage, mean, error, sds, memory, sensor)


def bands_of(record: Made, spoilt: FloatArray | float = 0.0, *, training: bool = False) -> Bands:
    """Return the bands of a record whose readings have ``spoilt`` (samples,) um added."""
    return normal_bands(
        record.time,
        record.voltage,
        record.mean,
        record.sds,
        record.mean + record.error + spoilt,
        training=training,
    )


def normal_bands(
    time: FloatArray,
    voltage: FloatArray,
    mean: FloatArray,
    sds: Mapping[Kind, FloatArray],
    measured: FloatArray | None,
    *,
    training: bool = False,
) -> Bands:
    """Return bands (samples,) that are normal, of these means and sds."""
    half = {
        (kind, level): ndtri(0.5 + level / 200) * sds[kind] for kind in KINDS for level in LEVELS
    }
    return Bands(
        name="training" if training else "held-out",
        time=time,
        voltage=voltage,
        measured=measured,
        truth=None,
        mean=mean,
        lower={key: mean - width for key, width in half.items()},
        upper={key: mean + width for key, width in half.items()},
        pit=None if measured is None else ndtr((measured - mean) / sds["sensor"]),
        crps=None if measured is None else np.abs(measured - mean),
        log_score=None if measured is None else -np.abs(measured - mean),
        interval=float(time[1] - time[0]),
        training=training,
    )
