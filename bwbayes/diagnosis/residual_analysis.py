"""Analysis of a fitted record for explanations: the fit, its scales, and fits of other models."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import product
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np

from bwbayes.arrays import FloatArray
from bwbayes.diagnosis.finding import Finding
from bwbayes.diagnosis.innovations import innovations
from bwbayes.diagnosis.laplace import LocalFit, climb
from bwbayes.errors import InputError
from bwbayes.inference import map_estimate
from bwbayes.inference.map_estimate import SAMPLES
from bwbayes.inference.noise import SmoothNoise
from bwbayes.inference.posterior import Posterior
from bwbayes.inference.study import Stated, Study
from bwbayes.inference.thinning import (
    beginning,
    stride_of,
    thin,
    thin_posterior,
    thin_windows,
    with_residuals_of,
)
from bwbayes.model.inputs import rate, time_between_turns
from bwbayes.model.spec import ModelSpec
from bwbayes.record.io.grid import clock
from bwbayes.record.voltage_path import VoltagePath
from bwbayes.shown import rounded
from bwbayes.watching import Watch, unwatched

# Number of readings used: an explanation takes some hundred passes over them, and the residual of a
# model shows in fewer.
READINGS = 4_000

# A smaller gain in log density, nats, does not pay for any parameter.
GAIN = 1.0

# Normal scores at which new parameters may leave a fit as it is.
SCORES = (-4.0, -2.0, -1.0, 0.0, 1.0, 2.0, 4.0)

# Number of paths from which the error of a noisy voltage's path is estimated.
PATHS = 4


class Sighting(NamedTuple):
    """Starting points for a fit of another model.

    ``stated`` holds the priors of its new parameters. These start at ``starts``, normal scores by
    name, and the others at ``places`` (places, free), by default at the fit. The choice costs
    ``cost`` nats; ``note`` is appended to the text. If it is ``named_only``, the model is never
    added to that of a run, whatever it is worth.
    """

    stated: Mapping[str, Stated] = {}
    starts: Sequence[Mapping[str, float]] = ({},)
    places: FloatArray | None = None
    cost: float = 0.0
    note: str = ""
    named_only: bool = False


@dataclass(frozen=True)
class Explanation(Finding):
    """An extension of a fitted model, worth ``nats`` of log evidence.

    ``rmse`` is the root mean square of the residual, um, without it and with it; ``held_out`` is
    that of the readings that were held out, nan without any. ``shift`` is the largest shift of a
    parameter of the actuator, in sds of both fits. A ``foreign`` effect does not come from the
    actuator, so that a fit without it has followed it. An explanation by ``noise`` leaves the
    displacement as it is. ``spec`` is the model that it is a part of, ``stated`` holds the priors
    of new parameters, ``mode`` has the coordinates of its fit by name, and ``cost`` is that of its
    choice, nats. ``advice`` is the fix that leaves the model as it is, if there is one.
    """

    rmse: tuple[float, float] = (np.nan, np.nan)
    held_out: tuple[float, float] = (np.nan, np.nan)
    shift: float = 0.0
    foreign: bool = False
    noise: bool = False
    spec: ModelSpec | None = None
    stated: Mapping[str, Stated] = field(default_factory=dict)
    mode: Mapping[str, float] = field(default_factory=dict, repr=False, compare=False)
    cost: float = 0.0
    advice: str = ""

    @property
    def mends(self) -> bool:
        """True if it removes most of the fit's mean square residual, or if that is not known."""
        without, with_it = self.rmse
        return not with_it**2 > without**2 / 2

    @property
    def misleads(self) -> bool:
        """True if it makes the error on held-out readings a tenth larger.

        If the noise model does not describe the discrepancy, the evidence is too large, and it
        favors what helps with the training readings alone.
        """
        without, with_it = self.held_out
        return with_it > 1.1 * without

    @property
    def worth(self) -> str:
        """Its worth in words: nats, and errors with it instead of without it."""
        errors = ((self.rmse, "RMSE"), (self.held_out, "held out"))
        texts = [
            f"{name} {after:.3g} um instead of {before:.3g} um"
            for (before, after), name in errors
            if np.isfinite(after)
        ]
        return ", ".join([f"{rounded(self.nats)} nats", *texts])

    @property
    def numbers(self) -> dict[str, object]:
        """Numbers for ``summary.json``."""
        return {
            "kind": self.kind,
            "text": self.text,
            "fix": self.fix,
            "nats": self.nats,
            "rmse_um": self.rmse[1],
            "rmse_without_um": self.rmse[0],
            "held_out_rmse_um": self.held_out[1],
            "held_out_rmse_without_um": self.held_out[0],
            "shift_sds": self.shift,
        }


