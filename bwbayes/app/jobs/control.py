"""A fitted model at work: ``fit.compensate()``, ``fit.export()`` and ``fit.track()``.

The files of a compensation are the command as a record, ``command.csv``, which a signal generator
can play; the numbers, ``compensation.json``; everything along time, ``compensation.csv``; and a
page with pictures, ``compensation.html``. An export writes two: ``model.json`` has the parts, all
coefficients with units, and the linear part as matrices; ``actuator.c`` is the model and its
inverse, one sample a call. In a closed loop the posterior's draws are the actuators, on the virtual
test stand, and its mean is the model that a controller has.
"""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import suppress
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, Literal

import numpy as np

from bwbayes.app.fit.fitted import Run
from bwbayes.app.jobs.fit_methods import amplifier_limits, conditions_at
from bwbayes.app.study.from_config import open_like
from bwbayes.arrays import FloatArray
from bwbayes.control.compensation import Compensation, compensate as compensated
from bwbayes.control.exported import Exported, export_model
from bwbayes.control.loop import LoopNoise, Robustness, Stand
from bwbayes.control.references import SHAPES, Reference, build_reference
from bwbayes.control.tracking import Tracking, track as tracked
from bwbayes.diagnosis import extrapolation
from bwbayes.errors import InputError, suggestion
from bwbayes.model.actuator import Actuator
from bwbayes.model.inputs import Hold, parse_hold
from bwbayes.prediction.prediction import thin_draws
from bwbayes.record.io.formats import read_reference
from bwbayes.watching import WatchSteps, unwatched


def compensate(
    fit: Run,
    reference: Literal["sine", "triangle", "staircase", "raster"] | Any,
    *,
    amplitude: float | None = None,
    frequency: float | None = None,
    middle: float | None = None,
    periods: float | None = None,
    levels: int | None = None,
    interval: float | None = None,
    smoothed: float | None = None,
    command: Literal["mean", "expected"] = "mean",
    hold: str = "zoh",
    limit: float | None = None,
    from_rest: bool = False,
    voltage: tuple[float, float] | None = None,
    slew: float | None = None,
    current: float | None = None,
    capacitance: float | None = None,
    at: Mapping[str, str | float] | None = None,
    beyond_training: bool = False,
    nearest: bool = False,
    reading: Mapping[str, Any] | None = None,
    watch: WatchSteps = unwatched,
) -> Compensation:
    """Compute the voltage command for a reference displacement, and its predicted error.

    The displacement is in a file, or one of the usual shapes. 0 um is where the actuator stands at
    zero volts as the command begins, so the default voltages are those fitted and 0 V. The
    displacement that the voltage will cause is predicted with its error, beside that of a linear
    command. Exit status 3: the limit is exceeded more probably than not; 5: it is kept at less than
    95%.

    Parameters
    ----------
    fit
        The fit to use; the first of several records, and a thousand of the draws.
    reference
        The shape of the displacement. A file with time and displacement, in place of SHAPE. In
        Python also displacements (samples,), um, or the ``reference`` of an earlier command. One
        that begins elsewhere than at 0 um gets a way from there before it.
    amplitude
        Amplitude of the shape, um.
    frequency
        Frequency of the shape, or of a raster's lines, Hz.
    middle
        Middle of the shape, um; default: 0.
    periods
        Periods, or lines; default: 3.
    levels
        Steps of a staircase from the middle to either end; default: 5.
    interval
        Sampling interval of a shape, s; default: the record's.
    smoothed
        Smooths the reference, s (SD); default: a shape's 0.01 periods.
    command
        Inverse of the mean model, or least expected squared error over the draws.
    hold
        Voltage between samples: held, as a DAC does (zoh), or straight lines (foh). It need not be
        that of the record.
    limit
        Limit of the error, um; says how probably it is kept, and fails if it is not.
    from_rest
        The actuator starts demagnetized. Otherwise it has waited at zero volts, in a state of its
        hysteresis that nothing tells.
    voltage
        Lowest and highest voltage of the amplifier, V; default: what was fitted, and 0 V.
    slew
        Its fastest change of the voltage, V/s.
    current
        Its largest current, A; with the capacitance.
    capacitance
        The actuator's capacitance, F.
    at
        Constant value of a covariate that the model follows, as temperature_degC=25.
    beyond_training
        Allows voltages and covariates beyond those fitted, where nothing is known of the error.
    nearest
        If limits are exceeded, return the nearest feasible command.
    reading
        How the reference's file is read, as keyword arguments of ``read_record``: columns, units,
        fs, table; default: as the training record was, if its columns are the same.
    watch
        Called with the name of a step and the share of it that is done.

    Raises
    ------
    NotConvergedError
        The sampling has not converged.
    InputError
        A reference that cannot be used or reached, or voltages beyond those fitted.

    Warns
    -----
    InputWarning
        A reference that was smoothed or led to, a command beyond what was fitted.

    Examples
    --------
    ``fit.compensate("sine", amplitude=40, frequency=1, from_rest=True)`` is what this writes::

        bwbayes compensate results/ring_bender sine --amplitude 40 --frequency 1 --from-rest
    """
    study = fit.study
    limits = amplifier_limits(
        study, voltage, slew, current, capacitance, beyond_training=beyond_training
    )
    shape = {"amplitude": amplitude, "frequency": frequency, "middle": middle, "periods": periods}
    options = shape | {"levels": levels, "interval": interval, "smoothed": smoothed}
    options = {name: value for name, value in options.items() if value is not None}
    read_as = next(iter(fit.config.records.values())).read_as
    desired = _reference(reference, study.record.interval, options, read_as, reading)
    _, alone, of_record = next(study.posterior.each(fit.flat_draws))
    command_from = partial(
        compensated,
        alone,
        reference=desired,
        command=command,
        hold=parse_hold(hold),
        limits=limits,
        nearest=nearest,
        limit=limit,
        conditions=conditions_at(study, at, beyond_training=beyond_training),
        instruments=study.record.instruments,
    )
    draws, source = thin_draws(of_record, study.generator("draws")), f"compensate {desired.name}"
    compensation = command_from(
        draws=draws,
        generator=study.generator(source),
        from_rest=from_rest,
        watch=partial(watch, "predicted error"),
    )
    extrapolations = extrapolation.beyond_training(alone, compensation.record.inputs)
    remarks = [*compensation.remarks, *(finding.note for finding in extrapolations)]
    if not from_rest:
        # A voltage that exists from some states need not exist from rest.
        with suppress(InputError):
            rested = command_from(
                draws=draws[::4], generator=study.generator(source), from_rest=True
            )
            remarks += _from_rest_remark(compensation, rested)
    if compensation.shortfall:
        remarks.insert(0, compensation.shortfall)
    return replace(compensation, remarks=tuple(remarks), standing=fit.standing)


