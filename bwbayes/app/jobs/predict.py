"""Predictions of a run: its windows, the records it holds out, and any other one.

:func:`predictions` predicts what a config names, :func:`predict_another` any record or planned
voltage, :func:`predict_after` what follows on a training record; what comes of them is judged by
the readings, if there are any. Rivals of the model, if it has any, widen the bands of unlike
drives, by what they differ from the model as it was fitted. Random numbers hang on the data alone:
the same record under another name gets the same bands.

``fit.predict()`` gives bands for another record, a planned voltage or a signal.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from itertools import pairwise, zip_longest
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from bwbayes.app.fit.fitted import Run
from bwbayes.app.study.from_config import open_like
from bwbayes.arrays import FloatArray
from bwbayes.diagnosis.extrapolation import beyond_training, unexcited_note
from bwbayes.diagnosis.finding import Finding
from bwbayes.diagnosis.residual_analysis import Explanation
from bwbayes.diagnosis.rivals import Rival, disagreement
from bwbayes.diagnosis.validation import (
    BandValidation,
    ValidationSummary,
    validate_bands,
)
from bwbayes.errors import ExitStatus, InputError, Renamed, path_text, refuse_unwritable, suggestion
from bwbayes.inference.posterior import Posterior
from bwbayes.inference.prior_creep import add_prior_creep
from bwbayes.inference.study import InitialConditions, Study, Validation
from bwbayes.model.spec import ModelSpec

# The fields that Prediction inherits are read where it stands.
from bwbayes.prediction.bands import Bands, Correction, Kind, LeadIn, correct  # noqa: F401
from bwbayes.prediction.prediction import (
    continue_record,
    forecast,
    predict_record,
    predict_windows,
)
from bwbayes.record.io.formats import read_named
from bwbayes.record.io.grid import clock
from bwbayes.record.record import Record
from bwbayes.record.voltage_path import estimate_path
from bwbayes.record.waveforms import signal as named_signal
from bwbayes.report.figures import draw_styled, picture_of
from bwbayes.report.report import (
    Block,
    Figure,
    Product,
    Report,
    Text,
    remarks_banner,
    standing_banner,
)
from bwbayes.report.result import refuse_existing, write_bands, write_summary
from bwbayes.report.run import correction_texts, rivals_table, scores_table
from bwbayes.watching import Watch, WatchSteps, part, unwatched


@dataclass(frozen=True, eq=False, repr=False)
class Prediction(Product, Bands):
    """Bands of one record or window, and how they turned out.

    ``validation`` holds the bands against the readings and is None without any; ``remarks`` say
    where the drive leaves what was fitted, ``hints`` what may be known of it and was not stated;
    ``run_validation`` is that of the run's own bands. All else is as of :class:`bwbayes.Bands`.
    """

    NAME: ClassVar[str] = "prediction"

    validation: BandValidation | None = None
    remarks: tuple[str, ...] = ()
    hints: tuple[str, ...] = ()
    run_validation: ValidationSummary | None = None

    holds, verdict = Renamed("passed"), Renamed("validation")

    @property
    def passed(self) -> bool | None:
        """Whether the bands hold on the readings; None if that cannot be told."""
        return None if self.validation is None else self.validation.passed

    @property
    def standing(self) -> ValidationSummary:
        """Whether the bands hold, as one carries that along."""
        return ValidationSummary.of([self.validation] if self.validation else [])

    @property
    def exit_status(self) -> ExitStatus:
        """The exit status of its command, unless the run's validation is worse."""
        return self.standing.exit_status

    @property
    def notes(self) -> list[str]:
        """Notes on the bands: where the drive extrapolates, and what does not hold."""
        return [*(f"{self.name}: {remark}" for remark in self.remarks), *self.standing.messages]

    @property
    def residuals(self) -> FloatArray:
        """Readings less the mean, (samples,), um; nan where there is no reading."""
        measured = np.full(self.mean.size, np.nan) if self.measured is None else self.measured
        residuals: FloatArray = measured - self.mean
        return residuals

    def to_pandas(self) -> Any:
        """Return the bands as a pandas.DataFrame with the columns of ``bands.csv``."""
        import pandas as pd  # noqa: PLC0415  # slow to load, and only needed here

        return pd.DataFrame({self.quantities.heading(n): v for n, v in self.columns()})

    def plot(self) -> Figure:
        """Draw the bands along time: voltage, displacement, and the residuals off the mean."""
        from bwbayes.report.figures.series import draw_bands  # noqa: PLC0415  # slow to load

        return draw_styled(draw_bands, self, quantities=self.quantities)

    def numbers(self) -> dict[str, object]:
        """Return what ``bwbayes predict`` writes beside the bands: scores, validation, remarks."""
        held: dict[str, object] = (
            {"passed": None} if self.validation is None else self.validation.summary
        )
        return {
            "name": self.name,
            "from_s": float(self.time[0]),
            "to_s": float(self.time[-1] + self.interval),
            "samples": self.time.size,
            "remarks": list(self.remarks),
            "model_error_sd_um": self.model_error_sd,
            "lead_in": None if self.lead_in is None else asdict(self.lead_in),
            "correction": None if self.correction is None else asdict(self.correction),
            "scores": None if self.scores is None else self.scores.numbers,
            **held,
        }

    def report(self) -> Report:
        """Return how the prediction turned out, and what to know of it."""
        blocks, notes, name = (
            list[Block](),
            self.validation.notes if self.validation else (),
            self.name,
        )
        if self.scores is not None and self.validation is not None:
            blocks.append(scores_table({name: self.scores}, {name: self.validation}, {name: name}))
        blocks += rivals_table([self])
        blocks += correction_texts([self])
        if self.passed:
            blocks.append(Text(f"{name}: validation passed for drives like this one", on="both"))
        of_run = standing_banner(self.run_validation) if self.run_validation else []
        remarks = remarks_banner([*self.remarks, *notes])
        banners = [*of_run, *remarks_banner(self.hints), *standing_banner(self.standing), *remarks]
        return Report(title=name, banners=banners, blocks=blocks)

    @classmethod
    def files(cls, path: Path) -> list[Path]:
        """Return the files of bands in a CSV: that, their scores (JSON), and a figure.

        Raises InputError: another suffix than that of a table.
        """
        files = [path, path.with_suffix(".json"), path.with_suffix(".png")]
        if path in files[1:]:
            raise InputError(f"{path}: the bands are a table; give a name that ends in .csv")
        return files

    def save(
        self, path: str | Path, *, overwrite: bool = False, watch: Watch = unwatched
    ) -> list[Path]:
        """Write the bands to a CSV, scores (JSON) and a figure beside it, and return the files.

        ``watch`` is called with the share that is done.

        Raises
        ------
        InputError
            A file that exists, unless it may be replaced, or that cannot be written.
        """
        table, numbers, picture = files = self.files(Path(path))
        refuse_existing(files, overwrite=overwrite)
        with refuse_unwritable(table):
            table.parent.mkdir(parents=True, exist_ok=True)
            write_bands(table, [self], part(watch, 0.0, 0.8), self.quantities)
            standing = self.run_validation
            summary = self.numbers() | {"run_validation": standing and standing.numbers}
            write_summary(numbers, self.quantities.rendered(summary))
            picture.write_bytes(picture_of(self.plot))
            watch(1.0)
        return files

    @property
    def heading(self) -> str:
        """Name, times and width of the sensor band."""
        first, last = (
            clock(time, self.interval) for time in (self.time[0], self.time[-1] + self.interval)
        )
        return (
            f"prediction {self.name}: {self.time.size} samples from {first} to {last} s; "
            f"the 95% sensor band is {self.width():.3g} um wide"
        )


