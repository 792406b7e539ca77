"""Models compared: their numbers, what is recommended, and how they are shown.

:func:`~bwbayes.comparison.recommendation.recommend` returns a :class:`Comparison`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, ClassVar

import numpy as np
from markupsafe import Markup

from bwbayes.comparison.candidates import Candidate
from bwbayes.diagnosis.validation import ValidationSummary
from bwbayes.errors import ExitStatus
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
    standing_banner,
)
from bwbayes.report.words import mark, with_error

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
        return Report(
            title="Comparison of models",
            heading="Which model",
            banners=[
                *standing_banner(self.standing),
                Banner(kind_of(self.standing) if self.recommended else "bad", first, others),
                *[Banner("note", "Caveats", items=self.caveats, label="caveat")]
                * bool(self.caveats),
            ],
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
