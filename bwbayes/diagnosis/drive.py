"""What lies between the recorded voltage and the actuator, or between actuator and sensor.

A delay, an amplifier that saturates or is slow, a mount with backlash.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import accumulate

import numpy as np

from bwbayes.arrays import FloatArray
from bwbayes.diagnosis.laplace import Simulate
from bwbayes.diagnosis.scene import Explanation, Scene

__all__ = ["backlash", "delay", "saturation", "slew_limit"]


@dataclass(frozen=True)
class Reshaped:
    """Another voltage at the actuator: ``voltage(voltage, sizes)`` (samples,), V."""

    voltage: Callable[[FloatArray, FloatArray], FloatArray]
    starts: FloatArray

    def apply(self, simulate: Simulate, voltage: FloatArray, sizes: FloatArray) -> FloatArray:
        """Simulate with that voltage."""
        return simulate(self.voltage(voltage, sizes))


def delay(scene: Scene) -> Iterator[Explanation]:
    """Try u(t − δ); δ is a fiftieth of the time between reversals, give or take."""
    scale = max(scene.turn_time / 50, scene.interval)

    def shifted(voltage: FloatArray, sizes: FloatArray) -> FloatArray:
        clock = scene.interval * np.arange(voltage.size)
        late: FloatArray = np.interp(clock - scale * sizes[0], clock, voltage)
        return late

    fit = scene.extended(Reshaped(shifted, np.array([[0.0], [1.0]])))
    size = scale * fit.sizes[0]
    text = f"delay of {1000 * size:.2g} ms between voltage and displacement"
    fix = "align the channels in the file, or set hold in [model] if the voltage is a command"
    yield scene.explained("delay", text, fix, fit)


def saturation(scene: Scene) -> Iterator[Explanation]:
    """Try a voltage that ends at levels inside its recorded range."""
    low, high = float(scene.voltage.min()), float(scene.voltage.max())
    scale = 0.2 * (high - low)

    def limits(sizes: FloatArray) -> FloatArray:
        depth: FloatArray = scale * np.minimum(np.abs(sizes), 2.0)
        return np.array([low + depth[0], high - depth[1]])

    def clipped(voltage: FloatArray, sizes: FloatArray) -> FloatArray:
        return np.clip(voltage, *limits(sizes))

    starts = np.array([[0.0, 0.5], [0.5, 0.0], [0.5, 0.5]])
    fit = scene.extended(Reshaped(clipped, starts))
    lower, upper = limits(fit.sizes)
    text = f"amplifier that saturates at {lower:.4g} and {upper:.4g} V"
    fix = "record the amplifier's output voltage, or drive inside its range"
    yield scene.explained("saturation", text, fix, fit)


def slew_limit(scene: Scene) -> Iterator[Explanation]:
    """Try a voltage that changes by no more than so many volts a second."""
    fastest = float(np.max(np.abs(scene.rate)))

    def limit(sizes: FloatArray) -> float:
        return float(fastest * np.exp(-0.7 * abs(sizes[0])))

    def limited(voltage: FloatArray, sizes: FloatArray) -> FloatArray:
        step = limit(sizes) * scene.interval

        def follow(reached: float, wanted: float) -> float:
            return min(max(wanted, reached - step), reached + step)

        return np.array([*accumulate(voltage.tolist(), follow)])

    fit = scene.extended(Reshaped(limited, np.array([[0.3], [1.0], [2.0]])))
    text = f"amplifier that follows no faster than {limit(fit.sizes):.3g} V/s"
    fix = "record the amplifier's output voltage, or drive more slowly"
    yield scene.explained("slew limit", text, fix, fit)


@dataclass(frozen=True)
class Backlash:
    """A sensor that follows the actuator with play, of ``scale`` um each way, give or take."""

    scale: float
    starts: FloatArray

    def apply(self, simulate: Simulate, voltage: FloatArray, sizes: FloatArray) -> FloatArray:
        """Follow what the model does.

        A sample later the sensor is where it was, held between low and high. To be held twice is to
        be held once, between other limits: so these are found for 1, 2, 4 ... samples at a time.
        """
        moved, play = simulate(voltage), self.scale * abs(sizes[0])
        low, high = moved - play, moved + play
        held = 1
        while held < voltage.size:
            before, later = slice(None, -held), slice(held, None)
            limits = [np.clip(end[:, before], low[:, later], high[:, later]) for end in (low, high)]
            low[:, later], high[:, later] = limits
            held *= 2
        followed: FloatArray = np.clip(moved[:, :1], low, high)
        return followed


def backlash(scene: Scene) -> Iterator[Explanation]:
    """Try a play between actuator and sensor."""
    scale = 0.05 * scene.extent
    fit = scene.extended(Backlash(scale, np.array([[0.3], [1.0]])))
    text = f"backlash of {2 * scale * abs(fit.sizes[0]):.2g} um in the mount"
    yield scene.explained("backlash", text, "tighten the mount, or preload it", fit)