def predict_another(
    run: Run,
    other: Validation,
    name: str,
    watch: Watch = unwatched,
    held_out: Iterable[Bands] = (),
) -> Prediction:
    """Predict another record, or a planned voltage without a measurement, and judge it.

    The ``other`` record may have any sampling interval; ``name`` is that of the bands. ``watch`` is
    called with the share that is done. The correction of a drive like it is that of the run's
    ``held_out`` bands.

    Raises InputError: a lead-in or window that does not fit into the record.
    """
    assert other.record is not None
    watch(0.0)
    beyond = beyond_training(run.study.posterior, other.record.inputs)
    bands = _of_another(run, run.subset, other, name, beyond, part(watch, 0.0, 0.8))
    validation = validate_bands(bands, run.background, beyond=beyond)
    bands = bands.with_scores(run.background.extent)
    from_rest_note = _from_rest_remark(run, other, bands, beyond)
    watch(1.0)
    noise = other.record.path.remark or planned_noise(other.record)
    held = _held_lead_in_remark(run.study.spec, other, bands)
    notes = (noise, from_rest_note, held, *_notes(bands, beyond))
    remarks = tuple(note for note in notes if note)
    if validation is None or not validation.passed:
        bands = replace(bands, correction=_of_drives_alike(run, held_out, beyond))
    return Prediction(**vars(bands), validation=validation, remarks=remarks)


