"""What a run was made of, in words, for its report."""

from __future__ import annotations

from bwbayes.app.problem.model import in_words
from bwbayes.app.problem.problem import Problem
from bwbayes.record import Record
from bwbayes.sampling.chain import PHASES
from bwbayes.sampling.storage import ChainFile

__all__ = ["facts_of", "stepped"]


def stepped(problem: Problem) -> dict[str, Record]:
    """Return the records that may show a step response: others, and those of a joint fit."""
    fitted = problem.records if len(problem.records) > 1 else {}
    return {**fitted, **problem.others}


def facts_of(problem: Problem, chain: ChainFile) -> dict[str, str]:
    """Return what was run, for people: one line each, by subject."""
    config, posterior, fitted = problem.config, problem.posterior, {}
    for name, record in problem.records.items():
        training = posterior.alone(name).only.training
        which = "" if len(problem.records) == 1 else f" {name}"
        fitted[f"record{which}"] = (
            f"{record.origin}: {record.samples} samples every {record.interval:g} s"
        )
        fitted[f"fitted{which}"] = ", ".join(
            f"{record.time[w.start]:g} to {record.time[w.stop - 1]:g} s" for w in training
        )
    accepted = {
        phase: ", ".join(
            f"{n} {accepted / p:.0%}" for n, (p, accepted) in chain.moves(phase).items()
        )
        for phase in PHASES
    }
    return {
        **fitted,
        "model": in_words(config.model),
        "noise": config.model.noise,
        "sampling": (
            f"{problem.plan.ensembles} ensembles of {problem.plan.walkers} walkers; "
            f"{', '.join(f'{chain.steps(phase)} steps of {phase}' for phase in PHASES)}"
        ),
        "accepted": "; ".join(f"{phase}: {text}" for phase, text in accepted.items() if text),
        "engine": posterior.engine,
    }
