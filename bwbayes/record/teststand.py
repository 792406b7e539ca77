"""A virtual test stand: the paper's amplifier, ring bender and laser sensor (its section 2).

A commanded electrode voltage goes through the DAC and the amplifier, drives the actuator of the
paper's Table 1, and comes back through the laser sensor and the ADC as a
:class:`~bwbayes.record.record.Record`. Another actuator can be put on it, made of any parts that a
model can have. Because real actuators do not follow any model exactly, the displacement can also
have a discrepancy of known kind and size, so that an analysis can be compared with the truth.

True values are those of an actuator of the ring bender's size, which moves by about 60 um either
way at 100 V, a tenth of it hysteresis: the medians of a part's default priors where they make such
an actuator, or others, stated in one table.
"""

from __future__ import annotations

import itertools
import math
import warnings
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from types import MappingProxyType
from typing import Literal

import numpy as np
import scipy

from bwbayes.arrays import ArrayLike, FloatArray
from bwbayes.errors import InputError, InputWarning, suggestion
from bwbayes.model.actuator import Actuator
from bwbayes.model.declaration import Context, Distribution, Ranges
from bwbayes.model.linear import first_order_lag
from bwbayes.model.operator import Operator
from bwbayes.model.operators.bouc_wen import BoucWen
from bwbayes.model.operators.bouc_wen_asymmetric import BoucWenAsymmetric
from bwbayes.model.operators.duhem import BacklashLike, Duhem
from bwbayes.model.operators.scalar_memory import OneState
from bwbayes.record.record import Record
from bwbayes.record.waveforms import Waveform
from bwbayes.shown import brief

# Sd and correlation time of the discrepancy process; like all discrepancies it is not adjustable.
PROCESS_SD = 1.5  # um
PROCESS_TIME = 0.5  # s


# The actuator's parameters: Table 1 of the paper, alpha read as um/V; beta and gamma at exponent 1.
TABLE_1: Mapping[str, float] = MappingProxyType(
    {
        "d": 0.7,  # um/V
        "alpha": 0.3575,  # um/V
        "beta": 0.0272,  # 1/V
        "gamma": 0.0172,  # 1/V
        "exponent": 1.0,
        "initial": 0.0,  # um
        "mass": 0.00134,  # kg
        "damping": 1580.0,  # N s/m
        "stiffness": 4.10e5,  # N/m
        "offset": 0.0,  # um
    }
)


@dataclass(frozen=True)
class Amplifier:
    """A DAC and the high-voltage amplifier behind it, into the capacitance of one electrode.

    Parameters
    ----------
    gain : float
        V at the electrode per V of the DAC.
    limit : float
        Largest voltage at the electrode, either sign, V.
    current : float
        Largest current, A; with the capacitance it limits the slew to current / capacitance.
    capacitance : float
        F.
    dac_bits : int
        Width of the DAC's two's complement code.
    dac_range : float
        Range of the DAC, either sign, V.
    """

    gain: float = 20.0
    limit: float = 100.0
    current: float = 0.065
    capacitance: float = 940e-9
    dac_bits: int = 12
    dac_range: float = 10.0

    @property
    def step(self) -> float:
        """The DAC's smallest step, seen at the electrode, V."""
        return self.gain * 2 * self.dac_range / 2.0**self.dac_bits

    @property
    def slew(self) -> float:
        """Fastest change of the electrode's voltage, V/s."""
        return self.current / self.capacitance

    def output(self, command: FloatArray, interval: float) -> FloatArray:
        """Voltage at the electrode, (samples,), V, held from each sample to the next, s.

        The level follows the quantized and limited command, (samples,), V, by at most slew x
        interval per sample; the ramp inside a sample is not resolved. It starts settled at the
        first command.
        """
        levels = np.clip(_quantize(command, self.step, self.dac_bits), -self.limit, self.limit)
        reach = self.slew * interval
        followed = itertools.accumulate(
            levels.tolist(), lambda held, level: min(max(level, held - reach), held + reach)
        )
        return np.fromiter(followed, dtype=np.float64, count=levels.size)


@dataclass(frozen=True)
class LaserSensor:
    """A laser displacement sensor and the ADC that reads it, zeroed at mid-range.

    Parameters
    ----------
    sd : float
        Standard deviation of its white, Gaussian noise (the data sheet's resolution), um.
    span : float
        Range, um; the reading clips at +-span/2.
    adc_bits : int
        Width of the ADC's two's complement code, which spans the range.
    """

    sd: float = 0.5
    span: float = 2000.0
    adc_bits: int = 16

    @property
    def step(self) -> float:
        """The ADC's smallest step, um."""
        return self.span / 2.0**self.adc_bits

    def read(self, displacement: FloatArray, generator: np.random.Generator) -> FloatArray:
        """Return the readings (samples,) of a displacement (samples,), both in um."""
        noise = self.sd * generator.standard_normal(displacement.size)
        return _quantize(displacement + noise, self.step, self.adc_bits)


