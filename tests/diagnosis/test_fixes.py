"""Where bands fail, the likely cause's fix is followed, and the plant's next record is covered.

Each of the plants of :mod:`tests.diagnosis.plants` is fitted with the good model and the noise that
it has evidence for. Its likely cause is looked up, and what the fix says is done: lines of config
are set, channels are shifted, or the plant is measured again without the cause, if it has that.
Then the next record of the plant, another drive that is cut from a running one, is predicted.
"""

import json
import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest

from bwbayes.app.config.config import Config, ParameterConfig, parse
from bwbayes.app.running.explaining import explain_record
from bwbayes.diagnosis.explanations import likely_causes
from bwbayes.diagnosis.residual_analysis import Explanation
from bwbayes.diagnosis.validation import BandValidation
from bwbayes.inference import map_estimate as pointfit
from bwbayes.record import Record, write_record
from tests.diagnosis.plants import CAUSES, bench
from tests.measured import keep
from tests.prediction.runs import covered, judge, study_of

SEEDS, GOOD = range(10, 30), 100

CONFIG = """
[record]
file = "record.h5"
from_rest = true
[validation.next]
file = "next.h5"
estimate_offset = false
"""


@dataclass(frozen=True)
class SamplingResult:
    """The outcome of a plant: its causes and the fix, then whether bands pass and the coverage."""

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


def put(records: Sequence[Record], folder: Path) -> None:
    for record, name in zip(records, ("record.h5", "next.h5"), strict=True):
        (folder / name).unlink(missing_ok=True)
        write_record(record, folder / name)


def shifted(record: Record, delay: float) -> Record:
    voltage = np.interp(record.time - delay, record.time, record.voltage)
    return replace(record, voltage=voltage)


def followed(config: Config, cause: Explanation, kind: str, seed: int, folder: Path) -> Config:
    """Do what a fix says, in the files and in the config that is returned."""
    made = bench(kind, (6, seed))
    (record,) = config.records.values()
    records: Sequence[Record] = made.records
    if cause.spec is not None and "[model]" in cause.fix:
        stated = {name: ParameterConfig(**one.keys) for name, one in (cause.stated or {}).items()}
        return config.model_copy(
            update={
                "model": config.model.with_spec(cause.spec),
                "parameters": {**config.parameters, **stated},
            }
        )
    if "set outliers = true" in cause.fix:
        model = config.model.model_copy(update={"outliers": True})
        return config.model_copy(update={"model": model})
    if found := re.search(r"exclude = (\[\[.*?\]\])", cause.fix):
        changed = record.model_copy(update={"exclude": json.loads(found[1])})
        return config.model_copy(update={"record": changed})
    if cause.kind == "step":
        time = float(cause.fix.rsplit(" ", 1)[-1])
        window = [0.0, time] if time > 5 else [time, 10.0]
        changed = record.model_copy(update={"train": [window]})
        # The other side has another offset, and nobody knows which one the sensor has now.
        later = config.validation["next"].model_copy(
            update={"estimate_offset": True, "lead_in": 5.0}
        )
        return config.model_copy(update={"record": changed, "validation": {"next": later}})
    if cause.kind == "sign":
        records = [replace(each, displacement=-np.array(each.displacement)) for each in records]
    elif found := re.match(r"(\w+) that is late by (\S+) ms", cause.text):
        late = float(found[2]) / 1000 * (1 if found[1] == "displacement" else -1)
        records = [shifted(each, late) for each in records]
    elif cause.kind in ("saturation", "slew limit"):
        driven = zip(records, made.driven, strict=True)
        records = [replace(each, voltage=voltage) for each, voltage in driven]
    elif not cause.kind.startswith("noise by"):
        # The bench is put right, and the plant measured again.
        cured = kind if cause.kind in CAUSES.get(kind, ()) else ""
        records = bench(kind, (6, seed), cured).records
    put(records, folder)
    return parse(CONFIG, "config")


def study(kind: str, seed: int, folder: Path) -> SamplingResult:
    """Fit a plant, follow the leading cause's fix, if there is one, and predict the next record."""
    put(bench(kind, (6, seed)).records, folder)
    config = parse(CONFIG, "config")
    study = study_of(config, folder)
    source = np.random.default_rng((6, seed))
    point = pointfit.fit(study.posterior, source)
    found = likely_causes(explain_record(study, "record", point.optima))
    if found:
        config = followed(config, found[0], kind, seed, folder)
    judged = judge(study_of(config, folder), source, again=False)
    return SamplingResult(
        tuple(cause.kind for cause in found),
        bool({cause.kind for cause in found} & CAUSES.get(kind, set())),
        found[0].fix if found else "",
        judged.validation["training"].passed,
        judged.validation["next"].passed,
        covered(judged.bands["next"]),
    )


