"""Default priors: broad, and from the record's ranges and the drive's own times alone.

With Y half the range of the displacement, U half the range of the voltage and T the typical time
from one turning point of the drive to the next, every scale of the model is known to within a
factor of a few; each part declares its own. The sampling rate does not enter: a record and its
every k-th sample have the same priors.

The ranges are those of the training data, displacement included, so strictly the data are used
twice: once for these scales, once for the fit. The priors are wide enough that this does not show
(every one holds a factor of several), and they never come from a fit. They are resolved once to
explicit numbers, which a run prints and stores.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from bwbayes.arrays import FloatArray
from bwbayes.model.declaration import Ranges
from bwbayes.model.inputs import Inputs, time_between_turns


def ranges_of(
    inputs: Inputs,
    displacement: FloatArray,
    windows: Sequence[slice] = (slice(None),),
) -> Ranges:
    """Take the ranges within windows of a record.

    ``inputs`` and ``displacement`` (samples,), um, are the whole record's; nan is missing.
    """
    volts = np.concatenate([inputs.voltage[window] for window in windows])
    readings = np.concatenate([displacement[window] for window in windows])
    low, high = float(np.nanmin(readings)), float(np.nanmax(readings))
    rows = np.concatenate([np.arange(inputs.samples)[window] for window in windows])
    return Ranges(
        voltage=float(np.ptp(volts)) / 2,
        displacement=(high - low) / 2,
        middle=(high + low) / 2,
        time=time_between_turns(inputs.voltage, inputs.interval, windows),
        bias=float(np.min(volts) + np.max(volts)) / 2,
        interval=inputs.interval,
        duration=volts.size * inputs.interval,
        rounding=rounding_sd(readings[~np.isnan(readings)]),
        resolution=resolution_sd(readings[~np.isnan(readings)]),
        begin=inputs.interval * float(rows[np.isfinite(displacement[rows])][0]),
        covariates={name: inputs.range_of(name, windows) for name in inputs.covariates},
    )


def rounding_sd(readings: FloatArray) -> float:
    """Return the sd of the rounding of readings (readings,) that show no other noise, um; else 0.

    Numbers that are multiples of a step q are rounded to it, with an sd of q/√12; others to 2⁻²⁴ of
    their range, of which no converter resolves less. The likelihood of a model that follows them
    exactly has no bound where the sensor's sd may be less.
    """
    # Here, because to open a run is to read files: records bring what reads any of them.
    from bwbayes.record.voltage_path import noise_sd, rounding_step  # noqa: PLC0415

    rounding = max(rounding_step(readings) / math.sqrt(12), _finest_sd(readings))
    enough = readings.size > 10  # for differences of the highest order
    return rounding if enough and noise_sd(readings)[0] < 1.1 * rounding else 0.0


def resolution_sd(readings: FloatArray) -> float:
    """Return the least sd of a sensor whose readings (readings,) hide their noise, um; else 0.

    Readings along a drive that jumps at every few samples may have none, and a model may follow
    them exactly.
    """
    from bwbayes.record.voltage_path import noise_sd  # noqa: PLC0415  # as above

    enough = readings.size > 10
    return _finest_sd(readings) if enough and not noise_sd(readings)[1] else 0.0


def _finest_sd(readings: FloatArray) -> float:
    """Return the sd of rounding to 2⁻²⁴ of the range of readings, um."""
    return 2.0**-24 * float(np.ptp(readings)) / math.sqrt(12)


def join_ranges(records: Sequence[Ranges]) -> Ranges:
    """Return the ranges of several records of one actuator together.

    Displacements are not held against each other, for sensors are set to zero between records: the
    widest counts, and its middle. Voltages are. The time between turns is that of the fastest
    drive: a step never turns.
    """
    if len(records) == 1:
        return records[0]
    widest = max(records, key=lambda record: record.displacement)
    low = min(record.bias - record.voltage for record in records)
    high = max(record.bias + record.voltage for record in records)
    return Ranges(
        voltage=(high - low) / 2,
        displacement=widest.displacement,
        middle=widest.middle,
        time=min(record.time for record in records),
        bias=(high + low) / 2,
        interval=min(record.interval for record in records),
        duration=max(record.duration for record in records),
        rounding=min(record.rounding for record in records),
        resolution=min(record.resolution for record in records),
        begin=min(record.begin for record in records),
        covariates={
            name: (
                min(record.covariates[name][0] for record in records),
                max(record.covariates[name][1] for record in records),
            )
            for name in set.intersection(*(set(record.covariates) for record in records))
        },
    )
