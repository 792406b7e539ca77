"""Records of nine operators: the right model is named, and what cannot be told is called so.

The parameters come from the prior of a typical actuator, the noise is white, 0.3% of the range,
and fitted with a discrepancy as any record is: 3,000 readings, of which the last third is held out.
The candidates have each of the nine operators with the parts that the plant has, and the plant's
operator with the other parts: twelve. The right model is recommended or left open with what is
recommended. Operators that are the same thing (Prandtl-Ishlinskii and Preisach or Krasnosel'skii-
Pokrovskii loops that are alike, backlash-like and Bouc-Wen with γ near zero) are rightly left open.
The recommended model then predicts a fresh record of the plant, another drive from rest, whose
error is compared with that of the best candidate.
"""

import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rich.console import Console

from bwbayes.app.config.config import Config
from bwbayes.app.config.keywords import config_of, models_of
from bwbayes.app.fit.fitted import open_finished
from bwbayes.app.jobs.compare import compare_models
from bwbayes.app.running.folder import RunFolder
from bwbayes.app.running.run import begin
from bwbayes.app.study.resolve import resolve_config
from bwbayes.arrays import FloatArray
from bwbayes.comparison.comparison import Candidate, Comparison, difference, recommend
from bwbayes.comparison.evidence import FUTURE, Evidence, Part
from bwbayes.diagnosis.validation import ValidationSummary
from bwbayes.record import Record
from bwbayes.report.report import Table, as_text
from tests.app import small
from tests.measured import keep

NINE = (
    "bouc-wen",
    "backlash-like",
    "duhem",
    "prandtl-ishlinskii",
    "maxwell-slip(thresholds=6)",
    "preisach",
    "krasnoselskii-pokrovskii",
    "jiles-atherton",
    "domain-wall",
)
EXTRAS = ("", " + quadratic", " + creep", " + quadratic + creep")
INTERVAL, SAMPLES, FITTED = 0.01, 3000, 2000
NOISE = 0.003
RECORDS = 20


def voltage(period: float = 11.0, fast: float = 0.93) -> FloatArray:
    """Return sweeps of many amplitudes, from rest: the later third repeats none of the first."""
    time = INTERVAL * np.arange(SAMPLES)
    size = 1 - 0.045 * time + 0.3 * np.sin(2 * np.pi * time / period)
    drive = size * np.sin(2 * np.pi * 0.4 * time) + 0.2 * np.sin(2 * np.pi * fast * time)
    drive *= 100 / np.max(np.abs(drive))
    return drive


def config_for(record: Record, **others: Any) -> tuple[Config, dict[str, Record]]:
    keys: dict[str, Any] = {
        "dynamics": "none",
        "from_rest": True,
        "train": (0.0, FITTED * INTERVAL),
        "validation": {"later": (FITTED * INTERVAL, SAMPLES * INTERVAL)},
        "ess": 200,
        "steps": 3000,
    }
    config, records = config_of(record, keys | others)
    return config, dict(records)


def plant(model: str, seed: int) -> tuple[Record, Record]:
    """Draw an actuator from the prior of a typical record; a record of it, and a fresh one."""
    rng = np.random.default_rng([seed, *model.encode()])
    drives = voltage(), 0.95 * voltage(7.0, 1.31)
    noise = rng.normal(size=SAMPLES)
    typical = Record.from_arrays(drives[0], 0.6 * drives[0] + noise, interval=INTERVAL)
    config, records = config_for(typical)
    (parts,) = models_of(model, config.model).values()
    posterior = resolve_config(
        config.model_copy(update={"model": parts}), Path(), records
    ).study.posterior
    theta = posterior.prior.theta(posterior.prior.draw(rng, 1))
    actuator = posterior.likelihood.actuator
    of_actuator = posterior.single_record.table.actuator(theta)
    clean, fresh = (
        actuator.displacement(of_actuator, drive, from_rest=True)[0] for drive in drives
    )
    reading = clean + NOISE * np.ptp(clean) * rng.normal(size=SAMPLES)
    return (
        Record.from_arrays(drives[0], reading, interval=INTERVAL),
        Record.from_arrays(drives[1], fresh, interval=INTERVAL),
    )


