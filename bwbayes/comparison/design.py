"""Experimental design: the drive that would most reduce a parameter's SD or a band's width.

Each candidate is a voltage that the amplifier can make. At some posterior draws the model is made
linear in its parameters: the Fisher information of the readings that the candidate would bring,
with the noise of that draw, adds to what is known already. As in a fit of the new record, its
initial state and its offset are unknown. The score is the expected remaining share of a standard
deviation, averaged over the draws; their scatter gives its Monte Carlo error.

Every reading counts as often as a fit counts it, which trusts the noise model. The model's error
returns with every period of a steady drive; only the discrepancy's correlation time keeps it from
counting as new each time.

:func:`rank_by_rivals` ranks by what would tell a model from its rivals, other models that fit the
same record (:mod:`bwbayes.diagnosis.rivals`): by how much they differ along a candidate, and what
would be left of their differences if they were fitted to it, too.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from typing import ClassVar, overload

import numpy as np
import scipy

from bwbayes.arrays import FloatArray
from bwbayes.diagnosis.explanations import TIED
from bwbayes.diagnosis.rivals import DRAWS, Rival, close_rivals
from bwbayes.diagnosis.validation import ValidationSummary
from bwbayes.errors import InputError, suggestion
from bwbayes.inference.likelihood import batches
from bwbayes.inference.mode_finding import Target, value_and_jacobian
from bwbayes.inference.posterior import Posterior
from bwbayes.inference.study import InitialConditions, Study
from bwbayes.model.inputs import Limits
from bwbayes.prediction.initial_state import estimate_initial_states
from bwbayes.record.instruments import EXACT, Instruments
from bwbayes.record.record import Record
from bwbayes.report.report import (
    Banner,
    Block,
    Facts,
    Picture,
    Product,
    Report,
    Section,
    Table,
    TableColumn,
    kind_of,
    remarks_banner,
    standing_banner,
)
from bwbayes.shown import brief
from bwbayes.watching import Watch, part, unwatched, watched


@dataclass(frozen=True)
class DesignScore:
    """Expected remaining standard deviation of a candidate signal.

    Attributes
    ----------
    name
        The candidate's name.
    sd_ratio
        The part of the standard deviation that would be left: of the parameter, or of the
        parameter band's mean width along the chosen drive; nan if it is refused.
    error
        Its Monte Carlo error.
    refused
        Why the amplifier cannot make it; empty if it can.
    """

    __repr__ = brief

    name: str
    sd_ratio: float
    error: float
    refused: str = ""


@dataclass(frozen=True)
class RivalScore(DesignScore):
    """The score of a candidate signal for telling a model from its rivals, by their difference.

    Attributes
    ----------
    difference_um
        Root mean square difference of the rivals from the model along it, um.
    sd_um
        Sd of a reading along it, as the model's bands have it without the rivals, um.
    told_apart
        Part of the pairs of models whose evidence would differ by odds of more than twenty to one,
        if it was fitted as well.
    """

    difference_um: float = np.nan
    sd_um: float = np.nan
    told_apart: float = np.nan


@dataclass(frozen=True)
class Design(Product, Sequence[DesignScore]):
    """Candidates for the next measurement, from a run: a sequence of their scores.

    Attributes
    ----------
    run
        The name of the run that is started from.
    parameter, drive
        Target: a parameter, or the band along a drive of that name.
    amplifier
        Limits of the amplifier.
    signals
        The candidates' voltages (samples,) by name, V.
    interval
        Their sampling interval, s.
    standing
        How the validation of the run came out.
    scores
        The score of each candidate, the best first; the first is not refused.
    """

    NAME: ClassVar[str] = "design"
    __repr__ = brief

    run: str
    parameter: str | None
    drive: str | None
    amplifier: Limits
    signals: Mapping[str, FloatArray]
    interval: float
    standing: ValidationSummary
    scores: Sequence[DesignScore]

    @overload
    def __getitem__(self, index: int) -> DesignScore: ...
    @overload
    def __getitem__(self, index: slice) -> Sequence[DesignScore]: ...
    def __getitem__(self, index: int | slice) -> DesignScore | Sequence[DesignScore]:
        return self.scores[index]

    def __len__(self) -> int:
        return len(self.scores)

    @property
    def best(self) -> DesignScore:
        """The best candidate."""
        return self.scores[0]

    @property
    def quantity(self) -> str:
        """The quantity whose remaining SD the scores are, in words."""
        if self.parameter is not None:
            return f"sd left of {self.parameter}"
        return f"width left of the band along {self.drive}"

    @property
    def tied(self) -> list[str]:
        """The candidates that cannot be told apart from the best."""
        best = self.best
        return [
            score.name
            for score in self.scores[1:]
            if score.sd_ratio - best.sd_ratio < 2 * float(np.hypot(score.error, best.error))
        ]

    @property
    def chosen(self) -> dict[str, tuple[str, DesignScore]]:
        """The signals to measure: a title and a candidate, by the name of the signal's file."""
        return {"best": ("The best signal", self.best)}

    def records(self) -> dict[str, Record]:
        """Return what to measure as records that a signal generator can play."""
        return {
            name: Record(
                self.signals[score.name], None, interval=self.interval, voltage_is="command"
            )
            for name, (_, score) in self.chosen.items()
        }

    def numbers(self) -> dict[str, object]:
        """Return what ``design.json`` holds."""
        return {
            "validation": self.standing.numbers,
            "target": self.parameter or self.drive or "",
            "best": self.best.name,
            "amplifier": asdict(self.amplifier),
            "candidates": [asdict(score) for score in self.scores],
            **{name: score.name for name, (_, score) in self.chosen.items()},
        }

    def report(self) -> Report:
        """Return what to measure, what it teaches, and what it looks like, to be shown."""
        from bwbayes.report.figures.series import record_pictures  # noqa: PLC0415

        amplifier = self.amplifier
        rate = f", at most {amplifier.rate:.4g} V/s" if np.isfinite(amplifier.rate) else ""
        facts = [
            ("Run", self.run),
            ("Target", self.quantity.replace(" left", "")),
            ("Amplifier", f"{amplifier.low:.4g} to {amplifier.high:.4g} V{rate}"),
            ("Sampling interval", f"{self.interval:g} s"),
        ]
        signals = [
            replace(
                record_pictures(record, (), ())["time"],
                name=name,
                title=f"{self.chosen[name][0]}: {self.chosen[name][1].name}",
                caption=f"Its voltage, as {name}.csv has it for the signal generator.",
            )
            for name, record in self.records().items()
        ]
        return Report(
            title="What to measure next",
            banners=[
                *standing_banner(self.standing),
                *self._answers(),
                *remarks_banner(
                    [f"{p.name} {p.refused}" for p in self.scores if p.refused],
                    "What the amplifier cannot make",
                ),
            ],
            blocks=[
                *self._comparison(),
                *signals,
                Section("Request", [Facts(facts)], folded=False),
            ],
            numbers=self.numbers(),
        )

    def _answers(self) -> list[Banner]:
        """Return what to measure, and what it teaches."""
        best = self.best
        lines = [
            f"{self.quantity} after one more record of it: {best.sd_ratio:.1%} ± {best.error:.1%}"
        ]
        if self.tied:
            lines.append(f"indistinguishable from it: {', '.join(self.tied)}")
        return [Banner(kind_of(self.standing), f"Best: {best.name}", lines)]

    def _comparison(self) -> list[Block]:
        """Return the candidates side by side."""
        from bwbayes.report.figures.products import draw_promises  # noqa: PLC0415

        feasible = [score for score in self.scores if not score.refused]
        names = [score.name for score in feasible]
        remaining, error = np.array([(p.sd_ratio, p.error) for p in feasible]).T
        return [
            self._table(),
            Picture(
                "promises",
                "What each candidate would leave",
                "The part that is expected to be left after one more record, with two Monte "
                "Carlo errors to either side; at 100% a signal teaches nothing new.",
                partial(draw_promises, names, remaining, error, self.quantity),
            ),
        ]

    def _table(self) -> Table:
        rows = []
        for score in self.scores:
            voltage = self.signals[score.name]
            fastest = float(np.max(np.abs(np.diff(voltage)))) / self.interval
            numbers = (score.sd_ratio, score.error)
            rows.append(
                (
                    score.name,
                    *("–" if score.refused else f"{number:.1%}" for number in numbers),
                    f"{voltage.min():.4g} V",
                    f"{voltage.max():.4g} V",
                    f"{fastest:,.0f} V/s",
                    f"{self.interval * voltage.size:.4g} s",
                )
            )
        signal = (
            TableColumn(title, on="page") for title in ("Lowest", "Highest", "Fastest", "Length")
        )
        return Table(
            "candidates",
            self.quantity.capitalize()
            if self.parameter is None
            else f"SD left of {self.parameter}",
            ("Candidate", "Left", "Error", *signal),
            rows,
            records=[asdict(score) for score in self.scores],
            note="The error is that of Monte Carlo. Expected from the posterior's draws, with the "
            "model made linear in its parameters at each: what a fit would gain from a new record "
            "with an offset and an initial state of its own (none where the record that was fitted "
            "starts from rest). The noise model is trusted: what the model is wrong about returns "
            "each time that a signal repeats itself.",
            on="both",
        )


