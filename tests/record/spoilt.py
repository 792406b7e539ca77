"""Good records of all kinds of drives on the virtual test stand, and what may be wrong with one."""

import warnings
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Literal

import numpy as np
from scipy.signal import butter, sosfiltfilt

from bwbayes.arrays import FloatArray
from bwbayes.errors import InputWarning
from bwbayes.model.inputs import turning_points
from bwbayes.record import Record
from bwbayes.record.teststand import VirtualTestStand
from bwbayes.record.waveforms import Waveform, signal, sine, staircase, triangle

Generator = np.random.Generator
Discrepancy = Literal["none", "process", "structural"]


def good(number: int) -> Record:
    """Return a good record, of one of ten drives and of some rates and amplitudes."""
    generator = np.random.default_rng(number)
    drives = [*LOOPING.values(), *OTHERS.values()]
    return _run(drives[number % len(drives)], generator)


def looping(number: int) -> Record:
    """Return a good record whose drive makes loops, of varied amplitudes, of 60 V or more."""
    generator = np.random.default_rng(number)
    drives = [*LOOPING.values()]
    return _run(drives[number % len(drives)], generator, (60.0, 100.0))


def _run(
    drive: Callable[[float, float, Generator], Waveform | FloatArray],
    generator: Generator,
    amplitudes: tuple[float, ...] = (10.0, 30.0, 60.0, 100.0),
) -> Record:
    rate = float(generator.choice([100.0, 250.0, 1000.0]))
    kinds: tuple[Discrepancy, ...] = ("none", "process", "structural")
    stand = VirtualTestStand(kinds[generator.integers(3)], rate)
    required = drive(float(generator.choice(amplitudes)), rate, generator)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", InputWarning)
        record = stand.run(required, generator)
    if isinstance(required, Waveform) and required.decay_from == FROM_MOTION:
        return record.window(float(generator.uniform(1, 3)), record.duration)
    return record


# When a drive begins to decay whose record begins in motion, s.
FROM_MOTION = 3.5


def _random(amplitude: float, rate: float, generator: Generator) -> FloatArray:
    samples = round(10 * rate)
    corner = float(generator.choice([1.0, 2.0, 5.0]))
    white = generator.standard_normal(samples + 2000)
    values = sosfiltfilt(butter(2, corner, fs=rate, output="sos"), white)[1000:-1000]
    result: FloatArray = values * amplitude / np.abs(values).max()
    return result


def _multisine(amplitude: float, rate: float, generator: Generator) -> FloatArray:
    """Return ten seconds of five equal sines with Schroeder's phases, (samples,), V."""
    time = np.arange(round(10 * rate)) / rate
    frequencies = generator.uniform(0.3, 4, 5)
    i = np.arange(1, 6)[:, np.newaxis]
    sines = np.sin(2 * np.pi * frequencies[:, np.newaxis] * time - np.pi * i * (i - 1) / 5)
    voltage: FloatArray = amplitude / 5 * np.sum(sines, axis=0)
    return voltage


LOOPING: Mapping[str, Callable[[float, float, Generator], Waveform | FloatArray]] = {
    "decaying sine": lambda amplitude, _, g: Waveform(
        sine(amplitude, float(g.choice([0.5, 1.0, 2.0, 5.0])), g.uniform(0, 2 * np.pi)),
        float(g.uniform(6, 16)),
        decay=float(g.uniform(0.03, 0.15)),
        decay_from=1.0,
    ),
    "identification": lambda *_: signal("identification"),
    "verification": lambda *_: signal("verification"),
    "random": _random,
    "triangle": lambda amplitude, _, g: Waveform(
        triangle(amplitude, float(g.choice([0.5, 1.0, 3.0]))), 8.0, decay=0.1, decay_from=2.0
    ),
    "multisine": _multisine,
    "from motion": lambda amplitude, _, g: Waveform(
        sine(amplitude, float(g.choice([1.0, 2.0])), g.uniform(0, 2 * np.pi)),
        14.0,
        decay=0.06,
        decay_from=FROM_MOTION,
    ),
}
OTHERS: Mapping[str, Callable[[float, float, Generator], Waveform | FloatArray]] = {
    "steps": lambda amplitude, _, g: Waveform(
        staircase(tuple(g.uniform(-amplitude, amplitude, 12).tolist()), float(g.uniform(0.3, 2))),
        float(g.uniform(5, 15)),
    ),
    "slow": lambda amplitude, *_: Waveform(
        sine(amplitude, 0.05), 60.0, decay=0.02, decay_from=20.0
    ),
    "step": lambda _a, _r, g: signal(f"step{float(g.choice([10.0, 50.0, 100.0])):.0f}"),
}


