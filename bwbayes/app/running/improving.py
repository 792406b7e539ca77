"""Give a model the parts for which its record has evidence, one after the other.

Each round fits the model, explains its readings better in every way there is, and takes the part of
the model that leads, if it is worth more than chance. None is added while the fit follows what the
actuator did not do: no part of a model mends a transient. What was added is noted in the config,
for the run to show.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from rich.console import Console

from bwbayes.app.config.config import Config
from bwbayes.app.problem.problem import generator, resolve
from bwbayes.app.running.explaining import explained
from bwbayes.diagnosis.explanations import followed_causes, likely_causes
from bwbayes.errors import InputError
from bwbayes.inference import map_estimate as pointfit
from bwbayes.record import Record

__all__ = ["improve_model"]


def improve_model(
    config: Config, folder: Path, console: Console, records: Mapping[str, Record] | None = None
) -> Config:
    """Return a config with all parts of the model that pay.

    Parameters
    ----------
    config, folder, records
        As :func:`~bwbayes.app.problem.problem.resolve` takes them; one record is fitted.
    console
        Where progress goes.

    Raises
    ------
    InputError
        The config cannot be used, or several records are fitted.
    """
    if len(config.records) > 1:
        raise InputError("improve: is for one training record; improve a fit of one of them first")
    notes: list[str] = []
    while True:
        problem = resolve(config, folder, records)
        (name,) = problem.records
        console.print("searching for missing parts of the model ...", highlight=False)
        point = pointfit.fit(problem.posterior, generator(config.seed, "point fit"))
        found = explained(problem, name, point.optima, thorough=True)
        parts = likely_causes([cause for cause in found if cause.changes])
        if followed_causes(found) or not parts:
            break
        explanation = parts[0]
        notes.append(f"model improved: {explanation.text} ({explanation.worth}); {explanation.fix}")
        console.print(
            f"added: {explanation.text} ({explanation.worth})", highlight=False, soft_wrap=True
        )
        config = problem.changed(config, explanation.changes, explanation.parameters)
    record = config.records[name]
    noted = record.model_copy(update={"remarks": [*(record.remarks or []), *notes]})
    return config.model_copy(update={"record": noted}) if notes else config
