"""Where bands fail, the likely cause's fix is followed, and the plant's next record is covered.

Each of the plants of :mod:`tests.diagnosis.plants` is fitted with the good model. Its likely cause
is looked up, and what the fix says is done: lines of config are set, channels are shifted, or the
plant is measured again without the cause, if it has that. Then the next record of the plant,
another drive that is cut from a running one and has an offset of its own, is predicted.
"""

from __future__ import annotations

import json
import re
from collections import Counter
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np
import pytest

from bwbayes.app.config.config import Config, parse
from bwbayes.app.problem.problem import Problem, resolve
from bwbayes.app.running.explaining import explained
from bwbayes.diagnosis.explanations import likely_causes
from bwbayes.diagnosis.scene import Explanation
from bwbayes.inference import map_estimate as pointfit
from bwbayes.record import Record, write_record
from tests.diagnosis.plants import CAUSES, bench
from tests.measured import keep
from tests.prediction.runs import covered, judge

SEEDS, GOOD = 20, 100

CONFIG = """
[record]
file = "record.h5"
from_rest = true
[validation.next]
file = "next.h5"
"""


@dataclass(frozen=True)
class Outcome:
    """What came of a plant: its causes and the fix, then whether bands pass and the coverage."""

    causes: tuple[str, ...]
    right: bool
    fix: str
    passes: bool | None
    next_passes: bool | None
    coverage: float

    @property
    def green(self) -> bool:
        """Whether bands pass on the record, and its next one is not covered."""
        return self.passes is True and self.coverage < 0.85


def put(records: tuple[Record, Record], folder: Path) -> None:
    for record, name in zip(records, ("record.h5", "next.h5"), strict=True):
        (folder / name).unlink(missing_ok=True)
        write_record(record, folder / name)


def shifted(record: Record, delay: float) -> Record:
    """Move the voltage of a record by so many s."""
    voltage = np.interp(record.time - delay, record.time, record.voltage)
    return replace(record, voltage=voltage)


def followed(
    config: Config, problem: Problem, cause: Explanation, kind: str, seed: int, folder: Path
) -> Config:
    """Do what a fix says, in the files and in the config that is returned."""
    made = bench(kind, (6, seed))
    (name, record), = config.records.items()
    if cause.changes:
        return problem.changed(config, cause.changes, cause.parameters)
    if found := re.search(r"set outliers = true", cause.fix):
        return problem.changed(config, {"outliers": True}, {})
    if found := re.search(r"exclude = (\[\[.*?\]\])", cause.fix):
        changed = record.model_copy(update={"exclude": json.loads(found[1])})
        return config.model_copy(update={"record": changed})
    if cause.kind == "step":
        time = float(cause.fix.rsplit(" ", 1)[-1])
        window = [0.0, time] if time > 5 else [time, 10.0]
        changed = record.model_copy(update={"train": [window]})
        return config.model_copy(update={"record": changed})
    records = made.records
    if cause.kind == "sign":
        records = tuple(replace(each, displacement=-each.displacement) for each in records)
    elif cause.kind == "delay":
        delay = float(re.search(r"delay of (\S+) ms", cause.text)[1]) / 1000
        records = tuple(shifted(each, delay) for each in records)
    elif cause.kind in ("saturation", "slew limit"):
        records = tuple(
            replace(each, voltage=u) for each, u in zip(records, made.driven, strict=True)
        )
    elif not cause.kind.startswith("noise by"):
        # The bench is put right, and the plant measured again.
        cured = kind if cause.kind in CAUSES.get(kind, ()) else ""
        records = bench(kind, (6, seed), cured).records
    put(records, folder)
    return parse(CONFIG, "config")


def study(kind: str, seed: int, folder: Path) -> Outcome:
    """Fit a plant, follow the leading cause's fix, if there is one, and predict the next record."""
    put(bench(kind, (6, seed)).records, folder)
    config = parse(CONFIG, "config")
    problem = resolve(config, folder)
    source = np.random.default_rng((6, seed))
    point = pointfit.fit(problem.posterior, source)
    found = likely_causes(explained(problem, "record", point.optima, thorough=kind != "good"))
    if found:
        config = followed(config, problem, found[0], kind, seed, folder)
    judged = judge(resolve(config, folder), source, again=False)
    return Outcome(
        tuple(cause.kind for cause in found),
        bool({cause.kind for cause in found} & CAUSES.get(kind, set())),
        found[0].fix if found else "",
        judged.verdicts["training"].holds,
        judged.verdicts["next"].holds,
        covered(judged.bands["next"]),
    )