@pytest.mark.parametrize("kind", ["mains", pytest.param("operator", marks=pytest.mark.slow)])
def test_a_fix_that_is_followed_is_right_for_the_next_record(kind: str, tmp_path: Path) -> None:
    """The quick twin: a fix at the bench, and one of the model."""
    outcome = study(kind, 0, tmp_path)
    assert outcome.right
    assert outcome.passes
    assert outcome.coverage > 0.85


@pytest.mark.slow
def test_plants_get_their_cause_and_its_fix_covers_their_next_record(tmp_path: Path) -> None:
    """At least 90% of 20 kinds get their cause and are then covered; 1% of good ones get one.

    The right cause may be tied, and 90 to 99% of readings lie in the next record's 95% band. No
    bands pass on the record that was fitted and cover less than 85% of the next one.
    """
    kinds: dict[str, dict[str, int]] = {}
    for kind in CAUSES:
        outcomes = [study(kind, seed, tmp_path) for seed in SEEDS]
        kinds[kind] = {
            "right": sum(each.right for each in outcomes),
            "covered": sum(0.90 <= each.coverage <= 0.99 for each in outcomes),
            "passes": sum(each.passes is True for each in outcomes),
            "false green": sum(each.green for each in outcomes),
        }
        print(kind, kinds[kind], flush=True)
    good = [study("good", seed, tmp_path) for seed in range(GOOD)]
    alarms = sum(bool(each.causes) for each in good)
    figures = {"seeds": len(SEEDS), "good": GOOD, "good with a cause": alarms}
    covered_good = sum(0.90 <= each.coverage <= 0.99 for each in good)
    keep("causes and fixes", {**figures, "good covered": covered_good, **kinds})
    plants = len(SEEDS) * len(CAUSES)
    assert sum(each["right"] for each in kinds.values()) >= 0.9 * plants
    assert sum(each["covered"] for each in kinds.values()) >= 0.9 * plants
    assert not sum(each["false green"] for each in kinds.values())
    assert alarms <= 0.01 * GOOD


# A run that passes is right on the next drive; one of a wrong model does not pass.
# The plants of :mod:`tests.diagnosis.plants` are fitted with the good model, and nothing is mended.
# Their next record is another drive, no faster and no further than the first.


NEXT_SEEDS, NEXT_GOOD = range(5), 100


def fitted(kind: str, seed: int, folder: Path) -> tuple[BandValidation, float]:
    put(bench(kind, (7, seed)).records, folder)
    source = np.random.default_rng((7, seed))
    judged = judge(study_of(parse(CONFIG, "config"), folder), source)
    return judged.validation["training"], covered(judged.bands["next"])


@pytest.mark.parametrize("kind", ["good", "backlash"])
def test_a_better_model_keeps_a_run_from_passing(kind: str, tmp_path: Path) -> None:
    """The quick twin: a right model passes, a wrong one does not although its bands cover."""
    verdict, _ = fitted(kind, 0, tmp_path)
    assert verdict.passed is (True if kind == "good" else None)
    reasons = [reason for reason in verdict.reasons if "a better model is known" in reason]
    assert bool(reasons) is (kind != "good")


@pytest.mark.slow
def test_no_run_passes_whose_next_record_is_not_covered(tmp_path: Path) -> None:
    """None of 20 kinds of wrong models passes; at most 1% of right ones are kept from it."""
    figures: dict[str, object] = {"seeds": len(NEXT_SEEDS), "good": NEXT_GOOD}
    false = 0
    for kind in CAUSES:
        runs = [fitted(kind, seed, tmp_path) for seed in NEXT_SEEDS]
        green = sum(verdict.passed is True and part < 0.85 for verdict, part in runs)
        passed = sum(verdict.passed is True for verdict, _ in runs)
        figures[kind] = {"passed": passed, "false green": green}
        print(kind, figures[kind], flush=True)
        false += green
    good = [fitted("good", seed, tmp_path)[0] for seed in range(NEXT_GOOD)]
    kept = sum("a better model" in reason for verdict in good for reason in verdict.reasons)
    keep("next drives", figures | {"good kept from passing": kept})
    assert not false
    assert kept <= 0.01 * NEXT_GOOD