def compared(
    record: Record, names: list[str], folder: Path, *, future: bool = True, **keys: Any
) -> Comparison:
    config, records = config_for(record, **keys)
    models = models_of("; ".join(names), config.model)
    quiet = Console(quiet=True)
    return compare_models(
        config,
        Path(),
        models,
        folder,
        quiet,
        in_memory=records,
        future=future,
        files=False,
        workers=1,
    )


def errors(comparison: Comparison, folder: Path, fresh: Record) -> dict[str, float]:
    """RMSE on a fresh record, um, by model: of the mean, or at the MAP estimate if screened."""
    assert fresh.displacement is not None
    # Without its readings, which would be validated.
    planned = Record(fresh.voltage, None, interval=fresh.interval)
    made = {}
    for candidate in comparison.candidates:
        run = RunFolder.open(folder / re.sub(r"[^\w.-]+", "-", candidate.name).strip("-."))
        if candidate.converged:
            mean = open_finished(run).predict(planned, from_rest=True, estimate_offset=False).mean
        else:
            begun = begin(run)
            posterior, point = begun.study.posterior, begun.chain.point
            free, _ = posterior.prior.constrain(point.mode[np.newaxis])
            theta = posterior.prior.theta(free)
            mean = posterior.likelihood.actuator.displacement(
                posterior.single_record.table.actuator(theta),
                fresh.voltage,
                from_rest=True,
            )[0]
        made[candidate.name] = float(np.sqrt(np.mean((fresh.displacement - mean) ** 2)))
    return made


@pytest.mark.slow
def test_the_right_model_is_named_or_left_open_and_predicts_a_fresh_record(tmp_path: Path) -> None:
    """Right or tied in 19 of 20; within 10% of the best candidate's error in 18 of 20."""
    named, alone, near, ratios = [], [], [], []
    for number in range(RECORDS):
        operator, extras = NINE[number % len(NINE)], EXTRAS[number % len(EXTRAS)]
        model = f"{operator}{extras}"
        record, fresh = plant(model, number)
        folder = tmp_path / str(number)
        others = [f"{other}{extras}" for other in NINE if other != operator]
        candidates = [*(f"{operator}{parts}" for parts in EXTRAS), *others]
        comparison = compared(record, candidates, folder)
        assert comparison.recommended is not None
        missed = errors(comparison, folder, fresh)
        named.append(model in (comparison.recommended, *comparison.tied))
        alone.append(model == comparison.recommended and not comparison.tied)
        ratios.append(missed[comparison.recommended] / min(missed.values()))
        near.append(ratios[-1] < 1.1)
        print(number, model, "->", comparison.recommended, comparison.tied, f"{ratios[-1]:.3f}")
        keep(
            "which model",
            {
                "records": len(named),
                "named or left open": int(np.sum(named)),
                "named alone": int(np.sum(alone)),
                "error within a tenth of the best": int(np.sum(near)),
                "largest ratio of errors": round(max(ratios), 2),
            },
        )
    assert np.sum(named) >= 19
    assert np.sum(near) >= 18