@dataclass(frozen=True)
class VirtualTestStand:
    """The whole stand: command in, :class:`bwbayes.Record` with its truth out.

    The actuator follows the amplifier's held output, starting at rest and demagnetized at the
    first sample; an operator that remembers extrema came there straight from zero volts. On top of
    its displacement comes one of three discrepancies:

    ``"none"``
        nothing;
    ``"process"``
        a stationary Ornstein-Uhlenbeck process, sd 1.5 um, correlation time 0.5 s: peaks of about
        5 um, as in the paper's Fig. 8;
    ``"structural"``
        :func:`creep` of 1% of the displacement per decade of time, an even term of
        1 um (V / 100 V)^2 that goes through the same dynamics, and a steady drift of 0.5 um from
        the first sample to the last.

    Parameters
    ----------
    discrepancy : {"none", "process", "structural"}
        Kind of the discrepancy.
    sample_rate : float
        Hz.
    amplifier : Amplifier
        The voltage source.
    sensor : LaserSensor
        The sensor.
    actuator : Actuator
        The parts of the actuator, by default n = 1 Bouc-Wen hysteresis and a mass on a spring. Its
        interval is the stand's, its hold that of the amplifier.
    true : mapping of str to float
        True values of its parameters; those that are not given are the ring bender's, or typical
        ones. With an ``initial`` the hysteresis starts in that state.

    Raises
    ------
    InputError
        If the discrepancy is unknown, the sample rate not above zero, or a true value is none of
        the actuator's parameters.
    """

    __repr__ = brief

    discrepancy: Literal["none", "process", "structural"] = "process"
    sample_rate: float = 1000.0
    amplifier: Amplifier = Amplifier()
    sensor: LaserSensor = LaserSensor()
    actuator: Actuator = field(default_factory=lambda: Actuator("second-order", "zero"))
    true: Mapping[str, float] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if self.discrepancy not in ("none", "process", "structural"):
            raise InputError(
                f"test stand: discrepancy: no {self.discrepancy!r}; "
                "give 'none', 'process' or 'structural'"
            )
        if not (math.isfinite(self.sample_rate) and self.sample_rate > 0):
            raise InputError(
                f"test stand: sample_rate: {self.sample_rate} Hz is not above zero; "
                "give a positive, finite number"
            )
        for name in self.true:
            if name not in self.actuator.parameters:
                raise InputError(
                    f"test stand: {name}: its actuator has no such parameter; "
                    f"{suggestion(name, self.actuator.parameters)}"
                )

    def parameters(self) -> dict[str, float]:
        """Return all true values by name: the actuator's, ``sensor_sd`` and the process's.

        ``discrepancy_sd`` (um) and ``discrepancy_time`` (s) exist for ``"process"`` only. There is
        no ``initial`` where no value of it is the demagnetized state.
        """
        truth = {**self._values, "sensor_sd": self.sensor.sd}
        if self._from_rest:
            del truth["initial"]
        if self.discrepancy == "process":
            truth |= {"discrepancy_sd": PROCESS_SD, "discrepancy_time": PROCESS_TIME}
        return truth

    def run(self, drive: Waveform | ArrayLike, generator: np.random.Generator) -> Record:
        """Drive the actuator and record it.

        Parameters
        ----------
        drive : Waveform or (samples,) array
            Commanded voltage at the electrode, V; an array has the stand's sample rate.
        generator : numpy.random.Generator
            Source of the discrepancy process and of the sensor's noise.

        Returns
        -------
        Record
            Its voltage is the command, before DAC and amplifier; its truth is what a perfect
            sensor would read.

        Raises
        ------
        InputError
            If the voltage is not one finite row of at least two samples.

        Warns
        -----
        InputWarning
            If the command goes beyond the amplifier's limit.
        """
        if isinstance(drive, Waveform):
            command = drive.sample(self.sample_rate)[1]
        else:
            command = np.array(drive, dtype=np.float64)
        if command.ndim != 1 or command.size < 2 or not np.isfinite(command).all():
            raise InputError(
                f"test stand: voltage of shape {command.shape}: give one row of at least two "
                "finite values"
            )
        if np.abs(command).max() > self.amplifier.limit:
            warnings.warn(
                f"test stand: voltage: the command reaches {np.abs(command).max():g} V, the "
                f"amplifier limits it to {self.amplifier.limit:g} V; use a smaller amplitude",
                InputWarning,
                stacklevel=2,
            )
        output = self.amplifier.output(command, 1 / self.sample_rate)
        actuator = replace(self.actuator, hold="zero", interval=1 / self.sample_rate)
        theta = np.array([[self._values[name] for name in actuator.parameters]])
        try:
            (truth,) = actuator.displacement(theta, output, from_rest=self._from_rest)
        except InputError as error:
            raise InputError(f"test stand: {error}") from None
        truth = truth + self._discrepancy(output, truth, generator)
        return Record(
            voltage=command,
            displacement=self.sensor.read(truth, generator),
            interval=1 / self.sample_rate,
            voltage_is="command",
            origin=f"virtual test stand, discrepancy {self.discrepancy}",
            truth=truth,
        )

    @cached_property
    def _values(self) -> dict[str, float]:
        """The true values of the actuator's parameters."""
        return true_values(self.actuator, TABLE_1) | dict(self.true)

    @property
    def _from_rest(self) -> bool:
        """True if the voltage came straight from zero; else ``initial`` is the first state."""
        one_state = isinstance(self.actuator.hysteresis, OneState)
        return not one_state and "initial" not in self.true

    def _discrepancy(
        self, output: FloatArray, displacement: FloatArray, generator: np.random.Generator
    ) -> FloatArray:
        samples, interval = displacement.size, 1 / self.sample_rate
        if self.discrepancy == "none":
            return np.zeros(samples)
        if self.discrepancy == "process":  # drawn from its stationary distribution, exactly
            decay = math.exp(-interval / PROCESS_TIME)
            shocks = PROCESS_SD * generator.standard_normal(samples)
            shocks[1:] *= math.sqrt(-math.expm1(-2 * interval / PROCESS_TIME))
            return np.asarray(scipy.signal.lfilter([1.0], [1.0, -decay], shocks), dtype=np.float64)
        strain = 1.0 * (output / 100.0) ** 2  # um
        column = {name: np.array([value]) for name, value in self._values.items()}
        dynamics = self.actuator.filter.recursion(column, 1, interval, "zero")
        (even,) = dynamics.run(strain[np.newaxis] - strain[0], dynamics.at_rest())
        drift = np.linspace(0.0, 0.5, samples)  # um
        return np.asarray(creep(displacement, interval) + (strain[0] + even) + drift)


