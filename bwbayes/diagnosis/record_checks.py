"""What is wrong with a record, as far as the record itself shows.

:func:`inspect` looks at a record before any model is fitted and returns a :class:`Finding` for
everything that a fit would stumble over, with the line of config that deals with it. It says
nothing about a good record.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from bwbayes.arrays import FloatArray, IntArray
from bwbayes.data.record import Record
from bwbayes.diagnosis.finding import Finding
from bwbayes.diagnosis.frozen import SHORTEST_AT_END, Stuck, clipped, clipped_drive, held, repeated
from bwbayes.diagnosis.loopfit import LoopFit, fit_loop
from bwbayes.diagnosis.series_patterns import (
    find_gross_outliers,
    runs,
    scatter,
    spikes,
    turning_points,
)

__all__ = ["inspect", "isolated_outliers"]

# What the voltage and the displacement of piezo actuators may be, and their quotient.
VOLTS = (0.05, 2000.0)
MICROMETRES = (0.01, 5000.0)
GAINS = (1e-4, 1e3)  # um/V

LEAST_READINGS = 100
LEAST_A_TURN = 6  # samples from one turning point of the voltage to the next
SAME_AMPLITUDE = 0.05  # the largest less the smallest swing of the voltage, over the usual one
LEAST_EXPLAINED = 0.3  # part of the displacement's variance that the voltage must explain

# A decay or a trend counts if it is as large, in sds of what the loops miss and as a part of
# the displacement's range. A drive before the record leaves a decay too, of at most lag x velocity.
DECAY_SDS, DECAY_PART, DECAY_LEFT_BY_DRIVE = 12.0, 0.1, 3.0
START_SDS, START_PART = 20.0, 0.24
TREND_SDS, TREND_PART, TREND_TOLD = 7.0, 0.05, 0.1
LONG_DECAY = 0.13  # of the record: a decay that takes longer is a drift
SPIKE_PART = 0.01  # of the range
LEAST_OPENING = 0.004  # of a loop: its area over that of the rectangle around it
MOST_WINDOWS = 5  # that a fix writes out
# A start that holds more than this part of the drive's path is not left out.
MOST_LEFT_OUT = 0.05
SETTLE_FIRST = "measure again once the displacement has settled"
MOST_SPIKES = 0.05  # of the readings: more are not outliers


def inspect(record: Record) -> tuple[Finding, ...]:
    """Return what is wrong with a record, in the order in which to deal with it.

    Findings are "wrong units", "no relation", "reversed sign", "swapped columns", "few readings",
    "coarse sampling", "one amplitude", "held readings", "repeated samples", "clipping", "spikes",
    "switch-on transient" and "drift". A planned voltage is looked at for its own sake alone.

    Examples
    --------
    >>> time = np.arange(0, 6, 0.01)
    >>> voltage = 100 * np.exp(-0.2 * time) * np.sin(2 * np.pi * time)
    >>> [finding.kind for finding in inspect(Record(voltage, -0.6 * voltage, 0.01))]
    ['reversed sign']
    """
    outliers = np.empty(0, dtype=np.int64)
    if record.displacement is not None:
        outliers = isolated_outliers(record)
    spiky = [*_spikes(record, outliers)]
    # All else is said of the others.
    record = record.without(outliers)
    findings = [*_units(record), *_sampling(record), *_amplitude(record)]
    if record.displacement is None or record.readings < 3:
        return (*findings, *spiky)
    loop = fit_loop(record)
    unlike = [*_relation(record, loop)]
    if {"few readings", "coarse sampling"} & {finding.kind for finding in findings}:
        # Of so little only the most obvious can be said.
        return (
            *findings,
            *(finding for finding in unlike if finding.kind == "no relation"),
            *spiky,
        )
    unlike += [*_stuck(record), *_clipping(record), *_clipped_drive(record)]
    findings += [*unlike, *spiky]
    if not unlike:
        findings += [*_transient(record, loop), *_drift(record, loop)]
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


def _units(record: Record) -> Iterator[Finding]:
    """Find voltages and displacements that no piezo actuator has."""
    volts = float(np.abs(record.voltage).max())
    names = "check the units in the names of the columns: voltage_V, voltage_mV, displacement_um, "
    names += "displacement_nm, displacement_m"
    if not VOLTS[0] <= volts <= VOLTS[1]:
        yield _whole(record, "wrong units", f"voltages of up to {volts:.3g} V", names)
    if record.displacement is None:
        return
    extent = _extent(_readings(record))
    gain = extent / float(np.ptp(record.voltage))
    if not MICROMETRES[0] <= extent <= MICROMETRES[1]:
        yield _whole(record, "wrong units", f"a displacement that moves by {extent:.3g} um", names)
    elif not GAINS[0] <= gain <= GAINS[1]:
        yield _whole(record, "wrong units", f"{gain:.3g} um per volt", names)


def _sampling(record: Record) -> Iterator[Finding]:
    if record.displacement is not None and record.readings < LEAST_READINGS:
        text = f"{record.readings} readings, some ten for each parameter"
        yield _whole(record, "few readings", text, "record longer, or lower `decimate`")
    turns = turning_points(record.voltage, 0.1 * float(np.ptp(record.voltage)))
    if turns.size >= 5:
        a_turn = float(np.median(np.diff(turns)))
        if a_turn < LEAST_A_TURN:
            text = f"{2 * a_turn:.3g} samples a period of the drive, so its turns are not seen"
            fix = "sample faster (20 samples a period or more), or drive more slowly"
            yield _whole(record, "coarse sampling", text, fix)


def _amplitude(record: Record) -> Iterator[Finding]:
    """Find a drive whose swings are all alike, except for the unfinished ones at its ends."""
    turns = turning_points(record.voltage, 0.02 * float(np.ptp(record.voltage)))
    swings = np.abs(np.diff(record.voltage[turns]))[1:-1]
    if swings.size >= 3 and np.ptp(swings) < SAME_AMPLITUDE * np.median(swings):
        text = f"every swing of the voltage is {np.median(swings):.4g} V"
        fix = (
            "vary the amplitude, since one loop does not tell d, alpha and beta apart (a sine that "
            "decays to zero does)"
        )
        yield _whole(record, "one amplitude", text, fix)


def isolated_outliers(record: Record, *, ends: bool = False) -> IntArray:
    """Return the samples whose readings are isolated outliers; none if they are too many.

    With `ends` also a first or last reading that may as well belong to a transient.
    """
    rows, displacement = np.flatnonzero(record.has_reading), _readings(record)
    gross = find_gross_outliers(displacement, record.voltage[rows])
    others = np.delete(np.arange(rows.size), gross)
    displacement, voltage = displacement[others], record.voltage[rows[others]]
    extent = _extent(displacement)
    levels = np.unique(displacement)
    resolution = float(np.diff(levels).min()) if levels.size > 1 else 0.0
    drive = voltage * (extent / max(float(np.ptp(voltage)), 1e-300))
    threshold = max(SPIKE_PART * extent, 6 * resolution)
    near = spikes(displacement, drive, threshold, ends=ends)
    isolated = np.union1d(gross, others[near])
    return rows[isolated] if isolated.size <= MOST_SPIKES * rows.size else rows[:0]


def _spikes(record: Record, outliers: IntArray) -> Iterator[Finding]:
    if not outliers.size:
        return
    times = record.time[outliers]
    shown = ", ".join(map(record.clock, times[:5])) + (", ..." if times.size > 5 else "")
    plural = "" if times.size == 1 else "s"
    text = f"{times.size} isolated outlier{plural} of the displacement, at {shown} s"
    fix = "outliers = true under [model]"
    yield Finding("spikes", text, fix, float(times[0]), float(times[-1]) + record.interval)


def _relation(record: Record, loop: LoopFit) -> Iterator[Finding]:
    """Find a displacement that does not follow the voltage, or the wrong way."""
    if loop.explained < LEAST_EXPLAINED:
        text = f"the voltage explains {max(loop.explained, 0):.0%} of the displacement's variance"
        yield _whole(record, "no relation", text, "check the columns, the wiring and the amplifier")
        return
    leads = _leads(record)
    # A single step leaves the fitted gain open; then the two do not agree.
    voltage, displacement = record.voltage[record.has_reading], _readings(record)
    together = float((voltage - voltage.mean()) @ (displacement - displacement.mean()))
    if loop.gain < 0 and together < 0:
        text = f"the displacement falls by {-loop.gain:.3g} um where the voltage rises by 1 V"
        fix = "change the sign of the displacement's column in the file"
        yield _whole(record, "reversed sign", text, fix)
        leads = not leads if leads is not None else None
    if leads:
        text = "the displacement turns before the voltage does"
        fix = "swap the names of the columns voltage and displacement in the file"
        yield _whole(record, "swapped columns", text, fix)


def _leads(record: Record) -> bool | None:
    """Tell whether the displacement leads the voltage, by the sense in which the loops run.

    None if the record has no loops, or they are too thin or too uneven to tell.
    """
    rows = np.flatnonzero(record.has_reading)
    voltage, displacement = record.voltage[rows], _readings(record)
    turns = turning_points(voltage, 0.2 * float(np.ptp(voltage)))
    if turns.size < 4:
        return None
    # From one turn to the next but one, twice the area between loop and chord.
    steps_v, steps_d = np.diff(voltage), np.diff(displacement)
    middle_v, middle_d = voltage[:-1] + steps_v / 2, displacement[:-1] + steps_d / 2
    sums = [
        np.concatenate([[0.0], np.cumsum(values)])
        for values in (middle_v * steps_d - middle_d * steps_v, steps_v, steps_d)
    ]
    first, last = turns[:-2], turns[2:]
    area = sums[0][last] - sums[0][first]
    area -= voltage[first] * (displacement[last] - displacement[first])
    area += displacement[first] * (voltage[last] - voltage[first])
    swing = np.abs(voltage[turns[1:-1]] - voltage[first])
    size = 2 * swing * float(np.ptp(displacement) / np.ptp(voltage)) * swing
    opening = area / size
    usual = float(np.median(opening))
    error = scatter(opening) / np.sqrt(opening.size)
    if abs(usual) < max(LEAST_OPENING, 4 * error):
        return None
    return usual < 0


def _stuck(record: Record) -> Iterator[Finding]:
    """Find readings that stay where they are while the voltage moves on."""
    assert record.displacement is not None
    rows = np.flatnonzero(record.has_reading)
    voltage, displacement = record.voltage[rows], _readings(record)
    stuck = repeated(voltage, displacement)
    if stuck is not None:
        count = f"{stuck.samples} samples repeat"
        text = f"{count} the one before, voltage and displacement, and then jump"
        yield _where(record, rows, "repeated samples", text, stuck)
        return
    stuck = held(voltage, displacement)
    if stuck is not None:
        text = (
            f"{stuck.samples} readings repeat the one before and then jump, while the voltage moves"
        )
        yield _where(record, rows, "held readings", text, stuck)


def _where(record: Record, rows: IntArray, kind: str, text: str, stuck: Stuck) -> Finding:
    """Return a finding about stuck samples, with the windows to leave out if these are few."""
    starts = record.time[rows[stuck.first]]
    stops = record.time[rows[stuck.last]] + record.interval
    windows = [
        f"[{record.clock(a)}, {record.clock(b)}]" for a, b in zip(starts, stops, strict=True)
    ]
    text += f", first at {record.clock(starts[0])} s"
    if len(windows) <= MOST_WINDOWS:
        fix = f"exclude = [{', '.join(windows)}] under [record]"
    elif kind == "clipping":
        fix = "use a wider range"
    else:
        fix = f"decimate = {stuck.length} under [record], or record at the sensor's own rate"
    return Finding(kind, text, fix, float(starts[0]), float(stops[-1]))


def _clipping(record: Record) -> Iterator[Finding]:
    """Find a sensor at the end of its range."""
    rows = np.flatnonzero(record.has_reading)
    voltage, displacement = record.voltage[rows], _readings(record)
    for side, sign in (("largest", 1.0), ("smallest", -1.0)):
        stuck = clipped(sign * displacement, voltage)
        if stuck is not None:
            value = displacement[stuck.first[0]]
            text = f"{stuck.samples} readings stay at the {side} value, {value:g} um, while the "
            yield _where(record, rows, "clipping", text + "voltage moves", stuck)


def _clipped_drive(record: Record) -> Iterator[Finding]:
    """Find a voltage at the end of its range while the displacement goes on."""
    rows = np.flatnonzero(record.has_reading)
    displacement = _readings(record)
    for side, sign in (("largest", 1.0), ("smallest", -1.0)):
        voltage = sign * record.voltage
        at_end = voltage == voltage.max()
        if runs(at_end)[1].max() < SHORTEST_AT_END or (~at_end[rows]).sum() < LEAST_READINGS:
            continue
        loop = fit_loop(record, at_end)
        stuck = clipped_drive(voltage[rows], sign * displacement, scatter(loop.residual))
        if stuck is not None:
            text = (
                f"{stuck.samples} voltages stay at the {side} value, "
                f"{record.voltage[rows[stuck.first[0]]]:g} V, while the displacement goes on and "
                f"returns, first at {record.clock(record.time[rows[stuck.first[0]]])} s"
            )
            yield _whole(record, "clipping", text, "record the voltage over its whole range")


def _transient(record: Record, loop: LoopFit) -> Iterator[Finding]:
    """Find a displacement that comes from elsewhere at the start, whatever the voltage does."""
    size, time = loop.decay
    usual, extent = scatter(loop.residual), _extent(_readings(record))
    steps = np.abs(np.diff(record.voltage))
    velocity = float(np.quantile(steps, 0.99)) / record.interval
    lagged = abs(loop.gain) * velocity * min(time, 1.5 * loop.lag)
    alone = max(DECAY_SDS * usual, DECAY_PART * extent, DECAY_LEFT_BY_DRIVE * lagged)
    # With another hysteretic state at the start, which steps of the voltage do not show.
    moving = np.count_nonzero(steps) > steps.size / 2
    in_all = max(START_SDS * usual, START_PART * extent)
    if abs(loop.start) > in_all and moving and abs(size) > usual:
        size = loop.start
    elif abs(size) < alone or time > LONG_DECAY * record.duration:
        return
    begin = float(record.time[loop.rows[0]])
    # Until no more is to be seen of it than of the rest, or a thousandth of the range.
    over = begin + time * float(np.log(abs(size) / max(0.5 * usual, 0.001 * extent)))
    over = min(over, record.start + 0.9 * record.duration)
    text = (
        f"the displacement starts {abs(size):.3g} um {'above' if size > 0 else 'below'} where the "
        f"voltage would have it, and settles with a time constant of {time:.2g} s"
    )
    gone = int(np.searchsorted(record.time, over))
    share = steps[:gone].sum() / steps.sum()
    fix = SETTLE_FIRST if share > MOST_LEFT_OUT else f"start = {record.clock(over)} under [record]"
    yield Finding("switch-on transient", text, fix, begin, over)


def _drift(record: Record, loop: LoopFit) -> Iterator[Finding]:
    usual, extent = scatter(loop.residual), _extent(_readings(record))
    size = loop.trend
    if loop.decay.time > LONG_DECAY * record.duration:
        size -= loop.decay.size * (1 - float(np.exp(-record.duration / loop.decay.time)))
    told = max(loop.trend_told, 1e-12)
    threshold = max(TREND_SDS * usual / np.sqrt(told), TREND_PART * extent)
    if told > TREND_TOLD and abs(size) > threshold:
        text = f"at equal voltages the displacement moves by {size:+.3g} um over the record"
        fix = "let it warm up, fit a shorter part (train = [[start, stop]] under [record])"
        yield _whole(record, "drift", text, f"{fix}, or take the trend out of the file")
