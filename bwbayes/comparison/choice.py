"""Which model: differences to the best, a recommendation, and what speaks against it.

Held-out readings decide first, because foretelling them is what a band is for. Where their scores
lie within two paired standard errors, or differ by little, the log evidence decides if it is sure:
by three nats, odds of twenty to one. What still cannot be told apart is called so, and the plainest
of it stands in front. Nothing is recommended whose score is lower by two errors, even if by little,
or whose sampling has not converged.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from bwbayes.arrays import FloatArray
from bwbayes.comparison.candidates import Candidate
from bwbayes.comparison.differences import SURE, Difference, paired
from bwbayes.comparison.future import BELIEVED_K
from bwbayes.results.standing import Standing
from bwbayes.shown import brief

__all__ = ["Comparison", "Measure", "choose"]

Measure = Literal["held_out", "future", "evidence"]

WORDS: Mapping[Measure, str] = {
    "held_out": "held-out log score",
    "future": "log score of the training readings' future",
    "evidence": "log evidence",
}

# Log evidences that differ by less do not tell models apart: odds of 20 to 1.
TELLING = 3.0

# An error of the log evidence above this leaves it out.
LARGEST_ERROR = 0.5

# Stretches as good as independent, below which the errors of scores are uncertain themselves.
FEW = 10


@dataclass(frozen=True)
class Comparison:
    """Models compared on the same readings.

    Attributes
    ----------
    candidates
        The models: the best first, what has not converged last.
    measure
        What decides first.
    best
        The best by that, to which the differences are; None if nothing has converged.
    differences
        By model and measure, the model less the best: held-out and future log scores in nats per
        reading, log evidence in nats.
    recommended
        The model recommended; None if nothing has converged.
    alike
        Models that cannot be told apart from it.
    lines
        The recommendation in words, a line each.
    against
        What speaks against it, a line each.
    """

    __repr__ = brief

    candidates: tuple[Candidate, ...]
    measure: Measure
    best: str | None
    differences: Mapping[str, Mapping[Measure, Difference]]
    recommended: str | None
    alike: tuple[str, ...]
    lines: tuple[str, ...]
    against: tuple[str, ...]

    @property
    def standing(self) -> Standing:
        """Whether the bands of the recommended model hold."""
        return Standing() if self.recommended is None else self[self.recommended].standing

    def __getitem__(self, name: str) -> Candidate:
        """Return a model by its name."""
        return next(one for one in self.candidates if one.name == name)


def choose(candidates: Sequence[Candidate], generator: np.random.Generator) -> Comparison:
    """Compare models that were fitted to the same readings.

    Parameters
    ----------
    candidates
        The models, of different names.
    generator
        Draws the blocks of the bootstrap.
    """
    usable = [one for one in candidates if one.converged]
    unusable = tuple(one for one in candidates if not one.converged)
    left_out = tuple(
        f"{one.name} has not converged ({one.stop_reason}) and is not judged" for one in unusable
    )
    measure = _measure(usable)
    if not usable:
        none = ("no model has converged, so none is recommended",)
        return Comparison(tuple(candidates), measure, None, {}, None, (), none, left_out)
    ordered = sorted(usable, key=lambda one: -_value(one, measure))
    best = ordered[0]
    differences = {one.name: _differences(one, best, generator) for one in ordered}
    near = [one for one in ordered if not differences[one.name][measure].worse]
    by_evidence: list[Candidate] = []
    if measure != "evidence" and len(near) > 1 and all(_known(one) for one in near):
        top = max(near, key=_log_evidence)
        by_evidence = [one for one in near if _less_likely(one, top)]
    alike = [one for one in near if one not in by_evidence]
    eligible = [one for one in alike if not differences[one.name][measure].beyond]
    if eligible:
        chosen = min(eligible, key=lambda one: (one.free, -_value(one, measure)))
    else:
        # Score and evidence disagree about models that predict nearly the same.
        chosen = best
        by_evidence = [one for one in by_evidence if one is not best]
    others = tuple(one.name for one in alike if one is not chosen)
    lines = _in_words(chosen, others, by_evidence, ordered, measure, differences)
    if chosen.hysteresis and any(not one.hysteresis for one in alike):
        lines = (*lines, "whether there is any hysteresis cannot be told")
    against = (*_against(chosen, best, ordered, measure, differences), *left_out)
    return Comparison(
        (*ordered, *unusable),
        measure,
        best.name,
        differences,
        chosen.name,
        others,
        lines,
        against,
    )


def _measure(usable: Sequence[Candidate]) -> Measure:
    """Return what all models have: held-out readings, a future, or the evidence alone."""
    if all(one.log_scores is not None for one in usable):
        return "held_out"
    if all(one.future is not None and one.future.converged for one in usable):
        return "future"
    return "evidence"


def _series(one: Candidate, measure: Measure) -> FloatArray | None:
    if measure == "held_out":
        return one.log_scores
    return one.future.log_score if one.future is not None else None


def _value(one: Candidate, measure: Measure) -> float:
    if measure == "evidence":
        return _log_evidence(one)
    series = _series(one, measure)
    assert series is not None
    return float(np.mean(series))


def _log_evidence(one: Candidate) -> float:
    known = one.evidence is not None and np.isfinite(one.evidence.log_evidence)
    return one.evidence.log_evidence if known and one.evidence is not None else -np.inf


def _known(one: Candidate) -> bool:
    return one.evidence is not None and one.evidence.error < LARGEST_ERROR


def _less_likely(one: Candidate, top: Candidate) -> bool:
    """Tell whether the evidence against a model is sure."""
    assert one.evidence is not None
    assert top.evidence is not None
    error = float(np.hypot(one.evidence.error, top.evidence.error))
    return _log_evidence(top) - _log_evidence(one) > TELLING + SURE * error


def _differences(
    one: Candidate, best: Candidate, generator: np.random.Generator
) -> dict[Measure, Difference]:
    """Return what a model has more than the best, by each measure that both have."""
    known: dict[Measure, Difference] = {}
    measures: tuple[Measure, ...] = ("held_out", "future")
    for measure in measures:
        ours, theirs = _series(one, measure), _series(best, measure)
        if ours is not None and theirs is not None:
            known[measure] = paired(ours, theirs, generator)
    if one.evidence is not None and best.evidence is not None:
        error = 0.0 if one is best else float(np.hypot(one.evidence.error, best.evidence.error))
        value = 0.0 if one is best else _log_evidence(one) - _log_evidence(best)
        known["evidence"] = Difference(value, error, total=value)
    return known


def _listed(names: Sequence[str]) -> str:
    return names[0] if len(names) == 1 else f"{', '.join(names[:-1])} and {names[-1]}"


def _in_words(
    chosen: Candidate,
    others: Sequence[str],
    by_evidence: Sequence[Candidate],
    ordered: Sequence[Candidate],
    measure: Measure,
    differences: Mapping[str, Mapping[Measure, Difference]],
) -> tuple[str, ...]:
    """Say what is recommended, and why."""
    lines = []
    if others:
        names = _listed([chosen.name, *others])
        plainest = all(chosen.free <= one.free for one in ordered if one.name in others)
        which = "the plainest of them is" if plainest else "the best score of them has"
        lines.append(f"{names} cannot be told apart; {which} {chosen.name}")
    elif len(ordered) > 1:
        lines.append(f"{chosen.name} is recommended")
    else:
        lines.append(f"{chosen.name} is the only model that has converged")
    if not chosen.hysteresis:
        lines.append("the record shows no hysteresis: a model without any does as well")
    worse = [one for one in ordered if differences[one.name][measure].worse]
    if worse:
        nearest = differences[worse[0].name][measure]
        which = f"{worse[0].name} " if len(worse) > 1 else ""
        lines.append(
            f"by the {WORDS[measure]} {_listed([one.name for one in worse])} "
            f"{'is' if len(worse) == 1 else 'are'} worse by more than {SURE:g} standard errors, "
            f"{which}by {-nearest.value:.3g} ± {nearest.error:.2g}"
        )
    if by_evidence:
        nearest_one = max(by_evidence, key=_log_evidence)
        top = max((one for one in ordered if one.name in (chosen.name, *others)), key=_log_evidence)
        margin = _log_evidence(top) - _log_evidence(nearest_one)
        lines.append(
            f"the {WORDS[measure]} does not tell {_listed([one.name for one in by_evidence])} "
            f"apart, but the log evidence is lower by {margin:.1f} or more"
        )
    return tuple(lines)


def _against(
    chosen: Candidate,
    best: Candidate,
    ordered: Sequence[Candidate],
    measure: Measure,
    differences: Mapping[str, Mapping[Measure, Difference]],
) -> list[str]:
    """Say what speaks against the recommendation."""
    said = []
    if chosen is not best:
        lost = differences[chosen.name][measure]
        said.append(
            f"{best.name} has the best {WORDS[measure]}, by {-lost.value:.2g} ± {lost.error:.2g}"
        )
    said += chosen.standing.said
    if measure == "evidence":
        said.append("nothing was held out, so the evidence decides, which trusts priors and noise")
    elif measure == "future":
        said.append("nothing was held out; the training readings' own future decides")
    if measure != "evidence" and _known(chosen):
        top = max((one for one in ordered if _known(one)), key=_log_evidence)
        if top is not chosen and _less_likely(chosen, top):
            by = _log_evidence(top) - _log_evidence(chosen)
            said.append(f"the log evidence is for {top.name}, by {by:.1f}")
    if measure == "held_out" and chosen.future is not None:
        said += _future_against(chosen, ordered, differences)
    lowest = min((one for one in ordered if one.bic is not None), key=_bic, default=chosen)
    if lowest is not chosen and _bic(lowest) < _bic(chosen) - 2 * TELLING:
        said.append(f"BIC is for {lowest.name}, by {_bic(chosen) - _bic(lowest):.1f}")
    blocks = min((d[measure].blocks for n, d in differences.items() if n != best.name), default=FEW)
    if blocks < FEW:
        said.append(
            f"the readings that decide are worth some {blocks:.0f} independent stretches only, so "
            "the errors are uncertain; hold out more"
        )
    return said


def _bic(one: Candidate) -> float:
    return np.inf if one.bic is None else one.bic


def _future_against(
    chosen: Candidate,
    ordered: Sequence[Candidate],
    differences: Mapping[str, Mapping[Measure, Difference]],
) -> list[str]:
    """Say where the training readings' own future speaks for another model."""
    told = [one for one in ordered if one.future is not None and one.future.converged]
    ours = differences[chosen.name].get("future")
    if chosen not in told or ours is None:
        return ["fits to parts of the training readings did not converge; its future is not judged"]
    top = max(told, key=lambda one: _value(one, "future"))
    gain = differences[top.name]["future"].value - ours.value
    error = float(np.hypot(differences[top.name]["future"].error, ours.error))
    said = []
    if top is not chosen and gain > SURE * error:
        said.append(f"the {WORDS['future']} is for {top.name}, by {gain:.2g} ± {error:.2g}")
    assert chosen.future is not None
    if chosen.future.pareto_k and max(chosen.future.pareto_k) > BELIEVED_K:
        said.append("its posterior moves much as the record goes on (Pareto k above 0.7)")
    return said
