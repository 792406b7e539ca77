"""Which model: candidates in numbers, their differences to the best, a recommendation, its caveats.

Everything is about the same readings for all models: the held-out ones for scores and bands, these
and the later half of the training readings for what decides, all of the training readings for
evidence and information criteria.

There is one rule. A model's score is the joint log density of the later readings, given the earlier
ones (:func:`~bwbayes.comparison.evidence.leave_future_out`), summed over the later half of the
training readings and all that was held out. A part worth fewer than five independent readings has
no vote. Models tie if their sums differ by less than four nats, or than the 95% limit of blocks
longer than the correlation time. The tied model with the largest log evidence is recommended;
evidence weighs a model's fit against its freedom. The others stay tied unless they are less
probable by odds of twenty to one, and the tie is said. Where no part has a vote, the log evidence
decides alone, and where its Monte Carlo error leaves it open, the plainest is recommended.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, ClassVar

import numpy as np
import scipy
from markupsafe import Markup

from bwbayes.comparison.evidence import Evidence, Part
from bwbayes.diagnosis.validation import ValidationSummary
from bwbayes.errors import ExitStatus
from bwbayes.prediction.bands import Bands
from bwbayes.report.report import (
    UNKNOWN,
    Banner,
    Facts,
    Product,
    Report,
    Section,
    Table,
    TableColumn,
    kind_of,
    mark,
    standing_banner,
    with_error,
)
from bwbayes.shown import brief


@dataclass(frozen=True)
class Candidate:
    """A model that was fitted.

    Attributes
    ----------
    name
        Its name in the comparison.
    model
        Its parts, in words.
    converged, stop_reason
        How its sampling ended; all below stays empty unless converged.
    free
        Number of free parameters.
    readings
        Number of training readings.
    hysteresis
        Whether it has any hysteresis.
    held_out
        Bands of what was held out and measured.
    standing
        Whether its run's bands hold; None if that was not worked out.
    parts
        Its log scores of later readings, by the part's name.
    evidence
        Its log evidence.
    screened
        Whether it was only screened: its evidence, by Laplace's approximation at the MAP estimate,
        and its likelihood are too far behind for sampling it to be worth while.
    """

    __repr__ = brief

    name: str
    model: str
    converged: bool
    stop_reason: str
    free: int
    readings: int
    hysteresis: bool = True
    held_out: tuple[Bands, ...] = ()
    standing: ValidationSummary | None = None
    parts: Mapping[str, Part] = field(default_factory=dict)
    evidence: Evidence | None = None
    screened: bool = False

    @property
    def log_evidence(self) -> float:
        """Its log evidence, nats; −∞ if it is not known."""
        value = np.nan if self.evidence is None else self.evidence.log_evidence
        return value if np.isfinite(value) else -np.inf

    @property
    def log_likelihood(self) -> float | None:
        """The largest among the draws, or at the MAP estimate, nats."""
        return None if self.evidence is None else self.evidence.max_log_likelihood

    def criterion(self, penalty: float) -> float | None:
        """Return penalty times k − 2 log L: Akaike's with 2, Schwarz's with the log of readings."""
        if self.log_likelihood is None:
            return None
        return penalty * self.free - 2 * self.log_likelihood

    def log_score(self, parts: Collection[str]) -> float:
        """Return the sum of its log scores of parts by their names, nats."""
        return sum(float(np.sum(self.parts[name].log_scores)) for name in parts)

    @property
    def mean(self) -> dict[str, float] | None:
        """Means over all held-out readings, each counting the same; None without any.

        ``log_score`` in nats per reading, ``crps_um`` and ``width_um`` of the 95% sensor band in
        um, ``nrmse`` over the range of the readings; ``coverage`` of the 95% sensor band with its
        error.
        """
        counts = np.array([np.sum(b.scored(b.measured)) for b in self.held_out], dtype=np.float64)
        if not counts.sum():
            return None
        shares, scores = counts / counts.sum(), [b.scores for b in self.held_out if b.scores]
        covered, errors = (
            np.array([dict(values["sensor"] or {})[95] for values in several])
            for several in ([s.coverage for s in scores], [s.coverage_error for s in scores])
        )
        return {
            "log_score": float(shares @ [score.log_score for score in scores]),
            "crps_um": float(shares @ [score.crps_um for score in scores]),
            "nrmse": float(np.sqrt(shares @ np.square([score.nrmse for score in scores]))),
            "coverage": float(shares @ covered),
            "coverage_error": float(np.sqrt(shares**2 @ np.square(errors))),
            "width_um": float(shares @ [score.width_um[95] for score in scores]),
        }

    def numbers(self, voting: Collection[str]) -> dict[str, Any]:
        """Return what ``comparison.json`` holds of it; ``voting`` are the parts that decide."""
        evidence = {} if self.evidence is None else vars(self.evidence)
        return {
            "model": self.model,
            "converged": self.converged,
            "screened": self.screened,
            "stop_reason": self.stop_reason,
            "free": self.free,
            "readings": self.readings,
            "validation": None if self.standing is None else self.standing.status,
            "held_out": self.mean,
            "windows": {b.name: b.scores.numbers for b in self.held_out if b.scores},
            "parts": {
                name: {
                    "log_score": float(np.sum(section.log_scores)),
                    "readings": section.readings,
                    "independent": section.independent,
                    "joint": section.joint,
                    "votes": name in voting,
                }
                for name, section in self.parts.items()
            },
            "log_evidence": evidence.get("log_evidence"),
            "log_evidence_error": evidence.get("error"),
            "log_prior_mass": evidence.get("log_prior_mass"),
            "prior_share": evidence.get("prior_share"),
            "log_likelihood": self.log_likelihood,
            "aic": self.criterion(2.0),
            "bic": self.criterion(float(np.log(self.readings))),
        }


# The columns of the models' table. The deciding numbers stand in the table of differences.
COLUMNS = (
    TableColumn("Model", text="{name}"),
    TableColumn("Validation", text=Markup("{status}")),
    TableColumn("Free", text="{free}"),
    TableColumn("Log score", on="page", text="{log_score:.1f}"),
    TableColumn("CRPS", on="page", text="{held_out[crps_um]:.3g} µm"),
    TableColumn("NRMSE", text="{held_out[nrmse]:.2%}"),
    TableColumn("95% covers", text="{held_out[coverage]:.1%} ± {held_out[coverage_error]:.1%}"),
    TableColumn("95% width", text="{held_out[width_um]:.3g} µm"),
    TableColumn("Log evidence", on="page", text="{evidence}"),
    TableColumn("Priors' share", on="page", text="{prior_share:.1f}"),
    TableColumn("AIC", on="page", text="{aic:.1f}"),
    TableColumn("BIC", on="page", text="{bic:.1f}"),
)


@dataclass(frozen=True)
class Difference:
    """A model less the best by what decides, nats: ``value``, standard error, and ``limit``.

    A model whose value is lower by more than the limit is worse.
    """

    value: float
    error: float
    limit: float

    @property
    def worse(self) -> bool:
        """Whether the model is worse for sure."""
        return -self.value > self.limit


@dataclass(frozen=True, repr=False)
class Comparison(Product):
    """Models compared on the same readings.

    Attributes
    ----------
    candidates
        The models: the best first, what has not converged last.
    voting
        The parts whose log scores decide; none if the log evidence does.
    differences
        By model that has converged, the model less the best, nats; the best first.
    tied
        Models that cannot be told apart from the recommended one.
    recommended
        The model recommended; None if nothing has converged.
    lines, caveats
        The recommendation in words, and what speaks against it, a line each.
    facts
        Facts about the comparison, by subject.
    """

    NAME: ClassVar[str] = "comparison"

    candidates: tuple[Candidate, ...]
    voting: tuple[str, ...] = ()
    differences: Mapping[str, Difference] = field(default_factory=dict)
    recommended: str | None = None
    tied: tuple[str, ...] = ()
    lines: tuple[str, ...] = ()
    caveats: tuple[str, ...] = ()
    facts: Sequence[tuple[str, str]] = ()

    @property
    def best(self) -> str | None:
        """The best by what decides; None if nothing has converged."""
        return next(iter(self.differences), None)

    @property
    def measure(self) -> str:
        """The number that decides first, in words."""
        return "log score" if self.voting else "log evidence"

    @property
    def standing(self) -> ValidationSummary:
        """Whether the bands of the recommended model hold."""
        recommended = None if self.recommended is None else self[self.recommended].standing
        return recommended or ValidationSummary()

    @property
    def shortfall(self) -> str:
        """Why no model is recommended; empty if one is."""
        if self.recommended is not None:
            return ""
        return "NOT CONVERGED: no model has converged, so none is recommended"

    @property
    def exit_status(self) -> ExitStatus:
        """The status is no success if no model has converged."""
        return ExitStatus.NOT_CONVERGED if self.shortfall else ExitStatus.SUCCESS

    def __getitem__(self, name: str) -> Candidate:
        """Return a model by its name."""
        return next(model for model in self.candidates if model.name == name)

    def numbers(self) -> dict[str, object]:
        """Return what ``comparison.json`` holds."""
        return {
            "measure": self.measure,
            "voting": list(self.voting),
            "best": self.best,
            "recommended": self.recommended,
            "tied": list(self.tied),
            "recommendation": list(self.lines),
            "caveats": list(self.caveats),
            "validation": self.standing.numbers,
            "models": {model.name: self._model_numbers(model) for model in self.candidates},
        }

    def _model_numbers(self, model: Candidate) -> dict[str, Any]:
        difference = self.differences.get(model.name)
        return model.numbers(self.voting) | {"difference": difference and vars(difference)}

    def to_pandas(self) -> Any:
        """Return a pandas.DataFrame with a row for each model, as ``comparison.csv`` has them."""
        import pandas as pd  # noqa: PLC0415  # slow to load, and only needed here

        rows = [{"name": model.name, **self._model_numbers(model)} for model in self.candidates]
        for row in rows:
            del row["windows"]
        frame = pd.json_normalize(rows, sep="_").set_index("name")
        # Nested values have columns of their own, except where they are missing.
        return frame.drop(columns=["held_out", "difference"], errors="ignore")

    def report(self) -> Report:
        """Return what is recommended, what speaks against it, and the numbers, to be shown."""
        first, *others = self.lines
        tables = [self._models_table(), self._differences_table()]
        banners = standing_banner(self.standing)
        banners.append(Banner(kind_of(self.standing) if self.recommended else "bad", first, others))
        if self.caveats:
            banners.append(Banner("note", "Caveats", items=self.caveats, label="caveat"))
        return Report(
            title="Comparison of models",
            heading="Which model",
            banners=banners,
            blocks=[
                *(table for table in tables if table.rows),
                Section("Models and readings", [Facts(self.facts)]),
            ],
            numbers=self.numbers(),
            csv=self.to_pandas().to_csv(lineterminator="\n"),
        )

    def _models_table(self) -> Table:
        rows = []
        for model in self.candidates:
            row = {"name": model.name, **self._model_numbers(model)}
            row["status"] = UNKNOWN if model.standing is None else mark(model.standing.status)
            if not model.converged:
                row["status"] = "only screened" if model.screened else "not converged"
            if self.voting and model.converged:
                row["log_score"] = model.log_score(self.voting)
            if model.evidence is not None:
                text = "about {log_evidence:.0f}"
                if not model.screened:
                    text = "{log_evidence:.2f} ± {log_evidence_error:.2f}"
                row["evidence"] = text.format_map(row)
            rows.append(row)
        return Table.of(
            "models",
            "Models",
            rows,
            COLUMNS,
            records=self.to_pandas().reset_index().to_dict("records"),
            note="Log score: joint log density of the later readings, each given all before it, "
            "summed over the parts that vote; nats. CRPS, NRMSE, coverage and width on what was "
            "held out. Log evidence: by bridge sampling, nats, or about that by Laplace's "
            "approximation at the MAP estimate of a model that was only screened; the priors' "
            "share is what it pays for their width. AIC and BIC: with the largest likelihood. All "
            "of them take the noise model at its word.",
            on="both",
        )

    def _differences_table(self) -> Table:
        parts = tuple(self[self.best].parts) if self.best else ()
        rows = []
        for name, margin in list(self.differences.items())[1:]:  # the first is the best
            model, best = self[name], self[str(self.best)]
            sign = "+" if margin.value > 0 else ""
            texts = [f"{sign}{with_error(margin.value, margin.error)}"]
            for part_name in parts:
                if part_name not in model.parts:
                    texts.append(UNKNOWN)
                    continue
                gain = f"{model.log_score([part_name]) - best.log_score([part_name]):+.3g}"
                texts.append(gain if part_name in self.voting else f"({gain})")
            advantage = model.log_evidence - best.log_evidence
            texts.append(f"{advantage:+.3g}" if np.isfinite(advantage) else UNKNOWN)
            rows.append((name, *texts))
        return Table(
            "differences",
            f"Differences to {self.best}",
            ("Model", self.measure.capitalize(), *parts, "Log evidence"),
            rows,
            note="Model less the best, nats: what decides with its standard error, by blocks "
            "longer than the correlation time; then part by part, in brackets those worth fewer "
            "than five independent readings, which have no vote. Less than four nats, or than the "
            "95% limit of the error, does not tell models apart.",
            on="both",
        )


# Independent readings that a part must be worth to have a vote: as many blocks tell its error.
MIN_INDEPENDENT = 5


def recommend(candidates: Sequence[Candidate], facts: Sequence[tuple[str, str]] = ()) -> Comparison:
    """Compare models that were fitted to the same readings; their names differ.

    ``facts`` are subjects of the comparison, and what is said of each.
    """
    usable = [candidate for candidate in candidates if candidate.converged]
    unusable = sorted(
        (candidate for candidate in candidates if not candidate.converged),
        key=lambda candidate: -candidate.log_evidence,
    )
    unconverged = [
        f"{candidate.name} has not converged ({candidate.stop_reason}) and is not judged"
        for candidate in unusable
        if not candidate.screened
    ]
    if not usable:
        none = ("no model has converged, so none is recommended",)
        return Comparison(tuple(unusable), lines=none, caveats=tuple(unconverged), facts=facts)
    sizes = {
        name: max(candidate.parts[name].independent for candidate in usable)
        for name in usable[0].parts
        if all(name in candidate.parts for candidate in usable)
    }
    voting = tuple(name for name, independent in sizes.items() if independent >= MIN_INDEPENDENT)

    def value(candidate: Candidate) -> float:
        return candidate.log_score(voting) if voting else candidate.log_evidence

    def below(candidate: Candidate, best: Candidate) -> Difference:
        return difference(candidate, best, voting) if voting else _less_probable(candidate, best)

    # Readings that were scored one by one count as independent ones do.
    counted = []
    for candidate in usable:
        parts = {
            name: replace(
                scored_part, log_scores=scored_part.log_scores * sizes[name] / scored_part.readings
            )
            for name, scored_part in candidate.parts.items()
            if name in sizes and not scored_part.joint
        }
        counted.append(replace(candidate, parts={**candidate.parts, **parts}))
    ordered = sorted(counted, key=lambda candidate: -value(candidate))
    differences = {candidate.name: below(candidate, ordered[0]) for candidate in ordered}
    near = [candidate for candidate in ordered if not differences[candidate.name].worse]
    if all(_is_known(candidate) for candidate in near):
        chosen = min(near, key=lambda candidate: (-candidate.log_evidence, candidate.free))
        tied = [candidate for candidate in near if not _less_probable(candidate, chosen).worse]
    else:
        chosen, tied = min(near, key=lambda candidate: (candidate.free, -value(candidate))), near
    comparison = Comparison(
        (*ordered, *unusable),
        voting,
        differences,
        chosen.name,
        tuple(candidate.name for candidate in tied if candidate is not chosen),
        facts=facts,
    )
    without_vote = [
        f"{name} is worth {independent:.1f} independent readings only and has no vote"
        for name, independent in sizes.items()
        if name not in voting
    ]
    return replace(
        comparison,
        lines=tuple(_summarize(comparison)),
        caveats=(*_list_caveats(comparison), *without_vote, *unconverged),
    )


def difference(candidate: Candidate, best: Candidate, voting: Sequence[str]) -> Difference:
    """Return the log score of a model less that of the best, over parts by their names, nats.

    Its error is that of sums over blocks of each part, ten, or five where either model's residuals
    leave no ten independent ones; the Monte Carlo errors of both are in it. Less than four nats
    are small whatever their error: models that predict nearly the same differ by the luck of one
    fit (T. Sivula, M. Magnusson, A. Vehtari, arXiv:2008.10296).
    """
    if candidate is best:
        return Difference(0.0, 0.0, 0.0)
    total, variance, freedom = 0.0, 0.0, 0
    with np.errstate(invalid="ignore"):  # both may hold a reading for impossible
        for first, second in ((candidate.parts[name], best.parts[name]) for name in voting):
            gains = first.log_scores - second.log_scores
            is_enough = min(first.independent, second.independent) >= gains.size
            blocks = gains.size if is_enough else MIN_INDEPENDENT
            sums = gains.reshape(blocks, -1).sum(axis=1)
            total += float(np.sum(sums))
            variance += blocks * float(np.var(sums, ddof=1))
            variance += 1 / first.effective + 1 / second.effective
            freedom += blocks - 1
    error = float(np.sqrt(variance))
    return Difference(total, error, max(4.0, float(scipy.stats.t.ppf(0.975, freedom)) * error))


def _less_probable(candidate: Candidate, best: Candidate) -> Difference:
    """Return the log evidence of a model less that of the best; odds of 20 to 1 count."""
    if candidate is best:
        return Difference(0.0, 0.0, 0.0)
    errors = [c.evidence.error for c in (candidate, best) if c.evidence is not None]
    error = float(np.linalg.norm(errors)) if len(errors) > 1 else np.inf
    return Difference(
        candidate.log_evidence - best.log_evidence, error, float(np.log(20)) + 2 * error
    )


def _is_known(candidate: Candidate) -> bool:
    """Tell whether the Monte Carlo error of a log evidence leaves it in."""
    return candidate.evidence is not None and candidate.evidence.error < 0.5


def _list_of(names: Sequence[str]) -> str:
    return " and ".join(filter(None, [", ".join(names[:-1]), names[-1]]))


def _summarize(comparison: Comparison) -> Iterator[str]:
    """Say what is recommended, and why."""
    recommended, tied = comparison[str(comparison.recommended)], comparison.tied
    screened = [candidate.name for candidate in comparison.candidates if candidate.screened]
    if tied:
        names = _list_of([recommended.name, *tied])
        are_known = all(_is_known(comparison[name]) for name in (recommended.name, *tied))
        why = "most probable" if are_known else "simplest"
        yield f"{names} are indistinguishable; {recommended.name} is the {why}"
    elif len(comparison.differences) > 1 or screened:
        yield f"{recommended.name} is recommended"
    else:
        yield f"{recommended.name} is the only model that has converged"
    if not recommended.hysteresis:
        yield "the record shows no hysteresis: a model without any does as well"
    elif any(not comparison[name].hysteresis for name in tied):
        yield "whether there is any hysteresis cannot be told"
    worse = [name for name, value in comparison.differences.items() if value.worse]
    if worse:
        nearest = comparison.differences[worse[0]]
        which = f"{worse[0]} " if len(worse) > 1 else ""
        yield (
            f"by the {comparison.measure} {_list_of(worse)} {'is' if len(worse) == 1 else 'are'} "
            f"worse, {which}by {with_error(-nearest.value, nearest.error)} nats"
        )
    others = [n for n in comparison.differences if n not in (*worse, recommended.name, *tied)]
    if others:
        evidence = {name: comparison[name].log_evidence for name in comparison.differences}
        margin = max(evidence[name] for name in (recommended.name, *tied)) - max(
            evidence[name] for name in others
        )
        yield (
            f"the {comparison.measure} does not tell {_list_of(others)} apart, "
            f"but the log evidence is lower by {margin:.1f} nats or more"
        )
    if screened:
        yield f"only screened, as too far behind at the MAP estimate: {_list_of(screened)}"


def _list_caveats(comparison: Comparison) -> Iterator[str]:
    """Say what speaks against the recommendation."""
    recommended = comparison[str(comparison.recommended)]
    if recommended.name != comparison.best:
        behind = comparison.differences[recommended.name]
        yield (
            f"{comparison.best} has the best {comparison.measure}, "
            f"by {with_error(-behind.value, behind.error)} nats"
        )
    if not comparison.voting:
        yield "the evidence decides alone, which takes priors and noise at their word"
        return
    converged = [comparison[name] for name in comparison.differences]
    top = max(converged, key=lambda candidate: candidate.log_evidence)
    against = _less_probable(recommended, top)
    if top.evidence and recommended.evidence and _is_known(top) and against.worse:
        share = recommended.evidence.prior_share - top.evidence.prior_share
        yield (
            f"the log evidence is for {top.name}, by {-against.value:.1f} nats, "
            f"of which {share:.1f} are the priors' share"
        )