@dataclass(frozen=True)
class ResidualAnalysis:
    """A fit of one record, and other places from which its extensions are fitted, too.

    Attributes
    ----------
    fit
        The fit without any extension.
    whole
        The posterior of the whole record; the fit's posterior may be a thinned one.
    places
        Coordinates (places, free) to climb from, those of the fit first.
    generator
        Starts the point fits of other models.
    study
        The study of the record, which gives other models.
    held_out
        Windows of the record that were held out.
    begin
        Time of the record's first sample, s.
    alone
        True if no other record is fitted: all fitted records share the actuator's model.
    before
        Fit that explanations are compared with, if it is another one.
    kinds
        Kinds of other models that are fitted; all of them if None.
    watch
        Called again and again by fits of other models, which end where it raises an error.
    """

    fit: LocalFit
    whole: Posterior
    places: FloatArray
    generator: np.random.Generator
    study: Study
    held_out: tuple[slice, ...] = ()
    begin: float = 0.0
    alone: bool = True
    before: LocalFit | None = None
    kinds: frozenset[str] | None = None
    watch: Watch = unwatched

    @classmethod
    def of(
        cls,
        posterior: Posterior,
        optima: FloatArray,
        generator: np.random.Generator,
        study: Study,
        held_out: Sequence[slice] = (),
        begin: float = 0.0,
        *,
        alone: bool = True,
    ) -> ResidualAnalysis:
        """Fit a posterior of one record once more, from its optima (optima, free).

        An effect at the start of the record may have drawn the fit to an optimum that the rest of
        the record does not have. A fit of the rest gives another starting point, if its optimum is
        a different one.
        """
        theta = posterior.prior.theta(posterior.prior.constrain(optima[:1])[0])
        unthinned, posterior = posterior, thin_posterior(posterior, theta, READINGS)
        if posterior is not unthinned:
            posterior = with_residuals_of(posterior, unthinned, theta)
        rows = posterior.single_record.readings.rows
        if rows.size > READINGS:
            # Keep evenly spaced readings; the voltage stays as it is.
            retained = rows[:: -(-rows.size // READINGS)]
            readings = posterior.single_record.displacement.copy()
            readings[np.setdiff1d(rows, retained)] = np.nan
            posterior, rows = posterior.altered(displacement=readings), retained
        first = int(rows[rows.size // 5])
        windows = posterior.single_record.training
        later = tuple(slice(max(w.start, first), w.stop) for w in windows if w.stop > first)
        best = max((climb(posterior, p) for p in optima), key=lambda fit: fit.log_evidence)
        places = [*optima]
        try:
            shorter = posterior.altered(training=later)
            of_rest = climb(shorter, map_estimate.local_minima(shorter, generator, 1))
        except InputError:
            pass  # the rest has too few readings for these priors
        else:
            if len(of_rest.distinct([best.coordinates])) > 1:
                places.append(of_rest.coordinates)
                best = max(best, climb(posterior, places[-1]), key=lambda fit: fit.log_evidence)
        # Keep the places as they are: a climb on the whole record would draw them to the fit.
        starts = best.distinct(places)
        held_out = thin_windows(held_out, stride_of(posterior, unthinned))
        return cls(best, unthinned, starts, generator, study, held_out, begin, alone)

    def of_beginning(self) -> ResidualAnalysis:
        """Return the analysis of a long record's beginning, if the record cannot be thinned.

        The beginning shows the effect of another model. The analysis of a short record is returned
        as it is.
        """
        if beginning(self.posterior, SAMPLES) is self.posterior:
            return self
        short = beginning(self.whole, SAMPLES)
        analysis = ResidualAnalysis.of(
            short, self.places, self.generator, self.study, begin=self.begin, alone=self.alone
        )
        return replace(analysis, watch=self.watch)

    def with_rough_noise(self) -> ResidualAnalysis | None:
        """Return the analysis with a rough discrepancy instead of a smooth one; else None.

        A smooth discrepancy takes up the effect that an explanation describes, and no climb leads
        from there to a mode where the explanation takes it up.
        """
        if not self.alone or not isinstance(self.posterior.single_record.noise, SmoothNoise):
            return None
        rough = replace(self.study.spec, noise="discrepancy")
        study = self.study.with_model(rough)
        posterior = self.rebuilt(study)
        rows = [self.posterior.names.index(name) for name in posterior.names]
        fit = climb(posterior, self.places[:, rows])
        places = fit.distinct(self.places[:, rows])
        return replace(self, fit=fit, places=places, study=study, before=self.fit)

    @property
    def posterior(self) -> Posterior:
        """The posterior that was fitted."""
        return self.fit.posterior

    @property
    def stride(self) -> int:
        """Number of samples of the whole record for each one that is used."""
        return stride_of(self.posterior, self.whole)

    @property
    def interval(self) -> float:
        """Sampling interval, s."""
        return self.posterior.single_record.actuator.interval

    @property
    def time(self) -> FloatArray:
        """Time since the first reading (samples,), s, along the whole record."""
        record = self.posterior.single_record
        samples = np.arange(record.voltage.size) - record.readings.rows[0]
        time: FloatArray = self.interval * np.maximum(samples, 0.0)
        return time

    @property
    def duration(self) -> float:
        """Time from the first reading to the last, s."""
        rows = self.posterior.single_record.readings.rows
        return self.interval * max(float(rows[-1] - rows[0]), 1.0)

    @property
    def voltage(self) -> FloatArray:
        """Voltage (samples,) up to the last reading, V."""
        return self.posterior.single_record.voltage[: self.posterior.single_record.readings.samples]

    @property
    def rate(self) -> FloatArray:
        """Slope of the voltage (samples,), V/s."""
        return rate(self.voltage, self.interval)

    @property
    def turn_time(self) -> float:
        """Typical time between two reversals of the voltage, s."""
        return time_between_turns(self.voltage, self.interval)

    @property
    def extent(self) -> float:
        """Range of the readings, um."""
        return self.posterior.single_record.extent

    @cached_property
    def innovations(self) -> FloatArray:
        """Innovations of the fit (readings,), in sds."""
        return innovations(self.posterior, self.fit.free).white

    @cached_property
    def unexplained(self) -> float:
        """Gain in log likelihood, nats, if the model were right and left the sensor's noise alone.

        No other model can gain more than the discrepancy takes up. It is inf without a discrepancy,
        because the sensor's noise takes everything up then.
        """
        record = self.posterior.single_record
        if not record.noise.states:
            return np.inf
        parameters = record.table.noise(self.posterior.prior.theta(self.fit.free[np.newaxis]))
        residual = record.readings.values - self.fit.displacement
        white, log_determinant = self.posterior.likelihood.whiten(
            parameters, residual[np.newaxis, np.newaxis]
        )
        sensor = record.noise.sensor_variance(parameters, self.posterior.likelihood.speed)
        now = -0.5 * (float(np.sum(white**2)) + float(log_determinant[0]))
        return float(-0.5 * (np.sum(np.log(sensor)) + residual.size) - now)

    @cached_property
    def path_error_gain(self) -> float:
        """Expected gain in log likelihood, nats, if the voltage's path were known exactly.

        A stage in front of the hysteresis may gain as much by smoothing the path's error alone. It
        is the mean of ½ |W (x(v) − x(u))|² for paths v that are estimated of the path u with new
        noise on it, W whitens the readings; 0 where the voltage has no noise.
        """
        whole, record = self.whole.single_record, self.posterior.single_record
        noise_sd = self.study.records[whole.name].path.noise_sd
        if not noise_sd:
            return 0.0
        path = VoltagePath(whole.voltage, noise_sd)
        theta = self.posterior.prior.theta(self.fit.free[np.newaxis])

        def white(along: Posterior) -> FloatArray:
            residual = record.readings.values - along.simulate(theta, record.readings.rows)
            return self.posterior.likelihood.innovations(record.table.noise(theta), residual)

        worths = []
        for _ in range(PATHS):
            inputs = replace(whole.inputs, voltage=path.redrawn(self.generator))
            voltage = thin(replace(whole, inputs=inputs), self.stride).inputs
            changed = replace(record, inputs=voltage)
            moved = white(replace(self.posterior, datasets=(changed,))) - white(self.posterior)
            worths.append(0.5 * float(np.sum(moved**2)))
        return float(np.mean(worths))

    @property
    def lead(self) -> float:
        """Log evidence, nats, of the fit that explanations are compared with, minus this fit's."""
        return self.before.log_evidence - self.fit.log_evidence if self.before else 0.0

    @cached_property
    def without(self) -> tuple[float, float]:
        """RMSE and held-out error, um, of the fit that explanations are compared with."""
        before = self.before or self.fit
        return before.rmse, before.error(self.held_out)

    def looks_for(self, kind: str) -> bool:
        """Tell whether to fit another model of a kind."""
        return self.kinds is None or kind in self.kinds

    def clock(self, time: float) -> str:
        """Write a time since the first reading as a time of the record, s."""
        first = self.begin + self.interval * float(self.posterior.single_record.readings.rows[0])
        return clock(first + time, self.interval)

    def rebuilt(self, study: Study) -> Posterior:
        """Return the posterior of another model and the same readings."""
        rebuilt, readings = self._of_whole(study), self.posterior.single_record.displacement
        posterior = replace(rebuilt, datasets=(thin(rebuilt.single_record, self.stride),))
        ours, theirs = self.whole.single_record, rebuilt.single_record
        if self.stride > 1 and (
            theirs.actuator.hold != ours.actuator.hold
            or not np.array_equal(theirs.voltage, ours.voltage)
        ):
            # The readings of a thinned record depend on the voltage's course between samples.
            theta = rebuilt.prior.theta(self.fit.free[np.newaxis])
            held = with_residuals_of(posterior, rebuilt, theta).single_record.displacement
            readings = np.where(np.isfinite(readings), held, np.nan)
        return posterior.altered(
            displacement=_common(readings, posterior.single_record.displacement),
            training=self.posterior.single_record.training,
        ).known()

    def on_readings_of(self, posterior: Posterior) -> ResidualAnalysis:
        """Return the analysis of the readings of another model, which may follow fewer of them."""
        fit, before = on_readings(self.fit, posterior), self.before
        if fit is self.fit:
            return self
        return replace(self, fit=fit, before=before and on_readings(before, posterior))

    def _of_whole(self, study: Study) -> Posterior:
        """Return the posterior of another model of the whole record."""
        if self.alone:
            return of_readings(study.posterior, self.whole)
        # The reference values of the actuator's stages depend on the other records, too.
        stages = study.posterior.single_record.actuator.stages
        actuator = replace(self.whole.single_record.actuator, stages=stages)
        return study.posterior.altered(actuator=actuator)

    def extended(self, posterior: Posterior, places: FloatArray) -> LocalFit:
        """Fit another model from places of its own.

        The climb goes on while the model may become more probable than the fit by :data:`GAIN`.
        """
        return climb(posterior, places, self.fit.log_density + GAIN, self.watch)

    def local_minima(self, posterior: Posterior, starts: int = map_estimate.STARTS) -> FloatArray:
        """Find coordinates (places, free) near the modes of another model, as of that name."""
        return map_estimate.local_minima(posterior, self.generator, starts, self.watch)

    def _placed(
        self, posterior: Posterior, places: FloatArray, starts: Sequence[Mapping[str, float]]
    ) -> FloatArray:
        """Return places of this model in another one: new parameters start at 0, or as given."""
        values = [
            {**dict(zip(self.posterior.names, place, strict=True)), **start}
            for place, start in product(places, starts)
        ]
        return np.array([[value.get(name, 0.0) for name in posterior.names] for value in values])

    def _embedded(self, posterior: Posterior) -> FloatArray:
        """Return the place (1, free) of another model that changes this fit least.

        All new parameters are at one of a few normal scores: where they change nothing depends on
        the parameters.
        """
        new = {*posterior.names} - {*self.posterior.names}
        starts = [dict.fromkeys(new, score) for score in SCORES]
        places = self._placed(posterior, self.places, starts)
        best = int(np.argmax(posterior.log_density(places)))
        return places[best : best + 1]

    def changed(
        self,
        kind: str,
        words: str | Callable[[Mapping[str, float]], tuple[str, str]] = "",
        stages: Sequence[str] = (),
        sighting: Sighting = Sighting(),  # noqa: B008  # never written to
        flags: Mapping[str, bool] = MappingProxyType({}),
        **parts: Any,
    ) -> Iterator[Explanation]:
        """Fit the model with further stages, or another noise or hold, by ``parts``.

        ``words`` are the text, by default the kind, or a function from the parameters' values by
        name to text and advice; ``flags`` are fields of the explanation. A model that does not
        follow the readings yields no explanation.
        """
        if not self.looks_for(kind):
            return
        spec, stated = replace(self.study.spec, **parts).with_stages(*stages), sighting.stated
        posterior = self.rebuilt(self.study.with_model(spec, stated))
        compared = self.on_readings_of(posterior)
        before = self.places if sighting.places is None else sighting.places
        places = [self._placed(posterior, before, sighting.starts)]
        embedded = self._embedded(posterior)
        if posterior.log_density(embedded) > np.max(posterior.log_density(places[0])) + GAIN:
            places.append(embedded)
        if len(sighting.starts) > 1 and self.unexplained > GAIN:
            # No short climb leads from a fit that has taken up the effect to one that leaves it to
            # a stage which acts for some values alone; least squares does.
            places.append(self.local_minima(posterior, 1))
        fit = compared.extended(posterior, np.concatenate(places))
        if not fit.follows:
            return
        text, advice = words or kind, ""
        if not isinstance(words, str):
            theta = posterior.prior.theta(fit.free[np.newaxis])[0].tolist()
            text, advice = words(dict(zip(posterior.table.names, theta, strict=True)))
        fix = lines(self.study.spec, spec)
        if stated:
            statement = f"what is known of {', '.join(stated)} in [parameters]"
            fix = f"state {statement}" if spec == self.study.spec else f"{fix}, with {statement}"
        if advice:
            fix = advice if any(flags.values()) else f"{advice}, or {fix}"
        smooths = any(
            stage.side == "input" and not stage.rate_independent
            for stage in posterior.single_record.actuator.stages
            if stage.name in {*spec.chain} - {*self.study.spec.chain}
        )
        yield compared.explained(
            kind,
            f"{text}{sighting.note}",
            fix,
            fit,
            sighting.cost + (self.path_error_gain if smooths else 0.0),
            shift=compared._shift(fit),
            spec=spec,
            stated=stated,
            mode=fit.by_name,
            advice=advice,
            **flags,
        )

    def confirmed(self, explanation: Explanation) -> Explanation:
        """Evaluate an explanation on all readings, if the analysis used a part of them."""
        is_short = (
            self.posterior.single_record.readings.rows.size
            < self.whole.single_record.readings.rows.size
        )
        spec, mode = explanation.spec, explanation.mode
        if not is_short or spec is None or not mode:
            return explanation
        other = self._of_whole(self.study.with_model(spec, explanation.stated))
        fit = climb(other, np.array([mode[name] for name in other.names]), watch=self.watch)
        before = on_readings(self._on_all, other)
        nats = fit.log_evidence - before.log_evidence - explanation.cost
        return replace(explanation, nats=nats, rmse=(before.rmse, fit.rmse))

    @cached_property
    def _on_all(self) -> LocalFit:
        """The fit of all readings."""
        before = self.before or self.fit
        return climb(self.whole, before.coordinates, watch=self.watch)

    def explained(
        self, kind: str, text: str, fix: str, fit: LocalFit, cost: float = 0.0, **facts: Any
    ) -> Explanation:
        """Compare a fit with the one without any extension.

        ``cost`` is the cost of its choice, nats; ``facts`` are other fields of the explanation.
        """
        return Explanation(
            kind,
            text,
            fix,
            nats=fit.log_evidence - self.fit.log_evidence - self.lead - cost,
            rmse=(self.without[0], fit.rmse),
            held_out=(self.without[1], fit.error(self.held_out)),
            cost=cost,
            **facts,
        )

    def _shift(self, fit: LocalFit) -> float:
        """Return the largest shift of the actuator's parameters, in sds of both fits together.

        Only parameters that both fits have, with the same priors, count.
        """
        ours, theirs = self.posterior, fit.posterior
        of_record = ours.single_record.table.of_scope("record", "event")
        priors = dict(zip(theirs.names, theirs.prior.free, strict=True))
        shared = [
            (row, theirs.names.index(parameter.name))
            for row, parameter in enumerate(ours.prior.free)
            if parameter.name in {*ours.table.physical} - {*of_record}
            and priors.get(parameter.name) == parameter
        ]
        rows, columns = np.array(shared, dtype=np.intp).reshape(-1, 2).T
        variance = np.diag(self.fit.covariance)[rows] + np.diag(fit.covariance)[columns]
        moved = np.abs(fit.coordinates[columns] - self.fit.coordinates[rows]) / np.sqrt(variance)
        return float(np.max(moved, initial=0.0))


def on_readings(fit: LocalFit, other: Posterior) -> LocalFit:
    """Return a fit without the readings that another posterior of the record does not have."""
    missing = np.isnan(other.single_record.displacement)
    readings = fit.posterior.single_record.displacement
    if np.isnan(readings[missing]).all():
        return fit
    fewer = fit.posterior.altered(displacement=np.where(missing, np.nan, readings))
    return climb(fewer, fit.coordinates)


def of_readings(posterior: Posterior, other: Posterior) -> Posterior:
    """Return a posterior of one record without the readings that another one leaves out."""
    readings = posterior.single_record.displacement
    common = _common(readings, other.single_record.displacement)
    return posterior if common is readings else posterior.altered(displacement=common)


def _common(readings: FloatArray, others: FloatArray) -> FloatArray:
    """Return readings (samples,), um, that others (samples,) have, too."""
    missing = np.isnan(others) & np.isfinite(readings)
    return np.where(missing, np.nan, readings) if missing.any() else readings


def lines(before: ModelSpec, after: ModelSpec) -> str:
    """Return the lines of config that change a model."""
    changes = before.changes_to(after).items()
    return f"set {', '.join(f'{key} = {json.dumps(value)}' for key, value in changes)} in [model]"
