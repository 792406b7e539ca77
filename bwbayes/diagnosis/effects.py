"""Effects beside the model: of the sensor, and of what lies between voltage and actuator.

A sensor may add a drift, a transient, a step or an oscillation, have another sign, or a gain that
moves. A voltage may be late.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any

import numpy as np

from bwbayes.arrays import FloatArray
from bwbayes.diagnosis.innovations import innovations
from bwbayes.diagnosis.laplace import Effect, LocalFit, climb
from bwbayes.diagnosis.loopfit import find_delay
from bwbayes.diagnosis.record_checks import late_fix, settle_fix
from bwbayes.diagnosis.residual_analysis import Explanation, ResidualAnalysis
from bwbayes.diagnosis.series_patterns import strongest_line
from bwbayes.inference import map_estimate
from bwbayes.inference.study import Stated
from bwbayes.model.stages.additions import Drift, Oscillation
from bwbayes.model.stages.gain import MovingGain
from bwbayes.record.record import Record

# Prior sd of an addition to the displacement, as a fraction of its range.
SIZE = 0.1


def _add(shape: Callable[[FloatArray], FloatArray], starts: FloatArray) -> Effect:
    """Add ``shape(sizes)`` (samples,), um, to the displacement."""
    return Effect(starts, read=lambda moved, sizes: moved + shape(sizes)[: moved.shape[1]])


def add_shapes(shapes: FloatArray, size: float) -> Effect:
    """Add shapes (shapes, samples), each of a size whose prior sd is given, um."""
    return _add(lambda sizes: size * (sizes @ shapes), np.zeros((1, len(shapes))))


def _as_stage(scene: ResidualAnalysis, name: str, **fixed: float) -> dict[str, Any]:
    """Return the model in which a stage is the effect, as facts of an explanation.

    ``fixed`` are values of its parameters. It has such a stage once, and only of a record alone.
    """
    if scene.study is None or name in scene.study.spec.chain:
        return {}
    stated = {parameter: Stated(fixed=value) for parameter, value in fixed.items()}
    return {"spec": scene.study.spec.with_stages(name), "stated": stated}


def drift(scene: ResidualAnalysis) -> Iterator[Explanation]:
    """Try A₁ t/T + A₂ (t/T)²."""
    along = scene.time / scene.duration
    fit = scene.extended(add_shapes(np.stack([along, along**2]), SIZE * scene.extent))
    size = SIZE * scene.extent * float(np.sum(fit.sizes))
    text = f"drift of the readings by {size:.2g} um"
    fix, facts = Drift.advice, _as_stage(scene, "drift")
    yield scene.explained("drift", text, fix, fit, foreign=True, **facts)


def transient(scene: ResidualAnalysis) -> Iterator[Explanation]:
    """Try A exp(−t/τ); τ is a thirtieth of the record, within a factor of three."""

    def decay(size: float) -> float:
        return float(scene.duration / 30 * np.exp(1.1 * size))

    def shape(sizes: FloatArray) -> FloatArray:
        faded: FloatArray = np.exp(-scene.time / decay(sizes[1]))
        return np.asarray(2 * SIZE * scene.extent * sizes[0] * faded)

    fit = scene.extended(_add(shape, np.array([[0.0, z] for z in (-1.2, 0.0, 1.2)])))
    size, time = 2 * SIZE * scene.extent * fit.sizes[0], decay(fit.sizes[1])
    # Until a five-hundredth of the range is left of it.
    until = time * np.log(max(abs(size) / (0.002 * scene.extent), 1.0))
    text = f"transient of {size:.2g} um at the start that decays within {time:.2g} s"
    window = f"set exclude = [[{scene.clock(0.0)}, {scene.clock(until)}]] in [record]"
    settled = int(np.searchsorted(scene.time[: scene.voltage.size], until))
    fix = settle_fix(scene.voltage, settled, window)
    facts = _as_stage(scene, "transient")
    yield scene.explained("transient", text, fix, fit, removes=True, foreign=True, **facts)


def step(scene: ResidualAnalysis) -> Iterator[Explanation]:
    """Try A from a time on: that of the largest innovation, whose choice is paid for.

    Where readings before it were not fitted, the largest of theirs says when it was.
    """
    rows = scene.posterior.single_record.readings.rows
    white = np.abs(scene.innovations)
    white[: max(white.size // 50, 1)] = 0.0
    number = int(np.argmax(white))
    between = scene.posterior.altered(training=(slice(rows[number - 1], rows[number] + 1),))
    rows_between = between.single_record.readings.rows
    white_between = np.abs(innovations(between, scene.fit.free).white)[1:]
    later = 1 + int(np.argmax(white_between))
    row = int(rows_between[later])
    after = (np.arange(scene.time.size) >= row).astype(np.float64)
    fit = scene.extended(add_shapes(after[np.newaxis], SIZE * scene.extent))
    size, time = SIZE * scene.extent * fit.sizes[0], scene.clock(scene.time[row])
    text = f"jump of the offset by {size:.2g} um at {time} s"
    cost = float(np.log(rows.size))
    fix = f"fit one side: set train to end or begin at {time}"
    facts = _as_stage(scene, "step", step_time=row * scene.interval)
    yield scene.explained("step", text, fix, fit, cost, foreign=True, **facts)


def oscillation(scene: ResidualAnalysis) -> Iterator[Explanation]:
    """Try A sin ωt + B cos ωt at the innovations' strongest frequency that the drive has not."""
    rows = scene.posterior.single_record.readings.rows
    line = strongest_line(scene.innovations, scene.voltage[rows], rows, scene.interval)
    if line is None:
        return
    phase = 2 * np.pi * line.frequency * scene.time
    sd = SIZE * scene.extent / 10
    fit = scene.extended(add_shapes(np.stack([np.sin(phase), np.cos(phase)]), sd))
    size = sd * float(np.hypot(*fit.sizes))
    text = f"oscillation of {size:.2g} um at {line.frequency:.4g} Hz{line.source}"
    cost = float(np.log(rows.size / 2))
    fix = Oscillation.advice
    # No stage for it: mains are in the next record too, where their phase is not known.
    yield scene.explained("oscillation", text, fix, fit, cost, noise=True)


