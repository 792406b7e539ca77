"""Drives of every kind at any rate, from 0 to 1, as benches play them."""

from collections.abc import Callable

import numpy as np
import scipy

from bwbayes.arrays import FloatArray

SECONDS = 10.0


def sine(time: FloatArray, rng: np.random.Generator) -> FloatArray:
    wave: FloatArray = np.sin(2 * np.pi * rng.uniform(0.5, 1.5) * time + rng.uniform(0, 2 * np.pi))
    return wave


def decaying_sine(time: FloatArray, rng: np.random.Generator) -> FloatArray:
    return np.exp(-rng.uniform(0.1, 0.25) * time) * sine(time, rng)


def triangle(time: FloatArray, rng: np.random.Generator) -> FloatArray:
    phase = 2 * np.pi * rng.uniform(0.3, 1.0) * time + rng.uniform(0, 2 * np.pi)
    wave: FloatArray = np.exp(-rng.uniform(0, 0.2) * time) * scipy.signal.sawtooth(phase, 0.5)
    return wave


def staircase(time: FloatArray, rng: np.random.Generator) -> FloatArray:
    """Return levels that are reached in no time, or by ramps, and held."""
    count = 10
    levels = np.concatenate([[0.0], rng.uniform(-1, 1, count)])
    ends = SECONDS / count * np.arange(count)
    ramp = rng.choice([1e-9, 0.1, 0.4])
    edges = np.stack([ends, ends + ramp], axis=1).ravel()
    values = np.stack([levels[:-1], levels[1:]], axis=1).ravel()
    wave: FloatArray = np.interp(time, edges, values)
    return wave


def multisine(time: FloatArray, rng: np.random.Generator) -> FloatArray:
    waves = [sine(time * rng.uniform(0.4, 1.3), rng) for _ in range(5)]
    return sum(waves, np.zeros(time.size))


DRIVES: dict[str, Callable[[FloatArray, np.random.Generator], FloatArray]] = {
    "sine": sine,
    "decaying sine": decaying_sine,
    "triangle": triangle,
    "staircase": staircase,
    "multisine": multisine,
}


def drive(kind: str, rate: float, rng: np.random.Generator, seconds: float = SECONDS) -> FloatArray:
    """Return a drive (samples,) of a kind, at a rate in Hz, that spans 0 to 1."""
    wave = DRIVES[kind](np.arange(round(seconds * rate)) / rate, rng)
    return (wave - wave.min()) / np.ptp(wave)
