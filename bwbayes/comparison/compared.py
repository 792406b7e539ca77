"""Models compared: their numbers, what is recommended, and how they are shown and kept.

What :func:`~bwbayes.comparison.recommendation.recommend` returns.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from bwbayes.comparison.candidates import Candidate
from bwbayes.diagnosis.standing import Standing
from bwbayes.report.report import (
    Banner,
    Facts,
    Report,
    Section,
    Table,
    TableColumn,
    kind_of,
    standing_banner,
)
from bwbayes.report.words import mark
from bwbayes.shown import head

__all__ = ["Comparison", "Difference"]


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


@dataclass(frozen=True)
class Comparison:
    """Models compared on the same readings.

    Attributes
    ----------
    candidates
        The models: the best first, what has not converged last.
    voting
        The parts whose log scores decide; none if the log evidence does.
    best
        The best by that, to which the differences are; None if nothing has converged.
    differences
        By model, the model less the best, nats.
    recommended
        The model recommended; None if nothing has converged.
    tied
        Models that cannot be told apart from it.
    lines
        The recommendation in words, a line each.
    caveats
        What speaks against it, a line each.
    facts
        What was compared: subjects, and what is said of each.
    """

    candidates: tuple[Candidate, ...]
    voting: tuple[str, ...]
    best: str | None
    differences: Mapping[str, Difference]
    recommended: str | None
    tied: tuple[str, ...]
    lines: tuple[str, ...]
    caveats: tuple[str, ...]
    facts: tuple[tuple[str, str], ...] = ()

    @property
    def measure(self) -> str:
        """What decides first, in words."""
        return "log score" if self.voting else "log evidence"

    @property
    def standing(self) -> Standing:
        """Whether the bands of the recommended model hold."""
        recommended = None if self.recommended is None else self[self.recommended].standing
        return recommended or Standing()

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
        evidence, difference = model.evidence, self.differences.get(model.name)
        return {
            "model": model.model,
            "converged": model.converged,
            "screened": model.screened,
            "stop_reason": model.stop_reason,
            "free": model.free,
            "readings": model.readings,
            "validation": None if model.standing is None else model.standing.status,
            "held_out": None if model.mean is None else vars(model.mean),
            "windows": {name: scores.numbers for name, scores in model.scores.items()},
            "parts": {
                name: {
                    "log_score": float(np.sum(section.log_scores)),
                    "readings": section.readings,
                    "independent": section.worth,
                    "joint": section.joint,
                    "votes": name in self.voting,
                }
                for name, section in model.parts.items()
            },
            "log_evidence": None if evidence is None else evidence.log_evidence,
            "log_evidence_error": None if evidence is None else evidence.error,
            "log_prior_mass": None if evidence is None else evidence.log_prior_mass,
            "prior_share": None if evidence is None else evidence.prior_share,
            "log_likelihood": model.log_likelihood,
            "aic": model.aic,
            "bic": model.bic,
            "difference": None if difference is None else vars(difference),
        }

    def to_pandas(self) -> Any:
        """Return a pandas.DataFrame with a row for each model, as ``comparison.csv`` has them."""
        import pandas as pd  # noqa: PLC0415  # slow to load, and only needed here

        rows = [{"name": model.name, **self._model_numbers(model)} for model in self.candidates]
        for row in rows:
            del row["windows"]
        frame = pd.json_normalize(rows, sep="_").set_index("name")
        # What is nested has columns of its own, but where it is missing.
        return frame.drop(columns=["held_out", "difference"], errors="ignore")

    def save(self, folder: str | Path) -> Path:
        """Write page, table and numbers to a folder, as ``bwbayes compare`` does; return it.

        Raises
        ------
        InputError
            The folder cannot be written.
        """
        from bwbayes.report.saving import save  # noqa: PLC0415  # slow to load

        save(self.report(), Path(folder), "comparison")
        return Path(folder)

    def report(self) -> Report:
        """Return what is recommended, what speaks against it, and the numbers, to be shown."""
        first, *others = self.lines
        tables = [self._models_table(), self._differences_table()]
        return Report(
            title="Comparison of models",
            heading="Which model",
            banners=[
                # The screen has it among what speaks against the recommendation.
                *standing_banner(self.standing, on="page"),
                Banner(kind_of(self.standing) if self.recommended else "bad", first, others),
                *[Banner("note", "What speaks against it", items=self.caveats, label="against it")]
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
        return Table(
            "models",
            "Models",
            MODEL_COLUMNS,
            [(model.name, *_model_texts(model, self.voting)) for model in self.candidates],
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
        return Table(
            "differences",
            f"Differences to {self.best}",
            ("Model", self.measure.capitalize(), *parts, "Log evidence"),
            [
                (name, *self._difference_texts(self[name], parts))
                for name in self.differences
                if name != self.best
            ],
            note="Model less the best, nats: what decides with its standard error, by blocks "
            "longer than the correlation time; then part by part, in brackets those worth fewer "
            "than five independent readings, which have no vote. Less than four nats, or than the "
            "95% limit of the error, does not tell models apart.",
            on="both",
        )

    def _difference_texts(self, model: Candidate, parts: tuple[str, ...]) -> tuple[str, ...]:
        assert self.best is not None
        best, difference = self[self.best], self.differences[model.name]
        texts = [f"{difference.value:+.3g} ± {difference.error:.2g}"]
        for name in parts:
            if name not in model.parts:
                texts.append("–")
                continue
            gain = np.sum(model.parts[name].log_scores - best.parts[name].log_scores)
            texts.append(f"{gain:+.3g}" if name in self.voting else f"({gain:+.3g})")
        advantage = model.log_evidence - best.log_evidence
        return (*texts, f"{advantage:+.3g}" if np.isfinite(advantage) else "–")

    def __repr__(self) -> str:
        return head(str(self))

    def __str__(self) -> str:
        from bwbayes.report.screen import as_text  # noqa: PLC0415  # slow to load

        return as_text(self.report())

    def _repr_html_(self) -> str:
        from bwbayes.report.page import fragment  # noqa: PLC0415  # slow to load

        return fragment(self.report())


MODEL_COLUMNS = (
    "Model",
    "Validation",
    "Free",
    "Log score",
    TableColumn("CRPS", on="page"),
    "NRMSE",
    "95% covers",
    TableColumn("95% width", on="page"),
    "Log evidence",
    "Priors' share",
    TableColumn("AIC", on="page"),
    TableColumn("BIC", on="page"),
)


def _model_texts(model: Candidate, voting: tuple[str, ...]) -> tuple[str, ...]:
    """Return a text for each of the columns but the first; a dash where nothing is known."""
    mean, evidence = model.mean, model.evidence
    held_out: tuple[str, ...] = ("–",) * 4
    if mean is not None:
        held_out = (
            f"{mean.crps_um:.4f} µm",
            f"{mean.nrmse:.2%}",
            f"{mean.coverage:.1%} ± {mean.coverage_error:.1%}",
            f"{mean.width_um:.3g} µm",
        )
    from_evidence: tuple[str, ...] = ("–",) * 4
    if evidence is not None:
        value, error = evidence.log_evidence, evidence.error
        from_evidence = (
            f"about {value:.0f}" if model.screened else f"{value:.2f} ± {error:.2f}",
            f"{evidence.prior_share:.1f}",
            f"{model.aic:.1f}",
            f"{model.bic:.1f}",
        )
    status = "–" if model.standing is None else mark(model.standing.status)
    return (
        "only screened" if model.screened else status if model.converged else "not converged",
        str(model.free),
        f"{model.log_score(voting):.1f}" if voting and model.converged else "–",
        *held_out,
        *from_evidence,
    )
