"""Which model: differences to the best, a recommendation, and its caveats.

There is one rule. A model's score is the joint log density of the later readings, given the earlier
ones (:mod:`~bwbayes.comparison.leave_future_out`), summed over the later half of the training
readings and all that was held out. A part worth fewer than five independent readings has no vote.
Models tie if their sums differ by less than four nats, or than the 95% limit of blocks longer than
the correlation time. The tied model with the largest log evidence is recommended; evidence weighs a
model's fit against its freedom. The others stay tied unless they are less probable by odds of
twenty to one, and the tie is said. Where no part has a vote, the log evidence decides alone, and
where its Monte Carlo error leaves it open, the plainest is recommended.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np
import scipy

from bwbayes.comparison.candidates import Candidate
from bwbayes.comparison.compared import Comparison, Difference
from bwbayes.report.words import with_error

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


def _listed(names: Sequence[str]) -> str:
    return " and ".join(filter(None, [", ".join(names[:-1]), names[-1]]))


def _summarize(comparison: Comparison) -> Iterator[str]:
    """Say what is recommended, and why."""
    recommended, tied = comparison[str(comparison.recommended)], comparison.tied
    screened = [candidate.name for candidate in comparison.candidates if candidate.screened]
    if tied:
        names = _listed([recommended.name, *tied])
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
            f"by the {comparison.measure} {_listed(worse)} {'is' if len(worse) == 1 else 'are'} "
            f"worse, {which}by {with_error(-nearest.value, nearest.error)} nats"
        )
    others = [n for n in comparison.differences if n not in (*worse, recommended.name, *tied)]
    if others:
        evidence = {name: comparison[name].log_evidence for name in comparison.differences}
        margin = max(evidence[name] for name in (recommended.name, *tied)) - max(
            evidence[name] for name in others
        )
        yield (
            f"the {comparison.measure} does not tell {_listed(others)} apart, "
            f"but the log evidence is lower by {margin:.1f} nats or more"
        )
    if screened:
        yield f"only screened, as too far behind at the MAP estimate: {_listed(screened)}"


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
