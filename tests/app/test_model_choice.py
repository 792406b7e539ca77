"""The parts that a record was made with are found by themselves, and no others."""

import io
import re
import warnings
from collections.abc import Callable
from dataclasses import replace
from functools import cache, partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import scipy
from hypothesis import given, strategies as st
from rich.console import Console

import bwbayes as bw
from bwbayes.app.config.config import Config, RecordConfig, dump, parse
from bwbayes.app.jobs.check import check
from bwbayes.app.running import explaining
from bwbayes.app.running.explaining import choose_model, chosen_noise
from bwbayes.app.running.folder import RunFolder
from bwbayes.app.running.run import resume
from bwbayes.app.study.about import lines
from bwbayes.app.study.resolve import resolve_config, with_noise
from bwbayes.diagnosis.explanations import explain, exponent, likely_causes
from bwbayes.diagnosis.laplace import climb
from bwbayes.diagnosis.residual_analysis import Explanation
from bwbayes.errors import InputWarning
from bwbayes.inference import map_estimate as pointfit, mode_finding
from bwbayes.inference.study import InitialConditions
from bwbayes.model.spec import ModelSpec
from bwbayes.prediction.prediction import predict_record
from bwbayes.record import Record, write_record
from tests.diagnosis.plants import plant
from tests.diagnosis.test_explanations import triangle_record
from tests.stand import Stand, autoregressive, play
from tests.test_sampling_rates import records

# What a run says of a stage that it has added: what to do on the test stand.
FIXES = {
    "step": r"fit one side: set train to end or begin at [\d.]+",
    "drift": "measure again after a longer warm-up",
    "transient": "measure again once the displacement has settled",
    "mains": "look for the source: mains, ground loops, vibration",
    "moving gain": "measure at a constant temperature; or measure when it has warmed up, or .*",
}


def config_of(kind: str, folder: Path) -> Config:
    write_record(plant(kind, (8, 1), 8.0), folder / "record.h5")
    return Config(record=RecordConfig(file="record.h5", from_rest=True, train=[[0.0, 6.0]]))