def test_a_record_without_hysteresis_is_said_to_have_none(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    small.without_explanations(monkeypatch)
    record, _ = plant("linear", 1)
    names = ["bouc-wen + white", "linear + white"]
    assert record.displacement is not None
    fewer = Record(record.voltage[::3], record.displacement[::3], interval=3 * INTERVAL)
    runs = tmp_path / "runs"
    comparison = compared(fewer, names, runs, future=False, walkers=24, steps=200)
    assert comparison.recommended == "linear + white"
    assert any("no hysteresis" in line for line in comparison.lines)


# The recommendation follows from the numbers, and says what cannot be told


def noise(seed: int, size: int = 10) -> FloatArray:
    return np.random.default_rng(seed).normal(size=size)


COMMON = -100 + 10 * noise(1)


def model(
    name: str,
    scores: FloatArray | None,
    log_evidence: float = 0.0,
    free: int = 5,
    *,
    hysteresis: bool = True,
    worth: float = 50.0,
) -> Candidate:
    parts = {} if scores is None else {FUTURE: Part(scores, 200, worth)}
    evidence = Evidence(log_evidence, 0.02, 0.0, 1000.0, 7.0, log_evidence + 20)
    return Candidate(
        name, name, True, "converged", free, 1000, hysteresis, parts=parts, evidence=evidence
    )


def test_the_better_score_is_recommended_whatever_the_evidence_says() -> None:
    worse = model("other", COMMON - 5 + noise(2), 100.0)
    comparison = recommend([worse, model("rich", COMMON, 0.0, 9)])
    assert comparison.recommended == comparison.best == "rich"
    assert comparison.tied == ()
    assert "by the log score other is worse, by 5" in comparison.lines[1]
    assert comparison.caveats[0].startswith("the log evidence is for other, by 100.0 nats, of")


def test_scores_that_tie_are_told_apart_by_the_evidence_if_it_is_sure() -> None:
    near = COMMON + 0.1 * noise(2)
    comparison = recommend([model("plain", COMMON), model("rich", near, 10.0, 9)])
    assert (comparison.recommended, comparison.tied) == ("rich", ())
    assert any("log evidence is lower by 10.0" in line for line in comparison.lines)
    comparison = recommend([model("plain", COMMON), model("rich", near, 2.0, 9)])
    assert (comparison.recommended, comparison.tied) == ("rich", ("plain",))
    expected = "rich and plain are indistinguishable; rich is the most probable"
    assert comparison.lines[0] == expected


def test_of_scores_that_tie_the_plainest_is_taken_where_the_evidence_is_not_sure() -> None:
    near = model("rich", COMMON + 0.1 * noise(2), 2.0, 9)
    assert near.evidence is not None
    unsure = replace(near, evidence=replace(near.evidence, error=0.6))
    comparison = recommend([model("plain", COMMON), unsure])
    assert (comparison.recommended, comparison.tied) == ("plain", ("rich",))
    expected = "plain and rich are indistinguishable; plain is the simplest"
    assert comparison.lines[0] == expected


def test_less_than_four_nats_do_not_tell_models_apart_however_small_their_error() -> None:
    """Three nats at many errors tie, five do not; at large errors fifteen tie."""
    for gain, spread, worse in ((3.0, 1e-3, False), (5.0, 1e-3, True), (15.0, 3.0, False)):
        changed = noise(2) - np.mean(noise(2))
        less = COMMON - gain / 10 + spread * changed
        comparison = recommend([model("plain", less), model("rich", COMMON, 0.0, 9)])
        assert comparison.differences["plain"].value == pytest.approx(-gain)
        assert comparison.differences["plain"].worse == worse
        assert comparison.recommended == ("rich" if worse else "plain")


def test_a_part_worth_fewer_than_five_independent_readings_has_no_vote() -> None:
    """The evidence then decides; a part that is worth more outvotes it."""
    tempting = model("tempting", COMMON + 30, 0.0, worth=1.6)
    truth = model("truth", COMMON, 51.0, 9, worth=1.6)
    comparison = recommend([tempting, truth])
    assert (comparison.measure, comparison.recommended) == ("log evidence", "truth")
    assert any("worth 1.6 independent readings only" in line for line in comparison.caveats)
    held_out = {"later": Part(COMMON, 200, 30.0)}
    better = {"later": Part(COMMON + 3 + 0.1 * noise(3), 200, 30.0)}
    comparison = recommend(
        [
            replace(tempting, parts={**tempting.parts, **held_out}),
            replace(truth, parts={**truth.parts, **better}),
        ]
    )
    assert comparison.voting == ("later",)
    assert (comparison.measure, comparison.recommended) == ("log score", "truth")


def test_errors_cover_differences_of_correlated_blocks() -> None:
    """400 pairs whose difference has a mean of zero, in blocks of twice their correlation time.

    The share of them beyond the 95% limit is 0.05 for exact errors; the twin, taken for certain
    to within independent readings, has far more.
    """
    rng = np.random.default_rng(7)
    beyond = naive = 0
    for _ in range(400):
        series = np.zeros(700)
        for i, fresh in enumerate(rng.normal(size=699), start=1):
            series[i] = 0.7 * series[i - 1] + fresh
        series = series[100:]
        part = Part(COMMON + series.reshape(10, -1).sum(axis=1), 600, 100.0)
        first = replace(model("first", None), parts={"part": part})
        second = replace(model("second", None), parts={"part": replace(part, log_scores=COMMON)})
        got = difference(first, second, ["part"])
        beyond += abs(got.value) > got.limit
        naive += abs(got.value) > 2 * np.sqrt(series.size * np.var(series))
    assert beyond < 0.1 * 400
    assert naive > 0.25 * 400


def test_without_hysteresis_it_says_so() -> None:
    linear = model("linear", COMMON, 2.0, 3, hysteresis=False)
    rich = model("rich", COMMON + 0.1 * noise(2))
    comparison = recommend([linear, rich])
    assert comparison.recommended == "linear"
    assert comparison.lines[1].startswith("the record shows no hysteresis")
    # One that is alike, but less probable, leaves it open.
    comparison = recommend([model("linear", COMMON, -2.0, 3, hysteresis=False), rich])
    assert "whether there is any hysteresis cannot be told" in comparison.lines


def test_what_has_not_converged_is_listed_and_never_recommended() -> None:
    """A model that was only screened is in the table, and in no caveat."""
    lost = Candidate("lost", "lost", False, "budget used up", 4, 1000)
    evidence = Evidence(-300.0, np.inf, 0.0, 0.0, 5.0, -290.0)
    far = Candidate("far", "far", False, "", 4, 1000, evidence=evidence, screened=True)
    comparison = recommend([lost, far, model("plain", COMMON)])
    assert comparison.recommended == "plain"
    assert comparison.candidates[1:] == (far, lost)
    assert comparison.caveats == ("lost has not converged (budget used up) and is not judged",)
    assert comparison.lines[0] == "plain is recommended"
    assert comparison.lines[-1].startswith("only screened")
    models, *_ = comparison.report().blocks
    assert isinstance(models, Table)
    assert "about -300" in models.rows[1]
    comparison = recommend([lost])
    assert comparison.recommended is None
    assert "not converged" in str(comparison)


def test_tables_fit_eighty_columns() -> None:
    """Whole, with names as long as models have, and each table in one part."""
    name = "maxwell-slip + quadratic"
    comparison = recommend([model(name, COMMON, 1012.3), model("bouc-wen", COMMON - 15)])
    text = as_text(replace(comparison, lines=("best",), caveats=()).report(), 80)
    assert max(map(len, text.splitlines())) <= 80
    assert "\u2026" not in text
    assert 2 == sum("─" in line for line in text.splitlines())


@pytest.mark.parametrize("length", [60, 120])
def test_tables_fit_eighty_columns_whatever_folders_are_called(length: int) -> None:
    """Also where nothing is scored, so that the evidence, of NumPy's floats, decides alone."""
    names = [letter * length for letter in "xy"]
    for scores in (COMMON, None):
        models = [model(name, scores, np.float64(3 * i)) for i, name in enumerate(names)]
        comparison = recommend(models)
        text = as_text(replace(comparison, lines=("best",), caveats=()).report(), 80)
        assert max(map(len, text.splitlines())) <= 80
        assert "\u2026" not in text


@pytest.mark.parametrize(("passed", "status"), [(False, "VALIDATION FAILED"), (None, "Validation")])
def test_what_does_not_hold_is_said_before_what_is_recommended(
    passed: bool | None, status: str
) -> None:
    standing = ValidationSummary(passed, ("next: the bands cover 55%",))
    wide = replace(model("wide", COMMON - 700 + 60 * noise(2)), standing=ValidationSummary())
    comparison = recommend([replace(model("good", COMMON), standing=standing), wide])
    first, second, *_ = as_text(comparison.report()).splitlines()
    assert re.match(rf"{status}.*: next: the bands cover 55%", first)
    # No more digits than are known, and no powers of ten.
    assert re.match(
        r"good is recommended: by the log score wide is worse, by \d+0 ± \d+0 nats", second
    )
