"""Plants whose defect is known, made by an integrator of their own: steps much finer than samples.

The good plant is Bouc-Wen hysteresis behind a lag, read with an Ornstein-Uhlenbeck error and white
noise. Each defect is large enough that a fit of the good model cannot be trusted.
"""

from dataclasses import dataclass, replace

import numpy as np
from scipy.signal import lfilter

from bwbayes.arrays import FloatArray
from bwbayes.record import Record
from tests.stand import play, process

RATE, FINE = 200.0, 8

# Planted defects, and the names they may get.
CAUSES: dict[str, set[str]] = {
    "transient": {"transient"},
    "drift": {"drift"},
    "step": {"step"},
    "mains": {"oscillation"},
    "moving gain": {"moving gain"},
    "sign": {"sign"},
    "delay": {"delay"},
    "saturation": {"saturation"},
    "slew limit": {"slew limit"},
    "backlash": {"backlash"},
    "outliers": {"heavy tails"},
    "heavy tails": {"heavy tails"},
    "noise by speed": {"noise by speed"},
    "noise by voltage": {"noise by voltage"},
    "quadratic": {"quadratic nonlinearity", "quadratic and cubic nonlinearity"},
    "cubic": {"cubic nonlinearity", "quadratic and cubic nonlinearity"},
    "creep": {"creep"},
    "resonance": {"second-order dynamics"},
    "hold": {"hold"},
    "operator": {"operator prandtl-ishlinskii", "operator plays"},
}


@dataclass(frozen=True)
class Plant:
    """The parts of a plant: um, V, s."""

    d: float
    alpha: float
    beta: float
    gamma: float
    lag: float
    discrepancy: float
    memory: float
    sensor: float
    offset: float


def drawn(rng: np.random.Generator) -> Plant:
    d = float(rng.uniform(0.5, 1.0))
    return Plant(
        d,
        d * float(rng.uniform(0.3, 0.6)),
        float(rng.uniform(0.02, 0.035)),
        float(rng.uniform(0.005, 0.02)),
        float(rng.uniform(0.004, 0.01)),
        float(rng.uniform(0.1, 0.4)),
        float(rng.uniform(0.1, 0.5)),
        float(rng.uniform(0.02, 0.1)),
        float(rng.normal(0, 5)),
    )


def drive(rng: np.random.Generator, seconds: float) -> FloatArray:
    """Return a voltage from rest at the fine steps: two sines, the amplitude changing."""
    time = np.arange(round(seconds * RATE * FINE)) / RATE / FINE
    slow, fast = rng.uniform(0.3, 0.6), rng.uniform(1.0, 2.0)
    swing = 1 - rng.uniform(0.2, 0.6) * time / seconds
    quick = 100 * swing * np.sin(2 * np.pi * fast * time)
    voltage: FloatArray = quick + 25 * np.sin(2 * np.pi * slow * time)
    return voltage


def hysteresis(part: Plant, voltage: FloatArray, exponent: float = 1.0) -> FloatArray:
    """Integrate h' = alpha u' - (beta |u'| h + gamma u' |h|) (|h|/top)^(n-1) by Heun's rule.

    Returns d u - h, um; ``top`` is the largest |h| of n = 1.
    """
    h, values, top = 0.0, np.empty(voltage.size), part.alpha / (part.beta + part.gamma)

    def moved(step: float, h: float) -> float:
        bent = float((abs(h) / top) ** (exponent - 1))
        turned = part.beta * abs(step) * h * bent
        return part.alpha * step - turned - part.gamma * step * abs(h) * bent

    values[0] = 0.0
    for number, step in enumerate(np.diff(voltage).tolist(), 1):
        first = moved(step, h)
        h += (first + moved(step, h + first)) / 2
        values[number] = h
    return part.d * voltage - values


def plays(part: Plant, voltage: FloatArray) -> FloatArray:
    """Sum plays with thresholds up to 80 V, um."""
    total = part.d * 0.55 * voltage
    for threshold in np.linspace(4, 80, 20):
        total += part.d * 0.03 * play(voltage, threshold)
    return total