def _displaced(record: Record, displacement: FloatArray) -> Record:
    return replace(record, displacement=displacement, truth=None)


def _readings(record: Record) -> FloatArray:
    assert record.displacement is not None
    return record.displacement.copy()


def _transient(record: Record, g: Generator) -> Record:
    values = _readings(record)
    size = float(g.choice([-1, 1])) * float(g.uniform(0.3, 0.6)) * np.ptp(values)
    elapsed = record.time - record.start
    return _displaced(record, values + size * np.exp(-elapsed / float(g.uniform(0.1, 0.5))))


def _swapped(record: Record, _: Generator) -> Record:
    return replace(record, voltage=_readings(record), displacement=record.voltage, truth=None)


def _spikes(record: Record, g: Generator) -> Record:
    values = _readings(record)
    at = g.choice(record.samples, 10, replace=False)
    values[at] += g.choice([-1, 1], 10) * g.uniform(0.2, 0.5, 10) * np.ptp(values)
    return _displaced(record, values)


def _held(record: Record, g: Generator) -> Record:
    every = int(g.integers(4, 10))
    return _displaced(record, np.repeat(_readings(record)[::every], every)[: record.samples])


def _dropped(record: Record, g: Generator) -> Record:
    rows = np.arange(record.samples)
    for at in g.choice(record.samples - 20, 15, replace=False):
        rows[at + 1 : at + int(g.integers(4, 10))] = at
    return replace(record, voltage=record.voltage[rows], displacement=_readings(record)[rows])


def _clipped(record: Record, g: Generator) -> Record:
    values = _readings(record)
    side = float(g.choice([-1, 1]))
    limit = np.max(side * values) - float(g.uniform(0.1, 0.25)) * np.ptp(values)
    return _displaced(record, side * np.minimum(side * values, limit))


def _clipped_tip(record: Record, g: Generator) -> Record:
    values = _readings(record)
    side = float(g.choice([-1, 1]))
    limit = np.quantile(side * values, float(g.uniform(0.98, 0.99)))
    return _displaced(record, side * np.minimum(side * values, limit))


def _drifting(record: Record, g: Generator) -> Record:
    values = _readings(record)
    size = float(g.choice([-1, 1])) * float(g.uniform(0.3, 0.6)) * np.ptp(values)
    part = (record.time - record.start) / record.duration
    shape = part if g.random() < 0.5 else np.sqrt(part)
    return _displaced(record, values + size * shape)


def _jumping(record: Record, g: Generator) -> Record:
    values = _readings(record)
    size = float(g.choice([-1, 1])) * float(g.uniform(0.2, 0.5)) * np.ptp(values)
    values[int(g.uniform(0.1, 0.9) * values.size) :] += size
    return _displaced(record, values)


def _coarse(_: Record, g: Generator) -> Record:
    samples = 400
    a_period = float(g.uniform(3, 9))
    voltage = np.sin(2 * np.pi * np.arange(samples) / a_period) * np.linspace(100, 30, samples)
    return VirtualTestStand("none", 100.0).run(voltage, g)


