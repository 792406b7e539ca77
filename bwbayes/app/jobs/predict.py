"""Bands for another record, a planned voltage or a signal: ``fit.predict()``."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from bwbayes.app.fit.fitted import Run
from bwbayes.app.running.predictions import Prediction, predict_after, predict_another
from bwbayes.app.study.records import open_like
from bwbayes.errors import InputError, path_text, suggestion
from bwbayes.inference.study import InitialConditions, Validation
from bwbayes.record import Record
from bwbayes.record.io.formats import read_named
from bwbayes.record.waveforms import signal as named_signal
from bwbayes.watching import WatchSteps, unwatched


def predict(
    fit: Run,
    record: Record | str | Path | None = None,
    *,
    signal: str | None = None,
    name: str | None = None,
    table: int | str | None = None,
    displacement_file: str | Path | None = None,
    window: tuple[float, float] | None = None,
    from_rest: bool = False,
    estimate_offset: bool = True,
    lead_in: float | None = None,
    lead_in_start: float | None = None,
    after: bool = False,
    of: str | None = None,
    reading: Mapping[str, Any] | None = None,
    watch: WatchSteps = unwatched,
) -> Prediction:
    """Predict displacement bands for another record or voltage.

    A record of the same columns as the run's is read as that was. Beside the bands, their scores
    (JSON) and a figure. Exit status 3: validation failed on the record; 5: it is inconclusive.

    Parameters
    ----------
    fit
        The fit to use.
    record
        The record to predict, measured or a voltage alone, or its file; at any sampling interval.
        A file of the same columns as that of the training record is read as that was. A voltage
        without readings is a plan, and drives the model as it is, noise included.
    signal
        A signal to predict instead, by its name.
    name
        Name of the bands; by default the file's or the signal's, or "prediction".
    table
        Table to read from a file with several: its number, from 1 on, or its title.
    displacement_file
        The file with the displacement, if the record's has the voltage alone.
    window
        Judge and write this part of the record alone: start and stop, s.
    from_rest
        The record starts from a demagnetized actuator.
    estimate_offset
        The sensor has an offset in the record that is estimated anew.
    lead_in
        Length of the lead-in, s, that estimates initial state and offset; default: a quarter of the
        record, and ten correlation times of the discrepancy at most.
    lead_in_start
        Where the lead-in begins, s; default: the record's start.
    after
        A forecast: condition the discrepancy on the lead-in or, with a signal, on the training
        record, behind which the signal follows.
    of
        Training record whose per-record parameters to use; default: the first.
    reading
        How the record's file is read, as keyword arguments of ``read_record``: columns, units, fs;
        default: as the training record was, if its columns are the same.
    watch
        Called with the name of a step and the share of it that is done.

    Raises
    ------
    NotConvergedError
        The sampling has not converged.
    InputError
        A lead-in or window that does not fit into the record.

    Warns
    -----
    InputWarning
        A drive beyond what was fitted; bands that do not hold, with the likeliest cause.

    Examples
    --------
    ``fit.predict("new.csv", lead_in=2.0).save("new_bands.csv")`` writes what this writes::

        bwbayes predict results/ring_bender --record new.csv --lead-in 2
    """
    if (record is None) == (signal is None):
        raise InputError("predict: give either a record or a signal")
    if lead_in is not None and not 0 < lead_in < math.inf:
        raise InputError(
            f"predict: a lead-in of {lead_in:g} s is not a positive length of time; give another"
        )
    study, watching, hints = fit.study, partial(watch, "predictions"), list[str]()
    held_out = fit.predictions if fit.standing.passed is False else ()
    of = of or next(iter(study.records))
    if of not in study.records:
        hint = suggestion(of, study.records)
        raise InputError(f"predict: no training record {of!r}; {hint}")
    if signal is not None:
        name, interval = name or signal, study.records[of].interval
        voltage = named_signal(signal).sample(1 / interval)[1]
        if after and window is not None:
            raise InputError(
                "predict: a window is for a record; what comes after the training record is "
                "predicted whole"
            )
        if after:
            prediction = predict_after(fit, voltage, name, of, watching, held_out)
            return replace(prediction, run_validation=fit.standing)
        record = Record(voltage, None, interval=interval, origin=f"{signal} signal")
    elif not isinstance(record, Record | str | Path):
        raise InputError(
            f"predict: {type(record).__name__} is no record; give a file, or "
            "`Record.from_arrays(voltage, interval=...)`"
        )
    elif not isinstance(record, Record):
        name = name or path_text(Path(record).stem)
        file, read_as = Path(record), fit.config.records[of].read_as
        reading = {"table": table, "displacement_file": displacement_file, **(reading or {})}
        record = read_named(*open_like(file, read_as, reading), need_displacement=False)
        if record.displacement is None:
            hints.append(
                f"{file}: has no displacement that is recognized, so the bands are not validated; "
                "if a column is one, say --column displacement=NAME"
            )
    record = record.like(study.records[of])
    record = record.without_values(fit.config.records[of].missing or ())
    hold = fit.config.model.hold
    declared_hold = None if hold == "auto" else hold
    start = InitialConditions(
        from_rest, estimate_offset, lead_in, lead_in_start, declared_hold, after
    )
    other = Validation((), record, start, window, of)
    prediction = predict_another(fit, other, name or "prediction", watching, held_out)
    is_said = any("--from-rest" in remark for remark in prediction.remarks)
    if record.displacement is None and not (from_rest or after or is_said):
        width = prediction.upper["sensor", 95] - prediction.lower["sensor", 95]
        hints.append(
            "the state that the actuator starts from is unknown: the 95% sensor band is "
            f"{width[0]:.3g} um wide at first, {np.median(width):.3g} um in the median; if it is "
            "demagnetized, say --from-rest"
        )
    return replace(prediction, hints=tuple(hints), run_validation=fit.standing)
