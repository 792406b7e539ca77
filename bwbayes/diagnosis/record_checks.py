"""Issues of a record that the record itself shows.

:func:`inspect` checks a record before any model is fitted and returns a :class:`Finding` for
every issue that would harm a fit, with the line of config that solves it. It returns none for a
good record.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from bwbayes.arrays import BoolArray, FloatArray, IntArray
from bwbayes.diagnosis.defects import DEFECTS, late_fix, settle_fix
from bwbayes.diagnosis.finding import Finding
from bwbayes.diagnosis.loopfit import LONG_DECAY, LoopFit, find_delay, fit_loop
from bwbayes.diagnosis.series_patterns import (
    FrozenRun,
    copies,
    find_clipped,
    find_held,
    find_repeated,
    lasting_jumps,
    moves_between,
    resolution,
    scatter,
    spikes,
)
from bwbayes.inference.defaults import rounding_sd
from bwbayes.model.inputs import turning_points
from bwbayes.record.record import Record
from bwbayes.shown import rounded

# Kinds of findings about what a drive cannot show, which are no fault of the readings.
UNTOLD = ("no reversal", "one amplitude", "few readings", "no hysteresis")


def inspect(record: Record) -> tuple[Finding, ...]:
    """Return the issues of a record, in the order in which to solve them.

    Findings are "unlikely units", "no relation", "late voltage", "late displacement",
    "reversed sign", "swapped columns", "few readings", "coarse sampling", "no reversal",
    "one amplitude",
    "held readings", "repeated samples", "clipping", "coarse resolution", "jump", "spikes",
    "switch-on transient", "drift", "no hysteresis" and "no noise". For a planned voltage, only the
    voltage is checked.

    Examples
    --------
    >>> time = np.arange(0, 6, 0.01)
    >>> voltage = 100 * np.exp(-0.2 * time) * np.sin(2 * np.pi * time)
    >>> [finding.kind for finding in inspect(Record(voltage, -0.6 * voltage, interval=0.01))]
    ['reversed sign']
    """
    sudden, stuck = list[Finding](), list[Finding]()
    if record.displacement is not None and record.readings >= 3:
        stuck += _stuck(record)
        # Held readings have jumps of their own.
        held_up = {"held readings", "repeated samples"} & {finding.kind for finding in stuck}
        if not held_up and (jumped := offset_jumps(record)) is not None:
            sudden.append(jumped[0])
            record = record.without(jumped[1])
        outliers = isolated_outliers(record)
        if outliers.size:
            times, several = record.time[outliers], outliers.size > 1
            shown = ", ".join(map(record.clock, times[:5])) + ", ..." * (times.size > 5)
            text = f"{times.size} isolated outlier{'s' * several} of the displacement, at {shown} s"
            stop = float(times[-1]) + record.interval
            fix = "outliers = true under [model]"
            sudden.append(Finding("spikes", text, fix, float(times[0]), stop))
        # All other checks leave the outliers out.
        record = record.without(outliers)
    findings = [*_plausibility(record)]
    if record.displacement is None or record.readings < 3:
        return (*findings, *sudden)
    loop = fit_loop(record)
    unlike = [*_relation(record, loop)]
    if {"few readings", "coarse sampling"} & {finding.kind for finding in findings}:
        # With this little data, report only the obvious problems.
        obvious = [finding for finding in unlike if finding.kind == "no relation"]
        return (*findings, *obvious, *sudden)
    unlike += [*stuck, *_coarse(record)]
    findings += [*unlike, *sudden]
    if not unlike:
        transient = [*_transient(record, loop)]
        late = _late(record, loop, 1.5) if transient else None
        findings += [
            *(transient if late is None else [late]),
            *_drift(record, loop),
            *_no_hysteresis(record, loop),
            *_no_noise(record),
        ]
    return tuple(findings)


def _whole(record: Record, kind: str, text: str, fix: str) -> Finding:
    return Finding(kind, text, fix, record.start, record.start + record.duration)


def _readings(record: Record) -> FloatArray:
    assert record.displacement is not None
    return record.displacement[record.has_reading]


def _extent(values: FloatArray) -> float:
    """Return the range of values without the outermost thousandth on either side."""
    low, high = np.quantile(values, (0.001, 0.999))
    return float(high - low)


def _plausibility(record: Record) -> Iterator[Finding]:
    """Find values that are implausible for a piezo actuator, and drives that show little."""
    volts, span = float(np.abs(record.voltage).max()), float(np.ptp(record.voltage))
    text, likely = f"voltages of up to {volts:.3g} V", 0.05 <= volts <= 2000
    if record.displacement is not None:
        extent = _extent(_readings(record))
        text += f" move the displacement by {extent:.3g} um, {extent / span:.3g} um per volt"
        likely = likely and 0.01 <= extent <= 5000 and 1e-4 <= extent / span <= 1e3
    if not likely and record.quantities.are_default:
        fix = "check the units in the names of the columns (voltage_V, voltage_mV, "
        fix += "displacement_um, displacement_nm, displacement_m), and keep them if they are right"
        yield _whole(record, "unlikely units", text, fix)
    if record.displacement is not None and record.readings < 100:
        text = f"{record.readings} readings, some ten for each parameter"
        yield _whole(record, "few readings", text, "record longer, or lower `decimate`")
    ways = record.voltage, -record.voltage
    if span and min(np.max(np.maximum.accumulate(way) - way) for way in ways) < 0.1 * span:
        begin, end = record.voltage[[0, -1]]
        text = f"the voltage goes one way, from {begin:.4g} to {end:.4g} V: no loop shows"
        fix = "drive up and down, with an amplitude that varies; alpha, beta and gamma stay open"
        yield _whole(record, "no reversal", text, fix)
    spacing = np.diff(turning_points(record.voltage, 0.1 * span))
    if spacing.size >= 3 and np.median(spacing) < 6:
        text = f"{2 * np.median(spacing):.3g} samples a period, too few to resolve the reversals"
        fix = "sample faster (20 samples a period or more), or drive more slowly"
        yield _whole(record, "coarse sampling", text, fix)
    swings = np.abs(np.diff(record.voltage[turning_points(record.voltage, 0.02 * span)]))
    if swings.size >= 3 and np.ptp(swings) < 0.05 * np.median(swings):
        text = f"every swing of the voltage is {np.median(swings):.4g} V"
        fix = (
            "vary the amplitude, since one loop does not tell d, alpha and beta apart (a sine that "
            "decays to zero does)"
        )
        yield _whole(record, "one amplitude", text, fix)


def isolated_outliers(record: Record, *, ends: bool = False) -> IntArray:
    """Return the samples whose readings are isolated outliers; none if they are more than 5%.

    Ranges are measured again without the outliers found so far, until there are no more. With
    `ends`, a first or last reading counts even if it may belong to a transient, being away from
    the median of all others by at most twice their range.
    """
    rows, readings = np.flatnonzero(record.has_reading), _readings(record)
    is_kept = np.ones(rows.size, dtype=np.bool_)
    while (retained := np.flatnonzero(is_kept)).size >= 0.95 * rows.size:
        displacement, voltage = readings[is_kept], record.voltage[rows[is_kept]]
        near = spikes(displacement, *_driven(displacement, voltage))
        if not ends:
            others = np.delete(displacement, near)
            outlying = np.abs(displacement[near] - np.median(others)) > 2 * np.ptp(others)
            near = near[outlying | ((near > 0) & (near < retained.size - 1))]
        if not near.size:
            return rows[~is_kept]
        is_kept[retained[near]] = False
    return rows[:0]


def _driven(displacement: FloatArray, voltage: FloatArray) -> tuple[FloatArray, float]:
    """Return the possible effect of a voltage (samples,) on the displacement, and a threshold, um.

    The effect is a gain times the voltage; the threshold of an outlier is a hundredth of the range
    or six steps of the sensor.
    """
    extent, levels = _extent(displacement), np.unique(displacement)
    resolution = float(np.diff(levels).min()) if levels.size > 1 else 0.0
    gain, voltage_scatter = extent / max(float(np.ptp(voltage)), 1e-300), scatter(voltage)
    if voltage_scatter > 0:  # outliers do not increase this gain
        gain = min(gain, scatter(displacement) / voltage_scatter)
    return gain * voltage, max(0.01 * extent, 6 * resolution)


def offset_jumps(record: Record) -> tuple[Finding, BoolArray] | None:
    """Find jumps of the offset, and the samples (samples,) on the sides that hold fewer readings.

    Segments belong together if the jumps between them add up to zero, as at a dropout. If there are
    more than five windows, none is left out.
    """
    rows, displacement = np.flatnonzero(record.has_reading), _readings(record)
    drive, threshold = _driven(displacement, record.voltage[rows])
    gaps = np.diff(rows)
    at = lasting_jumps(displacement, drive, gaps <= np.median(gaps), threshold)
    if not at.size:
        return None
    # Subtract the effect of the voltage in the meantime.
    sizes = np.diff(displacement - drive)[at - 1]
    edges = np.array([0, *at, rows.size])
    level = np.rint(np.cumsum([0.0, *sizes]) / np.abs(sizes).min())
    _, side = np.unique(level, return_inverse=True)
    shifted = side != np.argmax(np.bincount(side, np.diff(edges)))
    first, last = edges[:-1][shifted], edges[1:][shifted] - 1
    times = [record.clock(time) for time in record.time[rows[at[:5]]]]
    jumped = ", ".join(f"{size:+.3g} um at {t} s" for size, t in zip(sizes, times, strict=False))
    text = f"the displacement jumps by {jumped}" + ", ..." * (at.size > 5)
    fix = "look for what slips or is zeroed"
    samples = np.zeros(record.samples, dtype=np.bool_)
    if first.size <= 5:
        fix = _exclude(record, rows, FrozenRun(first, last))
        samples[rows[np.repeat(shifted, np.diff(edges))]] = True
    start, stop = record.time[rows[at[0]]], record.time[rows[at[-1]]] + record.interval
    return Finding(DEFECTS["step"].finding, text, fix, float(start), float(stop)), samples


def _exclude(record: Record, rows: IntArray, stuck: FrozenRun) -> str:
    """Return the line of config that excludes runs of the readings at ``rows``."""
    starts = record.time[rows[stuck.first]]
    stops = record.time[rows[stuck.last]] + record.interval
    windows = [
        f"[{record.clock(a)}, {record.clock(b)}]" for a, b in zip(starts, stops, strict=True)
    ]
    return f"exclude = [{', '.join(windows)}] under [record]"


def _relation(record: Record, loop: LoopFit) -> Iterator[Finding]:
    """Find a displacement that does not follow the voltage, or the wrong way, or ahead of it."""
    voltage, displacement = record.voltage[record.has_reading], _readings(record)
    leads = _leads(voltage, displacement)
    # A falling displacement whose loops lag has two faults, unless a column is late, which is one.
    falls_and_lags = loop.gain < 0 and leads is False
    if leads is not False or loop.missed >= 0.02 or falls_and_lags:
        late = _late(record, loop, 1.0 if falls_and_lags else 5.0)
        if late is not None:
            yield late
            return
    # Loops of another sign or sense imitate most of a motion that only coincides with the drive.
    limit = 0.03 if leads or loop.gain < 0 else 0.3
    # Rounding to coarse steps is off by half a step at most.
    half_step = resolution(displacement) * np.ptp(displacement) / 2
    if (loop.explained < 0.3 or loop.missed > limit) and np.var(loop.residual) > half_step**2:
        share = min(max(1 - loop.explained, loop.missed), 1)
        text = f"{share:.0%} of the displacement's variance does not follow the voltage"
        yield _whole(record, "no relation", text, "check the columns, the wiring and the amplifier")
        return
    # A single step leaves the fitted gain open; then the two do not agree.
    together = float((voltage - voltage.mean()) @ (displacement - displacement.mean()))
    if loop.gain < 0 and together < 0:
        text = f"the displacement falls by {-loop.gain:.3g} um where the voltage rises by 1 V"
        sign = DEFECTS["sign"]
        yield _whole(record, sign.finding, text, sign.in_bands[1])
        leads = not leads if leads is not None else None
    if leads:
        text = "the displacement turns before the voltage does"
        fix = "swap the names of the columns voltage and displacement in the file"
        yield _whole(record, "swapped columns", text, fix)


def _late(record: Record, loop: LoopFit, gain: float) -> Finding | None:
    """Find a column that is late by up to a quarter of the drive's period.

    A delay has to leave ``gain`` times less variance than a lag and a decay do; swapped columns are
    left out, which lead at any delay.
    """
    turns = turning_points(record.voltage, 0.1 * float(np.ptp(record.voltage)))
    quarter = 0.5 * record.interval * float(np.median(np.diff(turns))) if turns.size > 2 else 0.0
    if not record.interval < quarter < 0.2 * record.duration:
        return None
    delay, missed = find_delay(record, 1.1 * quarter)
    if np.var(loop.residual) < gain * missed or not 0.5 * record.interval < abs(delay):
        return None
    time = record.time[record.has_reading] - delay
    inside = (time >= record.time[0]) & (time <= record.time[-1])
    voltage = np.interp(time[inside], record.time, record.voltage)
    if _leads(voltage, _readings(record)[inside]):
        return None
    name = "displacement" if delay > 0 else "voltage"
    text = f"the {name} is late by about {rounded(1e3 * abs(delay), 2)} ms"
    kind = f"{DEFECTS['delay'].finding} {name}"
    fix = f"let a run fit the delay, or {late_fix(delay, record.interval)}"
    return _whole(record, kind, text, fix)


def _no_hysteresis(record: Record, loop: LoopFit) -> Iterator[Finding]:
    """Find a displacement without loops: 99 of 100 such records, if their noise is white.

    There is no finding without reversals, or if noise would hide loops of half a percent.
    """
    turns = turning_points(record.voltage, 0.2 * float(np.ptp(record.voltage)))
    # The rms of a loop is a third of its opening; the test of nine plays detects 30 times the
    # squared uncertainty in nine of ten records. A part of the loop may look like a lag.
    thinnest = 3 * np.sqrt(30 / loop.rows.size) * np.std(loop.residual) / _extent(_readings(record))
    if turns.size >= 3 and loop.without_loops > 0.01 and thinnest < 0.005:
        text = "a curve and a lag explain rising and falling voltage alike, over these volts"
        fix = 'hysteresis = "linear" under [model]'
        yield _whole(record, "no hysteresis", text, fix)


def _no_noise(record: Record) -> Iterator[Finding]:
    """Find readings without noise, from a simulation or from a sensor coarser than its noise."""
    if sd := rounding_sd(_readings(record)):
        text = f"the readings show no noise but rounding, which has an SD of {sd:.2g} um"
        fix = "record with a finer resolution; add the sensor's noise to simulated readings"
        yield _whole(record, "no noise", text, fix)


def _leads(voltage: FloatArray, displacement: FloatArray) -> bool | None:
    """Tell whether the displacement leads the voltage, by the sense in which the loops run.

    Returns None if the record has no loops, or they are too thin or too uneven to tell.
    """
    turns = turning_points(voltage, 0.2 * float(np.ptp(voltage)))
    if turns.size < 3:
        return None
    # Twice the area between loop and chord, from each reversal to the next but one.
    area = []
    for first, last in zip(turns[:-2], turns[2:] + 1, strict=True):
        u, x = voltage[first:last], displacement[first:last]
        area.append(u @ np.roll(x, -1) - x @ np.roll(u, -1))
    swing = np.abs(voltage[turns[1:-1]] - voltage[turns[:-2]])
    opening = area / (2 * swing**2 * np.ptp(displacement) / np.ptp(voltage))
    typical = float(np.median(opening))
    error = scatter(opening) / np.sqrt(opening.size)
    if abs(typical) < max(0.004, 4 * error):
        return None
    return typical < 0


def _stuck(record: Record) -> Iterator[Finding]:
    """Find readings that stay where they are while the voltage moves on."""
    rows, displacement = np.flatnonzero(record.has_reading), _readings(record)
    voltage = record.voltage[rows]
    repeats, jump = find_repeated(voltage, displacement), "repeat the one before{} and then jump{}"
    if (times := copies(voltage, displacement)) > 1:
        text = f"every sample is written {times} times"
        yield _whole(record, "repeated samples", text, f"decimate = {times} under [record]")
    elif repeats is not None:
        description = f"samples {jump.format(', voltage and displacement,', '')}"
        yield _where(record, rows, "repeated samples", description, repeats)
    elif (holds := find_held(voltage, displacement)) is not None:
        description = f"readings {jump.format('', ', while the voltage moves')}"
        yield _where(record, rows, "held readings", description, holds)
    limits: list[str] = []
    stays: list[tuple[float, float, str]] = []
    for side, sign in (("smallest", -1.0), ("largest", 1.0)):
        ends = find_clipped(sign * displacement, voltage)
        if ends is not None:
            limits.append(repr(float(f"{displacement[ends.first[0]]:.12g}")))
            start, stop = record.time[rows[[ends.first[0], ends.last[-1]]]].tolist()
            description = (
                f"{ends.samples} readings stay at the {side} value, {float(limits[-1]):g} um"
            )
            stays.append((start, stop + record.interval, description))
    if stays:
        starts, stops, texts = zip(*stays, strict=True)
        first = record.clock(min(starts))
        text = f"{', and '.join(texts)}, while the voltage moves, first at {first} s"
        fix = f"missing = [{', '.join(limits)}] under [record]"
        yield Finding("clipping", text, fix, min(starts), max(stops))


def _coarse(record: Record) -> Iterator[Finding]:
    """Find a column that is recorded in too coarse steps, except a staircase.

    Rounding to steps has an sd of 1/√12 of a step. Steps are too coarse if that exceeds a percent
    of the range, the usual error of a Bouc-Wen model of an actuator.
    """
    voltage, displacement = record.voltage[record.has_reading], _readings(record)
    fix = "record it with a finer resolution: a smaller range of the instrument, or more bits"
    for name, unit, values in (("voltage", "V", voltage), ("displacement", "um", displacement)):
        step = resolution(values)
        staircase = name == "voltage" and not moves_between(voltage, displacement)
        if step > 0.01 * np.sqrt(12) and not staircase:
            size = step * float(np.ptp(values))
            text = f"the {name} is recorded in steps of {size:.3g} {unit}, {step:.0%} of its range"
            yield _whole(record, "coarse resolution", text, fix)


def _where(
    record: Record, rows: IntArray, kind: str, description: str, stuck: FrozenRun
) -> Finding:
    """Return a finding about stuck samples, with the windows to leave out if these are few."""
    starts = record.time[rows[stuck.first]]
    stops = record.time[rows[stuck.last]] + record.interval
    if starts.size <= 5:
        fix = _exclude(record, rows, stuck)
    else:
        fix = f"decimate = {stuck.length} under [record], or record at the sensor's own rate"
    text = f"{stuck.samples} {description}, first at {record.clock(starts[0])} s"
    return Finding(kind, text, fix, float(starts[0]), float(stops[-1]))


def _transient(record: Record, loop: LoopFit) -> Iterator[Finding]:
    """Find a transient of the displacement at the start that the voltage does not cause.

    Loops may imitate at most 49 fiftieths of it: a drive of one swing shows nothing but the initial
    loading, which no other swing confirms. The same holds for a transient that has settled before
    the first reversal and is smaller than the response to the voltage in that time.
    """
    if loop.decay_share < 0.02:
        return
    size, time = loop.decay, loop.decay_time
    turns = turning_points(record.voltage, 0.1 * float(np.ptp(record.voltage)))
    first, settled = loop.rows[0], loop.rows[0] + round(3 * time / record.interval)
    if turns.size and settled <= turns[0]:
        loaded = abs(loop.gain * (record.voltage[settled] - record.voltage[first]))
        if max(abs(size), abs(loop.start)) < loaded:
            return
    spread, extent = scatter(loop.residual), _extent(_readings(record))
    steps = np.abs(np.diff(record.voltage))
    # A drive before the record leaves a decay, too, as fast as the lag, of lag times velocity.
    velocity = float(np.quantile(steps, 0.99)) / record.interval
    lagged = abs(loop.gain) * velocity * min(time, 1.5 * loop.lag) * (time < 10 * loop.lag)
    # The evidence for another initial hysteretic state, which voltage steps do not show, is weaker.
    moving, driven = np.count_nonzero(steps) > steps.size / 2, 2 * loop.driven_decay
    outside = abs(loop.start) > max(20 * spread, 0.24 * extent, driven)
    if outside and moving and abs(size) > spread:
        size = loop.start
    elif abs(size) < max(12 * spread, 0.1 * extent, 3 * lagged, driven) or (
        time > LONG_DECAY * record.duration
    ):
        return
    elif loop.decay_left > 0.1:
        # The decay corrects loops that no play follows, such as an amplifier's at its limits.
        return
    begin = float(record.time[first])
    # It is over once it is half as large as the other residuals, or a thousandth of the range.
    over = begin + time * float(np.log(abs(size) / max(0.5 * spread, 0.001 * extent)))
    over = min(over, record.start + 0.9 * record.duration)
    text = (
        f"the displacement starts {abs(size):.3g} um {'above' if size > 0 else 'below'} where the "
        f"voltage would have it, and settles with a time constant of {time:.2g} s"
    )
    kept_from = int(np.searchsorted(record.time, over))
    fix = settle_fix(record.voltage, kept_from, f"start = {record.clock(over)} under [record]")
    yield Finding(DEFECTS["transient"].finding, text, fix, begin, over)


def _drift(record: Record, loop: LoopFit) -> Iterator[Finding]:
    """Find a trend at least twice as large as the voltage might cause."""
    spread, extent = scatter(loop.residual), _extent(_readings(record))
    size = loop.trend
    share = max(loop.trend_share, 1e-12)
    threshold = max(10 * spread / np.sqrt(share), 0.05 * extent, 2 * loop.driven_trend)
    if share > 0.03 and abs(size) > threshold:
        text = f"at equal voltages the displacement moves by {size:+.3g} um over the record"
        fix = "let it warm up, fit a shorter part (train = [[start, stop]] under [record])"
        yield _whole(
            record, DEFECTS["drift"].finding, text, f"{fix}, or take the trend out of the file"
        )