@pytest.mark.slow
def test_a_search_that_adds_many_stages_and_leaves_an_error_has_not_found_the_mechanism(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Here one stage counts as many: the plant's own discrepancy remains beside a quadratic one."""
    monkeypatch.setattr(explaining, "MAX_STAGES", 1)
    chosen = choose_model(resolve_config(config_of("quadratic", tmp_path), tmp_path)).run
    unexplained = chosen.config.model.unexplained
    assert unexplained is not None
    assert unexplained > explaining.MAX_DISCREPANCY
    assert parse(dump(chosen.config), "again").model.unexplained == unexplained
    assert len(chosen.config.records["record"].remarks or []) == 1


def test_a_sampled_triangle_turns_between_its_samples(tmp_path: Path) -> None:
    """The search takes its corners first, and no stage for what the samples lack of them.

    The config says so; the next record's path reaches its corners, too, and no reading is held
    against the path there.
    """
    record, following = triangle_record(1), triangle_record(2)
    write_record(record, tmp_path / "record.h5")
    write_record(following, tmp_path / "next.h5")
    text = '[record]\nfile = "record.h5"\n[validation.next]\nfile = "next.h5"\n'
    chosen = choose_model(resolve_config(parse(text, "my.toml"), tmp_path))
    study = chosen.run.study
    assert (study.spec.chain, study.spec.hold) == (("bouc-wen", "lag"), "corners")
    (step, *_) = chosen.steps
    assert step.startswith("added: voltage whose reversals fall between samples (")
    assert parse(dump(chosen.run.config), "again").model.spec.hold == "corners"
    readings = study.posterior.single_record.readings
    assert readings.rows.size < record.readings
    draws = np.repeat(study.posterior.prior.constrain(chosen.point.optima[:1])[0], 40, axis=0)
    other = study.validations["next"]
    assert other.record is not None
    bands = predict_record(
        study.posterior, draws, other.record, other.start, np.random.default_rng(1)
    )
    assert np.max(bands.voltage) > np.max(following.voltage)
    measured = bands.measured
    assert measured is not None
    scored = slice(bands.scored_from, None)
    missed = np.abs(measured - bands.mean)[scored]
    assert np.nanmax(missed) < 0.06
    moved = bands.voltage != following.voltage
    assert np.array_equal(np.isnan(missed), moved[scored])


@pytest.mark.usefixtures("_without_pictures")
def test_a_run_adds_a_quadratic_gain_and_says_what_it_is_worth(tmp_path: Path) -> None:
    record = plant("quadratic", (8, 1), 8.0)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", InputWarning)
        fit = bw.fit(
            record,
            folder=tmp_path / "run",
            from_rest=True,
            train=(0.0, 6.0),
            validation={"rest": (6.0, 8.0)},
            ess=500,
            progress=False,
        )
    (note,) = [str(w.message) for w in caught if "stage added" in str(w.message)]
    assert re.match(r"stage added: quadratic.* nats, RMSE .* um, held out .* um\)$", note)
    assert "quadratic" in fit.config.model.nonlinearity
    # The plant has a discrepancy of its own, which no stage explains.
    assert [text[:24] for text in fit.config.records["record"].remarks or []] == [
        note[:24],
        "the search for stages ma",
    ]
    # It has been looked for what else there is, and nothing was found.
    assert not likely_causes(fit.result.explanations["record"])
    assert fit.validation["rest"].passed is not False
    # The run that is opened has the same model, which is not searched again.
    again = bw.open_run(tmp_path / "run")
    assert again.config.model.stages == []
    assert again.config.model.nonlinearity == fit.config.model.nonlinearity


def test_a_free_exponent_is_taken_while_the_noise_is_open(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It leaves stages and noise as they are, and states another prior."""
    monkeypatch.setattr(explaining, "explain", lambda analysis, *_: tuple(exponent(analysis)))
    chosen = choose_model(resolve_config(config_of("free exponent", tmp_path), tmp_path))
    assert chosen.steps[0].startswith("added: transition of exponent ")
    assert chosen.run.config.model.hysteresis == "bouc-wen"
    assert chosen.run.config.parameters["exponent"].fixed is None
    assert "exponent" in chosen.run.study.posterior.names


@pytest.mark.slow
def test_nothing_is_added_to_a_right_model(tmp_path: Path) -> None:
    problem = resolve_config(config_of("good", tmp_path), tmp_path)
    chosen = choose_model(problem)
    assert [step[:6] for step in chosen.steps] == ["noise:"]
    assert chosen.run.study.spec.chain == problem.study.spec.chain
    assert chosen.run.config.model.stages == []


@pytest.mark.parametrize(
    "kind",
    ["step", *(pytest.param(k, marks=pytest.mark.slow) for k in FIXES if k != "step")],
)
def test_what_the_actuator_did_not_do_is_fitted_in_its_record_and_not_expected_of_the_next(
    kind: str, tmp_path: Path
) -> None:
    """The next record is covered, by a band that is no wider than that of a good record's fit."""
    found, widths = {}, []
    for plant_kind in (kind, "good"):
        problem = resolve_config(config_of(plant_kind, tmp_path), tmp_path)
        if plant_kind == kind:
            chosen = choose_model(problem)
            problem, point = chosen.run, chosen.point
            stage = "oscillation" if kind == "mains" else kind.replace(" ", "-")
            assert problem.config.model.stages == [stage]
            remarks = problem.config.records["record"].remarks or []
            (added,) = [remark for remark in remarks if remark.startswith("stage added: ")]
            assert re.search(rf"\. Fix: {FIXES[kind]}\.$", added), added
        else:
            point = pointfit.fit(problem.study.posterior, np.random.default_rng(1))
        posterior, rng = problem.study.posterior, np.random.default_rng(2)
        coordinates = rng.multivariate_normal(point.mode, point.covariance, 200)
        draws, density = posterior.prior.constrain(coordinates)
        following = plant("good", (8, 1), 8.0)
        assert following.displacement is not None
        start = InitialConditions(from_rest=True)
        bands = predict_record(posterior, draws[np.isfinite(density)], following, start, rng)
        widths.append(np.mean((bands.upper["sensor", 95] - bands.lower["sensor", 95])[-400:]))
        found[plant_kind] = np.mean(bands.covers("sensor", 95, following.displacement)[-400:])
    assert min(found.values()) > 0.85
    assert widths[0] < 1.3 * widths[1]


def test_noise_that_grows_with_the_speed_is_as_wide_where_the_next_drive_is_fast(
    tmp_path: Path,
) -> None:
    """95% of 1,500 readings of each half, to 3.6 sds of luck; a level band errs on both sides."""

    def measured(seed: int) -> Record:
        rng = np.random.default_rng(seed)
        time = np.arange(3000) / 100
        drive = 80 * np.exp(-0.05 * time) * np.sin(2 * np.pi * time)
        record = Stand(discrepancy=0.0, sensor=0.0).measure(drive, rng)
        assert record.displacement is not None
        sd = 0.05 * np.hypot(1, np.gradient(drive, 0.01) / 60)
        noisy = record.displacement + sd * rng.standard_normal(time.size)
        return replace(record, displacement=noisy)

    write_record(measured(1), tmp_path / "record.h5")
    config = Config(record=RecordConfig(file="record.h5", from_rest=True))
    problem = resolve_config(config, tmp_path)
    chosen = choose_model(problem)
    assert chosen.run.study.spec.noise == "discrepancy + paced"
    following, shares = measured(2), []
    assert following.displacement is not None
    fast = np.abs(np.gradient(following.voltage))
    fast = fast > np.median(fast)
    level = pointfit.fit(problem.study.posterior, np.random.default_rng(1))
    for made, point in ((chosen.run, chosen.point), (problem, level)):
        posterior, rng = made.study.posterior, np.random.default_rng(2)
        draws, density = posterior.prior.constrain(
            rng.multivariate_normal(point.mode, point.covariance, 200)
        )
        start = InitialConditions(from_rest=True)
        bands = predict_record(posterior, draws[np.isfinite(density)], following, start, rng)
        inside = bands.covers("sensor", 95, following.displacement)
        shares.append((np.mean(inside[fast]), np.mean(inside[~fast])))
    assert np.abs(np.array(shares[0]) - 0.95).max() < 0.02
    assert np.abs(np.array(shares[1]) - 0.95).min() > 0.02


@pytest.mark.parametrize(
    "keys", [{"stages": []}, {"stages": ["backlash"]}, {"search": "none"}, {"search": "0s"}]
)
def test_stages_that_are_named_are_not_searched(keys: dict[str, Any], tmp_path: Path) -> None:
    config = config_of("quadratic", tmp_path)
    model = config.model.model_copy(update=keys)
    problem = resolve_config(config.model_copy(update={"model": model}), tmp_path)
    chosen = choose_model(problem)
    assert chosen.run.study.spec.chain == problem.study.spec.chain
    assert chosen.explanations is None


def test_a_search_ends_when_its_time_is_over(tmp_path: Path) -> None:
    config = config_of("quadratic", tmp_path)
    model = config.model.model_copy(update={"search": "0.001s"})
    chosen = choose_model(resolve_config(config.model_copy(update={"model": model}), tmp_path))
    assert chosen.explanations is None
    ended = "the search for stages ended after 0.001 s, before it was complete"
    assert ended in chosen.steps
    assert chosen.run.config.records["record"].remarks == [ended]


def test_fits_of_a_search_end_when_its_time_is_over(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Within a fit, after one round more: with what explains the readings by then."""
    study = resolve_config(config_of("quadratic", tmp_path), tmp_path).study
    point = pointfit.fit(study.posterior, np.random.default_rng(1))
    analysis = explaining._analysis(study, "record", point.optima)
    rounds, climbed = list[int](), mode_finding.Target.round

    def counted(*arguments: Any) -> Any:
        rounds.append(len(rounds))
        return climbed(*arguments)

    monkeypatch.setattr(mode_finding.Target, "round", counted)
    complete = {found.kind for found in explain(analysis)}
    for limit in (1, 6, 21):
        rounds.clear()
        ended = explain(analysis, is_over=partial(rounds.__contains__, limit - 1))
        assert {found.kind for found in ended} < complete
        assert len(rounds) == limit


def test_a_stage_that_errs_more_on_held_out_readings_is_not_added(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def misled(*arguments: Any) -> tuple[Explanation, ...]:
        return tuple(replace(found, held_out=(0.1, 0.12)) for found in explain(*arguments))

    monkeypatch.setattr(explaining, "explain", misled)
    problem = resolve_config(config_of("quadratic", tmp_path), tmp_path)
    chosen = choose_model(problem)
    assert chosen.run.study.spec.chain == problem.study.spec.chain
    assert chosen.steps[0].startswith("not added: quadratic")
    assert "held out 0.12 um instead of 0.1 um" in chosen.steps[0]


def test_several_records_have_no_stage_added(tmp_path: Path) -> None:
    config_of("quadratic", tmp_path)
    parts = {"first": [[0.0, 3.0]], "second": [[3.0, 6.0]]}
    files = {
        name: RecordConfig(file="record.h5", from_rest=True, train=train)
        for name, train in parts.items()
    }
    problem = resolve_config(Config(record=files), tmp_path)
    assert choose_model(problem).run.study.spec.chain == problem.study.spec.chain


@given(st.floats(-5, 100), st.floats(0.01, 10), st.floats(0.1, 10))
def test_nothing_explains_better_that_misses_more(nats: float, rmse: float, ratio: float) -> None:
    """Nor what chance makes as good once in twenty times."""
    found = Explanation("gain", "a gain that moves", "fix it", nats=nats, rmse=(rmse, ratio * rmse))
    said = list(lines([found]))
    assert (ratio <= 1 and nats > 3) <= bool(said) <= (ratio <= 1.2 and nats > 2.9)


# ``noise = "auto"`` is the one that a record has evidence for, and the run says so

CONFIG = '[record]\nfile = "record.h5"\ntrain = [[0.0, 4.0]]\nfrom_rest = true\n'
NOT_SEARCHED = f'{CONFIG}[model]\nsearch = "none"\n'


def thinned(record: Record) -> Record:
    assert record.displacement is not None
    return Record(record.voltage[::25], record.displacement[::25], interval=25 * record.interval)


@cache
def plays() -> Record:
    """Return a record of plays, whose discrepancy is smooth."""
    return thinned(records(2)[0])


def plain(sensor: float, rough: float) -> Record:
    """Return a record of a gain of 0.5 um/V, with a rough discrepancy or none."""
    rng = np.random.default_rng(3)
    record = plays()
    slow = autoregressive(0.98, record.samples, (), rng)
    noise = rough * slow + sensor * rng.standard_normal(record.samples)
    return replace(record, displacement=0.5 * record.voltage + noise)


@pytest.mark.parametrize(
    ("made", "expected"),
    [
        (plays, {"smooth"}),
        (partial(plain, 0.05, 1.0), {"discrepancy"}),
        # White noise alone is a limit of the others, which lose next to nothing by it.
        (partial(plain, 0.3, 0.0), {"discrepancy", "white"}),
    ],
    ids=["plays", "rough", "white"],
)
def test_the_noise_is_chosen_by_evidence(
    made: Callable[[], Record], expected: set[str], tmp_path: Path
) -> None:
    write_record(made(), tmp_path / "record.h5")
    problem = resolve_config(parse(CONFIG, "config"), tmp_path)
    point = pointfit.fit(problem.study.posterior, problem.study.generator("point fit"))
    noise, why = chosen_noise(problem.study, point)
    assert noise in expected
    assert why.startswith(f"noise: {noise} (")
    # A noise that could not gain anything is not fitted, which is said.
    compared = why.count("nats against") + why.count("a tie with")
    assert compared == 1 + ("innovations are white" not in why)
    assert ("innovations are white" in why) == (expected != {"smooth"})


def saturating() -> Record:
    """Return a record of plays that saturate and creep, under a unipolar triangle that shrinks."""
    time = 0.02 * np.arange(2500)
    wave = 2 / np.pi * np.arcsin(np.sin(0.4 * np.pi * time - np.pi / 2))
    voltage = 50 + 50 * wave * np.linspace(1, 0.3, time.size)
    weights = {0: 0.4, 5: 0.1, 10: 0.08, 20: 0.06, 30: 0.05}
    loops = sum(weight * play(voltage, threshold) for threshold, weight in weights.items())
    moved = 30 * np.tanh(loops / 45)
    crept = np.zeros(time.size)
    for lag in (0.2, 2.0, 20.0, 200.0):
        keep = np.exp(-0.02 / lag)
        crept += scipy.signal.lfilter([0.03 * (1 - keep)], [1, -keep], moved)
    noise = 0.05 * np.random.default_rng(1).standard_normal(time.size)
    return Record(voltage, moved + crept + noise, interval=0.02)


def test_a_noise_that_takes_up_the_readings_is_not_chosen(tmp_path: Path) -> None:
    """It has more evidence, and the model beside it misses more than a constant would."""
    write_record(saturating(), tmp_path / "record.h5")
    windows = [[0.0, 5.0], [7.5, 15.0], [17.5, 25.0], [27.5, 35.0], [37.5, 45.0], [47.5, 50.0]]
    config = parse(f'[record]\nfile = "record.h5"\ntrain = {windows}\n', "config")
    problem = resolve_config(config, tmp_path)
    point = pointfit.fit(problem.study.posterior, problem.study.generator("point fit"))
    rough = climb(problem.study.posterior, point.optima)
    other = problem.study.with_model(replace(problem.study.spec, noise="smooth")).posterior
    starts = [
        dict(zip(problem.study.posterior.names, place, strict=True)) for place in point.optima
    ]
    places = [[start.get(name, 0.0) for name in other.names] for start in starts]
    smooth = climb(other, np.array(places))
    assert smooth.log_evidence > rough.log_evidence
    assert rough.follows
    assert not smooth.follows
    assert chosen_noise(problem.study, point)[0] == "discrepancy"


def test_the_noise_of_several_records_is_chosen_too(tmp_path: Path) -> None:
    for name, record in zip("ab", records(2), strict=True):
        write_record(thinned(record), tmp_path / f"{name}.h5")
    text = "".join(f'[record.{n}]\nfile = "{n}.h5"\nfrom_rest = true\n' for n in "ab")
    text += "[parameters]\n'offset[b]' = { fixed = 0.5 }\n"
    problem = resolve_config(
        parse(f'{text}[model]\nper_record = ["sensor_sd"]\n', "config"), tmp_path
    )
    point = pointfit.fit(problem.study.posterior, problem.study.generator("point fit"))
    noise, why = chosen_noise(problem.study, point)
    assert noise == "smooth"
    assert why.count("nats against") == 2
    chosen = with_noise(problem, noise).study.posterior
    new = ["discrepancy_quality"]
    assert sorted(chosen.names) == sorted([*problem.study.posterior.names, *new])
    assert {"sensor_sd[a]", "offset[a]"} < set(chosen.names)
    assert "offset[b]" not in chosen.names


@pytest.mark.usefixtures("_without_explanations", "_without_pictures")
def test_a_check_takes_the_noise_that_a_run_would(tmp_path: Path) -> None:
    write_record(plays(), tmp_path / "record.h5")
    report = check(parse(NOT_SEARCHED, "config"), tmp_path, tmp_path / "out")
    assert "noise: smooth (" in report.about
    page = (tmp_path / "out" / "check.html").read_text(encoding="utf-8")
    assert "discrepancy_quality" in page


@pytest.mark.usefixtures("_without_explanations")
def test_a_run_says_its_noise_and_keeps_it(tmp_path: Path) -> None:
    write_record(plays(), tmp_path / "record.h5")
    config = parse(f'{NOT_SEARCHED}noise = "auto"\n[sampling]\nsteps = 50\n', "config")
    folder = RunFolder.create(tmp_path / "run", resolve_config(config, tmp_path))
    console = Console(file=io.StringIO(), width=200)
    fit = resume(folder, console, workers=1, files=False)
    assert fit.config.model.noise == "smooth"
    assert "discrepancy_quality" in fit.study.posterior.names
    assert 'noise = "smooth"' in folder.config.read_text(encoding="utf-8")
    said = console.file.getvalue()  # type: ignore[attr-defined]
    assert said.count("noise: smooth") == 1
    again = Console(file=io.StringIO(), width=200)
    resume(folder, again, workers=1, steps=100, files=False)
    assert "noise:" not in again.file.getvalue()  # type: ignore[attr-defined]


def test_models_that_tie_keep_what_the_search_did_later() -> None:
    """A stage that tied stands in the place of the one chosen; one that was left out is not back.

    A model with the same stages, but for another hold, is no other model.
    """
    base = ModelSpec()
    chosen = base.with_stages("amplifier-lag")
    others = [
        base.with_stages("sensor-lag"),
        base.with_stages("duhem"),
        replace(chosen, hold="zero"),
    ]
    ended = chosen.with_stages("backlash")

    def chains(ended: ModelSpec, chosen: ModelSpec, *others: ModelSpec) -> list[tuple[str, ...]]:
        causes = [Explanation("tie", "a tie", "none", nats=9.0, spec=other) for other in others]
        found = explaining._tied(ended, [(chosen, causes)])
        return [tied.spec.chain for tied in found if tied.spec]

    tied = chains(ended, chosen, *others)
    assert tied == [("bouc-wen", "lag", "backlash", "sensor-lag"), ("duhem", "lag", "backlash")]
    (left,) = chains(base.with_stages("cubic"), base, base.with_stages("cubic", "drift"))
    assert "drift" in left
