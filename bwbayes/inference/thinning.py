"""Thinned records: every k-th sample of a long record, for searches that take many simulations.

The voltage keeps its reversals and is taken to go straight in between, so that the hysteresis
remembers what it remembers of the whole record. The error that is left is that of the drive's
curvature between two samples. Where it is small beside a model's error, the modes of the thinned
posterior are near those of the whole one, which a climb along all readings then reaches in a few
steps. A drive that is too fast to be thinned comes back soon: there the beginning of the record
shows as much of the model (:func:`beginning`).
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

import numpy as np

from bwbayes.arrays import FloatArray
from bwbayes.inference.likelihood import Likelihood
from bwbayes.inference.posterior import Posterior
from bwbayes.model.inputs import monotone_stretches


def thin_posterior(posterior: Posterior, theta: FloatArray, samples: int) -> Posterior:
    """Thin each record of a posterior to so many samples, or as few as its displacement allows.

    That of most models at θ (models, parameters) changes by no more than a thousandth of its range,
    root mean square: a tenth of the error of a Bouc-Wen model. A posterior of short records is
    returned as it is.
    """
    for dataset in posterior.datasets:
        models = posterior.table.of(theta, dataset.name)
        stride = dataset.readings.samples // samples
        if stride > 1:
            full_displacement = displacement(posterior, dataset, models)
            limit = 1e-3 * np.ptp(full_displacement, axis=1)
        while stride > 1:
            short, kept = thin(dataset, stride), np.sum(dataset.readings.rows % stride == 0)
            change = displacement(posterior, short, models) - full_displacement[:, ::stride]
            error = np.sqrt(np.mean(change**2, axis=1))
            # There may be fewer readings than samples, and none of them at those that are kept.
            enough = 2 * kept >= min(dataset.readings.rows.size, samples)
            if enough and np.median(error - limit) <= 0:
                others = (short if other is dataset else other for other in posterior.datasets)
                posterior = replace(posterior, datasets=tuple(others))
                break
            stride //= 2
    return posterior


def beginning(posterior: Posterior, samples: int) -> Posterior:
    """Return the posterior of the beginnings of its records, of those that are twice as long.

    Until the voltage has been nearly everywhere, and so many samples on. A posterior of short
    records is returned as it is.
    """
    windows, shorter = {}, False
    for dataset in posterior.datasets:
        covered = np.maximum.accumulate(dataset.voltage) - np.minimum.accumulate(dataset.voltage)
        everywhere = int(np.searchsorted(covered, 0.9 * covered[-1]))
        last = max(everywhere, int(dataset.readings.rows[0])) + samples
        windows[dataset.name] = dataset.training
        if dataset.readings.samples > max(last, 2 * samples):
            cut = (slice(w.start, min(w.stop, last)) for w in dataset.training if w.start < last)
            windows[dataset.name], shorter = tuple(cut), True
    return posterior.with_training(windows) if shorter else posterior


def thin(dataset: Likelihood, stride: int) -> Likelihood:
    """Return every ``stride``-th sample of a record, with the extremes of its reversals.

    The voltage goes straight from one to the next, whatever it did between the record's samples.
    """
    if stride == 1:
        return dataset
    voltage = dataset.voltage[::stride].copy()
    for branch in [*monotone_stretches(voltage)][:-1]:
        position = stride * branch.last
        nearby = dataset.voltage[max(position - stride + 1, 0) : position + stride]
        voltage[branch.last] = nearby.max() if branch.direction > 0 else nearby.min()
    inputs = replace(dataset.inputs[::stride], voltage=voltage, voltage_is="output")
    actuator = replace(
        dataset.actuator.within(dataset.voltage), hold=inputs.hold, interval=inputs.interval
    )
    return replace(
        dataset,
        inputs=inputs,
        displacement=dataset.displacement[::stride],
        training=thin_windows(dataset.training, stride),
        actuator=actuator,
        noise=dataset.noise.at(inputs.interval),
    )


def with_residuals_of(short: Posterior, whole: Posterior, theta: FloatArray) -> Posterior:
    """Return a thinned posterior whose readings leave the residuals of the whole one.

    Those of one model θ (1, parameters): to the readings is added what thinning changes of the
    displacement, so that no other model gains from mending that.
    """
    readings = {}
    for thinned, dataset in zip(short.datasets, whole.datasets, strict=True):
        model = whole.table.of(theta, dataset.name)
        stride = round(thinned.inputs.interval / dataset.inputs.interval)
        before = displacement(whole, dataset, model)[0, ::stride]
        after = displacement(short, thinned, model)[0]
        readings[dataset.name] = dataset.displacement[::stride] + after - before
    return short.with_readings(readings)


def stride_of(short: Posterior, whole: Posterior) -> int:
    """Return the samples of a whole record for each of a thinned one."""
    return round(short.single_record.inputs.interval / whole.single_record.inputs.interval)


def thin_windows(windows: Iterable[slice], stride: int) -> tuple[slice, ...]:
    """Return where windows of a record (slices of its samples) are in a thinned one."""
    return tuple(slice(-(-w.start // stride), -(-w.stop // stride)) for w in windows)


def displacement(posterior: Posterior, dataset: Likelihood, theta: FloatArray) -> FloatArray:
    """Displacement (models, samples), um, from rest at θ (models, parameters) of a record."""
    likelihood = dataset.by(posterior.engine)
    return likelihood.simulate(likelihood.table.actuator(theta), dataset.inputs)