def moving_gain(scene: ResidualAnalysis) -> Iterator[Explanation]:
    """Try x (1 + a t/T)."""
    along = scene.time / scene.duration

    def scaled(moved: FloatArray, sizes: FloatArray) -> FloatArray:
        return np.asarray(moved * (1 + SIZE * sizes[0] * along[: moved.shape[1]]))

    fit = scene.extended(Effect(np.zeros((1, 1)), read=scaled))
    text = f"gain that changes by {100 * SIZE * fit.sizes[0]:.2g}% along the record (temperature)"
    yield scene.explained(
        "moving gain", text, MovingGain.advice, fit, **_as_stage(scene, "moving-gain")
    )


def reversed_sign(scene: ResidualAnalysis) -> Iterator[Explanation]:
    """Try −x, if the readings fall where the voltage rises."""
    record = scene.posterior.single_record
    readings, drive = record.readings, record.voltage[record.readings.rows]
    if float((drive - drive.mean()) @ (readings.values - readings.values.mean())) >= 0:
        return
    turned = scene.posterior.altered(displacement=-record.displacement)
    fit = climb(turned, map_estimate.local_minima(turned, scene.generator))
    text, fix = "reversed sign of the displacement", "change its sign in the file"
    yield scene.explained("sign", text, fix, fit, **_as_stage(scene, "reversed-sign"))


def delay(scene: ResidualAnalysis) -> Iterator[Explanation]:
    """Try u(t − δ), of either sign; δ is a fiftieth of the time between reversals, give or take."""
    scale = _delay_scale(scene)

    def shifted(voltage: FloatArray, sizes: FloatArray) -> FloatArray:
        clock = scene.interval * np.arange(voltage.size)
        return np.asarray(np.interp(clock - scale * sizes[0], clock, voltage))

    fit = scene.extended(Effect(np.array([[-1.0], [0.0], [1.0]]), drive=shifted))
    yield _late(scene, scale * float(fit.sizes[0]), fit)


def long_delay(scene: ResidualAnalysis) -> Iterator[Explanation]:
    """Try a delay up to a quarter of a period, which is told by loops.

    The model is fitted anew to readings that are moved by whole samples, and compared with a fit of
    the same readings where they are.
    """
    record, limit = scene.posterior.single_record, min(0.55 * scene.turn_time, 0.2 * scene.duration)
    displacement_kept = np.full(record.displacement.size, np.nan)
    for window in record.training:
        displacement_kept[window] = record.displacement[window]
    late, _ = find_delay(Record(record.voltage, displacement_kept, interval=scene.interval), limit)
    rows = round(late / scene.interval)
    if abs(late) < _delay_scale(scene) or not rows:
        return
    displacement_kept[: max(rows, 0)] = displacement_kept[
        displacement_kept.size + min(rows, 0) :
    ] = np.nan
    all_samples = (slice(0, displacement_kept.size),)
    unmoved = scene.posterior.altered(displacement=displacement_kept, training=all_samples)
    moved = scene.posterior.altered(
        displacement=np.roll(displacement_kept, -rows), training=all_samples
    )
    before = replace(scene, fit=climb(unmoved, scene.places), before=None, held_out=())
    fit = climb(moved, map_estimate.local_minima(moved, scene.generator))
    cost = scene.lead + float(np.log(2 * limit / scene.interval))
    yield _late(before, rows * scene.interval, fit, cost)


def _delay_scale(scene: ResidualAnalysis) -> float:
    return max(scene.turn_time / 50, scene.interval / scene.stride)


def _late(scene: ResidualAnalysis, late: float, fit: LocalFit, cost: float = 0.0) -> Explanation:
    text = f"{'displacement' if late > 0 else 'voltage'} that is late by {1000 * abs(late):.3g} ms"
    fix = late_fix(late, scene.interval / scene.stride)
    if late > 0:
        fix += ", or set hold in [model] if the voltage is a command"
    return scene.explained("delay", text, fix, fit, cost)