@dataclass(frozen=True)
class RivalDesign(Design):
    """Candidates that tell a model from its rivals: a record to validate on, one to train on."""

    __repr__ = brief

    scores: Sequence[RivalScore]

    @property
    def validation(self) -> RivalScore:
        """The candidate along which rivals differ most."""
        return max(
            (score for score in self.scores if not score.refused),
            key=lambda score: score.difference_um,
        )

    @property
    def training(self) -> RivalScore:
        """The candidate that would leave least of the rivals' differences, if it was fitted."""
        return self.scores[0]

    @property
    def quantity(self) -> str:
        """The quantity whose remaining part the scores are, in words."""
        return "difference of rivals left"

    @property
    def chosen(self) -> dict[str, tuple[str, DesignScore]]:
        """The signals to measure: a title and a candidate, by the name of the signal's file."""
        return {
            "validate": ("Validation record", self.validation),
            "train": ("Training record", self.training),
        }

    def _answers(self) -> list[Banner]:
        """Return which signals tell the model from its rivals, and by how much."""
        validation, training = self.validation, self.training
        seconds = self.interval * self.signals[validation.name].size
        differ = (
            f"along it rivals differ from the model by {validation.difference_um:.2g} um, "
            f"{validation.difference_um / validation.sd_um:.2g} times the SD of a reading"
        )
        training_text = (
            f"fitted, too, it would leave {training.sd_ratio:.0%} of the rivals' differences, and "
            f"tell {training.told_apart:.0%} of all pairs of models apart"
        )
        headline = f"Validate on: {validation.name}, {seconds:.3g} s"
        return [
            Banner(kind_of(self.standing), headline, [differ]),
            Banner("note", f"Train on: {training.name}", [training_text]),
        ]

    def _comparison(self) -> list[Block]:
        """Return the candidates side by side."""
        rows = []
        for score in self.scores:
            cells = (
                f"{score.difference_um:.2g} um",
                f"{score.difference_um / score.sd_um:.2g}",
                f"{score.sd_ratio:.0%}",
                f"{score.told_apart:.0%}",
            )
            rows.append((score.name, *("–" if score.refused else cell for cell in cells)))
        columns = ("Candidate", "Rivals differ by", "Over SD", "Left if fitted", "Told apart")
        table = Table(
            "candidates",
            "Rivals along the candidates",
            columns,
            rows,
            records=[asdict(score) for score in self.scores],
            note="Rivals are models of other families that fit the training record about as well. "
            "Over SD: their difference from the model, over the SD of a reading without them. Left "
            "if fitted: the part of all differences between models that would be left if the "
            "candidate was fitted as well; told apart: the part of the pairs of models whose "
            "evidence would differ by odds of more than twenty to one.",
            on="both",
        )
        return [table]