def lagged(values: FloatArray, time: float) -> FloatArray:
    kept = np.exp(-1 / RATE / FINE / time)
    moved = lfilter([1 - kept], [1.0, -kept], values - values[0])
    return np.asarray(values[0] + moved)


def resonant(values: FloatArray, frequency: float, quality: float) -> FloatArray:
    """Follow values by a mass on a spring, by a symplectic rule at the fine steps."""
    step, omega = 1 / RATE / FINE, 2 * np.pi * frequency
    followed, place, speed = np.empty_like(values), float(values[0]), 0.0
    for number, value in enumerate(values.tolist()):
        speed += step * (omega**2 * (value - place) - omega / quality * speed)
        place += step * speed
        followed[number] = place
    return followed


def limited(values: FloatArray, rate: float) -> FloatArray:
    """Follow values no faster than a rate, 1/s."""
    step, reached = rate / RATE / FINE, float(values[0])
    followed = np.empty_like(values)
    for number, value in enumerate(values.tolist()):
        reached += min(max(value - reached, -step), step)
        followed[number] = reached
    return followed


def at_actuator(kind: str, fine: FloatArray, rng: np.random.Generator) -> FloatArray:
    time = np.arange(fine.size) / RATE / FINE
    fastest = float(np.max(np.abs(np.diff(fine)))) * RATE * FINE
    match kind:
        case "delay":
            return np.asarray(np.interp(time - rng.uniform(0.006, 0.015), time, fine))
        case "saturation":
            return np.clip(fine, None, rng.uniform(0.7, 0.9) * fine.max())
        case "slew limit":
            return limited(fine, rng.uniform(0.5, 0.8) * fastest)
        case "hold":
            # A reading at a sample has not seen its voltage yet.
            return np.concatenate([fine[:1], np.repeat(fine[::FINE], FINE)[:-1]])
    return fine


def moved_by(
    kind: str, part: Plant, voltage: FloatArray, size: float, rng: np.random.Generator, warming: int
) -> FloatArray:
    """Return the displacement in front of the sensor, at the fine steps.

    ``size`` is in parts of the range; a gain that moves is steady after ``warming`` fine steps.
    """
    driven = (plays if kind == "operator" else hysteresis)(part, voltage)
    if kind == "free exponent":
        driven = hysteresis(part, voltage, 2.5)
    size *= float(np.ptp(driven))
    scaled = voltage / np.max(np.abs(voltage))
    match kind:
        case "quadratic":
            driven = driven + size * scaled**2
        case "cubic":
            driven = driven + size * scaled**3
        case "creep":
            times = (0.05, 0.16, 0.5, 1.6, 5.0, 16.0)
            slow = np.sum([lagged(driven, time) for time in times], axis=0)
            driven = driven + 0.5 * rng.uniform(0.02, 0.05) * slow
        case "resonance":
            return resonant(driven, rng.uniform(15, 30), rng.uniform(3, 10))
    moved = lagged(driven, part.lag)
    match kind:
        case "backlash":
            return play(moved, abs(size) / 2)
        case "series plays":
            radii = np.ptp(moved) * np.array([0.03, 0.07, 0.16, 0.25, 0.4])
            held_back = np.array([0.016 * (moved - play(moved, r)) for r in radii])
            return np.asarray(moved - held_back.sum(axis=0))
        case "moving gain":
            along = np.minimum(np.arange(moved.size) / warming, 1.0)
            return moved * (1 + rng.choice([-1, 1]) * rng.uniform(0.03, 0.1) * along)
    return moved


def added(
    kind: str, moved: FloatArray, size: float, time: FloatArray, rng: np.random.Generator
) -> FloatArray:
    """Return what the sensor adds to a displacement (samples,), um; ``size`` is in parts."""
    size *= float(np.ptp(moved))
    total = np.zeros(moved.size)
    match kind:
        case "transient":
            total += 3 * size * np.exp(-time / rng.uniform(0.2, 0.8))
        case "drift":
            total += 3 * size * time / time[-1]
        case "step":
            total += size * (time > rng.uniform(0.2, 0.8) * time[-1])
        case "mains":
            total += 0.3 * size * np.sin(2 * np.pi * 50 * time + rng.uniform(0, 6))
        case "sign":
            total -= 2 * moved
        case "outliers":
            wild = rng.choice(moved.size, 10, replace=False)
            total[wild] += 0.15 * np.ptp(moved) * rng.choice([-1, 1], 10)
    return total