def correct_failed(run: Run, bands: Sequence[Bands]) -> tuple[Bands, ...]:
    """Return bands, those of held-out readings that fail validation with their correction."""
    held_out = [predicted for predicted in bands if not predicted.training]
    validation = validate_predictions(run, held_out, {})
    failed = {name for name, outcome in validation.items() if outcome.passed is False}
    return tuple(
        replace(predicted, correction=correct(predicted)) if predicted.name in failed else predicted
        for predicted in bands
    )


def _of_drives_alike(
    run: Run, held_out: Iterable[Bands], beyond: Iterable[Finding]
) -> Correction | None:
    """Return the widest correction of held-out bands whose drive leaves training in the same ways.

    None if there is none, or they cannot be corrected.
    """
    ways = {finding.kind for finding in beyond}
    alike = [
        (bands.correction.factor, bands.correction)
        for bands in held_out
        if bands.correction is not None and bands.correction.factor is not None
        if {finding.kind for finding in run.extrapolations.get(bands.name, ())} == ways
    ]
    return max(alike, key=lambda pair: pair[0], default=(0.0, None))[1]


def _notes(bands: Bands, beyond: Iterable[Finding]) -> tuple[str, ...]:
    """Say where a drive leaves that of training, and by how much its bands are wider for that."""
    notes = (bands.model_error_note, unexcited_note(beyond), *(finding.note for finding in beyond))
    return tuple(note for note in notes if note)


def planned_noise(record: Record) -> str:
    """Say that a planned voltage looks like a measured one; nothing of any other."""
    if record.displacement is not None or record.voltage_is == "command":
        return ""
    sd = estimate_path(record.voltage).noise_sd
    if sd == 0:
        return ""
    return (
        f"voltage without readings drives the model as it is, with noise of {sd:.2g} V SD; if it "
        "was measured, give the command"
    )


def _from_rest_remark(run: Run, other: Validation, bands: Bands, beyond: Iterable[Finding]) -> str:
    """Say what it would change to declare a record from rest.

    The text is empty if the record cannot start so, or if width and coverage stay the same to a
    tenth. The change is computed from every fourth draw.
    """
    record, start = other.record, other.start
    assert record is not None
    if start.from_rest or start.after or not record.starts_at_zero:
        return ""
    rested = replace(other, start=replace(start, from_rest=True))
    declared = _of_another(run, run.subset[::4], rested, bands.name, beyond)
    scored = slice(max(bands.scored_from, declared.scored_from), None)
    widths, shares = [], []
    for predicted in (bands, declared):
        lower, upper = predicted.lower["sensor", 95], predicted.upper["sensor", 95]
        widths.append(float(np.mean((upper - lower)[scored])))
        if bands.measured is not None:
            inside = predicted.covers("sensor", 95, bands.measured)[scored]
            shares.append(float(np.mean(inside[np.isfinite(bands.measured[scored])])))
    if np.allclose(widths[0], widths[1], rtol=0.1) and np.ptp(shares or [0.0]) < 0.1:
        return ""
    covers = [f" and covers {share:.1%}" for share in shares]
    texts = zip_longest(widths, covers, fillvalue="")
    unknown, at_rest = (f"{width:.3g} um wide{cover}" for width, cover in texts)
    return (
        f"the record starts at 0 V, perhaps from rest: the 95% sensor band is {unknown}; "
        f"{at_rest} if the actuator was demagnetized and nothing moved, which --from-rest declares"
    )