def rank_designs(
    posterior: Posterior,
    draws: FloatArray,
    candidates: Mapping[str, FloatArray],
    target: str | FloatArray,
    amplifier: Limits,
    generator: np.random.Generator,
    watch: Watch = unwatched,
    *,
    instruments: Instruments = EXACT,
) -> list[DesignScore]:
    """Rank candidates by what they would teach, the best first.

    With Σ the covariance of the actuator's parameters among the draws, in the coordinates of the
    sampling, and I the information of the candidate's readings about them and about the initial
    state and offset of its record, whose prior is standard normal there
    (:meth:`~bwbayes.inference.mode_finding.Target.linearize`),

        Σ' = (Σ⁻¹ + Iₐₐ − Iₐᵣ (1 + Iᵣᵣ)⁻¹ Iᵣₐ)⁻¹.

    A target's sd goes from √(gᵀ Σ g + s²) to √(gᵀ Σ' g + s²), g its gradient; along a drive the
    mean over its samples counts. s is what the scales of the instruments leave unsure of it: they
    read the next record, too, so that no record tells of them.

    Parameters
    ----------
    posterior
        The posterior that was sampled.
    draws
        (draws, free), parameters in their own units.
    candidates
        Voltages (samples,) by name, V, at the interval of the fitted record. Their records start
        as that one did: demagnetized and at rest, or in a state that nothing tells.
    target
        The name of a free parameter of the actuator, or a drive (samples,), V, whose parameter band
        is to be narrow.
    amplifier
        Limits of the amplifier.
    generator
        Chooses draws, and draws the starts of the candidates' records.
    watch
        Called with the share that is done.
    instruments
        Those that read the fitted record, and will read the next one.

    Raises
    ------
    InputError
        The target is not a free parameter of the actuator.

    Notes
    -----
    K. Chaloner and I. Verdinelli, Bayesian experimental design: a review, Statistical Science 10
    (1995) 273-304: c-optimality, averaged over the posterior.
    """
    dataset, prior = posterior.single_record, posterior.prior
    scopes = {d.name: d.scope for d in dataset.actuator.declarations if d.name in prior.free_names}
    names = [name for name, scope in scopes.items() if scope == "actuator"]
    if isinstance(target, str) and target not in names:
        hint = suggestion(target, names)
        raise InputError(f"design: {target!r} is not a free parameter of the actuator; {hint}")
    columns, new = (
        np.array([prior.free_names.index(n) for n in scopes if (n in names) is shared], dtype=int)
        for shared in (True, False)
    )
    coordinates = prior.unconstrain(draws[:: max(len(draws) // 4000, 1)])
    covariance = np.atleast_2d(np.cov(coordinates[:, columns], rowvar=False))
    chosen = coordinates[
        generator.choice(len(coordinates), min(40, len(coordinates)), replace=False)
    ]
    proposed = chosen.copy()
    proposed[:, new] = generator.standard_normal((len(chosen), new.size))
    possible = np.isfinite(prior.constrain(proposed)[1])
    chosen[possible] = proposed[possible]

    def target_values(places: FloatArray) -> FloatArray:
        if isinstance(target, str):
            return prior.constrain(places)[0][:, [prior.free_names.index(target)]]
        return band.displacement(*prior.theta_at(places))

    band = _planned_posterior(
        posterior, posterior.single_record.voltage if isinstance(target, str) else target
    )
    factor = np.linalg.cholesky(covariance)
    gradients = [
        value_and_jacobian(target_values, point[np.newaxis], columns)[1][0] for point in chosen
    ]
    values = target_values(chosen)
    if isinstance(target, str):
        unit = prior.free[prior.free_names.index(target)].unit
        relative = float(np.hypot(*instruments.relative_sds(unit)))
    else:
        # Where the sensor's zero is says nothing of the displacement.
        relative = instruments.sensor_scale
        values -= dataset.table.columns(prior.theta_at(chosen)[0])["offset"][:, np.newaxis]
    unread = (relative * values) ** 2
    before = [_mean_sd(*both, covariance) for both in zip(gradients, unread, strict=True)]
    scores, count = [], len(candidates)
    for number, (name, voltage) in enumerate(candidates.items()):
        refused = amplifier.refuses(voltage, dataset.actuator.interval)
        if refused:
            scores.append(DesignScore(name, np.nan, np.nan, refused))
            continue
        planned, remaining = Target(_planned_posterior(posterior, voltage)), []
        rows, unknown = (np.searchsorted(planned.physical, c) for c in (columns, new))
        this = part(watch, number / count, (number + 1) / count)
        for batch in watched([*batches(len(chosen), 2 * len(scopes) * voltage.size)], this):
            informations = planned.linearize(chosen[batch], expected=True).fisher_information
            for gradient, variance, full in zip(
                gradients[batch], unread[batch], informations, strict=True
            ):
                # The unknowns of its own, with standard normal priors, are integrated out.
                across = full[np.ix_(rows, unknown)]
                start = full[np.ix_(unknown, unknown)] + np.eye(unknown.size)
                information = full[np.ix_(rows, rows)] - across @ np.linalg.solve(start, across.T)
                # With Σ = L Lᵀ, which is never inverted: L (1 + Lᵀ I L)⁻¹ Lᵀ.
                inner = np.eye(len(factor)) + factor.T @ information @ factor
                after = factor @ scipy.linalg.solve(inner, factor.T, assume_a="pos")
                remaining.append(_mean_sd(gradient, variance, after))
        shares = np.array(remaining) / before
        error = float(np.std(shares, ddof=1) / np.sqrt(shares.size)) if shares.size > 1 else np.inf
        scores.append(DesignScore(name, float(np.mean(shares)), error))
    return sorted(scores, key=lambda score: (bool(score.refused), score.sd_ratio, score.name))


def _planned_posterior(posterior: Posterior, voltage: FloatArray) -> Posterior:
    """Return the posterior of another record of one actuator, of which only readings are missing.

    It starts as the one that was fitted.
    """
    nothing, windows = np.zeros(voltage.size), (slice(0, voltage.size),)
    return posterior.altered(voltage=voltage, displacement=nothing, training=windows)


def _mean_sd(gradient: FloatArray, variance: FloatArray, covariance: FloatArray) -> float:
    """Mean over columns g of √(gᵀ Σ g + s²), for gradients (coordinates, targets).

    s² is the ``variance`` (targets,) that is added.
    """
    variances = np.einsum("it,ij,jt->t", gradient, covariance, gradient)
    return float(np.mean(np.sqrt(np.maximum(variances, 0) + variance)))


# Samples of a candidate that are looked at, and the part of it that only sets the state.
SAMPLES, SETTLING = 1_000, 0.25


class _Paths:
    """Simulated draws of a model along candidates: deviations (draws, samples) from their mean."""

    def __init__(
        self,
        posterior: Posterior,
        free: FloatArray,
        candidates: Mapping[str, FloatArray],
        rng: np.random.Generator,
    ) -> None:
        dataset, theta = posterior.single_record, posterior.prior.theta(free)
        self.posterior, self.interval = posterior, dataset.actuator.interval
        self.noise = np.median(dataset.table.noise(theta), axis=0, keepdims=True)
        self.mean, self.deviations, self.stride = {}, {}, {}
        for name, voltage in candidates.items():
            record = Record(voltage, None, interval=self.interval, origin=name)
            start = InitialConditions(from_rest=True, hold=dataset.actuator.hold)
            states = estimate_initial_states(posterior, theta, record, start, rng)
            first = round(SETTLING * voltage.size)
            self.stride[name] = -(-(voltage.size - first) // SAMPLES)
            paths = states.displacement(record.inputs)[:, first :: self.stride[name]]
            # Where a record's sensor was set to zero, nothing says.
            paths -= paths.mean(axis=1, keepdims=True)
            self.mean[name] = paths.mean(axis=0)
            self.deviations[name] = (paths - self.mean[name]) / np.sqrt(max(len(paths) - 1, 1))

    def sd(self, name: str) -> float:
        """Return the sd of a reading, given what is known of the model, um."""
        sds = self.posterior.single_record.noise.marginal_sd(self.noise)
        return float(
            np.sqrt(
                np.mean(np.sum(self.deviations[name] ** 2, axis=0)) + sum(s[0] ** 2 for s in sds)
            )
        )

    def fit(self, name: str, readings: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Fit readings (records, samples), um, along a candidate, linear in the draws' deviations.

        Returns the sizes (records, draws) of the deviations, and the nats (records,) that their
        evidence trails that of a model that makes the readings, but for what any fit takes up.
        """
        residual, deviations = readings - self.mean[name], self.deviations[name]
        constant = np.full((1, residual.shape[1]), self.posterior.single_record.extent)
        shapes = np.concatenate([deviations, constant])
        noise = self.posterior.single_record.noise.at(self.stride[name] * self.interval)
        series = np.concatenate([shapes, residual])[np.newaxis]
        white = noise.whiten(self.noise, series)[0][0]
        inside, outside = white[: len(shapes)], white[len(shapes) :]
        pull = inside @ outside.T
        sizes = np.linalg.solve(np.eye(len(shapes)) + inside @ inside.T, pull).T
        nats = (np.sum(outside**2, axis=1) - np.sum(sizes.T * pull, axis=0)) / 2
        return sizes[:, :-1], nats


def rank_by_rivals(
    posterior: Posterior,
    draws: FloatArray,
    study: Study,
    rivals: Sequence[Rival],
    candidates: Mapping[str, FloatArray],
    amplifier: Limits,
    rng: np.random.Generator,
    watch: Watch = unwatched,
) -> list[RivalScore]:
    """Rank candidates by what would be left of the rivals' differences, the best first.

    In turn each model, of those that fit the training record about as well as the best, makes the
    readings of a candidate, and the others are fitted to them, linear in their parameters about
    their fit of the training record. Those whose evidence trails by odds of more than twenty to one
    are told apart. The remaining difference is the root mean square, over all other pairs and all
    candidates, of that between a fitted model and the one that made the readings, as a part of
    their difference now.

    Parameters
    ----------
    posterior, draws
        The model: a posterior of one record, and draws (draws, free).
    study, rivals
        The study of that record, and other fits of it.
    candidates
        Voltages (samples,) by name, V, at the interval of the fitted record, from rest.
    amplifier
        Limits of the amplifier.
    rng
        Draws parameters and initial states.
    watch
        Called with the share that is done.

    Raises
    ------
    InputError
        No rival fits the record about as well.
    """
    refused = {
        name: amplifier.refuses(voltage, posterior.single_record.actuator.interval)
        for name, voltage in candidates.items()
    }
    possible = {name: voltage for name, voltage in candidates.items() if not refused[name]}
    scores = [RivalScore(name, np.nan, np.nan, why) for name, why in refused.items() if why]
    if not possible:
        return scores
    draws = draws[rng.integers(len(draws), size=DRAWS)]
    readings = posterior.single_record.readings
    fitted = np.mean(posterior.simulate(posterior.prior.theta(draws), readings.rows), axis=0)
    close = close_rivals(rivals, float(np.std(readings.values - fitted)))
    if not close:
        raise InputError("design: no other model fits the training record about as well")
    models = [(posterior, draws)]
    for rival in close:
        model = rival.posterior(study)
        models.append((model, rival.draw(model, rng)))
    paths = [_Paths(*model, possible, rng) for model in watched(models, watch)]
    truths = {name: np.stack([path.mean[name] for path in paths]) for name in possible}
    now = _pairs_mean_square(
        {name: [truths[name] - p.mean[name] for p in paths] for name in possible}
    )
    for name in possible:
        remaining: dict[str, list[FloatArray]] = {other: [] for other in possible}
        told_apart = 0
        for path in paths:
            sizes, nats = path.fit(name, truths[name])
            out = nats > TIED
            told_apart += int(np.sum(out))
            for other in possible:
                learned = path.mean[other] + sizes @ path.deviations[other]
                remaining[other].append(np.where(out[:, np.newaxis], 0.0, truths[other] - learned))
        difference = np.sqrt(np.mean((truths[name][1:] - truths[name][0]) ** 2))
        scores.append(
            RivalScore(
                name,
                float(np.sqrt(_pairs_mean_square(remaining) / now)),
                np.nan,
                difference_um=float(difference),
                sd_um=paths[0].sd(name),
                told_apart=told_apart / (len(paths) * (len(paths) - 1)),
            )
        )
    return sorted(scores, key=lambda score: (bool(score.refused), score.sd_ratio, score.name))


def _pairs_mean_square(differences: Mapping[str, Sequence[FloatArray]]) -> float:
    """Return the mean square over pairs of models, and over candidates, um².

    A model's own readings do not differ from it.
    """
    squares = [np.mean(np.square(of_model)) for all_ in differences.values() for of_model in all_]
    return float(np.mean(squares))