def noise(kind: str, part: Plant, voltage: FloatArray, rng: np.random.Generator) -> FloatArray:
    """Return discrepancy and noise along a voltage (samples,), um."""
    slow = process(voltage.size, 1 / RATE / part.memory, rng)
    rng.normal()  # as the plants were drawn whose causes are on record
    white = rng.normal(size=voltage.size)
    speed = np.abs(np.gradient(voltage))
    match kind:
        case "heavy tails":
            white = rng.standard_t(2, size=voltage.size)
        case "noise by speed":
            white = white * (0.2 + 4 * speed / speed.max())
        case "noise by voltage":
            white = white * (0.2 + 4 * np.abs(voltage) / np.abs(voltage).max())
    total: FloatArray = part.discrepancy * slow + part.sensor * white
    return total


def plant(kind: str, seed: tuple[int, int], seconds: float = 10.0) -> Record:
    """Return the record of a plant with a defect; "good" has none."""
    rng = np.random.default_rng(seed)
    part, fine = drawn(rng), drive(rng, seconds)
    size = float(rng.uniform(0.02, 0.06)) * float(rng.choice([-1, 1]))
    moved = moved_by(kind, part, at_actuator(kind, fine, rng), size, rng, fine.size)[::FINE]
    voltage, time = fine[::FINE], np.arange(moved.size) / RATE
    readings = moved + part.offset + added(kind, moved, size, time, rng)
    return Record(
        voltage, readings + noise(kind, part, voltage, rng), interval=1 / RATE, origin=kind
    )


@dataclass(frozen=True)
class Bench:
    """Two records of one plant by one sensor, the second cut from a running drive.

    ``driven`` are the voltages (samples,) that the actuator did get at the samples of each.
    """

    records: tuple[Record, Record]
    driven: tuple[FloatArray, FloatArray]


def bench(kind: str, seed: tuple[int, int], cured: str = "", seconds: float = 10.0) -> Bench:
    """Measure a plant twice: as :func:`plant` does, and again along another drive.

    A ``cured`` cause is absent from both, all else is the same. The other drive goes no faster and
    no further than the first, so that what is planted has one size. An event does not happen again.
    The discrepancy forgets within a fiftieth of the first record, so that this tells its size, and
    the coverage of the second, of 200 such times, is no matter of luck; as an offset of its own
    would be, from a lead-in of ten.
    """
    rng, later = (np.random.default_rng((*seed, number, *kind.encode())) for number in range(2))
    part, first = drawn(rng), drive(rng, seconds)
    part = replace(part, memory=0.4 * part.memory)
    size = float(rng.uniform(0.02, 0.06)) * float(rng.choice([-1, 1]))
    kind = "good" if kind == cured else kind
    second = drive(later, 42.0)
    second *= 0.95 * min(
        np.max(np.abs(each(first))) / np.max(np.abs(each(second))) for each in (np.array, np.diff)
    )
    joint = np.linspace(first[-1], second[0], round(RATE) * FINE)
    whole = np.concatenate([first, joint, second])
    driven = at_actuator(kind, whole, rng)
    moved = moved_by(kind, part, driven, size, rng, first.size)[::FINE]
    samples = round(seconds * RATE)
    records, voltages = [], []
    # From the middle of a swing on.
    for rows, source in (
        (slice(0, samples), rng),
        (slice(samples + round(2.3 * RATE), None), later),
    ):
        voltage, clean = whole[::FINE][rows], moved[rows]
        time = np.arange(clean.size) / RATE
        fault = "good" if source is later and kind in ("transient", "drift", "step") else kind
        readings = clean + part.offset + added(fault, clean, size, time, source)
        readings += noise(kind, part, voltage, source)
        records.append(Record(voltage, readings, interval=1 / RATE, origin=kind))
        voltages.append(driven[::FINE][rows])
    return Bench((records[0], records[1]), (voltages[0], voltages[1]))