def _held_lead_in_remark(spec: ModelSpec, other: Validation, bands: Bands) -> str:
    """Say that a lead-in whose voltage stays where it is tells little, where it is to tell a state.

    A twentieth of the range is hardly a motion; one of a quarter shows by how much loops open.
    """
    record, lead = other.record, bands.lead_in
    assert record is not None
    is_known = other.start.from_rest or spec.operator.name == "linear"
    if lead is None or is_known or not other.start.estimate_offset:
        return ""
    voltage, extent = record.path.voltage, float(np.ptp(record.path.voltage))
    first, last = np.searchsorted(record.time, [lead.start, lead.stop]).tolist()
    if np.ptp(voltage[first:last]) >= 0.05 * extent:
        return ""
    moved = np.abs(voltage[first:] - voltage[first]) > 0.25 * extent
    length = float(record.time[first + int(np.argmax(moved))]) - lead.start
    longer = f"; take --lead-in {2 * length:.2g}" if 2 * length < record.duration / 2 else ""
    return (
        f"the lead-in of {record.clock(lead.start)} to {record.clock(lead.stop)} s is only a hold, "
        f"which tells little: what earlier drives have left looks like an offset there{longer}"
    )


def predict_after(
    run: Run,
    voltage: FloatArray,
    name: str,
    of: str,
    watch: Watch = unwatched,
    held_out: Iterable[Bands] = (),
) -> Prediction:
    """Predict what follows on a training record whose last sample goes on into a planned voltage.

    ``voltage`` is (samples,), V, at the record's interval; ``of`` the record's name. All else is as
    in :func:`predict_another`; see :func:`~bwbayes.prediction.prediction.forecast`.
    """
    watch(0.0)
    study, record = run.study, run.study.records[of]
    longer, after = continue_record(record, voltage), slice(record.samples, None)
    beyond = beyond_training(study.posterior, longer.inputs, after)
    planned = Record(voltage, None, interval=record.interval)
    source = study.generator(f"forecast {planned.sha256}")
    alone, own_draws = reaching(study, run.subset, of, longer, beyond)

    def follow(posterior: Posterior, draws: FloatArray, rng: np.random.Generator) -> Bands:
        return forecast(posterior, draws, record, voltage, rng)

    rivals = run.widening_rivals(of, part(watch, 0.0, 0.5)) if beyond else None
    error = _model_error_sd(study, rivals, run.subset, of, planned, follow)
    predicting = part(watch, 0.0 if error is None else 0.5, 1.0)
    bands = forecast(alone, own_draws, record, voltage, source, name, predicting, error)
    bands = replace(bands, correction=_of_drives_alike(run, held_out, beyond))
    return Prediction(**vars(bands), remarks=_notes(bands, beyond))