def _one_amplitude(_: Record, g: Generator) -> Record:
    shape = (sine, triangle)[int(g.integers(2))]
    drive = shape(float(g.uniform(20, 45)), float(g.uniform(0.5, 2)), float(g.uniform(0, 6)))
    wave = Waveform(drive, float(g.uniform(4, 9)), bias=float(g.choice([0, 50])))
    return VirtualTestStand("process", 250.0).run(wave, g)


def _unrelated(record: Record, g: Generator) -> Record:
    quiet = 1e-3 * np.round(g.standard_normal(record.samples) * 3) + 20.0
    return replace(record, voltage=quiet)


def _written_often(record: Record, g: Generator) -> Record:
    times = int(g.integers(2, 6))
    voltage, values = np.repeat(record.voltage, times), np.repeat(_readings(record), times)
    return Record(voltage, values, interval=record.interval / times)


def _rounded(values: FloatArray, levels: int, g: Generator) -> FloatArray:
    step = float(np.ptp(values)) / levels
    phase = float(g.uniform(0, 1))
    rounded: FloatArray = step * (np.round(values / step + phase) - phase)
    return rounded


def _coarse_voltage(record: Record, g: Generator) -> Record:
    return replace(record, voltage=_rounded(record.voltage, int(g.integers(3, 6)), g))


def _coarse_displacement(record: Record, g: Generator) -> Record:
    return _displaced(record, _rounded(_readings(record), int(g.integers(1, 20)), g))


def _late(record: Record, g: Generator, least: float, column: str) -> Record:
    """Delay a column by ``least`` to a quarter of the drive's period."""
    turns = turning_points(record.voltage, 0.1 * float(np.ptp(record.voltage)))
    count = max(round(2 * float(g.uniform(least, 0.25)) * float(np.median(np.diff(turns)))), 1)
    late, other = slice(None, -count), slice(count, None)
    if column == "voltage":
        return Record(record.voltage[late], _readings(record)[other], interval=record.interval)
    return Record(record.voltage[other], _readings(record)[late], interval=record.interval)


def _by_itself(record: Record, g: Generator) -> Record:
    """Replace the displacement by a sine that the voltage does not have."""
    power = np.abs(np.fft.rfft(record.voltage - record.voltage.mean()))
    main = float(np.fft.rfftfreq(record.samples, record.interval)[np.argmax(power)])
    frequency = main * float(g.choice([0.6, 1.4, 2.3]))
    phase = 2 * np.pi * frequency * record.time + float(g.uniform(0, 6))
    return _displaced(record, 10 * np.sin(phase) + 0.05 * g.standard_normal(record.samples))


SPOILT: Mapping[str, Callable[[Record, Generator], Record]] = {
    "switch-on transient": _transient,
    "reversed sign": lambda record, _: _displaced(record, -_readings(record)),
    "swapped columns": _swapped,
    "spikes": _spikes,
    "held readings": _held,
    "repeated samples": _dropped,
    "clipping": _clipped,
    "clipping of the tips": _clipped_tip,
    "drift": _drifting,
    "jump": _jumping,
    "unlikely units: mV": lambda record, _: replace(record, voltage=1e3 * record.voltage),
    "unlikely units: nm": lambda record, _: _displaced(record, 1e3 * _readings(record)),
    "unlikely units: m": lambda record, _: _displaced(record, 1e-6 * _readings(record)),
    "coarse sampling": _coarse,
    "few readings": lambda record, _: record.decimate(record.samples // 60),
    "one amplitude": _one_amplitude,
    "no relation": _unrelated,
    "no relation: a sine": _by_itself,
    "repeated samples: all of them": _written_often,
    "coarse resolution: voltage": _coarse_voltage,
    "coarse resolution: displacement": _coarse_displacement,
    "late voltage": lambda record, g: _late(record, g, 0.06, "voltage"),
    "late displacement": lambda record, g: _late(record, g, 0.2, "displacement"),
}
