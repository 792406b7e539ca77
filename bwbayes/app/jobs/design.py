"""Experimental design: ``fit.design()``.

Candidates come from a file, a table of a signal each, or are a preset within the amplifier's
limits. They are ranked by what they would leave of a parameter's standard deviation, of a parameter
band's width along a drive, or of what rivals of the model differ by.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import ValidationError

from bwbayes.app.config.config import SignalConfig, read_toml
from bwbayes.app.config.keys import one_line
from bwbayes.app.fit.fitted import Run
from bwbayes.app.jobs.fit_methods import fitted_voltages
from bwbayes.app.study.from_config import open_like, sampled_waveform
from bwbayes.arrays import ArrayLike, FloatArray
from bwbayes.comparison.design import Design, DesignScore, RivalDesign, rank_by_rivals, rank_designs
from bwbayes.diagnosis.extrapolation import PART
from bwbayes.errors import InputError
from bwbayes.model.inputs import Limits, fastest, time_between_turns, turning_points
from bwbayes.record import Record
from bwbayes.record.io.formats import read_named
from bwbayes.record.waveforms import (
    Carrier,
    Waveform,
    signal,
    signal_names,
    sine,
    staircase,
    triangle,
)
from bwbayes.watching import WatchSteps, unwatched


def design(
    fit: Run,
    target: str | Path | ArrayLike | None = None,
    *,
    validate: bool = False,
    candidates: Mapping[str, ArrayLike] | str | Path = "standard",
    voltage: tuple[float, float] | None = None,
    slew: float | None = None,
    current: float | None = None,
    capacitance: float | None = None,
    reading: Mapping[str, Any] | None = None,
    watch: WatchSteps = unwatched,
) -> Design | RivalDesign:
    """Rank input signals by the expected reduction in posterior SD.

    Each signal's score is the share of a parameter's standard deviation, or of a band's width along
    a drive, that one more record would leave. The best signal within the amplifier's limits goes
    into best.csv. With ``validate`` the signals tell the model from its rivals: validate.csv is a
    short next record along which these differ most, train.csv one that would tell them apart if it
    was fitted.

    Parameters
    ----------
    fit
        The fit to use.
    target
        The parameter to know better. Or the drive whose band is to be narrow: a record or a signal.
        In Python the ``Path`` of a record's file or of a signal's name, or voltages (samples,), V.
    validate
        Find records that tell the model from its rivals, by default within what training drove.
    candidates
        A TOML file with a table for each signal, or the preset. Its keys are those of a config's
        [record.signal]. In Python also voltages (samples,) by name, V, at the fitted record's
        interval (of several that whose voltage turns most), and starting as it does.
    voltage
        Lowest and highest voltage of the amplifier, V; default: what was fitted.
    slew
        Its fastest change of the voltage, V/s.
    current
        Its largest current, A; with the capacitance.
    capacitance
        The actuator's capacitance, F.
    reading
        How the drive's file is read, as keyword arguments of ``read_record``: columns, units, fs,
        table; default: as the training record was, if its columns are the same.
    watch
        Called with the name of a step and the share of it that is done.

    Raises
    ------
    NotConvergedError
        The sampling has not converged.
    InputError
        A target that is not a free parameter of the actuator, candidates that cannot be read, or
        none that the amplifier can make.

    Examples
    --------
    ``fit.design(validate=True)`` finds a record to validate on, and ``fit.design("beta",
    slew=2000)`` ranks as this does::

        bwbayes design results/ring_bender --parameter beta --slew 2000
    """
    if (target is None) is not validate:
        raise InputError("design: give either a parameter, a drive or `validate=True`")
    study = fit.study
    # Several records all tell of the actuator; the new one is to be like the one whose voltage
    # turns most.
    records = study.records
    record = max(records, key=lambda name: turning_points(records[name].path.voltage).size)
    measured, posterior = records[record], study.posterior.for_record(record)
    low, high = voltage or fitted_voltages(study)
    seconds = measured.duration
    if validate:
        # A short record, of ten periods, and as fast as the record's drive.
        seconds = min(seconds, 20 * time_between_turns(measured.voltage, measured.interval))
        path, interval = measured.path.voltage, measured.interval
        fast = fastest(path, interval, PART * time_between_turns(path, interval))
        slew = fast if slew is None else slew
    amplifier = Limits(low, high, np.inf if slew is None else slew, current, capacitance)
    signals = candidates_of(candidates, measured, amplifier, seconds)
    flat = study.posterior.select_draws(fit.flat_draws, record)
    rng, ranking = study.generator("design"), partial(watch, "candidates")
    parameter, drive = None, None
    kind: type[Design] = Design
    scores: Sequence[DesignScore]
    if validate:
        kind, alone = RivalDesign, study.for_record(record)
        rivals = fit.rivals(record, partial(watch, "rivals"))
        scores = rank_by_rivals(posterior, flat, alone, rivals, signals, amplifier, rng, ranking)
    else:
        quantity: str | FloatArray
        if isinstance(target, str):
            quantity = parameter = target
        elif isinstance(target, Path):
            read_as = fit.config.records[record].read_as
            quantity, drive = _drive(target, measured.interval, read_as, reading), str(target)
        else:
            quantity, drive = np.asarray(target, dtype=np.float64), "a voltage"
        scores = rank_designs(
            posterior, flat, signals, quantity, amplifier, rng, ranking,
            instruments=measured.instruments,
        )  # fmt: skip
    if scores[0].refused:
        raise InputError(
            f"design: the amplifier can make none of the candidates; {scores[0].name} "
            f"{scores[0].refused}"
        )
    name, interval = fit.folder.path.name, measured.interval
    return kind(name, parameter, drive, amplifier, signals, interval, fit.standing, scores)


def candidates_of(
    candidates: Mapping[str, ArrayLike] | str | Path,
    record: Record,
    amplifier: Limits,
    seconds: float,
) -> dict[str, FloatArray]:
    """Return the candidates' voltages (samples,) by name, V, at a record's interval.

    Those of the preset take so many ``seconds``.

    Raises InputError: a file that cannot be read, or has no signal.
    """
    if not isinstance(candidates, str | Path):
        return {name: np.asarray(v, dtype=np.float64) for name, v in candidates.items()}
    if str(candidates) == "standard":
        waveforms = _preset(record, amplifier, seconds)
    else:
        waveforms = {}
        for name, table in read_toml(Path(candidates)).items():
            try:
                waveforms[name] = sampled_waveform(SignalConfig.model_validate(table))
            except ValidationError as error:
                raise InputError(one_line(f"{candidates}: {name}", error, SignalConfig)) from None
            except InputError as error:
                raise InputError(f"{candidates}: {name}: {error}") from None
    if not waveforms:
        raise InputError(f"{candidates}: has no candidate; write a table for each signal")
    return {name: waveform.sample(1 / record.interval)[1] for name, waveform in waveforms.items()}


def _preset(record: Record, amplifier: Limits, seconds: float) -> dict[str, Waveform]:
    """Return sines and triangles, steady and decaying, small and slow, a multisine, a staircase.

    They last so many seconds, about the middle of the amplifier's range, and turn as often as
    its drive, or as often as the amplifier allows. A decaying one ends at a tenth of its amplitude.
    """
    half, center = (amplifier.high - amplifier.low) / 2, (amplifier.high + amplifier.low) / 2
    # A sine changes fastest, by 2π f times its amplitude.
    frequency = min(
        0.5 / time_between_turns(record.voltage, record.interval),
        amplifier.rate / (2 * np.pi * half),
    )
    carriers = {
        "steady sine": sine(half, frequency),
        "decaying sine": sine(half, frequency),
        "small steady sine": sine(half / 2, frequency),
        "slow steady sine": sine(half, frequency / 4),
        "slow decaying sine": sine(half, frequency / 4),
        "steady triangle": triangle(half, frequency),
        "decaying triangle": triangle(half, frequency),
    }
    # Reversals at all voltages: sines of frequencies that have no common period.
    golden = (np.sqrt(5) - 1) / 2
    frequencies = frequency * golden ** np.arange(3)

    def mean(time: FloatArray) -> FloatArray:
        """Return the mean of sines of one amplitude."""
        return np.asarray(np.mean(np.sin(2 * np.pi * np.outer(frequencies, time)), axis=0))

    peak = np.max(np.abs(mean(np.arange(0.0, seconds, record.interval))))
    carriers["multisine"] = Carrier(lambda time: half / peak * mean(time), float(frequency))
    levels = [half * factor for factor in (1, -1, 0.6, -0.6, 0.3, -0.3, 0.8, -0.2, 0.5, 0)]
    dwell = seconds / len(levels)
    if 2 * half <= dwell * amplifier.rate:
        carriers["staircase"] = staircase(levels, dwell, amplifier.rate)
    fading = 0.9 / seconds
    return {
        name: Waveform(carrier, seconds, decay=fading if "decaying" in name else 0.0, bias=center)
        for name, carrier in carriers.items()
    }


def _drive(
    path: Path,
    interval: float,
    read_as: dict[str, Any] | None,
    reading: Mapping[str, Any] | None,
) -> FloatArray:
    """Return the voltage of a signal's name or of a record's file, at an interval."""
    if str(path) in signal_names():
        return signal(str(path)).sample(1 / interval)[1]
    record = read_named(*open_like(path, read_as, reading), need_displacement=False)
    if np.isclose(record.interval, interval, rtol=1e-6):
        return record.voltage
    samples = np.arange(0.0, record.duration, interval) / record.interval
    return np.interp(samples, np.arange(record.samples), record.voltage)