def predictions(run: Run, watch: Watch = unwatched, *, training: bool = True) -> tuple[Bands, ...]:
    """Predict everything held out, and the ``training`` windows of all records.

    ``watch`` is called with the share that is done.
    """
    study, bands = run.study, list[Bands]()
    samples = [r.samples for r in (*study.records.values(), *study.others.values())]
    shares = np.cumsum([0, *samples]) / sum(samples)
    watches = (part(watch, *edges) for edges in pairwise(shares.tolist()))
    for name, alone, own_draws in study.posterior.each(run.subset):
        predicting = next(watches)
        windows = study.windows(name) if training else study.held_out(name)
        if windows:
            record = study.records[name]
            # By content: the same record under another name gets the same bands.
            source = study.generator(f"predict {record.sha256}")
            bands += predict_windows(alone, own_draws, record, windows, source, predicting)
    for name, held_out in study.validations.items():
        if held_out.record is not None:
            beyond, predicting = run.extrapolations[name], next(watches)
            bands.append(_of_another(run, run.subset, held_out, name, beyond, predicting))
    watch(1.0)
    return tuple(predicted.with_scores(run.background.extent) for predicted in bands)


def _of_another(
    run: Run,
    draws: FloatArray,
    other: Validation,
    name: str,
    beyond: Iterable[Finding],
    watch: Watch = unwatched,
) -> Bands:
    """Return the bands of a record that was not fitted, from the draws of one that was."""
    study, record = run.study, other.record
    assert record is not None
    alone, own_draws = reaching(study, draws, other.of, record, beyond)

    def follow(posterior: Posterior, draws: FloatArray, rng: np.random.Generator) -> Bands:
        return predict_record(posterior, draws, record, other.start, rng)

    rivals = run.widening_rivals(other.of, part(watch, 0.0, 0.5)) if beyond else None
    error = _model_error_sd(study, rivals, draws, other.of, record, follow)
    source = study.generator(f"predict {record.sha256}")
    predicting = part(watch, 0.0 if error is None else 0.5, 1.0)
    return predict_record(
        alone, own_draws, record, other.start, source, name, other.judged, predicting, error
    )


def _model_error_sd(
    study: Study,
    rivals: Sequence[Rival] | None,
    draws: FloatArray,
    of: str,
    planned: Record,
    follow: Callable[[Posterior, FloatArray, np.random.Generator], Bands],
) -> float | None:
    """Return by how much rivals on a training record differ on a planned one, um; None without.

    ``follow`` predicts the planned record by the posterior of a model and its draws.
    """
    if rivals is None:
        return None
    rng = study.generator(f"rivals {planned.sha256}")
    alone, own_draws = study.posterior.for_record(of), study.posterior.select_draws(draws, of)

    def bands(posterior: Posterior, draws: FloatArray) -> Bands:
        return follow(posterior, draws, rng)

    return disagreement(alone, own_draws, study.for_record(of), rivals, bands, rng)


def reaching(
    study: Study, draws: FloatArray, of: str, record: Record, beyond: Iterable[Finding]
) -> tuple[Posterior, FloatArray]:
    """Return posterior and draws of a training record, to predict another record.

    They have creep where that is slower or longer than what was fitted, so that the band grows with
    what the training did not show.
    """
    posterior = study.posterior
    if any(finding.kind in ("slow", "duration") for finding in beyond):
        source = study.generator(f"creep {record.sha256}")
        posterior, draws = add_prior_creep(posterior, draws, record.duration, source)
    return posterior.for_record(of), posterior.select_draws(draws, of)


def validate_predictions(
    run: Run,
    bands: Iterable[Bands],
    explanations: Mapping[str, Sequence[Explanation]],
) -> dict[str, BandValidation]:
    """Validate all bands that have readings, by name.

    ``explanations`` are by the name of the training record.
    """
    study = run.study
    records = {window: name for name in study.records for window in study.windows(name)}
    validation = {}
    for predicted in bands:
        explained = explanations.get(records[predicted.name], ()) if predicted.training else ()
        verdict = validate_bands(
            predicted,
            run.background,
            explanations=explained,
            beyond=run.extrapolations.get(predicted.name, ()),
            unexplained=run.config.model.unexplained,
        )
        if verdict is not None:
            validation[predicted.name] = verdict
    return validation


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
    hold = fit.config.model.stated_hold
    start = InitialConditions(from_rest, estimate_offset, lead_in, lead_in_start, hold, after)
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