def _from_rest_remark(waited: Compensation, rested: Compensation) -> list[str]:
    """Say what declaring that a command starts from rest would change, if that is half the error.

    Otherwise say nothing: it hardly matters.
    """
    unknown, error_from_rest = (
        float(np.mean(compensation.compensated.largest)) for compensation in (waited, rested)
    )
    if error_from_rest > 0.5 * unknown:
        return []
    return [
        f"the command starts at 0 V after any drive: the largest error is {unknown:.3g} um in the "
        f"mean, but {error_from_rest:.3g} um if the actuator is demagnetized, which "
        "from_rest (--from-rest) declares"
    ]


def _reference(
    requested: Any,
    interval: float,
    options: Mapping[str, Any],
    read_as: dict[str, Any] | None,
    reading: Mapping[str, Any] | None,
) -> Reference:
    """Return a reference: one that is made already, a shape, a file's, or displacements.

    ``interval`` is that of samples where nothing says it, s; ``read_as`` how the record's file was
    read, and ``reading`` what the user says of this one. Refused are options that it cannot have.
    """
    shapes = ", ".join(SHAPES)
    if isinstance(requested, str) and requested in SHAPES:
        for name, unit in (("amplitude", "um"), ("frequency", "Hz")):
            if name not in options:
                raise InputError(f"{requested}: has no {name}; give it, in {unit}")
        return build_reference(requested, **{"interval": interval, **options})
    is_file, is_made = isinstance(requested, str | Path), isinstance(requested, Reference)
    kind, allowed = "displacements take", {"smoothed", "interval"}
    if is_made or is_file:
        kind = "one that is made already takes" if is_made else "a file takes"
        allowed = {"smoothed"} if is_file else set()
    for name in options.keys() - allowed:
        raise InputError(f"reference: {kind} no {name}; leave it out, or give one of {shapes}")
    if isinstance(requested, Reference):
        return requested
    smoothed = options.get("smoothed", 0.0)
    if is_file:
        path = Path(requested)
        if isinstance(requested, str) and not path.suffix and not path.exists():
            hint = suggestion(requested, SHAPES)
            raise InputError(f"reference: {requested!r} is neither a shape nor a file; {hint}")
        source, naming, _ = open_like(path, read_as, reading)
        values, interval = read_reference(source, naming)
        return Reference(values, interval, path.stem, smoothed)
    try:
        values = np.asarray(requested, dtype=np.float64)
    except (TypeError, ValueError):
        values = np.empty(())
    if values.ndim == 0:
        type_name = type(requested).__name__
        raise InputError(
            f"reference: {type_name} is none; give one of {shapes}, a file, or displacements in um"
        )
    return Reference(values, options.get("interval", interval), smoothed=smoothed)