def creep(displacement: FloatArray, interval: float) -> FloatArray:
    """Creep, (samples,), um, of 1% of a displacement, (samples,), um, per decade of time.

    The creep is the sum of Kelvin-Voigt elements: each is a lag, ``tau_i c_i' + c_i = 0.005 x``, at
    rest at zero before the first sample. The times tau_i are two per decade from 0.01 s to
    10,000 s, so that after a step the creep rises by 1% of it per decade within a hundredth of
    that (their ripple is 0.3%), from 0.1 s to 100 s after the step. The displacement is taken as
    linear between samples, an interval, s, apart.
    """
    times = 10.0 ** np.arange(-2.0, 4.5, 0.5)  # s
    elements = first_order_lag(times, interval, "first")
    response = elements.run(np.tile(displacement, (times.size, 1)), elements.at_rest())
    return np.asarray(0.01 / 2 * response.sum(axis=0))


def _quantize(values: FloatArray, step: float, bits: int) -> FloatArray:
    """Round to the levels of a two's complement converter, clipped at its ends."""
    half = 2.0 ** (bits - 1)
    levels: FloatArray = step * np.clip(np.round(values / step), -half, half - 1)
    return levels


# The paper's ring bender on its identification signal: +-100 V at 1 Hz, +-62 um.
RING_BENDER = Ranges(
    voltage=100.0,
    displacement=62.0,
    middle=0.0,
    time=0.5,
    interval=1e-3,
    duration=16.0,
)

# True values where medians are no guide: other parameters' bounds cut the prior, or it is centered
# at zero. They give the ring bender's loops at 100 V, and visible further terms.
OPERATORS: Mapping[type[Operator], Mapping[str, float]] = {
    BacklashLike: {"d": 0.7, "alpha": 0.35, "beta": 0.04, "initial": 0.0},
    BoucWenAsymmetric: {
        "d": 0.7,
        "alpha": 0.3575,
        "beta": 0.04,
        "gamma": 0.01,
        "b2": 0.1,
        "b3": 0.1,
        "b4": -0.1,
        "b5": 0.1,
        "b6": 0.15,
        "initial": 0.0,
    },
    Duhem: {
        "d": 0.65,
        "d3": 3e-6,
        "alpha": 0.3,
        "beta": 0.04,
        "alpha2": 1e-5,
        "d2": 2e-4,
        "alpha1": 1e-3,
        "initial": 0.0,
    },
}


def true_values(actuator: Actuator, table: Mapping[str, float]) -> dict[str, float]:
    """Return values of all parameters of an actuator, by name and in their order.

    ``table`` holds those of Bouc-Wen hysteresis, of a mass on a spring and of the sensor's offset.

    Raises
    ------
    InputError
        A parameter has no known value: its part is from outside the package and states no default
        prior.
    """
    operator = actuator.hysteresis
    stated = table if isinstance(operator, BoucWen) else OPERATORS.get(type(operator), {})
    of_operator = {declared.name for declared in operator.parameters}
    common = {**table, "quadratic": 3.0, "cubic": -2.0, "lag": 0.005}
    values = {n: value for n, value in common.items() if n not in of_operator} | {**stated}
    for name, declared in zip(actuator.parameters, actuator.declarations, strict=True):
        if name not in values:
            default = declared.default(Context(RING_BENDER))
            if default is None:
                raise InputError(f"test stand: {name}: has no default; give a true value")
            if isinstance(default, Distribution):
                default = float(default.frozen.median())
            values[name] = default
    return {name: values[name] for name in actuator.parameters}
