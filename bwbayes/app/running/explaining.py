"""What explains a problem's readings better than its model does, and how that is shown."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence

from bwbayes.app.problem.problem import Problem, generator
from bwbayes.arrays import FloatArray
from bwbayes.diagnosis.explanations import explain
from bwbayes.diagnosis.scene import Explanation, Scene

__all__ = ["explained", "lines"]

# Explanations that are shown.
SHOWN = 5


def explained(
    problem: Problem,
    name: str,
    places: FloatArray,
    watch: Callable[[float], None] = lambda _: None,
    *,
    thorough: bool,
) -> tuple[Explanation, ...]:
    """Explain a training record's readings better than its fit does, the best explanation first.

    Parameters
    ----------
    problem
        What was fitted.
    name
        The record's name.
    places
        The posterior's modes (modes, free), coordinates.
    watch
        Is called with the share that is done.
    thorough
        Something is known to be wrong.
    """
    posterior, record = problem.posterior, problem.records[name]
    scene = Scene.of(
        posterior.alone(name),
        posterior.its(places, name),
        generator(problem.config.seed, f"explanations {record.sha256}"),
        [window for windows in problem.held_out(name).values() for window in windows],
        record.start,
        # Of several records no other model is built: it would be one of all of them.
        problem.reconfigured if len(problem.records) == 1 else None,
    )
    return explain(scene, watch, thorough=thorough)


def lines(explanations: Sequence[Explanation]) -> Iterator[str]:
    """Write the explanations that are worth anything, a line each, the best first."""
    for explanation in explanations[:SHOWN]:
        if explanation.nats > 0:
            text = f"{explanation.text} ({explanation.worth})"
            yield f"explained better by: {text}. Fix: {explanation.fix}."