def export(
    fit: Run,
    folder: str | Path | None = None,
    *,
    voltage: tuple[float, float] | None = None,
    slew: float | None = None,
    current: float | None = None,
    capacitance: float | None = None,
    at: Mapping[str, str | float] | None = None,
    beyond_training: bool = False,
    rate: float | None = None,
    hold: str = "zoh",
    overwrite: bool = False,
    watch: WatchSteps = unwatched,
) -> Exported:
    """Write the model for a controller: JSON, and C with its inverse.

    It is the posterior's mean, in um and V as the sensors read them; the SDs in the JSON count what
    their scales are worth. The C file needs math.h alone and does a sample a call; its head
    says which sample, and what a value does that is not a number. 0 um is where the demagnetized
    actuator stands at zero volts.

    Parameters
    ----------
    fit
        The fit to use; the first of several records, as what belongs to a record matters little
        to a controller.
    folder
        Where the files go, ``model.json`` and ``actuator.c``; by default nothing is written.
    voltage
        Lowest and highest voltage of the inverse, V; default: what was fitted, and 0 V.
    slew
        Fastest change of the inverse's voltage, V/s.
    current
        The amplifier's largest current, A, which limits that change; with the capacitance.
    capacitance
        The actuator's capacitance, F.
    at
        Constant value of a covariate that the model follows, as temperature_degC=25.
    beyond_training
        Allows voltages and covariates beyond those fitted, where nothing is known of the error.
    rate
        The controller's samples a second; default: the record's.
    hold
        Voltage between samples: held, as a DAC does (zoh), or straight lines (foh). The latter is
        for a model beside a measured voltage; neither need be that of the record. With zoh the
        inverse is for the next sample: forward of inverse is one sample late.
    overwrite
        Replace existing files.
    watch
        Called with the name of a step and the share of it that is done.

    Raises
    ------
    NotConvergedError
        The sampling has not converged.
    InputError
        A hysteresis that has no step of bounded time, voltages beyond those fitted, options that
        make no sense, or files that exist or cannot be written.

    Examples
    --------
    ``fit.export("controller", rate=1000)`` returns the model, its ``linear`` part as a discrete
    ``scipy.signal`` system, and writes what this writes::

        bwbayes export results/ring_bender --rate 1000
    """
    study, posterior = fit.study, fit.study.posterior
    dataset = posterior.datasets[0]

    def of_actuator(draws: FloatArray) -> FloatArray:
        theta = posterior.table.of(posterior.prior.theta(draws), dataset.name)
        return dataset.table.actuator(theta)

    read = fit.flat_draws
    conditions = conditions_at(study, at, beyond_training=beyond_training)
    actuator = at_rate(dataset.actuator, rate, parse_hold(hold), conditions)
    true_sds = of_actuator(study.true_draws(read)).std(axis=0)
    sds = dict(zip(actuator.parameters, true_sds.tolist(), strict=True))
    name = fit.config.name or study.record.origin
    limits = amplifier_limits(
        study, voltage, slew, current, capacitance, beyond_training=beyond_training
    )
    model = replace(
        export_model(name, actuator, of_actuator(read).mean(axis=0), limits, sds),
        standing=fit.standing,
        instruments=study.record.instruments,
    )
    if folder is not None:
        model.save(folder, overwrite=overwrite, watch=partial(watch, "files"))
    return model


