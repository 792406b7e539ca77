"""Predictions of a run: its windows, the records it holds out, and any other one.

:func:`predictions` predicts what a config names, :func:`predict_another` any record or planned
voltage; what comes of either is judged by the readings, if there are any. Their random numbers hang
on the data alone: the same record under another name gets the same bands.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass, fields
from html import escape
from io import StringIO
from typing import TYPE_CHECKING, Any, NamedTuple, Self

import numpy as np
from rich.console import Console

from bwbayes.app.figures import draw_alone
from bwbayes.app.problem.problem import Problem, generator
from bwbayes.app.screen import show_scores, show_standing
from bwbayes.arrays import FloatArray
from bwbayes.data.record import Record
from bwbayes.errors import InputError, suggestion
from bwbayes.results import innovations

# The fields that Prediction inherits are read where it stands.
from bwbayes.results.bands import Bands, Kind, LeadIn  # noqa: F401
from bwbayes.results.drift import Drift
from bwbayes.results.extrapolation import beyond_training
from bwbayes.results.innovations import Innovations
from bwbayes.results.prediction import (
    Start,
    forecast,
    predict_record,
    predict_windows,
    thinned,
)
from bwbayes.results.result import Result
from bwbayes.results.scores import Scores, as_summary, score
from bwbayes.results.standing import Standing
from bwbayes.results.transient import Transient
from bwbayes.results.verdict import Background, Verdict, assess
from bwbayes.shown import head

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["Prediction", "Swallowed", "judged", "predict_another", "predictions", "scoring"]


@dataclass(frozen=True, eq=False, repr=False)
class Prediction(Bands):
    """Bands of one record or window, and how they turned out.

    ``scores`` and ``verdict`` hold the bands against the readings and are None without any;
    ``remarks`` say where the drive leaves what was fitted. All else is as of
    :class:`bwbayes.Bands`.
    """

    scores: Scores | None = None
    verdict: Verdict | None = None
    remarks: tuple[str, ...] = ()

    @classmethod
    def of(
        cls,
        bands: Bands,
        scores: Scores | None = None,
        verdict: Verdict | None = None,
        remarks: tuple[str, ...] = (),
    ) -> Self:
        """Return bands together with what is known of them."""
        known = {one.name: getattr(bands, one.name) for one in fields(Bands)}
        return cls(**known, scores=scores, verdict=verdict, remarks=remarks)

    @property
    def holds(self) -> bool | None:
        """Whether the bands hold on the readings; None if that cannot be told."""
        return None if self.verdict is None else self.verdict.holds

    @property
    def residuals(self) -> FloatArray:
        """Readings less the mean, (samples,), um; nan where there is no reading."""
        measured = np.full(self.mean.size, np.nan) if self.measured is None else self.measured
        residuals: FloatArray = measured - self.mean
        return residuals

    def to_pandas(self) -> Any:
        """Return the bands as a pandas.DataFrame with the columns of ``bands.csv``."""
        import pandas as pd  # noqa: PLC0415  # slow to load, and only needed here

        return pd.DataFrame(dict(self.columns()))

    def plot(self) -> Figure:
        """Draw the bands along time: voltage, displacement, and the residuals off the mean."""
        return draw_alone(self)

    def numbers(self) -> dict[str, object]:
        """Return what ``bwbayes predict`` writes beside the bands: scores, verdict, remarks."""
        held: dict[str, object] = {"holds": None} if self.verdict is None else self.verdict.summary
        return {
            "name": self.name,
            "from_s": float(self.time[0]),
            "to_s": float(self.time[-1] + self.interval),
            "samples": self.time.size,
            "remarks": list(self.remarks),
            "lead_in": None if self.lead_in is None else asdict(self.lead_in),
            "scores": None if self.scores is None else as_summary(self.scores),
            **held,
        }

    def __repr__(self) -> str:
        return head(str(self))

    def __str__(self) -> str:
        said = StringIO()
        console = Console(file=said, width=100, force_jupyter=False, color_system=None)
        console.print(self._title, highlight=False, markup=False, soft_wrap=True)
        if self.scores is not None and self.verdict is not None:
            show_standing(Standing.of([self.verdict]), console)
            show_scores({self.name: self.scores}, console, {self.name: self.verdict})
        for remark in (*self.remarks, *(self.verdict.notes if self.verdict else ())):
            console.print(f"note: {remark}", highlight=False, markup=False, soft_wrap=True)
        return said.getvalue().rstrip()

    def _repr_html_(self) -> str:
        return f"<pre>{escape(str(self))}</pre>"

    @property
    def _title(self) -> str:
        width = float(np.mean(self.upper["sensor", 95] - self.lower["sensor", 95]))
        return (
            f"prediction {self.name}: {self.time.size} samples from {self.time[0]:g} to "
            f"{self.time[-1] + self.interval:g} s; the 95 % sensor band is {width:.3g} um wide"
        )


def predict_another(
    problem: Problem,
    flat: FloatArray,
    record: Record,
    start: Start,
    name: str,
    window: tuple[float, float] | None = None,
    of: str | None = None,
) -> Prediction:
    """Predict another record, or a planned voltage without a measurement, and judge it.

    Parameters
    ----------
    problem
        What was fitted.
    flat
        Its draws, (draws, free), parameters in their own units; a thousand of them are used.
    record
        The other record, at any sampling interval.
    start
        What is known of its start.
    name
        Name of the bands.
    window
        Start and stop in s of the part that is predicted and judged; by default all of it.
    of
        The training record whose own parameters it takes where nothing tells its own; by default
        the first.

    Raises
    ------
    InputError
        A lead-in or window that does not fit into the record.
    """
    posterior, seed = problem.posterior, problem.config.seed
    far = beyond_training(posterior, record.voltage, record.interval)
    chosen = thinned(flat, generator(seed, "draws"))
    source = generator(seed, f"predict {record.sha256}")
    of = training_record(problem, of)
    alone, its = posterior.alone(of), posterior.its(chosen, of)
    bands = predict_record(alone, its, record, start, source, name, window)
    background = Background.of(posterior, flat)
    verdict = assess(bands, background, beyond=far)
    scores = None if verdict is None else score(bands, scoring(seed, bands), background.extent)
    return Prediction.of(bands, scores, verdict, tuple(one.line for one in far))


def predict_after(
    problem: Problem, flat: FloatArray, voltage: FloatArray, name: str, of: str | None = None
) -> Prediction:
    """Predict what follows on a training record whose last sample goes on into a planned voltage.

    ``voltage`` is (samples,), V, at the record's interval; ``of`` the record's name, by default the
    first. All else is as in :func:`predict_another`; see
    :func:`~bwbayes.results.prediction.forecast`.
    """
    posterior, seed, of = problem.posterior, problem.config.seed, training_record(problem, of)
    record = problem.records[of]
    whole = np.concatenate([record.voltage, voltage])
    far = beyond_training(posterior, whole, record.interval, slice(record.samples, None))
    chosen = thinned(flat, generator(seed, "draws"))
    source = generator(seed, f"forecast {Record(voltage, None, record.interval).sha256}")
    alone, its = posterior.alone(of), posterior.its(chosen, of)
    bands = forecast(alone, its, record, voltage, source, name)
    return Prediction.of(bands, remarks=tuple(one.line for one in far))


def residuals_along(problem: Problem, bands: Mapping[str, Prediction]) -> FloatArray:
    """Return readings less the mean of the bands along the training record, (samples,), um.

    Raises
    ------
    InputError
        Several records were fitted.
    """
    if len(problem.records) > 1:
        raise InputError("residuals: of several records; take fit.bands[NAME].residuals")
    values = np.full(problem.record.samples, np.nan)
    for name, windows in problem.windows(*problem.records).items():
        whole = slice(windows[0].start, windows[-1].stop)
        residuals = bands[name].residuals
        values[whole] = np.where(np.isfinite(residuals), residuals, values[whole])
    return values


def training_record(problem: Problem, name: str | None) -> str:
    """Return the name of a training record, by default of the first.

    Raises
    ------
    InputError
        No training record is called so.
    """
    if name is not None and name not in problem.records:
        hint = suggestion(name, list(problem.records))
        raise InputError(f"predict: no training record {name!r}; {hint}")
    return name or next(iter(problem.records))


def predictions(problem: Problem, result: Result) -> tuple[Bands, ...]:
    """Predict the training windows of all records and everything held out."""
    posterior, seed = problem.posterior, problem.config.seed
    chosen = thinned(result.flat_draws, generator(seed, "draws"))
    bands: list[Bands] = []
    for name, alone, its in posterior.each(chosen):
        record, windows = problem.records[name], problem.windows(name)
        # By content: the same record under another name gets the same bands.
        source = generator(seed, f"predict {record.sha256}")
        bands += predict_windows(alone, its, record, windows, source)
    for name, other in problem.validations.items():
        if other.record is not None:
            source = generator(seed, f"predict {other.record.sha256}")
            alone, its = posterior.alone(other.of), posterior.its(chosen, other.of)
            bands.append(
                predict_record(alone, its, other.record, other.start, source, name, other.judged)
            )
    return tuple(bands)


class Swallowed(NamedTuple):
    """What a fit has followed that the actuator did not do, if anything."""

    transient: Transient | None
    drift: Drift | None


def judged(
    problem: Problem,
    bands: Iterable[Bands],
    background: Background,
    series: Mapping[str, Innovations],
    followed: Mapping[str, Swallowed],
) -> dict[str, Verdict]:
    """Judge all bands that have readings, by name.

    ``series`` and ``followed`` are by the name of the training record.
    """
    records = {window: name for name in problem.records for window in problem.windows(name)}
    verdicts = {}
    for one in bands:
        far = problem.extrapolations(one.name)
        record = records.get(one.name) if one.training else None
        start, transient, drift = None, None, None
        # Of several training windows the first one holds the start.
        if record and one.time[0] <= series[record].time[0] <= one.time[-1]:
            start = innovations.odd_start(series[record])
            transient, drift = followed[record]
        verdict = assess(one, background, start=start, transient=transient, drift=drift, beyond=far)
        if verdict is not None:
            verdicts[one.name] = verdict
    return verdicts


def scoring(seed: int, bands: Bands) -> np.random.Generator:
    """Return the generator that scores bands: it depends on the readings, not on a name."""
    assert bands.measured is not None
    return generator(seed, f"score {hashlib.sha256(bands.measured.tobytes()).hexdigest()}")
