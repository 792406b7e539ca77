"""A comparison as numbers for a file, and as texts for screen and page."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

from bwbayes.comparison.candidates import Candidate
from bwbayes.comparison.choice import Comparison, Measure
from bwbayes.comparison.differences import Difference
from bwbayes.results.scores import as_summary

__all__ = ["COLUMNS", "DIFFERENCE_COLUMNS", "differences", "numbers", "rows", "table"]

COLUMNS = (
    "model",
    "free",
    "log score",
    "CRPS",
    "NRMSE",
    "95 % covers",
    "95 % width",
    "future",
    "log evidence",
    "AIC",
    "BIC",
)
DIFFERENCE_COLUMNS = ("model", "held-out log score", "future log score", "log evidence")

MEASURES: tuple[Measure, ...] = ("held_out", "future", "evidence")


def rows(comparison: Comparison) -> Iterator[tuple[str, ...]]:
    """Yield a text for each of ``COLUMNS``, a row for each model; a dash where nothing is known."""
    for one in comparison.candidates:
        if not one.converged:
            yield (one.name, str(one.free), "not converged", *["-"] * (len(COLUMNS) - 3))
            continue
        mean, future, evidence = one.mean, one.future, one.evidence
        held = ("-",) * 5
        if mean is not None:
            held = (
                f"{mean.log_score:.3f}",
                f"{mean.crps_um:.4f} um",
                f"{mean.nrmse:.2%}",
                f"{mean.coverage:.1%} ± {mean.coverage_error:.1%}",
                f"{mean.width_um:.3g} um",
            )
        yield (
            one.name,
            str(one.free),
            *held,
            "-" if future is None else f"{future.log_score.mean():.3f}",
            "-" if evidence is None else f"{evidence.log_evidence:.2f} ± {evidence.error:.2f}",
            "-" if one.aic is None else f"{one.aic:.1f}",
            "-" if one.bic is None else f"{one.bic:.1f}",
        )


def differences(comparison: Comparison) -> Iterator[tuple[str, ...]]:
    """Yield a text for each of ``DIFFERENCE_COLUMNS``, a row for each model but the best."""
    for name, known in comparison.differences.items():
        if name != comparison.best:
            yield name, *(_text(known.get(measure)) for measure in MEASURES)


def _text(known: Difference | None) -> str:
    return "-" if known is None else f"{known.value:+.3g} ± {known.error:.2g}"


def numbers(comparison: Comparison) -> dict[str, object]:
    """Return what ``comparison.json`` holds."""
    return {
        "measure": comparison.measure,
        "best": comparison.best,
        "recommended": comparison.recommended,
        "alike": list(comparison.alike),
        "recommendation": list(comparison.lines),
        "against": list(comparison.against),
        "validation": comparison.standing.numbers,
        "models": {
            one.name: _model(one, comparison.differences.get(one.name, {}))
            for one in comparison.candidates
        },
    }


def _model(one: Candidate, known: Mapping[Measure, Difference]) -> dict[str, object]:
    future, evidence = one.future, one.evidence
    return {
        "model": one.model,
        "converged": one.converged,
        "stop_reason": one.stop_reason,
        "free": one.free,
        "readings": one.readings,
        "validation": one.standing.status if one.converged else None,
        "held_out": None if one.mean is None else vars(one.mean),
        "windows": {name: as_summary(scores) for name, scores in one.scores.items()},
        "joint_log_score": None if one.joint is None else one.joint[0],
        "joint_pareto_k": None if one.joint is None else one.joint[1],
        "future": None
        if future is None
        else {
            "log_score": float(future.log_score.mean()),
            "readings": int(future.log_score.size),
            "pareto_k": list(future.pareto_k),
            "fits": future.fits,
            "converged": future.converged,
        },
        "log_evidence": None if evidence is None else evidence.log_evidence,
        "log_evidence_error": None if evidence is None else evidence.error,
        "log_prior_mass": None if evidence is None else evidence.log_prior_mass,
        "log_likelihood": one.log_likelihood,
        "aic": one.aic,
        "bic": one.bic,
        "difference": {
            measure: {"value": d.value, "error": d.error} for measure, d in known.items()
        },
    }


def table(comparison: Comparison) -> list[dict[str, object]]:
    """Return a flat row of numbers for each model, as ``comparison.csv`` has them."""
    flat = []
    for one in comparison.candidates:
        row: dict[str, object] = {"name": one.name}
        said = _model(one, comparison.differences.get(one.name, {}))
        for key, value in said.items():
            if key == "windows":
                continue
            if isinstance(value, Mapping):
                for inner, number in value.items():
                    if isinstance(number, Mapping):
                        row |= {f"{key}_{inner}_{k}": v for k, v in number.items()}
                    elif not isinstance(number, list):
                        row[f"{key}_{inner}"] = number
            else:
                row[key] = value
        flat.append(row)
    return flat