def at_rate(
    actuator: Actuator, rate: float | None, hold: Hold, conditions: Mapping[str, float]
) -> Actuator:
    """Return an actuator at a controller's pace: samples a second up to 10 MHz, with this hold.

    Raises InputError: a rate that is not above zero, or is too high.
    """
    if rate is not None and not 0 < rate <= 1e7:
        raise InputError(f"rate: {rate:g} Hz; give a number above 0 and up to {1e7:g}")
    interval = actuator.interval if rate is None else 1 / rate
    return replace(actuator, interval=interval, hold=hold, conditions=conditions)


def track(
    fit: Run,
    *,
    frequencies: tuple[float, ...] | None = None,
    amplitude: float | None = None,
    voltage: tuple[float, float] | None = None,
    slew: float | None = None,
    current: float | None = None,
    capacitance: float | None = None,
    at: Mapping[str, str | float] | None = None,
    beyond_training: bool = False,
    rate: float = 1000.0,
    delay: int = 1,
    gain_margin: float = 2.0,
    phase_margin: float = 60.0,
    draws: int = 200,
    watch: WatchSteps = unwatched,
) -> Tracking:
    """Simulate closed-loop tracking: open loop, feedforward, PID, and both.

    On the virtual test stand, with every draw of the posterior for actuator, and the paper's
    signals: a linear command, the mean model's inverse (feedforward), a PID controller, and both
    together. 0 um is where the demagnetized actuator stands at zero volts; the default voltages
    are those fitted and 0 V.

    Parameters
    ----------
    fit
        The fit to use; the first of several records.
    frequencies
        Frequency of the references, Hz; may be given again; default: 0.1 Hz to where dynamics
        matter.
    amplitude
        Amplitude of the references, um; default: 80% of the mean model's reach.
    voltage
        Lowest and highest voltage of the amplifier, V; default: what was fitted, and 0 V.
    slew
        Its fastest change of the voltage, V/s; at most the stand's.
    current
        Its largest current, A; with the capacitance.
    capacitance
        The actuator's capacitance, F.
    at
        Constant value of a covariate that the model follows, as temperature_degC=25.
    beyond_training
        Allows voltages and covariates beyond those fitted, where nothing is known of the error.
    rate
        Samples a second.
    delay
        Whole samples from a reading to the command that answers it.
    gain_margin
        Gain margin that all draws keep, a factor.
    phase_margin
        Phase margin that all draws keep, degrees.
    draws
        Simulated actuators. The margins hold for a thousand draws.
    watch
        Called with the name of a step and the share of it that is done.

    Raises
    ------
    NotConvergedError
        The sampling has not converged.
    InputError
        A model that cannot be stepped or inverted, voltages beyond those fitted, or options that
        make no sense.

    Examples
    --------
    ::

        bwbayes track results/ring_bender --frequency 1 --frequency 10
    """
    if not 0 <= delay <= 100:
        raise InputError(f"delay: {delay} samples; give 0 to 100")
    if draws < 2:
        raise InputError(f"draws: {draws} is too few for an uncertainty estimate; use at least 2")
    study, posterior = fit.study, fit.study.posterior
    dataset = posterior.datasets[0]
    free = fit.subset
    theta = posterior.table.of(posterior.prior.theta(free), dataset.name)
    alone = posterior.for_record(dataset.name)
    parameters = alone.noise_of_new(theta[:draws])
    limits = amplifier_limits(
        study, voltage, slew, current, capacitance, beyond_training=beyond_training
    )
    conditions = conditions_at(study, at, beyond_training=beyond_training)
    instruments, count = study.record.instruments, len(parameters)
    rng = study.generator("instruments")
    displacements = instruments.displacements(count, alone.single_record.extent, rng)

    def true(read: FloatArray) -> FloatArray:
        return displacements(slice(None), read.reshape(-1, count).T).T.reshape(read.shape)

    tracking = tracked(
        at_rate(dataset.actuator, rate, "zero", conditions),
        dataset.table.actuator(theta[:draws]),
        LoopNoise(dataset.noise, parameters),
        Stand(limits, delay),
        study.generator("track"),
        robustness=Robustness(gain_margin, phase_margin),
        frequencies=frequencies or None,
        amplitude=amplitude,
        all_theta=dataset.table.actuator(theta),
        true=true,
        watch=watch,
    )
    name = fit.config.name or study.record.origin
    return replace(tracking, standing=fit.standing, name=name, instruments=instruments)
